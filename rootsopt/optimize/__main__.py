"""`python -m rootsopt.optimize CONFIG`: an optimised design against the baseline."""

import argparse
import contextlib
import time
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from rootsopt import door

if TYPE_CHECKING:
    from rootsopt.cli import Outcome
    from rootsopt.config import Config
    from rootsopt.runs import RunFolder

PURPOSE = "Optimise the design parameters for low contact force and compare with the baseline."


def body(config: "Config", options: argparse.Namespace, folder: "RunFolder") -> "Outcome":
    """Check, search, write, print."""
    began = time.perf_counter()
    from rich.console import Console

    from rootsopt import auto, files, report
    from rootsopt.model import check_geometry
    from rootsopt.optimize.search import Search
    from rootsopt.timing import CompileClock

    formats = export.chosen(options.export)
    check_geometry(config)
    folder = files.ResultFolder(options.output)
    clock = CompileClock()
    with clock, _progress(Console(stderr=True)) as progress:
        config, choice = auto.resolve(config)
        result = Search(config, progress).run()
    ran = time.perf_counter() - began
    alike = _alike(config, result)
    _write(folder, config, options, result, choice | alike, clock.seconds, ran)
    if result.optimized is not None:
        export.write_simulated(folder, config, formats, result.optimized)
    out = Console()
    baseline = result.baseline.record().get("speeds")
    if result.optimized is None:
        out.print(report.evaluation_table(result.baseline))
        if baseline:
            out.print(report.speeds_table(baseline))
        out.print(_no_result(result))
    else:
        numbers = result.constraints, result.improvement
        out.print(report.comparison_table(result.baseline, result.optimized, *numbers))
        if baseline:
            optimized = result.optimized.record()["speeds"]
            out.print(report.speeds_table(baseline, optimized, result.objective_by_speed))
        if alike:
            out.print(report.likeness_table(alike["resembles"]))
    total = time.perf_counter() - began
    out.print(
        f"compile {clock.seconds:.1f} s, run {ran - clock.seconds:.1f} s, "
        f"reports {total - ran:.1f} s; results in {options.output}",
        soft_wrap=True,
    )
    return cli.OK if result.optimized is not None else cli.NO_RESULT


def _alike(config: Config, result) -> dict:
    """What a free form that was found resembles, for report and result file."""
    if config.profile.family != "free_form" or result.optimized is None:
        return {}
    import jax.numpy as jnp

    from rootsopt.model import Model
    from rootsopt.resemblance import likenesses

    design = list(result.optimized.design.values())
    found = likenesses(Model.of(config).profile(jnp.asarray(design)))
    return {"resembles": [one.record() for one in found]}


def _no_result(result) -> str:
    from rootsopt.optimize import noise

    if not result.baseline.usable:
        return f"baseline {result.baseline.status.label}: {result.baseline.message}"
    if message := noise.message(result.verification):
        return message
    if result.verification.get("rejected"):
        return (
            "No better design held up when simulated again from rest at the tight tolerance. "
            "Raise optimizer.iterations or optimizer.screening, or tighten solver.rtol."
        )
    return (
        "No feasible design better than the baseline was found. Lower "
        "constraints.area_efficiency_min, widen optimizer.bounds, or raise optimizer.screening."
    )


def _write(folder, config, options, result, choice, compiled, ran) -> None:
    from rootsopt import files
    from rootsopt.families import with_design
    from rootsopt.model import outline_mm

    records = {"baseline": result.baseline, "optimized": result.optimized}
    files.write_config(folder, config)
    if result.optimized is not None:
        profile = with_design(config.profile, list(result.optimized.design.values()))
        best = config.model_copy(update={"profile": profile})
        folder.write_text("optimized.yaml", best.to_yaml())
    data: dict = {name: e.record() if e is not None else None for name, e in records.items()}
    for name, evaluation in records.items():
        if evaluation is None:
            continue
        design = list(evaluation.design.values())
        folder.write_csv(f"profile_{name}.csv", files.profile_columns(outline_mm(config, design)))
        if evaluation.series is not None:
            folder.write_csv(f"response_{name}.csv", files.response_columns(evaluation.series))
    rows = result.history
    if rows:
        folder.write_csv("history.csv", {key: [row[key] for row in rows] for key in rows[0]})
    data |= choice
    data["improvement"] = result.improvement
    data["constraints"] = result.constraints
    if config.objective.speeds_rpm and result.optimized is not None:
        data["objective_by_speed"] = result.objective_by_speed
    data["verification"] = result.verification
    data["statistics"] = {
        "evaluations": len(rows),
        "compile_seconds": compiled,
        "run_seconds": ran - compiled,
    }
    data["versions"] = files.versions()
    folder.write_json("result.json", data)
    if not options.no_figures:
        from rootsopt import plot

        if result.optimized is not None:
            plot.optimization_figures(folder, result.baseline, result.optimized, rows, config)
        else:
            plot.simulation_figures(folder, result.baseline, config)
        if config.objective.speeds_rpm:
            from rootsopt.plot_speeds import speed_figure

            names = {"baseline": result.baseline, "optimised": result.optimized}
            designs = {name: one.parts for name, one in names.items() if one is not None}
            speed_figure(folder, designs, "Contact force over the speeds of the objective")


@contextlib.contextmanager
def _progress(console) -> Iterator:
    """A progress bar with the current best objective on a terminal, nothing in a pipe."""
    if not console.is_terminal:
        yield None
        return
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.completed}/{task.total} designs"),
        TextColumn("best objective {task.fields[best]}"),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=console) as bar:
        task = bar.add_task("baseline, compiling", total=None, best="-")

        def update(done: int, expected: int, best: float) -> None:
            bar.update(
                task, description="optimising", completed=done, total=expected, best=f"{best:.4f}"
            )

        yield update


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    return door.through("optimize", lambda: _run(argv), own=argv is None)


def _run(argv: Sequence[str] | None) -> int:
    from rootsopt import cli, export

    return cli.run("optimize", PURPOSE, body, argv, lambda p: export.add_option(p, "none"))


if __name__ == "__main__":
    door.leave(main())
