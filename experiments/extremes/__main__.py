"""Where do solvers give valid results, up to the limits of every config key?

Writes extremes.csv (a row per scene, updated after every stage), extremes.json (counts and worst
deviations) and extremes.png. The exit code is 3 if a promise is broken.
"""

import argparse
import sys
from typing import TYPE_CHECKING

from experiments._common.driver import Run, drive, verdict

if TYPE_CHECKING:
    from experiments.extremes.checks import Case

FIGURES = {"extremes.png": "extremes.png"}
PROMISES = ("unnamed", "not_finite", "beyond_allowed")
"""Entries of the record that count broken promises: all must be 0."""


def body(run: Run) -> int:
    """Check all scenes, write results, print the counts of each kind."""
    from experiments._common.tables import print_record
    from experiments.extremes import figures, study

    def keep(cases: "list[Case]") -> None:
        run.csv("extremes.csv", [case.row for case in cases])

    results = study.run(run.quick, run.options.jobs, run.say, keep)
    found = study.summary(results)
    run.json("extremes.json", found)
    run.figure("extremes.png", figures.atlas(results.rows))
    print_record(found["kinds"])
    broken = {key: found[key] for key in PROMISES}
    print_record(broken)
    return verdict(not any(broken.values()))


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the option for the number of threads."""
    parser.add_argument(
        "--jobs", type=int, default=2, help="scenes simulated in parallel (default: 2)"
    )


def main() -> int:
    """Run the study."""
    return drive(
        "extremes",
        __doc__,
        body,
        quick="a few scenes of one kind",
        published=FIGURES,
        add_options=add_options,
        cache=True,
    )


if __name__ == "__main__":
    sys.exit(main())
