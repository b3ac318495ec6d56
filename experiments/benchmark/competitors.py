"""The competitors: SciPy and Numba."""

import functools
from collections.abc import Iterator
from typing import Any

from experiments._common.engines import Engine, Scene, best_steps, central_differences
from experiments._common.engines.scipy_nodes import DOP853_1E3, NODES_1E3, ScipyNodes
from experiments._common.scenes import CIC
from experiments._common.simulation import errors_of
from experiments._common.tables import Row
from experiments._common.timing import first_and_warm, median_time
from experiments.benchmark.job import BASELINE, Job, row
from rootsopt.config import load


def competitor_rows(
    name: str, tool: Engine, settings: dict[str, Any], job: Job, more: Row, repeats: int
) -> Iterator[Row]:
    """Time a competitor: forces alone, then forces with gradient. Yield the rows."""
    forces, slopes = (x[0] for x in job.truth(1))
    steps, factor = best_steps(tool.forces, BASELINE, slopes)
    differences = functools.partial(central_differences, tool.forces, BASELINE, steps)
    told = f"told to settle {settings.get('settle', 4)} mesh periods; no check"
    more = more | {"settings": ", ".join(f"{key} {value}" for key, value in settings.items())}
    for what, call, note in (
        ("value", lambda: (tool.forces(BASELINE), None), told),
        ("value+gradient", differences, f"{told}; central differences, steps x {factor:g}"),
    ):
        seconds, found = median_time(call, repeats)
        yield row(name, what, seconds, note=note, **errors_of(found, (forces, slopes)), **more)


def part_scipy(job: Job) -> dict[str, Any]:
    """Measure part (a): SciPy with LSODA and DOP853."""
    scene, rows = Scene.of(load(CIC)), []
    for settings in (NODES_1E3,) if job.quick else (NODES_1E3, DOP853_1E3):
        name, tool = f"(a) SciPy {settings['method']}", ScipyNodes(scene, **settings)
        rows += competitor_rows(name, tool, settings, job, {}, 1 if job.quick else 5)
    return {"rows": rows}


def part_numba(job: Job) -> dict[str, Any]:
    """Measure part (b): Numba with search and with map, with few and with four periods to settle.

    The setting whose gradient is accurate to 1e-3 is measured too.
    """
    from experiments._common.engines import numba_pair as numba

    scene, repeats = Scene.of(load(CIC)), 5 if job.quick else 51
    cases = {
        "(b) Numba search": numba.SEARCH_1E3,
        "(b) Numba map": numba.MAP_1E3,
        "(b) Numba search, settle 4": numba.SEARCH_1E3 | {"settle": 4},
        "(b) Numba map, settle 4": numba.MAP_1E3 | {"settle": 4},
        "(b) Numba search, gradient to 1e-3": numba.SEARCH_GRADIENT_1E3,
    }
    rows = []
    for name, settings in cases.items():
        tool = numba.NumbaPair(scene, **settings)
        extra, _, _ = first_and_warm(functools.partial(tool.simulate, BASELINE), 3)
        if tool.contact == "map":
            tool = tool.fitted(BASELINE)
        # The other cases use the same program.
        more = {} if "settle" in name or "gradient" in name else {"compile_s": extra}
        rows += competitor_rows(name, tool, settings, job, more, repeats)
    return {"rows": rows}
