"""`rootsopt simulate CONFIG`: simulate one design in one scene."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from rootsopt.commands import door

if TYPE_CHECKING:
    import argparse

    from rootsopt.commands.cli import Outcome
    from rootsopt.config import Config
    from rootsopt.output.runs import RunFolder

PURPOSE = "Simulate one design in one scene: steady state, contact force, its gradient."


def body(config: "Config", options: "argparse.Namespace", folder: "RunFolder") -> "Outcome":
    """Run `rootsopt simulate`: simulate the design, and write files into `folder`.

    Return the `Outcome`. Raises `InputError` if the config or an option is invalid."""
    from rich.console import Console

    from rootsopt import export
    from rootsopt.commands import cli
    from rootsopt.measured import report as outline_report
    from rootsopt.output import files, tables
    from rootsopt.response.choice import resolve
    from rootsopt.response.evaluators import evaluator_for
    from rootsopt.response.speeds import alone
    from rootsopt.scene import check_geometry, outline_mm

    formats = export.chosen(options.export)
    check_geometry(config)
    with cli.waiting(Console(stderr=True), "compiling and simulating"):
        config, choice = resolve(config)
        evaluation = evaluator_for(alone(config))()
    files.write_config(folder, config)
    folder.write_csv("profile_design.csv", files.profile_columns(outline_mm(config)))
    if evaluation.series is not None:
        folder.write_csv("response_design.csv", files.response_columns(evaluation.series))
    data = evaluation.record() | choice | outline_report.record(config)
    folder.write_json("result.json", data | {"versions": files.versions()})
    export.write_simulated(folder, config, formats, evaluation)
    if not options.no_figures:
        from rootsopt.figures import runs

        runs.simulation_figures(folder, evaluation, config)

    def show(out: Console) -> None:
        out.print(tables.evaluation_table(evaluation))
        outline_report.say(config, out)

    return cli.Outcome(cli.OK if evaluation.usable else cli.NO_RESULT, show)


def main(argv: Sequence[str] | None = None) -> int:
    """Run `rootsopt simulate` with the arguments `argv` (`None`: those of the process).

    Return the exit code."""
    return door.through("simulate", lambda: _run(argv), own=argv is None)


def _run(argv: Sequence[str] | None) -> int:
    from rootsopt import export
    from rootsopt.commands import cli

    return cli.run("simulate", PURPOSE, body, argv, lambda p: export.add_option(p, "none"))
