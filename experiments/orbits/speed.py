"""Times value and gradient from a neighbour's orbit against those from rest.

All ways run in one process, in turns, on one core. Times are processor times, which other processes
on the machine hardly change. The neighbour is a design whose parameters differ by a small fraction.
The study `benchmark` compares with other tools."""

import functools
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from experiments._common.batch import compiled, rest_of, solver_of
from experiments._common.driver import NoResultError
from experiments._common.scenes import CIC
from experiments._common.simulation import errors_of, numbers_of
from experiments._common.tables import Row
from experiments._common.timing import processor_time
from rootsopt import Scene
from rootsopt.config import load
from rootsopt.response.evaluation import Evaluator

# Relative difference between the parameters of a design and those of its neighbour.
AWAY = 2e-3

# Orbit tolerance of the reference.
EXACT = 1e-10


def _row(tool: str, seconds: float, found: Any, truth: Any) -> Row:
    return {"tool": tool, "ms": 1e3 * seconds} | errors_of(found, truth)


def rows_of(repeats: int, say: Callable[[str], None]) -> Iterator[Row]:
    """Measure all tools in the shipped scene; yield a row for each.

    Raises `NoResultError` if a design has no orbit."""
    config = load(CIC)
    own = Evaluator.of(config)
    base = np.asarray(config.design, float)
    design = base * (1 + AWAY * np.random.default_rng(0).uniform(-1, 1, base.shape))
    say("compiling")
    neighbour = own(base, series=False)
    exact = own.at_tolerance(EXACT)(design, series=False)
    if not (neighbour.usable and exact.usable):
        raise NoResultError(f"no orbit: {neighbour.status.label}, {exact.status.label}")
    truth = numbers_of(exact)
    machine = Scene.from_config(config)
    solve, rest = compiled(solver_of(machine)), rest_of(machine, base)
    for tool, start in (("neighbour", solve(base, rest)[3]), ("from rest", rest)):
        call = functools.partial(solve, design, start)
        seconds, found = processor_time(call, repeats)
        yield _row(tool, seconds, found[:2], truth)
    for tool, start in (("neighbour", neighbour.start), ("from rest", None)):
        say(f"evaluate, {tool}")
        call = functools.partial(own, design, start=start, series=False)
        seconds, found = processor_time(call, repeats)
        yield _row(f"evaluate, {tool}", seconds, numbers_of(found), truth)
