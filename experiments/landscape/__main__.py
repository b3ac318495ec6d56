"""How good is the optimum, compared with an exhaustive grid of designs?

Writes landscape.csv (a row per design), landscape.json and landscape.png. The exit code is 3 unless
the optimum is within one percent of the best of the grid.
"""

import argparse
import sys

from experiments._common.driver import Run, drive, verdict

FIGURES = {"landscape.png": "landscape.png"}


def body(run: Run) -> int:
    """Optimise, simulate the grid, write results, print the comparison."""
    from experiments._common.tables import print_record
    from experiments.landscape import figures, study

    results = study.run(run.quick, run.options.config, run.options.designs, run.say)
    found = results.record()
    run.csv("landscape.csv", results.rows)
    run.json("landscape.json", found)
    run.figure("landscape.png", figures.designs(results))
    print_record(found)
    return verdict(found["within_one_percent"])


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add options for the config and the size of the grid."""
    parser.add_argument(
        "config", nargs="?", default="configs/cic.yaml", help="(default: %(default)s)"
    )
    parser.add_argument(
        "--designs", type=int, default=2000, help="minimum number of designs (default: 2000)"
    )


def main() -> int:
    """Run the study."""
    return drive(
        "landscape",
        __doc__,
        body,
        quick="a coarse grid, linear contact, one start",
        published=FIGURES,
        add_options=add_options,
    )


if __name__ == "__main__":
    sys.exit(main())
