"""Do orbits closed by collocation agree with those closed by shooting, and what do they cost?

Writes orbits.csv (updated after each pair) and orbits.png. The exit code is 3 if the
forces of an orbit differ by more than 1e-4.

With `--speed`, times value and gradient from a neighbour's orbit instead, against the other ways,
SciPy and Numba, on one core. Writes speed.csv.

With `--batches`, times value and gradient of batches of designs, on the device that JAX_PLATFORMS
names ("cuda,cpu" for a GPU) or on the CPU. Writes batches.csv.
"""

import argparse
import os
import sys
from typing import TYPE_CHECKING

from experiments._common.driver import Run, drive, verdict

if TYPE_CHECKING:
    from experiments.orbits.study import Row

FIGURES: dict[str, str] = {}
_AGREE = 1e-4
"""Relative difference of forces above which the two solvers disagree."""


def body(run: Run) -> int:
    """Compare, write and draw."""
    from experiments.orbits import figures, study

    def keep(rows: "list[Row]") -> None:
        run.csv("orbits.csv", rows)

    options = run.options
    if options.speed:
        return _timed(run)
    if options.batches is not None:
        return _batches(run)
    if not options.draw:
        study.run(run.quick, options.count, options.seed, run.say, keep)
    rows = study.read(run.folder.path)
    run.figure("orbits.png", figures.differences_of(rows))
    found = study.judge(rows)
    for line in found.lines():
        print(line)
    worst = max(found.differences[f"{name}_difference"][0] for name in study.FORCES)
    return verdict(worst <= _AGREE)


def _timed(run: Run) -> int:
    """Time the scenes named on one core, and print the table."""
    if hasattr(os, "sched_setaffinity"):  # before JAX starts its threads
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    from experiments.orbits import speed

    rows: list[speed.Row] = []
    for scene in run.options.speed:
        rows += speed.rows_of(scene, 3 if run.quick else 20, run.say)
        run.csv("speed.csv", rows)
    for line in speed.lines(rows):
        print(line)
    return verdict(all("ms" in row for row in rows))


def _batches(run: Run) -> int:
    """Time batches of designs, and print the table."""
    from experiments.orbits import batches

    rows: list[batches.Row] = []
    for row in batches.rows_of(run.options.batches or [*batches.SIZES], run.say):
        rows.append(row)
        run.csv("batches.csv", rows)
        run.say(batches.lines(rows[-1:])[1])
    for line in batches.lines(rows):
        print(line)
    return verdict(all(row["force_difference"] <= _AGREE for row in rows))


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add options for size and seed of the draw, and for drawing alone."""
    parser.add_argument("--count", type=int, default=72, help="pairs (default: 72)")
    parser.add_argument("--seed", type=int, default=0, help="seed of the draw (default: 0)")
    parser.add_argument(
        "--speed",
        nargs="+",
        choices=("cic", "lively", "free form", "pump"),
        help="scenes in which to time orbits from a neighbour; no comparison of random pairs",
    )
    parser.add_argument(
        "--batches",
        nargs="*",
        type=int,
        metavar="SIZE",
        help="numbers of designs in a batch to time (default: 256 to 65536); no comparison of "
        "random pairs",
    )
    parser.add_argument(
        "--draw", action="store_true", help="measure nothing: table and figure of a former run"
    )


def main() -> int:
    """Run the study."""
    return drive(
        "orbits",
        __doc__,
        body,
        quick="two pairs of one kind",
        published=FIGURES,
        add_options=add_options,
    )


if __name__ == "__main__":
    sys.exit(main())
