"""Do orbits closed by collocation agree with those closed by shooting, and what do they cost?

Writes orbits.csv (updated after each pair) and orbits.png. The exit code is 3 if an orbit has
another period or its forces differ by more than 1e-4.
"""

import argparse
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
    if not options.draw:
        study.run(run.quick, options.count, options.seed, run.say, keep)
    rows = study.read(run.folder.path)
    run.figure("orbits.png", figures.differences_of(rows))
    found = study.judge(rows)
    for line in found.lines():
        print(line)
    worst = max(found.differences[f"{name}_difference"][0] for name in study.FORCES)
    return verdict(worst <= _AGREE and not found.other_period)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add options for size and seed of the draw, and for drawing alone."""
    parser.add_argument("--count", type=int, default=72, help="pairs (default: 72)")
    parser.add_argument("--seed", type=int, default=0, help="seed of the draw (default: 0)")
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
