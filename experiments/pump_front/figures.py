"""Figure of the fronts of all families, pair by pair of terms."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from experiments._common.style import BLACK, COLORS, GREY, MARKS, grid_below, sheet
from experiments.pump_front.study import REFERENCE, Row

_LABELS = {
    "mean_force_N": ("mean contact force (N)", 1.0),
    "leakage_fraction": ("leakage (% of the flow)", 100.0),
    "flow_ripple": ("flow ripple (%)", 100.0),
    "radius_ratio": ("outer radius / pitch radius", 1.0),
}
_PANELS = (
    ("leakage_fraction", "mean_force_N"),
    ("flow_ripple", "mean_force_N"),
    ("flow_ripple", "leakage_fraction"),
    ("radius_ratio", "flow_ripple"),
)
_EFFICIENCIES = 0.35, 0.40, 0.45, 0.50


def fronts(rows: list[Row]) -> Figure:
    """Draw all best compromises, filled if no other family has a better one.

    The last panel shows that outer radius and area efficiency fix the ripple."""
    made, axes = sheet(11, 8.6, 2, 2)
    families = [*dict.fromkeys(row["family"] for row in rows if row["family"] != REFERENCE)]
    styles = {name: (COLORS[k % 6], MARKS[k % 7]) for k, name in enumerate(families)}
    styles[REFERENCE] = BLACK, "*"
    for ax, (x, y) in zip(axes.ravel(), _PANELS, strict=True):
        for row in rows:
            color, mark = styles[row["family"]]
            at = [_LABELS[key][1] * row[key] for key in (x, y)]
            fill = color if row["best_of_all"] else "none"
            size = 11 if row["family"] == REFERENCE else 6
            ax.plot(*at, mark, color=color, markerfacecolor=fill, ms=size, zorder=3)
        ax.set(xlabel=_LABELS[x][0], ylabel=_LABELS[y][0])
        grid_below(ax)
    _iso_efficiency(axes[1, 1])
    entries = [
        Line2D([], [], color=color, marker=mark, linestyle="", label=name.replace("_", " "))
        for name, (color, mark) in styles.items()
    ]
    plain: dict[str, Any] = {"color": GREY, "marker": "o", "linestyle": ""}
    entries.append(Line2D([], [], label="best of all families", **plain))
    entries.append(Line2D([], [], label="best of its family", markerfacecolor="none", **plain))
    made.legend(handles=entries, loc="outside lower center", ncols=6, frameon=False)
    return made


def _iso_efficiency(ax: Axes) -> None:
    """Draw the closed form of the ripple over the radius ratio at several area efficiencies."""
    (low, high), (bottom, top) = ax.get_xlim(), ax.get_ylim()
    ratio = np.linspace(low, high, 200)
    for eta in _EFFICIENCIES:
        ripple = 100 * (ratio - 1) ** 2 / (eta * ratio**2)
        ax.plot(ratio, ripple, color=GREY, linewidth=0.8, zorder=1)
        inside = np.flatnonzero((ripple > bottom) & (ripple < top))
        if inside.size:
            place = inside[int(0.85 * inside.size)]
            beside = {"textcoords": "offset points", "xytext": (4, -4), "fontsize": 8}
            ax.annotate(f"η = {eta:.2f}", (ratio[place], ripple[place]), color="0.3", **beside)
    ax.set(xlim=(low, high), ylim=(bottom, top))
