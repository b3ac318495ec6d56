"""Figure of ripple, force and bearing load over the twist."""

import numpy as np
from matplotlib.figure import Figure

from experiments._common.style import COLORS, MARKS, grid_below, sheet
from experiments.twist.study import Row

_PANELS = {
    "flow_ripple": ("flow ripple (%)", 100.0),
    "mean_force_N": ("mean contact force (N)", 1.0),
    "peak_force_N": ("peak contact force (N)", 1.0),
    "bearing_load_equivalent_N": ("equivalent bearing load (N)", 1.0),
    "axial_force_max_N": ("greatest axial force (N)", 1.0),
    "tilting_moment_max_N_m": ("greatest tilting moment (N m)", 1.0),
}


def over_twist(rows: list[Row]) -> Figure:
    """Draw each quantity over the twist, one line per number of lobes."""
    figure, axes = sheet(11, 6.6, 2, 3, sharex=True)
    numbers = sorted({row["lobes"] for row in rows})
    for ax, (key, (label, factor)) in zip(axes.ravel(), _PANELS.items(), strict=True):
        for lobes, color, mark in zip(numbers, COLORS, MARKS, strict=False):
            own = [row for row in rows if row["lobes"] == lobes]
            values = [np.nan if row[key] is None else factor * row[key] for row in own]
            twists = [row["twist_deg"] for row in own]
            ax.plot(twists, values, color=color, marker=mark, ms=4, label=f"{lobes} lobes")
        ax.set_ylabel(label)
        ax.set_ylim(bottom=0)
        grid_below(ax)
    for ax in axes[-1]:
        ax.set_xlabel("twist over the length (°)")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, frameon=False)
    return figure
