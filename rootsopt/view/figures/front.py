"""Figure of a front: points, gaps and baseline, in one panel for each pair of terms."""

import itertools
import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes

from rootsopt.config.units import words
from rootsopt.status import Standing
from rootsopt.view.figures.style import BLUE, COLORS, DASHES, GREY, ORANGE, VERMILION, figure, write
from rootsopt.view.files import ResultFolder

if TYPE_CHECKING:
    from rootsopt.optimize.tradeoffs.front import Front

# Look of each kind of point.
_LOOKS: dict[str, dict[str, Any]] = {
    "certified": {"marker": "o", "color": BLUE, "markersize": 6.5},
    "not certified": {"marker": "o", "color": BLUE, "markersize": 6.5, "markerfacecolor": "white"},
    "best in one term": {"marker": "s", "color": BLUE, "markersize": 10, "markerfacecolor": "none"},
    "dominated": {"marker": "x", "color": GREY, "markersize": 5},
    "side of a gap": {"marker": "o", "color": ORANGE, "markersize": 13, "markerfacecolor": "none"},
    "baseline": {"marker": "*", "color": VERMILION, "markersize": 13},
}


def kinds(result: Mapping[str, Any]) -> dict[str, list[Mapping[str, Any]]]:
    """Return the points of each kind that a front has, in the order of drawing.

    `result`: content of the result file, as from `Front.record`. A side of a gap, and the best
    point in a term, are of another kind, too."""
    points, base = result["points"], result.get("baseline") or {}
    sides = {gap[end] for gap in result.get("gaps") or () for end in ("first", "second")}
    sure = Standing.CERTIFIED.label
    dropped = result.get("dropped") or ()
    found = {
        "side of a gap": [one for one in points if one["point"] in sides],
        "certified": [one for one in points if one["status"] == sure],
        "not certified": [one for one in points if one["status"] != sure],
        "best in one term": [one for one in points if one.get("end_of")],
        "dominated": [one for one in dropped if one["status"] == Standing.DOMINATED.label],
        "baseline": [base] if base.get("terms") else [],
    }
    return {kind: group for kind, group in found.items() if group}


def plot_front(ax: Axes, front: "Front", x: str, y: str) -> Axes:
    """Draw the points of a front with the term `x` across and the term `y` up.

    Lines connect neighbours, but not across a gap. For three terms, colours show the third. Return
    `ax`."""
    aims = {aim.name: aim for aim in front.aims}
    for edge in front.edges:
        ends = [front.points[k - 1].terms for k in edge]
        ax.plot([p[x] for p in ends], [p[y] for p in ends], color=GREY, linewidth=1, zorder=1)
    for kind, group in kinds(front.record()).items():
        across, up = ([one["terms"][name] for one in group] for name in (x, y))
        ax.plot(across, up, linestyle="", label=kind, **_LOOKS[kind])
    text: dict[str, Any] = {"textcoords": "offset points", "xytext": (6, -9), "fontsize": 8}
    for point in front.points:
        ax.annotate(str(point.number), (point.terms[x], point.terms[y]), color="0.3", **text)
    third = next((aim for aim in front.aims if aim.name not in (x, y)), None)
    if third is not None:
        places = ([point.terms[name] for point in front.points] for name in (x, y, third.name))
        across, up, values = places
        colours = ax.scatter(across, up, c=values, cmap="viridis", s=40, zorder=3)
        ax.figure.colorbar(colours, ax=ax, location="top", label=third.label, shrink=0.8)
    ax.set(xlabel=_axis(aims[x]), ylabel=_axis(aims[y]))
    return ax


def _axis(aim) -> str:
    better = "less is better" if aim.sense == "min" else "more is better"
    return f"{aim.label}, {better}"


def front_figure(folder: ResultFolder, front: "Front") -> None:
    """Write front.png, the front in one panel for each pair of terms.

    With two terms, a panel below shows the designs along the front, in units of their bounds."""
    names = [aim.name for aim in front.aims]
    if len(names) == 2:
        made, axes = figure(8.5, 8.2, 2, 1, sharex=True, height_ratios=[1.6, 1])
        plot_front(axes[0, 0], front, names[1], names[0]).set_xlabel("")
        plot_designs(axes[1, 0], front, names[1])
    else:
        pairs = list(itertools.combinations(names, 2))
        made, axes = figure(14, 5.4, 1, len(pairs))
        for ax, (y, x) in zip(axes[0], pairs, strict=True):
            plot_front(ax, front, x, y)
    words = [aim.words for aim in front.aims]
    title = f"trade-off of {', '.join(words[:-1])} against {words[-1]}"
    title = f"{front.config.profile.family.upper()}: {title}"
    write(folder, "front", made, title, axes[0, 0].get_legend_handles_labels()[0], 6)


def plot_designs(ax: Axes, front: "Front", x: str) -> Axes:
    """Draw the design parameters along a front over the term `x`, each in units of its bounds.

    Lines are interrupted at gaps. Return `ax`."""
    keys = [*front.points[0].design]
    points = np.array([point.point for point in front.points])
    aim = next(aim for aim in front.aims if aim.name == x)
    for k, key in enumerate(keys[:12]):
        color, dashes = COLORS[k % len(COLORS)], DASHES[k % len(DASHES)]
        for one, other in front.edges:
            ends = [front.points[n - 1].terms[x] for n in (one, other)]
            ax.plot(ends, points[[one - 1, other - 1], k], color=color, linestyle=dashes)
        at = [point.terms[x] for point in front.points]
        ax.plot(at, points[:, k], "o", color=color, markersize=4)
        ax.plot([], [], "o", color=color, linestyle=dashes, markersize=4, label=words(key))
    ax.set(xlabel=_axis(aim), ylabel="design (0: lower, 1: upper bound)", ylim=(-0.05, 1.05))
    ax.legend(frameon=False, fontsize=8, ncols=math.ceil(len(keys[:12]) / 4))
    return ax
