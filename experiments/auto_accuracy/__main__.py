"""Does `solver.fidelity: auto` keep within the requested error?

Writes auto.csv (a row per scene), auto.json and auto.png. The exit code is 3 if the true error of a
scene exceeds the requested error.
"""

import argparse
import sys

from experiments._common.driver import Run, drive, verdict

FIGURES = {"auto.png": "auto.png"}


def body(run: Run) -> int:
    """Measure the errors, write results, print the counts."""
    from experiments._common.tables import print_record
    from experiments.auto_accuracy import figures, study

    rows = study.run(run.quick, run.options.count, run.options.seed, run.say)
    found = study.summary(rows)
    run.csv("auto.csv", rows)
    run.json("auto.json", found)
    run.figure("auto.png", figures.errors(rows))
    print_record(found)
    return verdict(found["within_request"] == found["judged"])


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add options for the number of random scenes and the seed."""
    parser.add_argument("--count", type=int, default=50, help="periodic scenes (default: 50)")
    parser.add_argument("--seed", type=int, default=0, help="seed of the draw (default: 0)")


def main() -> int:
    """Run the study."""
    return drive(
        "auto_accuracy",
        __doc__,
        body,
        quick="one scene",
        published=FIGURES,
        add_options=add_options,
    )


if __name__ == "__main__":
    sys.exit(main())
