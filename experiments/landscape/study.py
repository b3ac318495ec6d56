"""Compares the optimum with an exhaustive grid of designs, in different scenes.

The study lays a regular grid over pressure angle, involute share and tip arc angle, in the box that
the feasible designs of `configs/cic.yaml` span, fine enough for the requested number of feasible
designs. Each design is simulated at the tolerance of a screening, without gradients. Finer and
finer grids follow around the best designs that lie apart. Points outside the constraints are moved
onto their boundary. No step uses the gradient of the objective. The best design of all grids is
simulated at the full tolerance, and compared with the result of `rootsopt optimize`."""

import itertools
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from experiments._common.driver import NoResultError, Run
from experiments._common.scenes import FAIR
from experiments._common.simulation import feasible
from experiments._common.style import VERMILION, sheet
from experiments._common.tables import Row, show
from rootsopt.config import load
from rootsopt.optimize.problem import Problem
from rootsopt.optimize.search import Search
from rootsopt.scene.space import sobol

# Number of points along each axis of the coarsest grid, and of the finest.
GRID, MOST = 5, 80

# Number of points whose projections span the first grid.
SAMPLE = 256

# Minimum number of designs of the first grid: in a full run, and in a reduced run.
DESIGNS, QUICK_DESIGNS = 400, 1

# Number of seeds of the screening: in a full run, and in a reduced run.
SEEDS, QUICK_SEEDS = 10, 2

# Overrides for a reduced run.
QUICK = (
    "optimizer.screening=4",
    "optimizer.starts=1",
    "optimizer.iterations=15",
)

# Number of designs that finer grids surround, and the least distance between them in spacings of
# the first grid.
CENTERS, APART = 3, 3

# Number of finer grids around each of them. Each has half the spacing of the one before.
LEVELS, QUICK_LEVELS = 5, 1

# Relative difference of the objectives below which optimum and grid agree.
AGREES = 1e-3

# Relative range of the objectives below which runs with different seeds agree.
SAME = 1e-5


def feasible_grid(problem: Problem, wanted: int) -> tuple[np.ndarray, NDArray[np.float64]]:
    """Lay a regular grid over the feasible designs; return its points (n, 3), and its spacing (3,).

    The grid fills the box of `SAMPLE` points of a Sobol sequence that are moved onto the
    constraints. It is refined until at least `wanted` points are feasible. Raises `NoResultError`
    if the constraints exclude nearly all designs.
    """
    look = jax.jit(jax.vmap(lambda x: problem.space.slacks_of(problem.space.design(x))))
    moved = feasible(problem, sobol(SAMPLE, 0, 3))
    for count in range(GRID, MOST if moved else 0):
        axes = np.linspace(np.min(moved, axis=0), np.max(moved, axis=0), count).T
        points = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
        inside = points[np.asarray(look(points)).min(axis=1) >= 0]
        if len(inside) >= wanted:
            return inside, np.ptp(moved, axis=0) / (count - 1)
    raise NoResultError("the constraints leave hardly any design; relax them")


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
    problem: Problem,
    points: np.ndarray,
    values: NDArray[np.float64],
    spacing: NDArray[np.float64],
    apart: NDArray[np.float64],
) -> np.ndarray:
    """Return the points (m, 3) of grids with a `spacing` (3,) around the best of `points` (n, 3).

    `values` (n,): their objectives; `apart` (3,): semi-axes of the ellipsoid around a centre that
    holds no other. Points that cannot be moved onto the feasible set are left out."""
    chosen: list[np.ndarray] = []
    for place in np.argsort(np.where(np.isnan(values), np.inf, values)):
        far = all(np.linalg.norm((points[place] - other) / apart) > 1 for other in chosen)
        if far and len(chosen) < CENTERS and not np.isnan(values[place]):
            chosen.append(points[place])
    around = [np.array(shift) for shift in itertools.product((-1, 0, 1), repeat=3) if any(shift)]
    found = feasible(problem, [at + spacing * shift for at in chosen for shift in around])
    return np.unique(np.round(np.reshape(found, (-1, 3)), 12), axis=0)


NAMES = {
    "pressure_angle_deg": "pressure angle (°)",
    "involute_length_mm": "involute length (mm)",
    "tip_arc_angle_deg": "tip arc angle (°)",
}

# Overrides of the config by scene. A reduced run has the first scene only.
CASES: dict[str, tuple[str, ...]] = {
    "3000 rpm": (),
    "5000 rpm": ("scene.speed_rpm=5000",),
    "peak alone, wide backlash": (
        "objective.mean_weight=0", "scene.timing_gear.backlash_mm=0.2"),
    "RMS, little damping": (
        "objective.mean_weight=0", "objective.peak_weight=0", "objective.rms_weight=1",
        "scene.timing_gear.damping_ratio=0.2"),
    "worst of two speeds": (
        "objective.speeds_rpm=[2500, 3500]", "objective.over_speeds=worst"),
}  # fmt: skip

# Columns of the printed table.
SHOWN = (
    *("scene", "grid_designs", "finer_designs", "without_steady_state", "first_grid_best"),
    *("grid_best", "optimizer", "optimizer_over_grid_best", "optimizer_designs", "certified"),
    "optima",
)


