"""What does a twist of the rotors change, for two to four lobes?

Writes twist.csv (a row per twist and number of lobes) and twist.png.
"""

import sys

from experiments._common.driver import OK, Run, drive

FIGURES = {"twist.png": "twist.png"}


def body(run: Run) -> int:
    """Evaluate all twists, write results, print the table."""
    from experiments._common.tables import show
    from experiments.twist import figures, study

    rows = study.run(run.quick, run.say)
    run.csv("twist.csv", rows)
    run.figure("twist.png", figures.over_twist(rows))
    show("Twisted rotors", rows)
    return OK


def main() -> int:
    """Run the study."""
    return drive(
        "twist",
        __doc__,
        body,
        quick="three lobes, two twists, two slices",
        published=FIGURES,
    )


if __name__ == "__main__":
    sys.exit(main())
