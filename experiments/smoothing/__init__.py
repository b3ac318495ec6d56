"""What does rounding the corners of contact law and timing gear change?

Writes smoothing.csv (a row per scene and length), smoothing.json and smoothing.png, updated after
every kind of scene. The exit code is 3 unless the default's bias is below the limit.
"""

from experiments._common.driver import Study

STUDY = Study(quick="a few scenes of CIC", published={"smoothing.png": "smoothing.png"})
