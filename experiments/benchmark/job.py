"""What all parts of the benchmark share: the scene, required accuracies, rows."""

import dataclasses
from typing import Any

import numpy as np

from experiments._common.tables import Row

BASELINE = (36.43, 9.0, 4.0)

# Relative error of mean and peak force above which a setting is rejected.
ACCURACY = 1e-3

# Relative error of a requested gradient above which a setting is rejected. The competitors'
# central differences reach about 0.05 at settings with forces accurate to `ACCURACY`.
GRADIENT_ACCURACY = 0.1

# Expected time (s) of all runs of a batch above which the batch is skipped.
BATCH_SECONDS = 150.0


@dataclasses.dataclass(frozen=True)
class Job:
    """Task of a part: its name, whether the run is reduced, a batch size, and earlier findings.

    `known`: `forces` (n, 2) in N and `slopes` (n, 2, 3), the reference for some designs, and
    `batch_setting`."""

    part: str
    quick: bool
    size: int
    known: dict[str, Any]

    def truth(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the reference's forces and gradients for the first `count` designs."""
        return self.known["forces"][:count], self.known["slopes"][:count]


def row(tool: str, what: str, seconds: float, **more: Any) -> Row:
    """Return a row of the result; `seconds`: time of one call, for all its designs."""
    designs = more.get("designs", 1)
    start: Row = {"tool": tool, "what": what, "designs": designs, "run_s": seconds}
    return start | {"per_design_ms": 1e3 * seconds / designs} | more


def sample_designs(count: int) -> np.ndarray:
    """Draw designs (count, 3) around the baseline, which comes first.

    Smaller samples are the first designs of larger ones.
    """
    share = np.random.default_rng(0).random((count, 3))
    angle, tip = BASELINE[0] + 4 * share[:, 0] - 2, BASELINE[2] + 2 * share[:, 1] - 1
    longest = 33.0 * np.sin(np.radians(angle)) * np.radians(30.0 - tip)
    designs = np.stack([angle, (0.8 + 0.18 * share[:, 2]) * longest, tip], axis=1)
    designs[0] = BASELINE
    return designs
