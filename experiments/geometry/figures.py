"""Figure of the errors of area and inertia."""

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from experiments._common.style import BLUE, GREY, VERMILION, grid_below, sheet
from experiments.geometry.study import Row

SERIES = {
    "area_error": ("area", "o", BLUE),
    "polar_moment_error": ("polar moment of area", "s", VERMILION),
    "reference_error": ("reference itself (estimate)", "x", GREY),
}
FLOOR = 1e-17
"""Relative error below which an error is drawn at this value."""


def errors(rows: list[Row]) -> Figure:
    """Draw the largest error of each family over all numbers of lobes."""
    families = list(dict.fromkeys(row["family"] for row in rows))
    figure, axes = sheet(8, 1.6 + 0.3 * len(families))
    ax = axes[0, 0]
    for key, (label, mark, color) in SERIES.items():
        worst = [[row[key] for row in rows if row["family"] == family] for family in families]
        # A family without a valid design has no error to draw.
        known = [max((x for x in one if np.isfinite(x)), default=np.nan) for one in worst]
        ax.plot(np.maximum(known, FLOOR), range(len(families)), mark, color=color, label=label)
    ax.set_xscale("log")
    ax.set_xlim(FLOOR / 2, 1e-10)
    ax.xaxis.set_minor_formatter(NullFormatter())
    ax.margins(y=0.15)
    ax.set_yticks(range(len(families)), [family.replace("_", " ") for family in families])
    ax.invert_yaxis()
    ax.set_xlabel("largest relative error")
    ax.set_title(f"{sum(row['sound'] for row in rows)} designs against polygons of their outlines")
    grid_below(ax)
    figure.legend(loc="outside lower center", ncols=len(SERIES), frameon=False)
    return figure
