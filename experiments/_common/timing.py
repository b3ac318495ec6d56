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
    """Wait for a result of JAX; return it."""
    import jax

    return jax.block_until_ready(result)


def times_of(call: Callable[[], Any], repeats: int, at_most: float = math.inf) -> list[float]:
    """Return the seconds of each of `repeats` calls; stop after `at_most` seconds in all."""
    times: list[float] = []
    while not times or (len(times) < repeats and sum(times) < at_most):
        began = time.perf_counter()
        call()
        times.append(time.perf_counter() - began)
    return times


def median_time(
    call: Callable[[], Any], repeats: int, at_most: float = math.inf
) -> tuple[float, Any]:
    """Return the median seconds of a call and its last result; stop after `at_most` seconds."""
    results = []

    def keep() -> None:
        results[:] = [call()]

    return statistics.median(times_of(keep, repeats, at_most)), results[0]


def first_and_warm(
    call: Callable[[], Any], repeats: int, at_most: float = math.inf
) -> tuple[float, float, Any]:
    """Return the seconds of compilation (first call minus a warm one), of a warm call, and the
    result."""
    first, _ = median_time(call, 1)
    warm, result = median_time(call, repeats, at_most)
    return max(first - warm, 0.0), warm, result


def peak_memory() -> float:
    """Return the largest resident memory (MB) of this process so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 * MB
