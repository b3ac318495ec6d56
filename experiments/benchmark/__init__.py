"""How fast is rootsopt compared with SciPy and Numba, and how much memory does it need?

Writes benchmark.csv, benchmark.json and benchmark.png.
"""

from experiments._common.driver import Study

STUDY = Study(
    quick="small sizes",
    published={"benchmark.png": "benchmark.png"},
    precision=False,
    alone=True,
)
