"""Compares the optimum with an exhaustive grid of designs, in different scenes.

The study lays a regular grid over pressure angle, involute share and tip arc angle within the
config's bounds. The grid is fine enough for the requested number of feasible designs. Each design
is simulated at the tolerance of a screening, without gradients. Finer and finer grids follow around
the best designs that lie apart. Points outside the constraints are moved onto their boundary. No
step uses the gradient of the objective. The best design of all grids is simulated at the full
tolerance, and compared with the result of `rootsopt optimize`."""

import dataclasses
import itertools
import os
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import numpy as np
from numpy.typing import NDArray

from experiments._common.driver import NoResultError
from experiments._common.scenes import CIC
from rootsopt.config import load
from rootsopt.optimize.problem import Problem
from rootsopt.optimize.search import Search

Row = dict[str, Any]
GRID = 6
"""Number of points along each axis of the coarsest grid."""
QUICK_GRID = 5
"""Number of points along each axis in a reduced run."""
QUICK = (
    "optimizer.screening=4",
    "optimizer.starts=1",
    "optimizer.iterations=15",
)
"""Overrides for a reduced run."""
APART, CENTERS = 0.15, 3
"""Distance in the unit box between the designs that finer grids surround, and their number."""
LEVELS, QUICK_LEVELS = 5, 1
"""Number of finer grids around each of them. Each has half the spacing of the one before."""
AGREES = 1e-3
"""Relative difference of the objectives below which optimum and grid agree."""
SAME = 1e-5
"""Relative range of the objectives below which runs with different seeds agree."""


class Case(NamedTuple):
    """A scene of the study: its name, and the overrides of the config."""

    name: str
    overrides: tuple[str, ...]


CASES = (
    Case("3000 rpm", ()),
    Case("5000 rpm", ("scene.speed_rpm=5000",)),
    Case("peak alone, wide backlash",
         ("objective.mean_weight=0", "scene.timing_gear.backlash_mm=0.2")),
    Case("RMS, little damping", (
        "objective.mean_weight=0", "objective.peak_weight=0", "objective.rms_weight=1",
        "scene.timing_gear.damping_ratio=0.2")),
    Case("worst of two speeds", (
        "objective.speeds_rpm=[2500, 3500]", "objective.over_speeds=worst")),
)  # fmt: skip
QUICK_CASES = 1
"""Number of scenes in a reduced run."""


def feasible_grid(problem: Problem, wanted: int, first: int = GRID) -> tuple[np.ndarray, float]:
    """Lay a regular grid over the unit box; return its points (n, 3) within the constraints.

    The first grid has `first` points along each axis. It is refined until at least `wanted` points
    are feasible. Also return its spacing. Raises `NoResultError` if the constraints exclude nearly
    all designs.
    """
    look = jax.jit(jax.vmap(problem.space.slacks))
    for count in itertools.count(first):
        axis = np.linspace(0, 1, count)
        points = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
        slack = np.asarray(look(points)).min(axis=1)
        feasible = points[slack >= 0]
        if len(feasible) >= wanted:
            return feasible, 1 / (count - 1)
        if count > 80:
            raise NoResultError("the constraints leave hardly any design; relax them")
    raise AssertionError


def survey(search: Search, points: np.ndarray, level: int) -> list[Row]:
    """Simulate every point (n, 3) from rest, at the tolerance of a screening; return their rows.

    `level`: 0 for the first grid, k for the k-th finer grid."""
    evaluator = search.fast.without_gradient()

    def row(point) -> Row:
        evaluation = evaluator(search.problem.design(point), series=False)
        return {
            "level": level,
            **evaluation.design,
            "area_efficiency": evaluation.geometry["area_efficiency"],
            "objective": search.problem.objective(evaluation),
            "mean_force_N": evaluation.response.get("mean_force_N", np.nan),
            "peak_force_N": evaluation.response.get("peak_force_N", np.nan),
            "status": evaluation.status.label,
        }

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        return list(pool.map(row, points))


def finer(
    problem: Problem, points: np.ndarray, values: NDArray[np.float64], spacing: float
) -> np.ndarray:
    """Return the points (m, 3) of grids with a `spacing` around the best of `points` (n, 3).

    `values` (n,): their objectives. Points that cannot be moved onto the feasible set are left
    out."""
    chosen: list[np.ndarray] = []
    for place in np.argsort(np.where(np.isnan(values), np.inf, values)):
        apart = all(np.linalg.norm(points[place] - other) > APART for other in chosen)
        if apart and len(chosen) < CENTERS and not np.isnan(values[place]):
            chosen.append(points[place])
    around = [np.array(shift) for shift in itertools.product((-1, 0, 1), repeat=3) if any(shift)]
    tried = [problem.project(center + spacing * shift) for center in chosen for shift in around]
    found = [point for point in tried if problem.feasible(point)]
    return np.unique(np.round(np.array(found).reshape(-1, 3), 12), axis=0)


