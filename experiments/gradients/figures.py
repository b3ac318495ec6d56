"""Figure of the errors of reported gradients."""

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from experiments._common.scenes import FORCES
from experiments._common.style import COLORS, sheet
from experiments.gradients.study import MEASURES, TOLERANCES, Row


def errors_of(rows: Sequence[Row]) -> Figure:
    """Draw the gradient error over the estimate of its check, and its distribution by tolerance."""
    picture, axes = sheet(10, 4.2, 1, 2)
    left, right = axes[0]
    for rtol, color, marker in zip(TOLERANCES, COLORS[:3], "os^", strict=True):
        good = [r for r in rows if float(r["rtol"]) == rtol and r["status"] == "periodic"]
        off = np.array([[float(r[f"{name}_error"]) for name in MEASURES] for r in good]).ravel()
        said = np.repeat([float(r["gradient_disagreement"]) for r in good], len(MEASURES))
        kept = np.isfinite(off)
        left.loglog(said[kept], off[kept], marker, color=color, ms=3, alpha=0.5, label=f"{rtol:g}")
        for name, style in zip(FORCES, ("-", "--"), strict=True):
            errors = np.sort([float(r[f"{name}_error"]) for r in good])
            errors = errors[np.isfinite(errors)]
            share = 100 * (np.arange(errors.size) + 1) / errors.size
            what = name.split("_")[0]
            right.semilogx(errors, share, style, color=color, label=f"{what}, rtol {rtol:g}")
    left.plot([1e-9, 1e-2], [1e-9, 1e-2], "k:", lw=1, label="equal")
    left.set(
        xlabel="gradient_disagreement (relative)",
        ylabel="error of the gradients of mean, peak, RMS\nagainst differences (relative)",
        title="Check against error",
    )
    left.legend(title="solver.rtol")
    right.set(
        xlabel="error of the gradient against differences (relative)",
        ylabel="share of design–scene pairs below (%)",
        title="Errors, mean and peak force",
        ylim=(0, 100),
    )
    right.legend(fontsize=8)
    for ax in (left, right):
        ax.grid(alpha=0.3)
    return picture
