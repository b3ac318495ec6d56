"""Evaluates many points: designs, scenes or speeds, in this process or on others."""

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from itertools import islice
from os import cpu_count
from typing import Any, NamedTuple, Protocol, TypeVar, runtime_checkable

from rootsopt.response.result import Evaluation
from rootsopt.response.starts import Seeds

Item = TypeVar("Item")
Found = TypeVar("Found")


class Point(NamedTuple):
    """What is evaluated: `evaluator(design, start, series)`.

    The first three are the `Evaluator`, the design (d,) in config units, and where to begin;
    `series`: whether to compute the series."""

    evaluator: Callable[..., Evaluation]
    design: Any
    start: Seeds = None
    series: bool = False


@runtime_checkable
class Runs(Protocol):
    """Runs evaluations for threads that wait for them.

    An evaluation is a pure function, so that its result does not depend on where it runs."""

    @property
    def slots(self) -> int:
        """Number of evaluations that should be asked for at a time."""
        ...

    def evaluated(self, point: Point) -> Evaluation:
        """Return the evaluation of a point."""
        ...


class LocalRunner(NamedTuple):
    """Runs evaluations in this process, in the thread that asks for them.

    `slots`: number of threads that should ask."""

    slots: int

    def evaluated(self, point: Point) -> Evaluation:
        """Return the evaluation of a point."""
        return point.evaluator(*point[1:])


HERE = LocalRunner(cpu_count() or 1)
"""One thread per core."""
IN_TURN = LocalRunner(1)
"""No further thread: for points of a design, if designs run side by side."""


def evaluate_many(
    points: Iterable[Point], runs: Runs = HERE, progress: Callable[[int], None] = lambda done: None
) -> list[Evaluation]:
    """Return the evaluations of all `points`, in their order.

    `runs`: where they run; `progress` is called with the number of points done. Points are taken
    only when they can begin, so that a generator can end them early."""
    found = {}
    for number, one in as_done(runs.evaluated, points, runs.slots):
        found[number] = one
        progress(len(found))
    return [found[number] for number in sorted(found)]


def as_done(
    work: Callable[[Item], Found], items: Iterable[Item], slots: int
) -> Iterator[tuple[int, Found]]:
    """Yield (number, `work(item)`) of all items as they are done, `slots` of them at a time.

    Items are taken only when they can begin. After an error, no further item begins."""
    waiting = enumerate(items)
    if slots == 1:
        yield from ((number, work(item)) for number, item in waiting)
        return
    running: dict[Future[Found], int] = {}
    done: list[tuple[int, Found]] = []
    with ThreadPoolExecutor(slots) as pool:
        while True:
            for number, item in islice(waiting, slots - len(running)):
                running[pool.submit(work, item)] = number
            yield from done
            if not running:
                return
            ended, _ = wait(running, return_when=FIRST_COMPLETED)
            done = [(running.pop(one), one.result()) for one in ended]
