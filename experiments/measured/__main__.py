"""How do form errors of a measured rotor change the gap in rolling and the contact force?

Writes measured.csv (the points), measured.json and measured.png.
"""

import argparse
import sys

from experiments._common.driver import OK, Run, drive

FIGURES = {"measured.png": "outline.png"}


def body(run: Run) -> int:
    """Make a measured rotor, compare it with its design, write results, print the numbers."""
    from experiments._common.tables import print_record
    from experiments.measured import figures, study

    results = study.run(run.quick, run.folder, run.options.config)
    run.figure("measured.png", figures.deviations(results))
    run.json("measured.json", results.record)
    print_record(results.record)
    return OK


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the option for the config."""
    parser.add_argument(
        "config", nargs="?", default="configs/cic.yaml", help="(default: %(default)s)"
    )


def main() -> int:
    """Run the study."""
    return drive(
        "measured",
        __doc__,
        body,
        quick="no simulations",
        published=FIGURES,
        add_options=add_options,
    )


if __name__ == "__main__":
    sys.exit(main())
