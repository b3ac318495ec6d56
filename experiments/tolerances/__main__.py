"""What do manufacturing tolerances change: the forces, and the best design?

Writes tolerances.csv (statistics of each design in each case), tolerances_scenes.csv (every fresh
scene), tolerances.json and tolerances.png. The exit code is 3 if a robust optimum is worse than the
nominal one over the sample of the search, or if a search found no better design.
"""

import argparse
import sys

from experiments._common.driver import Run, drive, verdict

FIGURES = {"tolerances.png": "tolerances.png"}


def body(run: Run) -> int:
    """Run the cases; write results and print tables after every case."""
    from experiments._common.tables import show
    from experiments.tolerances import figures, study

    found: list[study.Found] = []
    for name in run.options.cases or study.USUAL:
        found.append(study.run(run.quick, name, run.say))
        run.csv("tolerances.csv", [row for one in found for row in study.rows_of(one)])
        run.csv("tolerances_scenes.csv", [row for one in found for row in study.scenes_of(one)])
        run.json("tolerances.json", {one.name: study.record_of(one) for one in found})
        run.figure("tolerances.png", figures.panels(found))
    for one in found:
        show(f"{one.name}: {study.CASES[one.name].title}", study.rows_of(one))
        show("Standard deviation, first-order and sampled", study.linear_of(one))
    return verdict(all(study.kept(one) for one in found))


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the option that chooses the cases."""
    parser.add_argument(
        "--case",
        dest="cases",
        action="append",
        choices=["shipped", "center_distance", "light"],
        help="case to run (repeatable; default: shipped)",
    )


def main() -> int:
    """Run the study."""
    return drive(
        "tolerances",
        __doc__,
        body,
        quick="two scenes in the search, eight fresh scenes",
        published=FIGURES,
        add_options=add_options,
        cache=True,
    )


if __name__ == "__main__":
    sys.exit(main())
