"""What the parts of the benchmark share: the scene, what counts as good enough, the clock."""

import dataclasses
import math
import resource
import statistics
import time
from collections.abc import Callable
from typing import Any

import numpy as np

CONFIG = "configs/cic.yaml"
BASELINE = (36.43, 9.0, 4.0)
FORCES = ("mean_force_N", "peak_force_N")
ACCURACY = 1e-3
"""Of mean and peak force."""
GRADIENT_ACCURACY = 0.1
"""Of the gradient where one is asked for: the competitors' differences are good to some 0.05 at
settings whose forces are good to `ACCURACY`, and no setting may be worse than that for speed."""
BATCH_SECONDS = 150.0
"""A batch expected to take longer than this, all its runs together, is not run."""
CONTACTS = {
    "search": ("solver.fidelity=search",),
    "map 384x16": ("solver.fidelity=map", "solver.map_rolls=384", "solver.map_relatives=16"),
    "map 192x12": ("solver.fidelity=map", "solver.map_rolls=192", "solver.map_relatives=12"),
    "linear": ("solver.fidelity=linear",),
}
MB = 1e-6

Row = dict[str, Any]


@dataclasses.dataclass(frozen=True)
class Job:
    """What a part is told: the part, whether it is quick, a batch size, and what earlier
    parts have found."""

    part: str
    quick: bool
    size: int
    known: dict[str, Any]

    @property
    def contacts(self) -> tuple[str, ...]:
        """Contacts to choose from, from coarse to fine."""
        return ("linear",) if self.quick else ("map 192x12", "map 384x16", "search")


def ready(result: Any) -> Any:
    """The result, once it is there."""
    import jax

    return jax.block_until_ready(result)


def median_time(
    call: Callable[[], Any], repeats: int, at_most: float = math.inf
) -> tuple[float, Any]:
    """Median seconds of a call and its result; stops repeating after `at_most` seconds."""
    times: list[float] = []
    result = None
    while not times or (len(times) < repeats and sum(times) < at_most):
        began = time.perf_counter()
        result = call()
        times.append(time.perf_counter() - began)
    return statistics.median(times), result


def first_and_warm(
    call: Callable[[], Any], repeats: int, at_most: float = math.inf
) -> tuple[float, float, Any]:
    """Seconds of compilation (first call less a warm one) and of a warm call, and the result."""
    first, _ = median_time(call, 1)
    warm, result = median_time(call, repeats, at_most)
    return max(first - warm, 0.0), warm, result


def peak_memory() -> float:
    """Greatest resident memory (MB) of this process so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 * MB


def forces_of(response: dict[str, float]) -> list[float]:
    return [response.get(key, math.nan) for key in FORCES]


def slopes_of(gradient: dict[str, dict[str, float]]) -> list[list[float]]:
    return [list(gradient[key].values()) if key in gradient else [math.nan] * 3 for key in FORCES]


def value_error(forces: Any, truth: Any) -> float:
    """Greatest relative error of mean and peak force."""
    return float(np.max(np.abs(np.asarray(forces) / np.asarray(truth) - 1)))


def gradient_error(slopes: Any, truth: Any) -> float:
    """Greatest error of a gradient relative to the greatest entry of its force."""
    slopes, truth = np.asarray(slopes), np.asarray(truth)
    off = np.abs(slopes - truth).max(axis=-1) / np.abs(truth).max(axis=-1)
    return float(np.max(off))


def row(tool: str, what: str, seconds: float, **more: Any) -> Row:
    """One line of the result: `seconds` a call for `designs` designs."""
    designs = more.pop("designs", 1)
    start: Row = {"tool": tool, "what": what, "designs": designs, "run_s": seconds}
    return start | {"per_design_ms": 1e3 * seconds / designs} | more


def use_jax(gpu: bool = False) -> None:
    """Double precision, on the processor unless told otherwise."""
    from rootsopt.cli import use_float64

    use_float64()
    if gpu:
        import jax

        jax.config.update("jax_platforms", None)


def at(evaluator: Any, rtol: float, transient: float) -> Any:
    """The same evaluator at other tolerances; nothing is compiled anew."""
    import jax.numpy as jnp

    evaluator.orbit = dataclasses.replace(evaluator.orbit, rtol=jnp.asarray(rtol))
    evaluator.transient = dataclasses.replace(evaluator.transient, rtol=jnp.asarray(transient))
    return evaluator


def sample_designs(count: int) -> np.ndarray:
    """Designs (count, 3) around the baseline, which comes first; smaller samples are the
    beginnings of larger ones."""
    share = np.random.default_rng(0).random((count, 3))
    angle, tip = BASELINE[0] + 4 * share[:, 0] - 2, BASELINE[2] + 2 * share[:, 1] - 1
    longest = 33.0 * np.sin(np.radians(angle)) * np.radians(30.0 - tip)
    designs = np.stack([angle, (0.8 + 0.18 * share[:, 2]) * longest, tip], axis=1)
    designs[0] = BASELINE
    return designs
