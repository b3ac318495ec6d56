"""Do the prices of limits agree with optima found again with each limit moved?

Writes prices.csv, prices.json and prices.png. The exit code is 3 if a price differs by more than
2 %, or if a search ends without a certificate.
"""

import sys

from experiments._common.driver import Run, drive, verdict

FIGURES: dict[str, str] = {}


def body(run: Run) -> int:
    """Run all cases; write the results and print the table."""
    from experiments._common.tables import show
    from experiments.prices import figures, study

    rows = study.run(run.quick, run.say)
    run.csv("prices.csv", rows)
    run.figure("prices.png", figures.prices_of(rows))
    run.json("prices.json", {"rows": rows, "agrees": study.AGREES})
    show("Change of the objective per unit of a limit", rows)
    return verdict(study.kept(rows))


def main() -> int:
    """Run the study."""
    return drive(
        "prices",
        __doc__,
        body,
        quick="one limit of one case, one start",
        published=FIGURES,
        cache=True,
    )


if __name__ == "__main__":
    sys.exit(main())
