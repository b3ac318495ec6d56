"""Does `solver.accuracy` bound the errors, and does a coarser one save time?

Writes accuracy.csv (a row per scene and accuracy), accuracy.json and accuracy.png. The exit code is
3 if fewer than 95 % of the errors are within an accuracy.
"""

import argparse
import sys

from experiments._common.driver import Run, drive, verdict

FIGURES = {"accuracy.png": "accuracy.png"}


def body(run: Run) -> int:
    """Measure errors and times, write results, print the table."""
    from experiments._common.tables import show
    from experiments.accuracy import figures, study

    rows = study.run(run.quick, run.options.count, run.options.seed, run.say)
    table = study.summary(rows)
    run.csv("accuracy.csv", rows)
    run.json("accuracy.json", {"table": table})
    run.figure("accuracy.png", figures.errors(rows))
    show("Accuracy asked for and reached", table)
    return verdict(all(row["within"] >= 0.95 for row in table))


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add options for the number of random scenes and the seed."""
    parser.add_argument("--count", type=int, default=60, help="periodic scenes (default: 60)")
    parser.add_argument("--seed", type=int, default=0, help="seed of the draw (default: 0)")


def main() -> int:
    """Run the study."""
    return drive(
        "accuracy",
        __doc__,
        body,
        quick="one scene",
        published=FIGURES,
        add_options=add_options,
    )


if __name__ == "__main__":
    sys.exit(main())
