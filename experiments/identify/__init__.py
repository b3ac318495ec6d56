"""Do the 95 % regions of `identify` hold the true values of simulated records with noise?

Writes identify.csv, identify.json and identify.png. The exit code is 3 if fewer than 90 % of the
regions hold the true values.
"""

from experiments._common.driver import Study

STUDY = Study(
    quick="two scenes, one noise",
    published={"identify.png": "identify.png"},
    options={
        "--scenes": {"type": int, "metavar": "N", "help": "number of scenes (default: 20)"},
    },
)
