"""Simulates points of a sweep in this process.

Points of the same structure share compiled programs. On a CPU, a thread per core works through them
one by one: as arrays, all motions would take as many steps as the longest. On an accelerator, they
are stepped together as arrays."""

import functools
import itertools
import threading
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

from rootsopt.config import Config
from rootsopt.response.many import HERE, as_done
from rootsopt.response.together import pays
from rootsopt.sweeps.plan import Plan
from rootsopt.sweeps.points import Row, simulated, simulated_together

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
    points = ((number, plan.at(number)) for number in numbers)
    asked = itertools.takewhile(lambda _: not stop.is_set(), points)
    for _, one in as_done(functools.partial(_numbered, config), asked, HERE.slots):
        yield [one]


def _numbered(config: Config, point: tuple[int, dict[str, Any]]) -> tuple[int, Row]:
    number, values = point
    return number, simulated(config, values)


def at_once(
    config: Config, points: Sequence[tuple[int, dict[str, Any]]], threads: int
) -> list[tuple[int, Row]]:
    """Return (number, record) of all `points`, each given as (number, values by dotted key).

    `threads`: number of points at a time."""
    if pays():
        rows = simulated_together(config, [values for _, values in points])
        return [(number, row) for (number, _), row in zip(points, rows, strict=True)]
    found = sorted(as_done(functools.partial(_numbered, config), points, threads))
    return [one for _, one in found]


def divided(numbers: Sequence[int], size: int) -> Iterator[list[int]]:
    """Yield the numbers in chunks of at most `size`."""
    for begin in range(0, len(numbers), size):
        yield [*numbers[begin : begin + size]]


__all__ = ["at_once", "divided", "in_process"]
