"""How many points per second does a sweep simulate on one process and on several?

Writes sweeps.csv (a row per way to run the points), sweeps_collector.csv (points without a
simulation, for the limit of the process that collects them) and sweeps.png.
"""

from experiments._common.driver import Study

STUDY = Study(quick="one worker, few points", published={"sweeps.png": "sweeps.png"})
