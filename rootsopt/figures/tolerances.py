"""Figures of designs in many scenes with scattered values: distributions of the contact force."""

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from rootsopt.figures.style import BLUE, GREEN, GREY, figure

NAMES = {"baseline": "baseline", "nominal": "nominal optimum", "robust": "robust optimum"}
"""Names of the designs in legends."""
_STYLES = {
    "baseline": (GREY, "-"),
    "nominal": (BLUE, "-"),
    "robust": (GREEN, (0, (4, 1.5))),
}
_BINS = 50
"""Maximum number of bins of a histogram."""
_PER_BIN = 6
"""Least average number of scenes per bin, if there are few scenes."""
PANELS = {"mean_force_N": "mean force (N)", "peak_force_N": "peak force (N)"}
"""Forces that `distributions` draws, with the labels of their axes."""


def plot_distribution(ax: Axes, designs: Mapping[str, ArrayLike], label: str) -> Axes:
    """Draw a histogram of each design's force, and a vertical line at its 95 % quantile.

    `designs`: force in each scene (n,) by name of the design (keys of `NAMES`); scenes without a
    usable motion are NaN and left out. `label`: that of the horizontal axis. Return `ax`.
    """
    known = {name: np.asarray(values, float) for name, values in designs.items()}
    known = {name: values[np.isfinite(values)] for name, values in known.items()}
    known = {name: values for name, values in known.items() if values.size}
    every = np.concatenate([np.zeros(0), *known.values()])
    most = max((values.size for values in known.values()), default=0)
    bins = max(1, min(_BINS, most // _PER_BIN))
    edges = np.histogram_bin_edges(every, bins).tolist()
    for name, values in known.items():
        color, dashes = _STYLES[name]
        style = {"color": color, "linestyle": dashes}
        weights = np.full(len(values), 100 / len(values))
        ax.hist(values, edges, weights=weights, histtype="step", linewidth=1.6,
                label=NAMES[name], **style)  # fmt: skip
        ax.axvline(float(np.quantile(values, 0.95)), linewidth=1.0, alpha=0.8, **style)
    ax.set(xlabel=label, ylabel="share of the scenes (%)")
    return ax


def distributions(designs: Mapping[str, Mapping[str, ArrayLike]], title: str) -> Figure:
    """Return a figure of the distributions of mean and peak force, one panel each.

    `designs`: by name of the design, its forces in each scene by key (`PANELS`)."""
    made, axes = figure(11, 4.4, 1, len(PANELS))
    for ax, (key, label) in zip(axes[0], PANELS.items(), strict=True):
        plot_distribution(ax, {name: one[key] for name, one in designs.items()}, label)
    lines, names = axes[0, 0].get_legend_handles_labels()
    made.legend(lines, names, loc="outside lower center", ncols=3, frameon=False)
    made.suptitle(f"{title}; vertical lines: 95 % quantiles")
    return made


__all__ = ["NAMES", "PANELS", "distributions", "plot_distribution"]
