"""What do manufacturing tolerances change: the forces, and the best design?

Writes tolerances.csv (statistics of each design in each case), tolerances_scenes.csv (every fresh
scene), tolerances.json and tolerances.png. The exit code is 3 if a robust optimum is worse than the
nominal one over the sample of the search, or if a search found no better design.
"""

from experiments._common.driver import Study

STUDY = Study(
    quick="two scenes in the search, eight fresh scenes",
    published={"tolerances.png": "tolerances.png"},
)
