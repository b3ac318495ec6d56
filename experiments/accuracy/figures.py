"""Figure of error and time against `solver.accuracy`."""

import numpy as np
from matplotlib.figure import Figure

from experiments._common.style import BLACK, BLUE, VERMILION, grid_below, sheet
from experiments.accuracy.study import REQUESTS, Row, summary


def errors(rows: list[Row]) -> Figure:
    """Draw the errors of all scenes, and the time relative to the usual accuracy."""
    figure, axes = sheet(10.0, 4.4, columns=2)
    left, right = axes[0]
    spread = np.random.default_rng(0)
    asked = np.array([row["accuracy"] for row in rows])
    reached = np.clip([row["error"] for row in rows], 1e-12, 1.0)
    shifted = asked * 10 ** spread.uniform(-0.2, 0.2, len(asked))
    left.loglog(shifted, reached, "o", color=BLUE, mfc="none", ms=4, label="a scene")
    line = np.array([REQUESTS[-1], REQUESTS[0]])
    left.loglog(line, line, "-", color=BLACK, lw=1, label="accuracy asked for")
    left.set_xlabel("solver.accuracy (points spread for legibility)")
    left.set_ylabel("relative error of forces and gradient, the largest")
    left.legend(fontsize=8)
    table = summary(rows)
    right.semilogx(REQUESTS, [row["time_over_usual"] for row in table], "s-", color=VERMILION)
    right.set_xlabel("solver.accuracy")
    right.set_ylabel("time of an evaluation, over that at 1e-5 (median)")
    right.set_ylim(bottom=0)
    for ax in (left, right):
        ax.invert_xaxis()
        grid_below(ax)
    figure.suptitle(f"{table[0]['scenes']} random designs and scenes, from rest", fontsize=11)
    return figure
