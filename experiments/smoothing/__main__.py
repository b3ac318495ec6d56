"""What does rounding the corners of contact law and timing gear change?

Writes smoothing.csv (a row per scene and length), smoothing.json and smoothing.png, updated after
every kind of scene. The exit code is 3 unless the default's bias is below the limit.
"""

import argparse
import sys
from typing import TYPE_CHECKING

from experiments._common.driver import Run, drive, verdict

if TYPE_CHECKING:
    from experiments.smoothing.study import Measured

FIGURES = {"smoothing.png": "smoothing.png"}


def body(run: Run) -> int:
    """Measure all kinds of scenes, write results after every kind, and print the counts."""
    from experiments.smoothing import figures, study

    def keep(found: "list[Measured]") -> None:
        # Save after each kind: the last one compiles for long.
        run.csv("smoothing.csv", [row for one in found for row in study.rows_of(one)])
        run.json("smoothing.json", {one.kind: study.summary(one) for one in found})
        run.figure("smoothing.png", figures.lengths(found))

    found = study.run(run.quick, run.options.count, run.options.seed, run.say, keep)
    for one in found:
        part = study.summary(one)
        print(f"{one.kind}: {part['settled']} of {part['scenes']} scenes settle")
        for width, row in part["by_width"].items():
            print(f"  {width} mm: {row}")
    return verdict(study.within_limit(found))


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add options for the number of random scenes and the seed."""
    parser.add_argument("--count", type=int, help="random scenes of CIC; fewer of the others")
    parser.add_argument("--seed", type=int, default=0, help="seed of the draw (default: 0)")


def main() -> int:
    """Run the study."""
    return drive(
        "smoothing",
        __doc__,
        body,
        quick="a few scenes of CIC",
        published=FIGURES,
        add_options=add_options,
        cache=True,
    )


if __name__ == "__main__":
    sys.exit(main())
