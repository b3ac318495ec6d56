"""What does each part of a scene cost?

Writes parts.csv (a row per part) and parts.png.
"""

import sys

from experiments._common.driver import OK, Run, drive

FIGURES: dict[str, str] = {}


def body(run: Run) -> int:
    """Measure the cost of each part, write results, print the table."""
    from experiments._common.tables import show
    from experiments.parts import figures, study

    rows = study.run(run.quick, run.say)
    run.csv("parts.csv", rows)
    run.figure("parts.png", figures.costs(rows))
    show("Parts of a scene", rows)
    return OK


def main() -> int:
    """Run the study."""
    return drive(
        "parts",
        __doc__,
        body,
        quick="right-hand sides of three scenes, few calls",
        published=FIGURES,
    )


if __name__ == "__main__":
    sys.exit(main())
