"""How accurate are the reported gradients?

Writes gradients_K_of_N.csv (a part of the pairs, updated after each pair) and gradients.png, drawn
from all parts in the result folder. The exit code is 3 if a gradient error exceeds what its check
promises, or if a pair has a result at one tolerance but none at a finer tolerance.
"""

import argparse
import sys
from typing import TYPE_CHECKING

from experiments._common.driver import Run, drive, verdict

if TYPE_CHECKING:
    from experiments.gradients.study import Row

FIGURES = {"gradients.png": "gradients.png"}


def body(run: Run) -> int:
    """Measure and write one part of the pairs, then draw and print the table of all parts."""
    from experiments.gradients import figures, study

    options = run.options
    part, parts = options.part

    def keep(rows: "list[Row]") -> None:
        run.csv(f"gradients_{part}_of_{parts}.csv", rows)

    if not options.draw:
        draw = study.Draw(options.count, options.seed, (part, parts))
        study.run(run.quick, draw, run.say, keep)
    rows = study.read(run.folder.path)
    if parts == 1 or options.draw:
        run.figure("gradients.png", figures.errors_of(rows))
    found = study.judge(rows)
    for line in found.lines():
        print(line)
    return verdict(not found.broken)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add options for number, seed and part of the pairs, and for drawing without measuring."""
    parser.add_argument("--count", type=int, default=200, help="pairs (default: 200)")
    parser.add_argument("--seed", type=int, default=0, help="seed of the draw (default: 0)")
    parser.add_argument(
        "--part",
        type=part_of,
        default=(0, 1),
        metavar="K/N",
        help="every N-th kind, from the K-th on (default: 0/1)",
    )
    parser.add_argument(
        "--draw", action="store_true", help="measure nothing: table and figure of all parts"
    )


def part_of(text: str) -> tuple[int, int]:
    """Read a part K/N. Raises `ValueError` unless 0 ≤ K < N."""
    part, parts = (int(number) for number in text.split("/"))
    if not 0 <= part < parts:
        raise ValueError
    return part, parts


def main() -> int:
    """Run the study."""
    return drive(
        "gradients",
        __doc__,
        body,
        quick="four pairs of one kind",
        published=FIGURES,
        add_options=add_options,
    )


if __name__ == "__main__":
    sys.exit(main())
