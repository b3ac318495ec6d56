"""How many points per second does a sweep simulate on one process and on several?

Writes sweeps.csv (a row per way to run the points), sweeps_collector.csv (points without a
simulation, for the limit of the process that collects them) and sweeps.png.
"""

import sys

from experiments._common.driver import OK, Run, drive

FIGURES = {"sweeps.png": "sweeps.png"}


def body(run: Run) -> int:
    """Measure throughput, write results, print the tables."""
    from experiments._common.tables import show
    from experiments.sweeps import figures, study

    ways, collector = study.run(run.quick, run.say)
    run.csv("sweeps.csv", ways)
    run.csv("sweeps_collector.csv", collector)
    run.json("sweeps.json", {"ways": ways, "collector": collector})
    run.figure("sweeps.png", figures.throughput(ways))
    show("Points with a simulation", ways)
    show("Points without a simulation", collector)
    return OK


def main() -> int:
    """Run the study."""
    return drive(
        "sweeps",
        __doc__,
        body,
        quick="one worker, few points",
        published=FIGURES,
        cache=True,
    )


if __name__ == "__main__":
    sys.exit(main())
