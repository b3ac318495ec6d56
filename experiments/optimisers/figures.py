"""Figure of the study: number of problems solved over the number of designs simulated."""

import numpy as np
from matplotlib.figure import Figure

from experiments.optimisers.study import EVALUATIONS, Results
from rootsopt.figures.style import COLORS, DASHES, figure

_NAMES = {"slsqp": "SQP (default)", "mma": "MMA"}
"""Names of methods in the legend; others are written as words."""


def solved(results: Results) -> Figure:
    """Draw, for each method, the number of problems whose optimum it has reached."""
    made, axes = figure(6.5, 3.6)
    ax = axes[0, 0]
    rows = results.summary()
    problems = len({row["problem"] for row in rows})
    styles = zip(dict.fromkeys(row["method"] for row in rows), COLORS, DASHES, strict=False)
    for method, color, dashes in styles:
        own = [row["evaluations"] for row in rows if row["method"] == method]
        counts = np.sort([count for count in own if count is not None])
        number = np.arange(len(counts) + 1)
        x = np.concatenate([[0], counts, [EVALUATIONS]])
        name = _NAMES.get(method, method.replace("_", " ").replace("lagrangian", "Lagrangian"))
        y = np.append(number, number[-1])
        ax.step(x, y, where="post", label=name, color=color, linestyle=dashes)
    ax.set_xlabel("designs simulated")
    ax.set_ylabel(f"problems solved to 1e-6, of {problems}")
    ax.set_ylim(0, problems + 0.3)
    ax.set_xlim(0, EVALUATIONS)
    ax.legend(frameon=False, loc="center right")
    return made
