"""Which profile family has the least contact force in the same housing?

Writes families.csv (a row per design), families.json, families.md (the tables), families.png (the
ranking) and families_profiles.png; with --overview only overview.png, an example of every family.
"""

import argparse
import json
import sys
from pathlib import Path

from experiments._common.driver import OK, Run, drive

FIGURES = {
    "families.png": "ranking.png",
    "families_profiles.png": "ranking_profiles.png",
    "overview.png": "families.png",
}
LONG = ("design", "outline_mm", "config")
"""Entries of a row that the table omits."""


def body(run: Run) -> int:
    """Study all families, or read an earlier run; write results and print the tables."""
    from experiments.families import figures, study, tables

    options = run.options
    if options.overview:
        run.figure("overview.png", figures.overview())
        return OK
    if options.show:
        data = json.loads(options.show.read_text())
    else:
        families = options.families.split(",") if options.families else None
        configs = options.configs or study.REFERENCES
        data = study.run(run.quick, configs, families, options.jobs, run.say)
        run.json("families.json", data)
    rows = data["rows"]
    run.csv("families.csv", rows, [key for key in rows[0] if key not in LONG])
    run.folder.write_text("families.md", tables.markdown(data))
    run.figure("families.png", figures.ranking_figure(data))
    run.figure("families_profiles.png", figures.profiles_figure(data))
    print(tables.markdown(data))
    return OK


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add options: reference configs, families, number of processes, overview, earlier run."""
    parser.add_argument(
        "configs",
        nargs="*",
        metavar="CONFIG",
        help="references (default: configs/ee.yaml configs/cic.yaml)",
    )
    parser.add_argument("--families", help="comma-separated (default: all but the free form)")
    parser.add_argument("--jobs", type=int, default=2, help="families in parallel (default: 2)")
    parser.add_argument(
        "--overview", action="store_true", help="only draw an example of every family"
    )
    parser.add_argument("--show", type=Path, help="families.json of an earlier run to show")


def main() -> int:
    """Run the study."""
    return drive(
        "families",
        __doc__,
        body,
        quick="one housing, two families",
        published=FIGURES,
        add_options=add_options,
        cache=True,
    )


if __name__ == "__main__":
    sys.exit(main())
