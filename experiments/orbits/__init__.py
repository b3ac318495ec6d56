"""Do closed orbits agree with the same by shooting, and what do they cost?

Writes orbits.csv (updated after each pair). The exit code is 3 if the forces of an orbit
differ by more than 1e-4.

With `--speed`, times value and gradient from a neighbour's orbit and from rest instead, on one
core. Writes speed.csv.

With `--batches`, times value and gradient of batches of designs, on the device that JAX_PLATFORMS
names ("cuda,cpu" for a GPU) or on the CPU. Writes batches.csv.
"""

from experiments._common.driver import Study

STUDY = Study(
    quick="two pairs of one kind",
    options={
        "--count": {"type": int, "default": 33, "help": "pairs (default: 33)"},
        "--seed": {"type": int, "default": 0, "help": "seed of the draw (default: 0)"},
        "--speed": {"action": "store_true", "help": "time an orbit from a neighbour instead"},
        "--batches": {"action": "store_true", "help": "time batches of designs instead"},
    },
    further=(("--speed",),),
    cache=False,
    alone="--speed",
)