@dataclasses.dataclass(frozen=True)
class Results:
    """Results in one scene: a row per design of the grids, and the optimum with its objective.

    `name`: that of the scene; `grid_best`: objective of the best design of all grids at the full
    tolerance; `evaluations`: designs of the optimiser; `converged`: whether its design has a
    certificate; `optima`: number of distinct optima that it found; `seconds`: run time of the
    grids."""

    name: str
    rows: list[Row]
    design: dict[str, float]
    objective: float
    grid_best: float
    evaluations: int
    converged: bool
    optima: int
    seconds: float

    @property
    def best(self) -> Row:
        """Best design of all grids."""
        return min(self.rows, key=lambda row: np.nan_to_num(row["objective"], nan=np.inf))

    def record(self) -> dict[str, Any]:
        """Return a comparison of the optimum with the best design of the grids."""
        values = np.array([row["objective"] for row in self.rows])
        first = np.array([row["level"] for row in self.rows]) == 0
        return {
            "scene": self.name,
            "grid_designs": int(first.sum()),
            "finer_designs": int((~first).sum()),
            "without_steady_state": int(np.isnan(values).sum()),
            "first_grid_best": float(np.nanmin(values[first])),
            "grid_best": self.grid_best,
            "optimizer": self.objective,
            "optimizer_over_grid_best": self.objective / self.grid_best - 1,
            "optimizer_designs": self.evaluations,
            "certified": self.converged,
            "optima": self.optima,
            "agrees": bool(self.objective <= (1 + AGREES) * self.grid_best),
            "grid_design": {key: self.best[key] for key in self.design},
            "optimizer_design": self.design,
            "seconds": self.seconds,
        }


def compared(config: str, case: Case, quick: bool, designs: int) -> Results:
    """Optimise in one scene, and simulate grids of designs.

    Raises `NoResultError` if the optimiser finds no design better than the baseline.
    """
    search = Search(load(config, [*(QUICK if quick else ()), *case.overrides]))
    result = search.run()
    if result.problem is None or result.optimized is None:
        raise NoResultError(f"{case.name}: the optimiser has no result: {result.verification}")
    began = time.perf_counter()
    problem = result.problem
    first, wanted = (QUICK_GRID, 1) if quick else (GRID, designs)
    points, spacing = feasible_grid(problem, wanted, first)
    rows = survey(search, points, 0)
    for level in range(1, 1 + (QUICK_LEVELS if quick else LEVELS)):
        spacing /= 2
        values = np.array([row["objective"] for row in rows])
        new = finer(problem, points, values, spacing)
        rows += survey(search, new, level)
        points = np.concatenate([points, new])
    values = np.array([row["objective"] for row in rows])
    best = search.exact(problem.design(points[np.nanargmin(values)]), series=False)
    optimality = result.optimality
    return Results(
        name=case.name,
        rows=rows,
        design=result.optimized.design,
        objective=problem.objective(result.optimized),
        grid_best=problem.objective(best),
        evaluations=len(result.history),
        converged=optimality is not None and optimality.converged,
        optima=0 if optimality is None else len(optimality.optima),
        seconds=time.perf_counter() - began,
    )


def by_seed(config: str, seeds: int, quick: bool) -> list[Row]:
    """Optimise a config once for each seed of its screening; return a row per run."""
    rows = []
    for seed in range(seeds):
        search = Search(load(config, [*(QUICK if quick else ()), f"optimizer.seed={seed}"]))
        result = search.run()
        known = result.optimality
        rows.append(
            {
                "seed": seed,
                "objective": 1 - result.improvement.get("objective", np.nan),
                "residual": np.nan if known is None else known.certificate.residual,
                "optima": 0 if known is None else len(known.optima),
                "designs": len(result.history),
                "status": result.status.label,
            }
        )
    return rows


def spread(rows: list[Row]) -> float:
    """Return the range of the objectives of `by_seed`, relative to the least one."""
    values = [row["objective"] for row in rows]
    return float(np.ptp(values) / np.min(values))


def run(
    quick: bool,
    config: str = CIC,
    designs: int = 400,
    say: Callable[[str], None] = lambda text: None,
) -> list[Results]:
    """Optimise a config in every scene, and simulate a grid of at least `designs` designs in each.

    Raises `NoResultError` if the optimiser finds no design better than the baseline.
    """
    found = []
    for case in CASES[: QUICK_CASES if quick else None]:
        found.append(compared(config, case, quick, designs))
        record: Mapping[str, Any] = found[-1].record()
        say(f"{case.name}: grid {record['grid_best']:.6f}, optimiser {record['optimizer']:.6f}")
    return found
