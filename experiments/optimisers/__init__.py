"""Which optimisation method reaches the optimum with the fewest simulated designs?

Writes optimisers.csv (a row per evaluation), optimisers.json (evaluations and time to 1e-6, by
problem and method) and optimisers.png. The exit code is 3 unless the package's own method solves at
least as many problems as any other.
"""

from experiments._common.driver import Study

STUDY = Study(
    quick="two problems, 15 designs per method",
    published={"optimisers.png": "optimisers.png"},
    cache=False,
)
