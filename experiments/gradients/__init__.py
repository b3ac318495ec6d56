"""How accurate are the reported gradients?

Writes gradients.csv (updated after each pair) and gradients.png. The exit code is 3 if a gradient
error exceeds what its check promises, or if a pair has a result at one tolerance but none at a
finer tolerance.
"""

from experiments._common.driver import Study

STUDY = Study(
    quick="four pairs of one kind",
    published={"gradients.png": "gradients.png"},
    options={
        "--count": {"type": int, "default": 100, "help": "pairs (default: 100)"},
        "--seed": {"type": int, "default": 0, "help": "seed of the draw (default: 0)"},
    },
    cache=False,
)
