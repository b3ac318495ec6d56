"""What the parts of the benchmark share: the scene, what counts as good enough, rows."""

import dataclasses
import math
from typing import Any

import numpy as np

from experiments._common.scenes import FORCES

BASELINE = (36.43, 9.0, 4.0)
ACCURACY = 1e-3
"""Relative error of mean and peak force above which a setting is not good enough."""
GRADIENT_ACCURACY = 0.1
"""The same of a gradient, where one is asked for. The competitors' differences are good to some
0.05 at settings whose forces are good to `ACCURACY`."""
BATCH_SECONDS = 150.0
"""Seconds, expected of all runs of a batch, above which it is not run."""
CONTACTS = {
    "search": ("solver.fidelity=search",),
    "map 384x16": ("solver.fidelity=map", "solver.map_rolls=384", "solver.map_relatives=16"),
    "map 192x12": ("solver.fidelity=map", "solver.map_rolls=192", "solver.map_relatives=12"),
    "linear": ("solver.fidelity=linear",),
}
Row = dict[str, Any]


@dataclasses.dataclass(frozen=True)
class Job:
    """What a part is told: its name, whether it is reduced, a batch size, and earlier findings."""

    part: str
    quick: bool
    size: int
    known: dict[str, Any]

    @property
    def contacts(self) -> tuple[str, ...]:
        """Contacts to choose from, from coarse to fine."""
        return ("linear",) if self.quick else ("map 192x12", "map 384x16", "search")


def forces_of(response: dict[str, float]) -> list[float]:
    """List mean and peak force (N), NaN where there is none."""
    return [response.get(key, math.nan) for key in FORCES]


def slopes_of(gradient: dict[str, dict[str, float]]) -> list[list[float]]:
    """List the gradients of mean and peak force (2, 3), NaN where there is none."""
    return [list(gradient[key].values()) if key in gradient else [math.nan] * 3 for key in FORCES]


def value_error(forces: Any, truth: Any) -> float:
    """Find the greatest relative error of mean and peak force."""
    return float(np.max(np.abs(np.asarray(forces) / np.asarray(truth) - 1)))


def gradient_error(slopes: Any, truth: Any) -> float:
    """Find the greatest error of a gradient, relative to the greatest entry of its force."""
    slopes, truth = np.asarray(slopes), np.asarray(truth)
    off = np.abs(slopes - truth).max(axis=-1) / np.abs(truth).max(axis=-1)
    return float(np.max(off))


def row(tool: str, what: str, seconds: float, **more: Any) -> Row:
    """Make a row of the result: `seconds` for each call with `designs` designs."""
    designs = more.pop("designs", 1)
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
