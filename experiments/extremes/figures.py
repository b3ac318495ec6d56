"""Figure of the outcomes over contact oscillations, and of the deviations over tolerance."""

from collections import Counter
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from experiments._common.style import (
    BLACK,
    BLUE,
    COLORS,
    GREEN,
    ORANGE,
    PURPLE,
    SKY,
    VERMILION,
    sheet,
)
from experiments.extremes.checks import ALLOWED

Row = dict[str, Any]
COLOURS = {
    "periodic": BLUE,
    "not_settled": SKY,
    "idle": "#999999",
    "passed_through": "#F0E442",
    "too_deep": ORANGE,
    "inaccurate": "#882255",
    "unresolved": PURPLE,
    "stalled": GREEN,
    "solver_failed": VERMILION,
    "non_finite": BLACK,
}
MOST = 7
"""Maximum number of solvers shown; those with most scenes come first."""
_EDGES = np.logspace(-2, 8, 11)
MARKS = "os^vD<>"


def atlas(rows: list[Row]) -> Figure:
    """Draw the outcomes of each solver, and the deviations from the reference."""
    counts = Counter(row["method"] for row in rows)
    groups = [name for name, _ in counts.most_common(MOST)]
    columns = min(3, len(groups) + 1)
    lines = -(-(len(groups) + 1) // columns)
    figure, axes = sheet(4.0 * columns, 3.4 * lines, lines, columns)
    axes = axes.ravel()
    present = [name for name in COLOURS if any(row["status"] == name for row in rows)]
    for ax, group in zip(axes, groups, strict=False):
        outcomes(ax, group, [row for row in rows if row["method"] == group], present)
    ax = axes[len(groups)]
    deviations(ax, groups, [row for row in rows if row.get("reference") == "closed"])
    # Put the legend into an empty panel, if there is one.
    handles, labels = ax.get_legend_handles_labels()
    for free in axes[len(groups) + 1 : len(groups) + 2]:
        free.legend(handles, labels, fontsize=8, loc="center left", frameon=False)
    if len(axes) == len(groups) + 1:
        ax.legend(fontsize=5.5)
    for ax in axes[len(groups) + 1 :]:
        ax.axis("off")
    for ax in axes:
        ax.tick_params(labelsize=7)
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), fontsize=8)
    return figure


def outcomes(ax: Axes, group: str, mine: list[Row], present: list[str]) -> None:
    """Draw the share of each outcome over the number of contact oscillations in a mesh period.

    `group`: method of the solver; `mine`: rows of this solver; `present`:
    outcomes to draw."""
    bins = len(_EDGES) - 1
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
    ax.set_title(f"{group} ({len(mine)} scenes)", fontsize=9)
    ax.set_xlabel("oscillations of the contact in a mesh period", fontsize=8)
    ax.set_ylabel("share of scenes", fontsize=8)


def deviations(ax: Axes, groups: list[str], judged: list[Row]) -> None:
    """Draw the deviation from the reference over the tolerance by solver, with the allowed
    limit."""
    for mark, colour, group in zip(MARKS, COLORS, groups, strict=False):
        mine = [row for row in judged if row["method"] == group]
        if mine:
            ax.loglog(
                [row["solver.rtol"] for row in mine],
                [max(row["mean_off"], row["peak_off"], 1e-13) for row in mine],
                mark, ms=4, mfc="none", color=colour,
                label=group,
            )  # fmt: skip
    line = np.array([1e-12, 1e-2])
    ax.loglog(line, ALLOWED * line, "k-", lw=1, label=f"{ALLOWED:g} × tolerance")
    ax.set_xlabel("tolerance", fontsize=8)
    ax.set_ylabel("relative deviation of mean or peak force", fontsize=8)
    ax.set_title(f"deviation from the reference ({len(judged)} scenes)", fontsize=9)
    ax.grid(alpha=0.3)
