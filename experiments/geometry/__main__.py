"""How exact are area and inertia of every profile family?

Writes geometry.csv (a row per family and number of lobes, with the largest relative errors and the
design that has them) and geometry.png.
"""

import argparse
import sys

from experiments._common.driver import OK, Run, drive

FIGURES: dict[str, str] = {}


def body(run: Run) -> int:
    """Compare areas and inertias with polygons, write results, print the table."""
    from experiments._common.tables import show
    from experiments.geometry import figures, study

    rows = study.run(run.quick, run.options.draws, run.options.seed, run.say)
    run.csv("geometry.csv", rows)
    run.figure("geometry.png", figures.errors(rows))
    show("Area and inertia against polygons", rows)
    return OK


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add options for the number of random designs and the seed."""
    parser.add_argument(
        "--draws", type=int, default=2000, help="designs drawn of each kind (default: 2000)"
    )
    parser.add_argument("--seed", type=int, default=0, help="seed of the draw (default: 0)")


def main() -> int:
    """Run the study."""
    return drive(
        "geometry",
        __doc__,
        body,
        quick="three families, two and three lobes, few designs",
        published=FIGURES,
        add_options=add_options,
    )


if __name__ == "__main__":
    sys.exit(main())
