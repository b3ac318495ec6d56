"""Does `solver.accuracy` bound the errors, and does a coarser one save time?

Writes accuracy.csv (a row per scene and accuracy), accuracy.json and accuracy.png. The exit code is
3 if fewer than 95 % of the errors are within an accuracy.
"""

from experiments._common.driver import Study

STUDY = Study(
    quick="one scene",
    published={"accuracy.png": "accuracy.png"},
    cache=False,
)
