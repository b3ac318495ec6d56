"""What do contact force, leakage and flow ripple cost in terms of each other, over families?

Writes pump_front.csv (a row per best compromise of every family) and pump_front.png.
"""

from experiments._common.driver import Study

STUDY = Study(
    quick="one family, the ends of its front and one point between each two",
    published={"pump_front.png": "pump_front.png"},
    cache=False,
)
