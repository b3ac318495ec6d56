"""Figure of the true errors of the settings that `auto` chooses."""

import numpy as np
from matplotlib.figure import Figure

from experiments._common.style import BLUE, GREEN, VERMILION, sheet
from experiments.auto_accuracy.study import Row, judged

MARKS = {"linear": ("o", BLUE), "search": ("s", VERMILION), "map": ("^", GREEN)}


def errors(rows: list[Row]) -> Figure:
    """Draw the true error over the requested error, with the line on which both are equal.

    All points should be below this line."""
    figure, axes = sheet(6.4, 4.8)
    ax = axes[0, 0]
    spread = np.random.default_rng(0)
    rows = judged(rows)
    for fidelity, (mark, colour) in MARKS.items():
        chosen = [row for row in rows if row["fidelity"] == fidelity]
        if chosen:
            asked = np.array([row["requested"] for row in chosen])
            ax.loglog(
                asked * 10 ** spread.uniform(-0.15, 0.15, len(asked)),
                np.maximum([row["error"] for row in chosen], 1e-10),
                mark, color=colour, mfc="none", label=f"{fidelity} chosen ({len(chosen)})",
            )  # fmt: skip
    line = np.array([3e-5, 3e-2])
    ax.loglog(line, line, "k-", lw=1, label="requested error")
    ax.set_xlabel("requested relative error (points spread for legibility)")
    ax.set_ylabel("true error of mean or peak force, the larger")
    ax.set_title(f"{len(rows)} random designs and scenes", fontsize=11)
    ax.legend(fontsize=8)
    ax.grid(alpha=0.3)
    return figure
