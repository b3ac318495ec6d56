"""Figure of the objective over the design space."""

import itertools
from collections.abc import Sequence

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from experiments._common.style import VERMILION, sheet
from experiments.landscape.study import Results

NAMES = {
    "pressure_angle_deg": "pressure angle (°)",
    "involute_length_mm": "involute length (mm)",
    "tip_arc_angle_deg": "tip arc angle (°)",
}


def designs(results: Sequence[Results]) -> Figure:
    """Draw the objective over each pair of parameters, with the best designs on top.

    One row per scene."""
    figure, axes = sheet(11, 0.6 + 2.7 * len(results), len(results), 3)
    for row, (found, line) in enumerate(zip(results, axes, strict=True)):
        _scene(figure, found, line, last=row == len(results) - 1)
    return figure


def _scene(figure: Figure, found: Results, axes, last: bool) -> None:
    """Draw one scene in a row of axes. `last`: whether it is the last row, which has labels."""
    rows = found.rows
    values = np.array([row["objective"] for row in rows])
    low, high = np.nanmin(values), np.nanpercentile(values, 95)
    order = np.argsort(-np.where(np.isnan(values), np.inf, values))
    for ax, (x, y) in zip(axes, itertools.combinations(NAMES, 2), strict=True):
        px, py = (np.array([row[k] for row in rows])[order] for k in (x, y))
        good = ~np.isnan(values[order])
        if not good.all():
            ax.plot(px[~good], py[~good], "x", color="0.6", ms=3, label="no steady state")
        ax.scatter(
            px[good], py[good], c=values[order][good], s=9, cmap="viridis", vmin=low, vmax=high
        )
        ax.plot(
            found.design[x], found.design[y], "*", ms=15, mfc="none", mec=VERMILION, mew=1.8,
            label=f"optimiser: {found.objective:.4f}",
        )  # fmt: skip
        ax.plot(
            found.best[x], found.best[y], "+", ms=9, color="black",
            label=f"best of the grids: {found.grid_best:.4f}",
        )  # fmt: skip
        ax.set_ylabel(NAMES[y])
        if last:
            ax.set_xlabel(NAMES[x])
    axes[0].set_title(found.name, loc="left", fontsize=10)
    axes[0].legend(loc="best", fontsize=7)
    shades = ScalarMappable(Normalize(low, high), "viridis")
    figure.colorbar(shades, ax=axes[-1], label="objective")
