"""Clocks that wait for JAX, and the memory of a process."""

import math
import resource
import statistics
import time
from collections.abc import Callable
from typing import Any

# Megabytes in a byte.
MB = 1e-6


def ready(result: Any) -> Any:
    """Wait until JAX has computed `result`, and return it."""
    import jax

    return jax.block_until_ready(result)


def times_of(
    call: Callable[[], Any],
    repeats: int,
    at_most: float = math.inf,
    clock: Callable[[], float] = time.perf_counter,
) -> tuple[list[float], Any]:
    """Return the times (s) of up to `repeats` calls, and the last result.

    No call starts after `at_most` seconds."""
    times, found = [], None
    while not times or (len(times) < repeats and sum(times) < at_most):
        began = clock()
        found = call()
        times.append(clock() - began)
    return times, found


def median_time(call: Callable[[], Any], repeats: int, *limits: Any) -> tuple[float, Any]:
    """Return the median time (s) of up to `repeats` calls, and the last result.

    `limits`: see `times_of`."""
    times, found = times_of(call, repeats, *limits)
    return statistics.median(times), found


def processor_time(call: Callable[[], Any], repeats: int) -> tuple[float, Any]:
    """Return the median processor time (s) of a warm call, and its result."""
    call()
    return median_time(call, repeats, math.inf, time.process_time)


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
