"""Figure of the objective over the design space."""

import itertools

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from experiments._common.style import VERMILION, sheet
from experiments.landscape.study import Results


def designs(results: Results) -> Figure:
    """Draw the objective over each pair of parameters, with the best designs on top."""
    rows, optimum, objective = results.rows, results.design, results.objective
    figure, axes = sheet(12, 4.6, 1, 3)
    axes = axes[0]
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
            optimum[x], optimum[y], "*", ms=16, mfc="none", mec=VERMILION, mew=1.8,
            label=f"optimiser: {objective:.4f}",
        )  # fmt: skip
        ax.set_xlabel(names[x])
        ax.set_ylabel(names[y])
    axes[0].legend(loc="best", fontsize=8)
    figure.colorbar(shades, ax=axes, label="objective (baseline = 1), best on top")
    figure.suptitle(
        f"{len(rows)} feasible designs in the scene of the main job; best of the grid {low:.4f}"
    )
    return figure
