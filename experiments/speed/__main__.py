"""How does the contact force depend on speed, and does optimising over a range pay off?

Writes speed.csv, speed_resonances.csv, speed_maxima.csv, speed.json, speed.png, speed_objective.png
and speed_resonances.png.
"""

import sys

from experiments._common.driver import OK, Run, drive

FIGURES = {name: name for name in ("speed.png", "speed_objective.png", "speed_resonances.png")}


def body(run: Run) -> int:
    """Sweep and optimise, write results, print the record."""
    from experiments._common.tables import print_record
    from experiments.speed import figures, study

    results = study.run(run.quick, run.say)
    run.csv("speed.csv", results.rows)
    run.csv("speed_resonances.csv", results.resonances)
    run.csv("speed_maxima.csv", results.peaks)
    run.json("speed.json", results.record())
    run.figure("speed.png", figures.over_speed(results))
    run.figure("speed_objective.png", figures.objectives(results))
    run.figure("speed_resonances.png", figures.resonances(results))
    print_record(results.record())
    return OK


def main() -> int:
    """Run the study."""
    return drive(
        "speed",
        __doc__,
        body,
        quick="one scene, few speeds, one short optimisation",
        published=FIGURES,
        cache=True,
    )


if __name__ == "__main__":
    sys.exit(main())
