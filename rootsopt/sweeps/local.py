"""Simulates points of a sweep in this process.

Points of the same structure share compiled programs. On a CPU, a thread per core works through them
one by one: as arrays, all motions would take as many steps as the longest. On an accelerator, they
are stepped together as arrays."""

import os
import threading
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from typing import Any

from rootsopt.config import Config
from rootsopt.response.together import pays
from rootsopt.sweeps.plan import Plan
from rootsopt.sweeps.points import Row, simulated, simulated_together

_AHEAD = 2
"""Number of points per thread that are queued in advance."""
_BATCH = 256
"""Number of points that an accelerator steps together."""


def in_process(
    config: Config,
    plan: Plan,
    numbers: Iterable[int],
    stop: threading.Event,
) -> Iterator[list[tuple[int, Row]]]:
    """Yield lists of (number, record) of the points with these `numbers`, as they are done.

    `stop`: event after which no further point begins."""
    if pays():
        for some in divided([*numbers], _BATCH):
            if not stop.is_set():
                yield at_once(config, [(number, plan.at(number)) for number in some], 1)
        return
    threads = os.cpu_count() or 1
    waiting = iter(numbers)
    running: dict[Future[Row], int] = {}
    with ThreadPoolExecutor(threads) as pool:
        while True:
            while len(running) < _AHEAD * threads and not stop.is_set():
                number = next(waiting, None)
                if number is None:
                    break
                running[pool.submit(simulated, config, plan.at(number))] = number
            if stop.is_set():
                running = {one: n for one, n in running.items() if not one.cancel()}
            if not running:
                return
            done, _ = wait(running, timeout=0.2, return_when=FIRST_COMPLETED)
            if done:
                yield [(running.pop(one), one.result()) for one in done]


def at_once(
    config: Config, points: Sequence[tuple[int, dict[str, Any]]], threads: int
) -> list[tuple[int, Row]]:
    """Return (number, record) of all `points`, each given as (number, values by dotted key).

    `threads`: number of points at a time."""
    if pays():
        rows = simulated_together(config, [values for _, values in points])
        return [(number, row) for (number, _), row in zip(points, rows, strict=True)]
    with ThreadPoolExecutor(threads) as pool:
        rows = pool.map(lambda one: simulated(config, one[1]), points)
        return [(number, row) for (number, _), row in zip(points, rows, strict=True)]


def divided(numbers: Sequence[int], size: int) -> Iterator[list[int]]:
    """Yield the numbers in chunks of at most `size`."""
    for begin in range(0, len(numbers), size):
        yield [*numbers[begin : begin + size]]


__all__ = ["at_once", "divided", "in_process"]
