"""Shared parts of the commands that search or sweep: `optimize`, `pareto` and `sweep`."""

import argparse
import contextlib
import os
import time
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any, Protocol, TypeVar

import jax
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from rootsopt.commands import cli, door
from rootsopt.config.reading import Config
from rootsopt.response.journal import Checkpoint, Journal, header_of, set_aside
from rootsopt.response.reducers import Runs
from rootsopt.response.sweeps.cluster import running
from rootsopt.runtime.environment import say
from rootsopt.runtime.threads import until_stopped
from rootsopt.status import Status
from rootsopt.view.runs import RunFolder

Result = TypeVar("Result", covariant=True)
PATIENCE = 5.0
"""Time (s) after an interrupt above which a command no longer waits for its search to end.

In this time, the simulation in progress may end, and the best design may be simulated again."""


class Searches(Protocol[Result]):
    """A search: `run` returns its outcome.

    `so_far` returns the results so far, or `None` before the baseline is known."""

    def run(self) -> Result: ...

    def so_far(self) -> Result | None: ...


J = TypeVar("J", bound=Journal)


def runs_of(options: argparse.Namespace) -> contextlib.AbstractContextManager[Runs]:
    """Return a context manager of the `Runs` that the `options` name: this process, or workers."""
    if options.workers is not None:
        say(
            f"`--workers {options.workers}` starts processes that load everything again, some 10 s "
            f"each, and then are no faster than this process, which uses all {os.cpu_count() or 1} "
            "cores; leave it out unless a design may end its process"
        )
    return running(options.workers, options.scheduler, options.imports, not options.no_cache)


def opened(make: Callable[[Path, bool], J], options: argparse.Namespace, folder: RunFolder) -> J:
    """Return the journal of this run, beside the result folder.

    `make`: function that opens it, given its path and whether to resume. With the option
    `--resume`, it begins with the results of the interrupted run. Without it, an existing journal
    is moved aside until a run has ended."""
    path = folder.checkpoint
    older = None if options.resume else set_aside(path)
    if older is not None:
        say(
            f"an interrupted run has left a checkpoint, which is now {str(older)!r} and is deleted "
            f"when this run ends; to go on with the interrupted run, stop this one, move the file "
            f"back to {path.name!r}, and add `--resume`"
        )
    journal = make(path, options.resume)
    if journal.damage:
        say(journal.damage)
    return journal


def searched(
    command: str,
    config: Config,
    options: argparse.Namespace,
    folder: RunFolder,
    make: Callable[..., Searches[Result]],
    bar: contextlib.AbstractContextManager,
    kept: str,
) -> tuple[Result | None, float]:
    """Run the search of a `command`; return its outcome and the time (s) spent on compiling.

    `make`: makes the search, with the keywords `progress`, `stop`, `checkpoint` and `runs`; `bar`:
    the progress bar; `kept`: what is kept if the user stops the search, in words. The
    outcome is `None` if the search was stopped before the baseline was known."""
    made: list[Searches[Result]] = []
    make_checkpoint = partial(Checkpoint, header_of(command, config, options.imports))
    with (
        CompileClock() as clock,
        door.patience(f"keeping {kept} and writing the files") as stop,
        runs_of(options) as runs,
        bar as progress,
        contextlib.closing(opened(make_checkpoint, options, folder)) as checkpoint,
    ):

        def work():
            made.append(
                make(config, progress=progress, stop=stop, checkpoint=checkpoint, runs=runs)
            )
            return made[0].run()

        outcome = until_stopped(work, stop, PATIENCE)
        outcome = made[0].so_far() if outcome is None and made else outcome
    if not stop.is_set():  # A stopped search can go on later.
        folder.remove_afterwards(folder.checkpoint)
    return outcome, clock.seconds


def nothing_known(folder: RunFolder, done: str, empty: Mapping[str, Any]) -> cli.Outcome:
    """Return the outcome of a run into `folder` that was stopped before the baseline was known.

    `done`: past participle for the message, such as "simulated"; `empty`: entries of the result
    file that have no value."""
    message = f"The run was stopped before the baseline had been {done}: there is no result."
    folder.overwrite = False  # An earlier result is more valuable than this one.
    return cli.Outcome(False, {**empty, "status": Status.INTERRUPTED.label, "message": message})


@contextlib.contextmanager
def progress_bar(
    first: str, then: str, counted: str, field: str = ""
) -> Iterator[Callable[..., None] | None]:
    """Yield a function (done, expected, …) that updates a progress bar on stderr.

    Yield `None` if stderr is not a terminal, where no progress bar is shown. `first`: text until
    the first update, `then`: text from there on; `counted`: what the bar counts; `field`: name of
    the number that is the function's third argument ("": the function has none).

    At the end, the bar is full and states the number counted."""
    console = Console(stderr=True)
    if not console.is_terminal:
        yield None
        return

    columns = [
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.fields[count]}"),
        *([TextColumn(field + " {task.fields[shown]}")] if field else []),
        TimeElapsedColumn(),
    ]
    with Progress(*columns, console=console) as bar:
        task = bar.add_task(first, total=None, shown="-", count="")

        def update(done: int, expected: int, *shown: float) -> None:
            text, count = f"{shown[0]:.4f}" if shown else "-", f"{done}/{expected} {counted}"
            bar.update(
                task, description=then, completed=done, total=expected, shown=text, count=count
            )

        yield update
        row = bar.tasks[0]
        if row.total is not None:  # Most searches need less than the expected number.
            count = f"ended after {row.completed:g} {counted}"
            bar.update(task, total=row.completed, count=count)


_COMPILE_EVENTS = (
    "/jax/core/compile/jaxpr_trace_duration",
    "/jax/core/compile/jaxpr_to_mlir_module_duration",
    "/jax/core/compile/backend_compile_duration",
)


class CompileClock(contextlib.AbstractContextManager):
    """Measures the time spent on tracing, lowering and compiling, to the end of a `with` block.

    JAX reports the duration of each of these steps. Steps overlap, because programs compile in
    parallel and traces are nested. The clock therefore counts the time during which at least one
    step was running."""

    def __init__(self) -> None:
        self._spans: list[tuple[float, float]] = []
        self._running = True
        jax.monitoring.register_event_duration_secs_listener(self._listen)

    @property
    def seconds(self) -> float:
        """Time measured so far (s)."""
        total, reached = 0.0, float("-inf")
        for begin, end in sorted(self._spans):
            total += max(0.0, end - max(begin, reached))
            reached = max(reached, end)
        return total

    def __exit__(self, *error: object) -> None:
        self._running = False

    def _listen(self, event: str, duration_secs: float, **_: object) -> None:
        if self._running and event in _COMPILE_EVENTS:
            now = time.perf_counter()
            self._spans.append((now - duration_secs, now))
