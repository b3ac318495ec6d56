"""Where do solvers give valid results, up to the limits of every config key?

Writes extremes.csv (a row per scene, updated after every stage), extremes.json (counts and worst
deviations) and extremes.png. The exit code is 3 if a promise is broken.
"""

from experiments._common.driver import Study

STUDY = Study(quick="a few scenes of one kind", published={"extremes.png": "extremes.png"})
