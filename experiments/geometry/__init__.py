"""How exact are area and inertia of every profile family?

Writes geometry.csv (a row per family and number of lobes, with the largest relative errors and the
design that has them).
"""

from experiments._common.driver import Study

STUDY = Study(quick="three families, two and three lobes, few designs", cache=False)
