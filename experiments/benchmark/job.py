"""What all parts of the benchmark share: the scene, required accuracies, rows."""

import dataclasses
import math
from typing import Any

import numpy as np

from experiments._common.scenes import FORCES

BASELINE = (36.43, 9.0, 4.0)

# Relative error of mean and peak force above which a setting is rejected.
ACCURACY = 1e-3

# Relative error of a requested gradient above which a setting is rejected. The competitors'
# central differences reach about 0.05 at settings with forces accurate to `ACCURACY`.
GRADIENT_ACCURACY = 0.1

# Expected time (s) of all runs of a batch above which the batch is skipped.
BATCH_SECONDS = 150.0
Row = dict[str, Any]


@dataclasses.dataclass(frozen=True)
class Job:
    """Task of a part: its name, whether the run is reduced, a batch size, and earlier findings."""

    part: str
    quick: bool
    size: int
    known: dict[str, Any]


def forces_of(response: dict[str, float]) -> list[float]:
    """Return mean and peak force (N) of a `response`, NaN if unknown."""
    return [response.get(key, math.nan) for key in FORCES]


def slopes_of(gradient: dict[str, dict[str, float]]) -> list[list[float]]:
    """Return the gradients of mean and peak force (2, 3), NaN if unknown."""
    return [list(gradient[key].values()) if key in gradient else [math.nan] * 3 for key in FORCES]


def value_error(forces: Any, truth: Any) -> float:
    """Return the largest relative error of mean and peak force."""
    return float(np.max(np.abs(np.asarray(forces) / np.asarray(truth) - 1)))


def gradient_error(slopes: Any, truth: Any) -> float:
    """Return the largest error of the gradients, relative to the largest entry of each gradient."""
    slopes, truth = np.asarray(slopes), np.asarray(truth)
    off = np.abs(slopes - truth).max(axis=-1) / np.abs(truth).max(axis=-1)
    return float(np.max(off))


def row(tool: str, what: str, seconds: float, **more: Any) -> Row:
    """Return a row of the result; `seconds`: time of one call, for all its designs."""
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
