"""Figure of the distributions of the contact force in fresh scenes, one row of panels per case."""

from collections.abc import Sequence

from matplotlib.figure import Figure

from experiments._common.style import sheet
from experiments.tolerances.study import CASES, Found
from rootsopt.figures.tolerances import PANELS, plot_distribution


def panels(found: Sequence[Found]) -> Figure:
    """Draw histograms of mean and peak force of baseline and optima, one row per case."""
    made, axes = sheet(11, 0.8 + 3.4 * len(found), len(found), len(PANELS))
    for row, one in zip(axes, found, strict=True):
        for ax, (force, label) in zip(row, PANELS.items(), strict=True):
            designs = {name: each.values[force] for name, each in one.robustness.fresh.items()}
            plot_distribution(ax, designs, label)
        row[0].set_title(CASES[one.name].title, loc="left", fontsize=10)
    lines, names = axes[0, 0].get_legend_handles_labels()
    made.legend(lines, names, loc="outside lower center", ncols=3, frameon=False)
    return made
