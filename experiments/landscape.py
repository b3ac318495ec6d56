"""How good is the optimum? An exhaustive grid of designs in the main job's scene.

    python experiments/landscape.py [configs/cic.yaml] [-o DIR] [--designs 2000]

Lays a regular grid over (pressure angle, involute share, tip arc angle) within the
config's bounds, fine enough that at least `--designs` designs are feasible, simulates
each of these from rest exactly as the optimiser does, and compares the best with what
`rootsopt optimize` finds. Writes landscape.csv, landscape.json and landscape.png.
"""

import argparse
import itertools
import sys
import time
from pathlib import Path

from rootsopt.cli import use_float64

use_float64()

import jax  # noqa: E402
import numpy as np  # noqa: E402
from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: E402
from matplotlib.cm import ScalarMappable  # noqa: E402
from matplotlib.colors import Normalize  # noqa: E402
from matplotlib.figure import Figure  # noqa: E402

from rootsopt import files  # noqa: E402
from rootsopt.config import load  # noqa: E402
from rootsopt.optimize.problem import Problem  # noqa: E402
from rootsopt.optimize.search import Search  # noqa: E402


def feasible_grid(problem: Problem, wanted: int) -> np.ndarray:
    """Points (n, 3) of a regular grid of the unit box that satisfy the constraints.

    The grid is refined until at least `wanted` of its points do.
    """
    look = jax.jit(jax.vmap(problem.space.slacks))
    for count in itertools.count(10, 2):
        axis = np.linspace(0, 1, count)
        points = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
        slack = np.asarray(look(points)).min(axis=1)
        feasible = points[slack >= 0]
        if len(feasible) >= wanted:
            return feasible
        if count > 80:
            raise SystemExit("the constraints leave hardly any design; relax them")
    raise AssertionError


def survey(search: Search, points: np.ndarray) -> list[dict]:
    """Simulate every point from rest; one row a design."""
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
            print(f"{number}/{len(points)} designs, {rate * 1e3:.0f} ms each", file=sys.stderr)
    return rows


def draw(rows: list[dict], optimum: dict, objective: float, path: Path) -> None:
    """Best objective over the third parameter, in the plane of the other two."""
    figure = Figure(figsize=(12, 4.6), layout="constrained", dpi=150)
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, 3)
    names = {
        "pressure_angle_deg": "pressure angle (deg)",
        "involute_length_mm": "involute length u (mm)",
        "tip_arc_angle_deg": "tip arc angle (deg)",
    }
    values = np.array([row["objective"] for row in rows])
    low, high = np.nanmin(values), np.nanpercentile(values, 95)
    order = np.argsort(-np.where(np.isnan(values), np.inf, values))
    shades = ScalarMappable(Normalize(low, high), "viridis")
    for ax, (x, y) in zip(axes, itertools.combinations(names, 2), strict=True):
        px, py = (np.array([row[k] for row in rows])[order] for k in (x, y))
        good = ~np.isnan(values[order])
        if not good.all():
            ax.plot(px[~good], py[~good], "x", color="0.6", ms=3, label="no steady state")
        ax.scatter(
            px[good], py[good], c=values[order][good], s=12, cmap="viridis", vmin=low, vmax=high
        )
        ax.plot(
            optimum[x], optimum[y], "*", ms=16, mfc="none", mec="#D55E00", mew=1.8,
            label=f"optimiser: {objective:.4f}",
        )  # fmt: skip
        ax.set_xlabel(names[x])
        ax.set_ylabel(names[y])
    axes[0].legend(loc="best", fontsize=8)
    figure.colorbar(shades, ax=axes, label="objective (baseline = 1), best on top")
    figure.suptitle(
        f"{len(rows)} feasible designs in the scene of the main job; best of the grid {low:.4f}"
    )
    figure.savefig(path)


def main() -> int:
    arguments = argparse.ArgumentParser(
        description="Optimum against an exhaustive grid of designs."
    )
    arguments.add_argument("config", nargs="?", default="configs/cic.yaml")
    arguments.add_argument("-o", "--output", type=Path, default=Path("results/landscape"))
    arguments.add_argument("--designs", type=int, default=2000)
    options = arguments.parse_args()
    folder = files.ResultFolder(options.output)
    search = Search(load(options.config))
    result = search.run()
    if result.problem is None or result.optimized is None:
        print(f"the optimiser has no result: {result.verification}", file=sys.stderr)
        return 3
    found = result.problem.objective(result.optimized)
    rows = survey(search, feasible_grid(search.problem, options.designs))
    folder.write_csv("landscape.csv", {k: [row[k] for row in rows] for k in rows[0]})
    values = np.array([row["objective"] for row in rows])
    best = rows[int(np.nanargmin(values))]
    summary = {
        "grid_designs": len(rows),
        "without_steady_state": int(np.isnan(values).sum()),
        "grid_best": best,
        "optimizer": {**result.optimized.design, "objective": found},
        "optimizer_over_grid_best": found / best["objective"],
        "within_one_percent": bool(found <= 1.01 * best["objective"]),
    }
    folder.write_json("landscape.json", summary)
    draw(rows, result.optimized.design, found, options.output / "landscape.png")
    for key, value in summary.items():
        print(f"{key}: {value}")
    return 0 if summary["within_one_percent"] else 3


if __name__ == "__main__":
    sys.exit(main())
