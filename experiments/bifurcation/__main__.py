"""Which quiet and noisy orbits does a rotor pair have over speed, load, backlash and design?

Writes bifurcation.csv (all points), special_points.csv, bifurcation.json, bifurcation_speed.png,
bifurcation_scene.png and bifurcation_ranges.png, updated after every parameter.
"""

import sys
from typing import TYPE_CHECKING

from experiments._common.driver import OK, Run, drive

if TYPE_CHECKING:
    from experiments.bifurcation.study import Diagram

FIGURES = {
    "bifurcation_speed.png": "bifurcation_speed.png",
    "bifurcation_scene.png": "bifurcation_scene.png",
    "bifurcation_ranges.png": "bifurcation_ranges.png",
}


def body(run: Run) -> int:
    """Follow all branches; write and print results after every parameter."""
    from experiments.bifurcation import study

    def keep(diagrams: "list[Diagram]") -> None:
        write(run, diagrams)
        last = diagrams[-1]
        print(f"{last.scene} {last.family} {last.parameter}: {study.ranges(last)}")
        print(f"  more than one stable orbit: {study.overlaps(last)}", flush=True)

    diagrams = study.run(run.quick, run.say, keep)
    residual = study.summary(diagrams, run.seconds)["largest_residual"]
    print(f"largest residual {residual}, {run.seconds:.0f} s")
    return OK


def write(run: Run, diagrams: "list[Diagram]") -> None:
    """Write everything known so far, so that a long run can be inspected."""
    from experiments.bifurcation import figures, study

    run.csv("bifurcation.csv", study.point_rows(diagrams))
    run.csv("special_points.csv", study.special_rows(diagrams))
    run.json("bifurcation.json", study.summary(diagrams, run.seconds))
    for name, figure in figures.pictures(diagrams).items():
        run.figure(f"bifurcation_{name}.png", figure)


def main() -> int:
    """Run the study."""
    return drive(
        "bifurcation",
        __doc__,
        body,
        quick="one start at one speed of one pair",
        published=FIGURES,
        cache=True,
    )


if __name__ == "__main__":
    sys.exit(main())
