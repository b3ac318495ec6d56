"""What does a free form gain over the best CIC, and where does it depart from it?

Writes freeform.json, freeform.yaml (the config with the optimised design) and freeform.png.
"""

import argparse
import sys

from experiments._common.driver import OK, Run, drive

FIGURES = {"freeform.png": "freeform.png"}


def body(run: Run) -> int:
    """Optimise, write results, print the designs and the families they resemble."""
    from experiments.freeform import figures, study

    results = study.run(run.quick, run.options.config)
    found = results.record
    run.folder.write_text("freeform.yaml", results.config.to_yaml())
    run.json("freeform.json", found)
    run.figure("freeform.png", figures.comparison(results))
    for name, row in found["designs"].items():
        print(f"{name:10s}", *(f"{key} {value:.5g}" for key, value in row.items()))
    print(f"{found['evaluations']} designs, {found['departure_um']:.1f} um from the best CIC")
    if found["optimality"]:
        print("search: {reason}, residual {residual:.2g}".format(**found["optimality"]))
    for row in found["resembles"]:
        print(f"{row['family']:18s} {row['departure_um']:8.1f} um  {row['design']}")
    return OK


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the option for the config."""
    parser.add_argument(
        "config", nargs="?", default="configs/free.yaml", help="(default: %(default)s)"
    )


def main() -> int:
    """Run the study."""
    return drive(
        "freeform",
        __doc__,
        body,
        quick="a few steps",
        published=FIGURES,
        add_options=add_options,
        cache=True,
    )


if __name__ == "__main__":
    sys.exit(main())
