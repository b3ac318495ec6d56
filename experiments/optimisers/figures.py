"""Figure of the study: share of problems solved over the number of designs simulated."""

import numpy as np
from matplotlib.figure import Figure

from experiments.optimisers.study import EVALUATIONS, Results


def solved(results: Results) -> Figure:
    """Draw, for each method, the share of problems whose optimum it has reached."""
    figure = Figure(figsize=(6.5, 3.6), layout="constrained")
    ax = figure.subplots()
    rows = results.summary()
    problems = len({row["problem"] for row in rows})
    for method in dict.fromkeys(row["method"] for row in rows):
        own = [row["evaluations"] for row in rows if row["method"] == method]
        counts = np.sort([count for count in own if count is not None])
        share = np.arange(len(counts) + 1) / problems
        x = np.concatenate([[0], counts, [EVALUATIONS]])
        ax.step(x, np.append(share, share[-1]), where="post", label=method.replace("_", " "))
    ax.set_xlabel("designs simulated")
    ax.set_ylabel("problems solved to 1e-6")
    ax.set_ylim(0, 1.02)
    ax.legend(frameon=False)
    return figure
