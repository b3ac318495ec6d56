"""The work of `rootsopt pareto`."""

import argparse
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, closing

from rich.console import Console

from rootsopt.commands import cli, door
from rootsopt.commands.work.searching import (
    CompileClock,
    checkpoint_of,
    nothing_known,
    progress_bar,
    runs_of,
    searched,
)
from rootsopt.config import Config
from rootsopt.output import files
from rootsopt.output.runs import RunFolder
from rootsopt.scene import check_geometry
from rootsopt.tradeoffs.trace import Tracer


def body(config: Config, options: argparse.Namespace, folder: RunFolder) -> cli.Outcome:
    """Run `rootsopt pareto`: trace the front, and write files into `folder`.

    Return the `Outcome`. Raises `InputError` if the config is invalid."""
    began = time.perf_counter()
    check_geometry(config)
    cli.load_figures(options, "front")
    clock = CompileClock()
    promise = "keeping the points found so far and writing the files"
    with (
        clock,
        door.patience(promise) as stop,
        runs_of(options) as runs,
        _progress(Console(stderr=True)) as progress,
        closing(checkpoint_of("pareto", config, options, folder)) as checkpoint,
    ):
        front = searched(lambda: Tracer(config, progress, stop, runs, checkpoint), stop)
    if not stop.is_set():  # A stopped search can go on later.
        folder.remove_afterwards(folder.checkpoint)
    if front is None:
        return nothing_known(config, folder, "evaluated", {"points": []})
    ran = time.perf_counter() - began
    record = front.record()
    seconds = {"compile_seconds": clock.seconds, "run_seconds": ran - clock.seconds}
    record["statistics"] |= seconds
    files.write_config(folder, config)
    if front.points:
        folder.write_csv("front.csv", files.row_columns([point.row() for point in front.points]))
    for point in front.points:
        text = front.config_of(point).to_yaml()
        folder.write_text(files.design_file(point.number), text)
    folder.write_json("result.json", record | {"versions": files.versions()})
    if front.points and not options.no_figures:
        from rootsopt.figures.front import front_figure

        front_figure(folder, front)
    if front.interrupted and not front.points:
        folder.overwrite = False  # An earlier result is more valuable than this one.
    line = (
        f"{front.searches} searches, {front.evaluations} designs, compile "
        f"{clock.seconds:.1f} s, run {ran - clock.seconds:.1f} s"
    )
    found = front.certified > 0 and not front.interrupted
    return cli.Outcome(cli.OK if found else cli.NO_RESULT, [line])


def _progress(console) -> "AbstractContextManager[Callable[..., None] | None]":
    """Return a context manager for a function (searches done, searches expected), as
    `progress_bar`."""
    return progress_bar(console, "baseline and screening", "tracing the front", "searches")