def compared(name: str, quick: bool) -> tuple[Row, list[Row]]:
    """Optimise in the scene `name`, and simulate grids of designs.

    Returns a record of the comparison, and a row per design of the grids. Where no feasible design
    is better than the baseline, which is not quite feasible itself, the best one of the search is
    compared. Raises `NoResultError` if the search has none.
    """
    search = Search(load(FAIR, [*(QUICK if quick else ()), *CASES[name]]))
    result = search.run()
    problem, optimum, known = result.problem, result.optimized, result.optimality
    rows = [row for row in result.history if row["feasible"] and np.isfinite(row["objective"])]
    if problem is None or not rows:
        raise NoResultError(f"{name}: the search has no feasible design")
    last = min(rows, key=lambda row: row["objective"])
    design = {key: last[key] for key in NAMES} if optimum is None else optimum.design
    own = last["objective"] if optimum is None else problem.objective(optimum)
    points, spacing = feasible_grid(problem, QUICK_DESIGNS if quick else DESIGNS)
    rows, apart = survey(search, points, 0), APART * spacing
    for level in range(1, 1 + (QUICK_LEVELS if quick else LEVELS)):
        spacing = spacing / 2
        new = finer(problem, points, np.array([row["objective"] for row in rows]), spacing, apart)
        rows += survey(search, new, level)
        points = np.concatenate([points, new])
    values, first = np.array([(row["objective"], row["level"] == 0) for row in rows]).T
    first, place = first.astype(bool), int(np.nanargmin(values))
    best = problem.objective(search.exact(problem.design(points[place]), series=False))
    return {
        "scene": name,
        "grid_designs": int(first.sum()),
        "finer_designs": int((~first).sum()),
        "without_steady_state": int(np.isnan(values).sum()),
        "first_grid_best": float(np.nanmin(values[first])),
        "grid_best": best,
        "optimizer": own,
        "optimizer_over_grid_best": own / best - 1,
        "optimizer_designs": len(result.history),
        "certified": known is not None and known.converged,
        "optima": 0 if known is None else len(known.optima),
        "agrees": bool(own <= (1 + AGREES) * best),
        "grid_design": {key: rows[place][key] for key in design},
        "optimizer_design": design,
    }, rows


def designs(found: Sequence[tuple[Row, list[Row]]]) -> Figure:
    """Draw the objective over each pair of parameters, with the best designs on top.

    One row per scene."""
    figure, axes = sheet(11, 0.6 + 2.7 * len(found), len(found), 3)
    for (record, rows), line in zip(found, axes, strict=True):
        _scene(figure, record, rows, line)
    for ax, (x, _) in zip(axes[-1], itertools.combinations(NAMES, 2), strict=True):
        ax.set_xlabel(NAMES[x])
    return figure


def _scene(figure: Figure, record: Row, rows: list[Row], axes: Any) -> None:
    """Draw one scene in a row of axes."""
    values = np.array([row["objective"] for row in rows])
    low, high = np.nanmin(values), np.nanpercentile(values, 95)
    order = np.argsort(-np.where(np.isnan(values), np.inf, values))
    good = ~np.isnan(values[order])
    star = {"marker": "*", "ms": 15, "mfc": "none", "mec": VERMILION, "mew": 1.8}
    star["label"] = f"optimiser: {record['optimizer']:.4f}"
    cross = {"marker": "+", "ms": 9, "color": "black"}
    cross["label"] = f"best of the grids: {record['grid_best']:.4f}"
    for ax, (x, y) in zip(axes, itertools.combinations(NAMES, 2), strict=True):
        px, py = (np.array([row[k] for row in rows])[order] for k in (x, y))
        if not good.all():
            ax.plot(px[~good], py[~good], "x", color="0.6", ms=3, label="no steady state")
        shades = ax.scatter(px[good], py[good], c=values[order][good], s=9, vmin=low, vmax=high)
        for name, style in (("optimizer", star), ("grid", cross)):
            best = record[f"{name}_design"]
            ax.plot(best[x], best[y], ls="", **style)
        ax.set_ylabel(NAMES[y])
    axes[0].set_title(record["scene"], loc="left", fontsize=10)
    axes[0].legend(loc="best", fontsize=7)
    figure.colorbar(shades, ax=axes[-1], label="objective")


def run(job: Run) -> bool:
    """Optimise in every scene, simulate a grid in each, and search with several seeds.

    Returns whether the optimum is that of the grids in every scene, for every seed."""
    found = []
    for name in list(CASES)[: 1 if job.quick else None]:
        found.append(compared(name, job.quick))
        record = found[-1][0]
        job.say(f"{name}: {record['grid_best']:.6f}, optimiser {record['optimizer']:.6f}")
    seeds = []
    for seed in range(QUICK_SEEDS if job.quick else SEEDS):
        few = QUICK if job.quick else ()
        result = Search(load(FAIR, [*few, f"optimizer.seed={seed}"])).run()
        own = 1 - result.improvement.get("objective", np.nan)
        seeds.append({"seed": seed, "objective": own, "designs": len(result.history)})
    values = [row["objective"] for row in seeds]
    apart = float(np.ptp(values) / np.min(values))
    records = [record for record, _ in found]
    job.csv("landscape.csv", [{"scene": r["scene"], **row} for r, rows in found for row in rows])
    job.json("landscape.json", {"scenes": records, "seeds": seeds, "range_over_seeds": apart})
    job.figure("landscape.png", designs(found))
    exact = [r | {key: f"{r[key]:.6f}" for key in ("grid_best", "optimizer")} for r in records]
    show("Objective of the best design, baseline = 1", exact, SHOWN)
    print(f"searches with different seeds: relative range {apart:.1e}")
    return all(record["agrees"] for record in records) and (job.quick or apart <= SAME)
