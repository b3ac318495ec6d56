"""What can be optimised where the motion is chaotic?

Writes chaos_line.csv, chaos_pathwise.csv, chaos_history.csv, chaos_members.csv,
chaos_gradients.csv, chaos.json and chaos.png.
"""

import sys

from experiments._common.driver import OK, Run, drive

FIGURES = {"chaos.png": "chaos.png"}


def body(run: Run) -> int:
    """Compute, write results, print the record."""
    from experiments._common.tables import print_record
    from experiments.chaos import figures, study

    results = study.run(run.quick, run.say)
    for name, rows in results.tables.items():
        run.csv(f"chaos_{name}.csv", rows)
    run.json("chaos.json", results.record())
    run.figure("chaos.png", figures.panels(results))
    print_record(results.record())
    return OK


def main() -> int:
    """Run the study."""
    return drive(
        "chaos",
        __doc__,
        body,
        quick="few members, short windows, one descent step",
        published=FIGURES,
        cache=True,
    )


if __name__ == "__main__":
    sys.exit(main())
