"""How does the contact force depend on speed, and does optimising over a range pay off?

Writes speed.csv, speed_resonances.csv, speed_maxima.csv, speed.json, speed.png, speed_objective.png
and speed_resonances.png.
"""

from experiments._common.driver import Study

STUDY = Study(
    quick="one scene, few speeds, one short optimisation",
    published={name: name for name in ("speed.png", "speed_objective.png", "speed_resonances.png")},
)
