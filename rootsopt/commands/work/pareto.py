"""`rootsopt pareto`: trace a front of best compromises, and write its files."""

import argparse
import time

from rootsopt.commands import cli
from rootsopt.commands.work.searching import nothing_known, progress_bar, searched
from rootsopt.config.reading import Config
from rootsopt.optimize.tradeoffs.trace import Tracer
from rootsopt.scene.check import check_geometry
from rootsopt.view import files
from rootsopt.view.runs import RunFolder


def body(config: Config, options: argparse.Namespace, folder: RunFolder) -> cli.Outcome:
    """Run `rootsopt pareto`: trace the front, and write files into `folder`.

    Return the `Outcome`. Raises `InputError` if the config is invalid."""
    began = time.perf_counter()
    check_geometry(config)
    bar = progress_bar("baseline and screening", "tracing the front", "searches")
    front, compiled = searched(
        "pareto", config, options, folder, Tracer, bar, "the points found so far"
    )
    if front is None:
        return nothing_known(folder, "evaluated", {"points": []})
    ran = time.perf_counter() - began
    record = front.record()
    record["statistics"] |= {"compile_seconds": compiled, "run_seconds": ran - compiled}
    if front.points:
        folder.write_csv("front.csv", files.row_columns([point.row() for point in front.points]))
    for point in front.points:
        folder.write_text(files.design_file(point.number), front.config_of(point).to_yaml())
    if front.points and not options.no_figures:
        from rootsopt.view.figures.comparisons import front_figure

        front_figure(folder, front)
    if front.interrupted and not front.points:
        folder.overwrite = False  # An earlier result is more valuable than this one.
    line = (
        f"{front.searches} searches, {front.evaluations} designs, compile "
        f"{compiled:.1f} s, run {ran - compiled:.1f} s"
    )
    return cli.Outcome(front.certified > 0 and not front.interrupted, record, [line])
