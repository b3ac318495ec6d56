"""What do contact force, leakage and flow ripple cost in terms of each other, over families?

Writes pump_front.csv (a row per best compromise of every family) and pump_front.png.
"""

import sys

from experiments._common.driver import OK, Run, drive

FIGURES = {"pump_front.png": "pump_front.png"}
SHOWN = (
    *("family", "point", "mean_force_N", "peak_force_N", "leakage_fraction", "flow_ripple"),
    *("radius_ratio", "area_efficiency", "displaced_volume_cm3", "status", "best_of_all"),
)


def body(run: Run) -> int:
    """Trace the front of every family, write results, print the table."""
    from experiments._common.tables import show
    from experiments.pump_front import figures, study

    rows = study.run(run.quick, run.say)
    run.csv("pump_front.csv", rows)
    run.figure("pump_front.png", figures.fronts(rows))
    show("Best compromises of every family", rows, SHOWN)
    return OK


def main() -> int:
    """Run the study."""
    return drive(
        "pump_front",
        __doc__,
        body,
        quick="one family, the ends of its front and one point between each two",
        published=FIGURES,
    )


if __name__ == "__main__":
    sys.exit(main())
