"""Figure of the throughput of sweeps."""

from matplotlib.figure import Figure

from experiments._common.style import BLUE, ORANGE, grid_below, sheet
from experiments.sweeps.study import Row


def throughput(ways: list[Row]) -> Figure:
    """Draw the rate of points, and the time until the first points, for each way to run them."""
    figure, axes = sheet(9, 1.4 + 0.5 * len(ways), 1, 2, sharey=True)
    shown = {
        "points_per_second": ("points per second, after the first", BLUE, "%.1f"),
        "start_s": ("time to the first points (s)", ORANGE, "%.1f"),
    }
    for ax, (key, (label, color, form)) in zip(axes[0], shown.items(), strict=True):
        bars = ax.barh(range(len(ways)), [row[key] for row in ways], 0.6, color=color)
        ax.bar_label(bars, fmt=form, padding=3, fontsize=9)
        ax.set_yticks(range(len(ways)), [row["way"] for row in ways])
        ax.margins(x=0.15)
        ax.set_xlabel(label)
        grid_below(ax, axis="x")
    axes[0, 0].invert_yaxis()
    return figure
