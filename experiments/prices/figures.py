"""Figure of prices of limits beside those found by moving the limits."""

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from experiments._common.style import COLORS, sheet
from experiments.prices.study import AGREES, Row


def prices_of(rows: Sequence[Row]) -> Figure:
    """Draw the relative difference between both prices of each limit."""
    picture, axes = sheet(9, 0.5 * len(rows) + 1.6, 1, 1)
    ax, places = axes[0, 0], np.arange(len(rows))
    found = [max(float(row["difference"]), 1e-9) for row in rows]
    ax.plot(found, places, "o", color=COLORS[0], label="this limit")
    ax.axvline(AGREES, color=COLORS[1], ls="--", label="greatest difference allowed")
    ax.set(
        xscale="log",
        xlabel="relative difference of the multiplier from the slope of the optima",
        yticks=places,
        yticklabels=[f"{row['case']}: {row['limit']}" for row in rows],
    )
    ax.invert_yaxis()
    ax.grid(alpha=0.3)
    ax.legend()
    return picture
