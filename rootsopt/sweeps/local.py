"""Simulates points of a sweep in this process.

Points of the same structure share compiled programs. On a CPU, a thread per core works through them
one by one: as arrays, all motions would take as many steps as the longest. On an accelerator, they
are stepped together as arrays."""

import itertools
import threading
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

from rootsopt.config import Config
from rootsopt.response.many import HERE, as_done
from rootsopt.response.together import pays
from rootsopt.sweeps.plan import Plan
from rootsopt.sweeps.points import Row, simulated, simulated_together

# Number of points that an accelerator steps together.
_BATCH = 256


def in_process(
    config: Config,
    plan: Plan,
    numbers: Iterable[int],
    stop: threading.Event,
) -> Iterator[list[tuple[int, Row]]]:
    """Yield lists of (number, record) of the points with these `numbers`, as they are done.

    `stop`: event after which no further point begins."""
    size, slots = (_BATCH, 1) if pays() else (1, HERE.slots)
    chunks = ([(one, plan.at(one)) for one in some] for some in divided([*numbers], size))
    asked = itertools.takewhile(lambda _: not stop.is_set(), chunks)
    for _, found in as_done(lambda points: at_once(config, points, 1), asked, slots):
        yield found


def at_once(
    config: Config, points: Sequence[tuple[int, dict[str, Any]]], threads: int
) -> list[tuple[int, Row]]:
    """Return (number, record) of all `points`, each given as (number, values by dotted key).

    `threads`: number of points at a time."""
    numbers, every = zip(*points, strict=True)
    if pays():
        rows = simulated_together(config, every)
    else:
        done = as_done(lambda values: simulated(config, values), every, threads)
        rows = [row for _, row in sorted(done)]
    return [*zip(numbers, rows, strict=True)]


def divided(numbers: Sequence[int], size: int) -> Iterator[list[int]]:
    """Yield the numbers in chunks of at most `size`."""
    for begin in range(0, len(numbers), size):
        yield [*numbers[begin : begin + size]]


__all__ = ["at_once", "divided", "in_process"]
