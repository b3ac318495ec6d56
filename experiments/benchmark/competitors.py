"""The competitors: SciPy and Numba."""

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

from experiments._common.engines import FD_STEPS, Scene
from experiments._common.engines.scipy_nodes import NODES_1E3, ScipyNodes
from experiments._common.scenes import CIC
from experiments._common.timing import first_and_warm, median_time
from experiments.benchmark.job import (
    ACCURACY,
    BASELINE,
    Job,
    Row,
    gradient_error,
    row,
    value_error,
)
from rootsopt.config import load


def tuned(
    make: Callable[..., Any], settings: Sequence[dict[str, Any]], truth: Any
) -> tuple[dict[str, Any], Any]:
    """Choose the fastest of `settings` that is accurate enough at the baseline.

    If no setting is accurate enough, choose the most accurate. Returns the setting and the
    simulator."""
    tried = []
    for one in settings:
        tool = make(**one)
        tool.simulate(BASELINE)
        seconds, found = median_time(lambda tool=tool: tool.simulate(BASELINE), 3)
        tried.append((value_error(found.response[:2], truth), seconds, one, tool))
    good = [one for one in tried if one[0] <= ACCURACY]
    best = min(good, key=lambda one: one[1]) if good else min(tried, key=lambda one: one[0])
    return best[2], best[3]


def competitor_rows(
    name: str, tool: Any, settings: dict[str, Any], job: Job, more: Row, repeats: int
) -> list[Row]:
    """Time a competitor: forces alone, then forces with gradient. Return the rows."""
    truth, slope = job.known["forces"][0], job.known["slopes"][0]
    text = ", ".join(f"{key} {value}" for key, value in settings.items())
    seconds, found = median_time(lambda: tool.simulate(BASELINE), repeats)
    off = value_error(found.response[:2], truth)
    told = f"told to settle {settings.get('settle', 4)} mesh periods; no check"
    rows = [row(name, "value", seconds, value_error=off, settings=text, note=told, **more)]
    best: tuple[float, float] | None = None
    for factor in (1.0, 3.0):
        steps = [factor * step for step in FD_STEPS]
        _, slopes = tool.gradient(BASELINE, steps)
        by = gradient_error(slopes[:2], slope)
        best = min(best or (math.inf, 0.0), (by, factor))
    assert best is not None
    steps = [best[1] * step for step in FD_STEPS]
    seconds, _ = median_time(lambda: tool.gradient(BASELINE, steps), repeats)
    told = f"{told}; central differences, steps x {best[1]:g}"
    shared: Row = {"value_error": off, "gradient_error": best[0], "settings": text, "note": told}
    rows.append(row(name, "value+gradient", seconds, **shared, **more))
    return rows


def part_scipy(job: Job) -> dict[str, Any]:
    """Measure part (a): SciPy with LSODA and DOP853."""
    scene = Scene.of(load(CIC))
    rows = []
    choices = {
        "LSODA": [NODES_1E3],
        "DOP853": [
            {"method": "DOP853", "nodes": 800, "rtol": rtol, "settle": 1}
            for rtol in (1e-3, 3e-4, 1e-4, 1e-5)
        ],
    }
    for method, settings in list(choices.items())[: 1 if job.quick else 2]:
        used, tool = tuned(functools.partial(ScipyNodes, scene), settings, job.known["forces"][0])
        name = f"(a) SciPy {method}"
        rows += competitor_rows(name, tool, used, job, {}, 1 if job.quick else 5)
    return {"rows": rows}


def part_numba(job: Job) -> dict[str, Any]:
    """Measure part (b): Numba with search and with map, with few and with four periods to settle.

    The setting whose gradient is accurate to 1e-3 is measured too.
    """
    from experiments._common.engines import motion_of, rotor_of
    from experiments._common.engines import numba_pair as numba

    scene, repeats = Scene.of(load(CIC)), 5 if job.quick else 51
    four = {"settle": 4}
    cases = {
        "(b) Numba search": numba.SEARCH_1E3,
        "(b) Numba map": numba.MAP_1E3,
        "(b) Numba search, settle 4": numba.SEARCH_1E3 | four,
        "(b) Numba map, settle 4": numba.MAP_1E3 | four,
        "(b) Numba search, gradient to 1e-3": numba.SEARCH_GRADIENT_1E3,
    }
    rows = []
    for name, settings in cases.items():
        tool, more = numba.NumbaPair(scene, **settings), {}
        extra, _, _ = first_and_warm(functools.partial(tool.simulate, BASELINE), 3)
        if tool.contact == "map":
            tool = tool.fitted(BASELINE)
            rotor = rotor_of(scene, BASELINE)
            deepest = tool.deepest or -motion_of(scene, 1e-6).angle_limit
            build = functools.partial(numba.tabulate, rotor, deepest, tool.rolls, tool.relatives)
            more["build_s"] = median_time(build, 5)[0]
        more["compile_s"] = extra if "settle" not in name and "gradient" not in name else None
        rows += competitor_rows(name, tool, settings, job, more, repeats)
    return {"rows": rows}
