"""Figure of what each part of a scene costs."""

import numpy as np
from matplotlib.figure import Figure

from experiments._common.style import BLUE, ORANGE, grid_below, sheet
from experiments.parts.study import Row


def costs(rows: list[Row]) -> Figure:
    """Draw equations and time of a right-hand side, relative to the smallest scene."""
    first = rows[0]
    figure, axes = sheet(8, 1.6 + 0.42 * len(rows))
    ax = axes[0, 0]
    series = {"equations": ("equations", ORANGE), "rhs_us": ("time of one right-hand side", BLUE)}
    for shift, (key, (label, color)) in zip((-0.2, 0.2), series.items(), strict=True):
        ratios = [row[key] / first[key] for row in rows]
        bars = ax.barh(np.arange(len(rows)) + shift, ratios, 0.38, color=color, label=label)
        ax.bar_label(bars, fmt="%.2f", padding=3, fontsize=8)
    ax.set_yticks(range(len(rows)), [f"{row['part']} ({row['states']} states)" for row in rows])
    ax.invert_yaxis()
    ax.margins(x=0.12)
    ax.set_xlabel("relative to the smallest scene")
    grid_below(ax, axis="x")
    figure.legend(loc="outside lower center", ncols=2, frameon=False)
    return figure
