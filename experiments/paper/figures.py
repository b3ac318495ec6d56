"""Figures of the paper's scene: forces, and how far they determine it."""

import numpy as np
from matplotlib.figure import Figure

from experiments._common.style import COLORS, sheet
from experiments.paper.scene import FAMILIES, PAPER, QUANTITIES, Response, config_of
from experiments.paper.study import Row
from rootsopt.view.figures.force import plot_force, plot_spectrum

# Range of misfits (%) shown. Larger misfits and non-periodic motions are at the upper edge.
LOWEST, HIGHEST = 0.1, 300.0
MARKS = "os^Dvp"


def force_figures(found: Response) -> tuple[Figure, Figure]:
    """Draw the contact force over time and over frequency, EE above CIC as in the paper."""
    series, responses = {}, {}
    for family, one, (mean, peak) in [*zip(FAMILIES, found.evaluations, PAPER, strict=True)][::-1]:
        title = f"{family.upper()}; the paper: mean {mean:.1f} N, maximum {peak:.1f} N"
        series[title], responses[title] = one.series, one.response
    over_time, axes = sheet(10, 6, 2)
    plot_force(axes[:, 0], series, responses)
    over_frequency, axes = sheet(10, 6, 2)
    series = {title.split(";")[0]: run for title, run in series.items()}
    config = config_of("cic")
    plot_spectrum(axes[:, 0], series, config.scene.speed_rpm / 60 * config.profile.lobes)
    return over_time, over_frequency


def uniqueness_figure(alone: list[Row], solved: list[Row]) -> Figure:
    """Draw the misfit over each quantity: changed alone, and with the others solved for again."""
    made, axes = sheet(11, 4.8, 1, 2 if solved else 1, sharey=True)
    panels = [(alone, "changed alone"), (solved, "the others solved for again")]
    for ax, (rows, title) in zip(axes[0], panels, strict=False):
        for quantity, color, mark in zip(QUANTITIES, COLORS, MARKS, strict=False):
            own = [row for row in rows if row["changed"] == quantity.key]
            own = [(100 * row["change"], 100 * row["misfit"]) for row in own]
            change, misfit = np.array(sorted([*own, (0.0, LOWEST)])).T
            style = {"marker": mark, "color": color, "label": quantity.label}
            ax.plot(change, np.clip(misfit, LOWEST, HIGHEST), clip_on=False, **style)
        ax.axhline(10, color="black", linestyle="--", linewidth=1)
        ax.set(
            xlabel="change of the quantity (%)", title=title, yscale="log", ylim=(LOWEST, HIGHEST)
        )
        ax.yaxis.set_major_formatter("{x:g}")
    axes[0, 0].set_ylabel("largest error of the four forces (%)")
    axes[0, -1].legend(loc="upper left", bbox_to_anchor=(1.01, 1), frameon=False)
    return made
