"""`rootsopt pareto CONFIG`: trace the best compromises between two or three terms."""

import contextlib
import time
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

from rootsopt.commands import door

if TYPE_CHECKING:
    import argparse

    from rootsopt.commands.cli import Outcome
    from rootsopt.config import Config
    from rootsopt.output.runs import RunFolder
    from rootsopt.tradeoffs.front import Front

PURPOSE = (
    "Trace the best compromises between two or three terms, such as peak force and area "
    "efficiency (pareto.terms)."
)
_PATIENCE = 5.0
"""Time (s) after an interrupt above which the command no longer waits for the search to end.

In this time, the simulation in progress may end."""


def body(config: "Config", options: "argparse.Namespace", folder: "RunFolder") -> "Outcome":
    """Run `rootsopt pareto`: trace the front, and write files into `folder`.

    Return the `Outcome`. Raises `InputError` if the config is invalid."""
    began = time.perf_counter()
    from rich.console import Console

    from rootsopt.commands import cli
    from rootsopt.output import files, fronts, tables
    from rootsopt.runtime.environment import say
    from rootsopt.runtime.timing import CompileClock
    from rootsopt.scene import check_geometry

    check_geometry(config)
    clock = CompileClock()
    promise = "keeping the points found so far and writing the files"
    with clock, door.patience(promise) as stop, _progress(Console(stderr=True)) as progress:
        config, choice, front = _traced(config, progress, stop)
    if front is None:
        return _nothing_known(config, folder)
    ran = time.perf_counter() - began
    record = front.record()
    seconds = {"compile_seconds": clock.seconds, "run_seconds": ran - clock.seconds}
    record["statistics"] |= seconds
    files.write_config(folder, config)
    fronts.write_front(folder, front)
    folder.write_json("result.json", choice | record | {"versions": files.versions()})
    if front.points and not options.no_figures:
        from rootsopt.figures import page
        from rootsopt.figures.front import front_figure

        front_figure(folder, front)
        if page.available():
            page.write_page(folder, front)
        else:
            say(page.MISSING)
    if front.interrupted and not front.points:
        folder.overwrite = False  # An earlier result is more valuable than this one.

    def show(out: Console) -> None:
        if front.infeasible is not None:
            out.print(tables.conflict_table(record["infeasible"]["conflicts"]))
        elif front.baseline_terms:
            out.print(tables.front_table(record))
        out.print(f"{front.status.label}: {front.message}", soft_wrap=True)
        out.print(
            f"{front.searches} searches, {front.evaluations} designs, compile "
            f"{clock.seconds:.1f} s, run {ran - clock.seconds:.1f} s",
            soft_wrap=True,
        )

    found = front.certified > 0 and not front.interrupted
    return cli.Outcome(cli.OK if found else cli.NO_RESULT, show)


def _traced(config: "Config", progress, stop) -> "tuple[Config, dict[str, Any], Front | None]":
    """Trace the front; return (config, settings chosen for `auto`, front).

    In the returned config, the chosen settings replace `auto`. The front is `None` if the search
    was stopped before the baseline was evaluated."""
    from rootsopt.optimize.search import until_stopped
    from rootsopt.response.choice import resolve
    from rootsopt.tradeoffs.trace import Tracer

    state: dict[str, Any] = {"config": config, "choice": {}}

    def work():
        state["config"], state["choice"] = resolve(config)
        state["tracer"] = Tracer(state["config"], progress, stop)
        return state["tracer"].run()

    front = until_stopped(work, stop, _PATIENCE)
    if front is None and "tracer" in state:
        front = state["tracer"].so_far()
    return state["config"], state["choice"], front


def _nothing_known(config: "Config", folder: "RunFolder") -> "Outcome":
    """Write the files of a run that was stopped before the baseline was evaluated.

    Return the `Outcome`, with exit code 3."""
    from rootsopt.commands import cli
    from rootsopt.output import files
    from rootsopt.status import Status

    status = Status.INTERRUPTED
    message = "The run was stopped before the baseline had been evaluated: there is no result."
    files.write_config(folder, config)
    data = {"points": [], "status": status.label, "message": message}
    folder.write_json("result.json", data | {"versions": files.versions()})
    folder.overwrite = False  # An earlier result is more valuable than this one.
    text = f"{status.label}: {message}"
    return cli.Outcome(cli.NO_RESULT, lambda out: out.print(text, soft_wrap=True))


@contextlib.contextmanager
def _progress(console) -> Iterator:
    """Yield a function (searches done, searches expected) that updates a progress bar.

    Yield `None` if the console is not a terminal, where no progress bar is shown."""
    if not console.is_terminal:
        yield None
        return
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.completed}/{task.total} searches"),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=console) as bar:
        task = bar.add_task("baseline and screening", total=None)

        def update(done: int, expected: int) -> None:
            bar.update(task, description="tracing the front", completed=done, total=expected)

        yield update


def main(argv: Sequence[str] | None = None) -> int:
    """Run `rootsopt pareto` with the arguments `argv` (`None`: those of the process).

    Return the exit code."""
    return door.through("pareto", lambda: _run(argv), own=argv is None)


def _run(argv: Sequence[str] | None) -> int:
    from rootsopt.commands import cli

    return cli.run("pareto", PURPOSE, body, argv)
