"""What does each part of a scene cost?

Writes parts.csv (a row per part).
"""

from experiments._common.driver import Study

STUDY = Study(
    quick="right-hand sides of three scenes, few calls",
    cache=False,
    alone=True,
)
