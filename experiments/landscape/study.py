"""Compares the optimum with an exhaustive grid of designs in the same scene.

The study lays a regular grid over pressure angle, involute share and tip arc angle within the
config's bounds, fine enough for the requested number of feasible designs. It simulates each from
rest exactly as the optimiser does, and compares the best with the result of `rootsopt optimize`.
"""

import dataclasses
import itertools
import time
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from experiments._common.driver import NoResultError
from experiments._common.scenes import CIC
from rootsopt.config import load
from rootsopt.optimize.problem import Problem
from rootsopt.optimize.search import Search

Row = dict[str, Any]
GRID = 10
"""Number of points along each axis of the coarsest grid."""
QUICK_GRID = 6
"""Number of points along each axis in a reduced run."""
QUICK = (
    "solver.fidelity=linear",
    "optimizer.screening=8",
    "optimizer.starts=1",
    "optimizer.iterations=20",
)
"""Overrides for a reduced run."""


def feasible_grid(problem: Problem, wanted: int, first: int = GRID) -> np.ndarray:
    """Lay a regular grid over the unit box; return its points (n, 3) within the constraints.

    The first grid has `first` points along each axis. It is refined until at least `wanted` points
    are feasible. Raises `NoResultError` if the constraints exclude nearly all designs.
    """
    look = jax.jit(jax.vmap(problem.space.slacks))
    for count in itertools.count(first, 2):
        axis = np.linspace(0, 1, count)
        points = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
        slack = np.asarray(look(points)).min(axis=1)
        feasible = points[slack >= 0]
        if len(feasible) >= wanted:
            return feasible
        if count > 80:
            raise NoResultError("the constraints leave hardly any design; relax them")
    raise AssertionError


def survey(search: Search, points: np.ndarray, say: Callable[[str], None]) -> list[Row]:
    """Simulate every point from rest; return a row per design."""
    rows = []
    began = time.perf_counter()
    for number, point in enumerate(points, 1):
        evaluation = search.fast(search.problem.design(point), series=False)
        rows.append(
            {
                **evaluation.design,
                "area_efficiency": evaluation.geometry["area_efficiency"],
                "objective": search.problem.objective(evaluation),
                "mean_force_N": evaluation.response.get("mean_force_N", np.nan),
                "peak_force_N": evaluation.response.get("peak_force_N", np.nan),
                "status": evaluation.status.label,
            }
        )
        if number % 200 == 0:
            rate = (time.perf_counter() - began) / number
            say(f"{number}/{len(points)} designs, {rate * 1e3:.0f} ms each")
    return rows


@dataclasses.dataclass(frozen=True)
class Results:
    """Results of the study: a row per design of the grid, and the optimum with its objective."""

    rows: list[Row]
    design: dict[str, float]
    objective: float

    def record(self) -> dict[str, Any]:
        """Return a comparison of the optimum with the best design of the grid."""
        values = np.array([row["objective"] for row in self.rows])
        best = self.rows[int(np.nanargmin(values))]
        return {
            "grid_designs": len(self.rows),
            "without_steady_state": int(np.isnan(values).sum()),
            "grid_best": best,
            "optimizer": {**self.design, "objective": self.objective},
            "optimizer_over_grid_best": self.objective / best["objective"],
            "within_one_percent": bool(self.objective <= 1.01 * best["objective"]),
        }


def run(
    quick: bool,
    config: str = CIC,
    designs: int = 2000,
    say: Callable[[str], None] = lambda text: None,
) -> Results:
    """Optimise a config, and simulate a grid of at least `designs` designs.

    Raises `NoResultError` if the optimiser finds no design better than the baseline.
    """
    search = Search(load(config, list(QUICK) if quick else []))
    result = search.run()
    if result.problem is None or result.optimized is None:
        raise NoResultError(f"the optimiser has no result: {result.verification}")
    first, wanted = (QUICK_GRID, 1) if quick else (GRID, designs)
    points = feasible_grid(search.problem, wanted, first)
    found = result.problem.objective(result.optimized)
    return Results(survey(search, points, say), result.optimized.design, found)
