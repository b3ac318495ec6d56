"""Figure of the differences between orbits by collocation and by shooting."""

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from experiments._common.style import COLORS, sheet
from experiments.orbits.study import FORCES, Row


def differences_of(rows: Sequence[Row]) -> Figure:
    """Draw the distribution of the differences in forces and in their derivatives."""
    picture, axes = sheet(10, 4.2, 1, 2)
    good = [row for row in rows if row["status"] == "periodic"]
    titles = {"difference": "Forces", "gradient_difference": "Derivatives"}
    for ax, (what, title) in zip(axes[0], titles.items(), strict=True):
        for name, color in zip(FORCES, COLORS[:3], strict=True):
            found = np.sort([float(row[f"{name}_{what}"]) for row in good])
            share = 100 * (np.arange(found.size) + 1) / max(found.size, 1)
            ax.semilogx(np.maximum(found, 1e-14), share, "o-", ms=3, color=color, label=name)
        ax.set(
            xlabel="relative difference, collocation and shooting",
            ylabel="share of pairs below (%)",
            title=title,
            ylim=(0, 100),
        )
        ax.grid(alpha=0.3)
        ax.legend()
    return picture
