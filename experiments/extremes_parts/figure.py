"""The atlas of the extremes: outcome over stiffness and speed, deviation over tolerance."""

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

COLOURS = {
    "periodic": "#0072B2",
    "not_settled": "#56B4E9",
    "idle": "#999999",
    "passed_through": "#F0E442",
    "too_deep": "#E69F00",
    "unresolved": "#CC79A7",
    "stalled": "#009E73",
    "solver_failed": "#D55E00",
    "non_finite": "#000000",
}
_EDGES = np.logspace(-2, 8, 11)
MARKS = "os^vD<>"
LINES = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")


def draw(rows: list[dict[str, Any]], allowed: float, single: float, path: Path) -> None:
    """Shares of each outcome over the swings in a mesh period for the solvers with most scenes, and
    deviation from the reference over tolerance, `allowed` times which is the limit; `single`: the
    finest that single precision holds."""
    counts = Counter((row["fidelity"], row["method"], row["precision"]) for row in rows)
    groups = [name for name, _ in counts.most_common(7)]
    columns = min(3, len(groups) + 1)
    lines = -(-(len(groups) + 1) // columns)
    figure = Figure(figsize=(4.0 * columns, 3.4 * lines), layout="constrained", dpi=130)
    FigureCanvasAgg(figure)
    axes = figure.subplots(lines, columns, squeeze=False).ravel()
    present = [name for name in COLOURS if any(row["status"] == name for row in rows)]
    bins = len(_EDGES) - 1
    for ax, group in zip(axes, groups, strict=False):
        mine = [r for r in rows if (r["fidelity"], r["method"], r["precision"]) == group]
        swings = np.clip([row["swings"] for row in mine], _EDGES[0], _EDGES[-1] * 0.999)
        place = np.digitize(swings, _EDGES) - 1
        total = np.bincount(place, minlength=bins)
        below = np.zeros(bins)
        for name in present:
            hit = np.array([row["status"] == name for row in mine])
            share = np.bincount(place[hit], minlength=bins) / np.maximum(total, 1)
            ax.bar(
                _EDGES[:-1], share, bottom=below, width=np.diff(_EDGES), align="edge",
                color=COLOURS[name], edgecolor="white", linewidth=0.3,
                label=name.replace("_", " "),
            )  # fmt: skip
            below += share
        ax.set_xscale("log")
        ax.set_xlim(_EDGES[0], _EDGES[-1])
        ax.set_ylim(0, 1)
        ax.set_title(f"{group[1]}, {group[2]}, {group[0]} ({len(mine)} scenes)", fontsize=9)
        ax.set_xlabel("swings of the contact in a mesh period", fontsize=8)
        ax.set_ylabel("share of scenes", fontsize=8)
    ax = axes[len(groups)]
    judged = [row for row in rows if row.get("reference") == "closed"]
    finest = {"float64": 0.0, "float32": single}
    for mark, colour, group in zip(MARKS, LINES, groups, strict=False):
        mine = [r for r in judged if (r["fidelity"], r["method"], r["precision"]) == group]
        if mine:
            ax.loglog(
                [max(row["solver.rtol"], finest[group[2]]) for row in mine],
                [max(row["mean_off"], row["peak_off"], 1e-13) for row in mine],
                mark, ms=4, mfc="none", color=colour,
                label=", ".join((group[1], group[2], group[0])),
            )  # fmt: skip
    line = np.array([1e-12, 1e-2])
    ax.loglog(line, allowed * line, "k-", lw=1, label=f"{allowed:g} × tolerance")
    ax.set_xlabel("tolerance (single precision: the finest it holds)", fontsize=8)
    ax.set_ylabel("relative deviation of mean or peak force", fontsize=8)
    ax.set_title(f"deviation from the reference ({len(judged)} scenes)", fontsize=9)
    # Beside the panel, where there is one left empty.
    handles, labels = ax.get_legend_handles_labels()
    for free in axes[len(groups) + 1 : len(groups) + 2]:
        free.legend(handles, labels, fontsize=8, loc="center left", frameon=False)
    if len(axes) == len(groups) + 1:
        ax.legend(fontsize=5.5)
    ax.grid(alpha=0.3)
    for ax in axes[len(groups) + 1 :]:
        ax.axis("off")
    for ax in axes:
        ax.tick_params(labelsize=7)
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), fontsize=8)
    figure.savefig(path)
