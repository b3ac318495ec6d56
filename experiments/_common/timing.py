"""Clocks that wait for JAX, and the memory of a process."""

import math
import resource
import statistics
import time
from collections.abc import Callable
from typing import Any

MB = 1e-6
"""Megabytes in a byte."""


def ready(result: Any) -> Any:
    """Wait until JAX has computed `result`, and return it."""
    import jax

    return jax.block_until_ready(result)


def times_of(call: Callable[[], Any], repeats: int, at_most: float = math.inf) -> list[float]:
    """Return the times (s) of up to `repeats` calls; start no call after `at_most` seconds."""
    times: list[float] = []
    while not times or (len(times) < repeats and sum(times) < at_most):
        began = time.perf_counter()
        call()
        times.append(time.perf_counter() - began)
    return times


def median_time(
    call: Callable[[], Any], repeats: int, at_most: float = math.inf
) -> tuple[float, Any]:
    """Return the median time (s) of up to `repeats` calls, and the last result.

    No further call is made after `at_most` seconds."""
    results = []

    def keep() -> None:
        results[:] = [call()]

    return statistics.median(times_of(keep, repeats, at_most)), results[0]


def first_and_warm(
    call: Callable[[], Any], repeats: int, at_most: float = math.inf
) -> tuple[float, float, Any]:
    """Return the time (s) of compilation, the time (s) of a warm call, and the result.

    The time of compilation is the time of the first call minus that of a warm call."""
    first, _ = median_time(call, 1)
    warm, result = median_time(call, repeats, at_most)
    return max(first - warm, 0.0), warm, result


def peak_memory() -> float:
    """Return the largest resident memory (MB) of this process so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 * MB
