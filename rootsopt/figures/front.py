"""Figure of a front: points, gaps and baseline, in one panel for each pair of terms."""

import itertools
import math
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.lines import Line2D

from rootsopt.config.units import words
from rootsopt.figures.style import BLUE, COLORS, DASHES, GREY, ORANGE, VERMILION, figure, write
from rootsopt.output.files import ResultFolder
from rootsopt.tradeoffs.front import Front, Standing

_DROPPED = (Standing.DOMINATED,)


def plot_front(ax: Axes, front: Front, x: str, y: str) -> Axes:
    """Draw the points of a front with the term `x` across and the term `y` up.

    Lines connect neighbours, but not across a gap. For three terms, colours show the third. Return
    `ax`."""
    aims = {aim.name: aim for aim in front.aims}
    third = next((name for name in aims if name not in (x, y)), None)
    for one, other in front.edges:
        ends = [front.points[k - 1].terms for k in (one, other)]
        ax.plot([p[x] for p in ends], [p[y] for p in ends], color=GREY, linewidth=1, zorder=1)
    if third is not None:
        values = [point.terms[third] for point in front.points]
        norm = Normalize(min(values), max(values))
    for point in front.points:
        color = BLUE if third is None else matplotlib.colormaps["viridis"](norm(point.terms[third]))
        sure = point.standing is Standing.CERTIFIED
        fill = color if sure else "white"
        marker = "s" if point.end_of else "o"
        at = point.terms[x], point.terms[y]
        ax.plot(*at, marker, color=color, markerfacecolor=fill, markersize=6.5, zorder=3)
        text: dict[str, Any] = {"textcoords": "offset points", "xytext": (6, -9), "fontsize": 8}
        ax.annotate(str(point.number), at, color="0.3", **text)
    for point in front.dropped:
        if point.standing in _DROPPED:
            ax.plot(point.terms[x], point.terms[y], "x", color=GREY, markersize=5, zorder=2)
    for gap in front.gaps:
        ends = [front.points[k - 1].terms for k in (gap.first, gap.second)]
        for end in ends:
            ax.plot(end[x], end[y], "o", color=ORANGE, markerfacecolor="none", markersize=12)
    if front.baseline_terms:
        base = front.baseline_terms
        ax.plot(base[x], base[y], "*", color=VERMILION, markersize=13, zorder=4)
    ax.set(xlabel=_axis(aims[x]), ylabel=_axis(aims[y]))
    return ax


def _axis(aim) -> str:
    better = "less is better" if aim.sense == "min" else "more is better"
    return f"{aim.label}, {better}"


def _entries(front: Front) -> list[Line2D]:
    """Return legend entries with the meaning of all markers that the figure shows."""
    line = Line2D
    standings = {point.standing for point in front.points}
    plain: dict[str, Any] = {"color": BLUE, "linestyle": ""}
    entries = [line([], [], marker="o", label="certified", **plain)]
    if standings - {Standing.CERTIFIED}:
        entries.append(line([], [], marker="o", markerfacecolor="white", label="not certified",
                            **plain))  # fmt: skip
    if any(point.end_of for point in front.points):
        entries.append(line([], [], marker="s", label="best in one term", **plain))
    if any(point.standing in _DROPPED for point in front.dropped):
        entries.append(line([], [], color=GREY, linestyle="", marker="x", label="dominated"))
    if front.gaps:
        kinds = {gap.kind for gap in front.gaps}
        what = {"terms": "gap", "design": "change of design"}
        names = " or ".join(what[kind] for kind in ("terms", "design") if kind in kinds)
        entries.append(line([], [], color=ORANGE, linestyle="", marker="o", markersize=11,
                            markerfacecolor="none", label=f"side of a {names}"))  # fmt: skip
    if front.baseline_terms:
        entries.append(line([], [], color=VERMILION, linestyle="", marker="*", markersize=12,
                            label="baseline"))  # fmt: skip
    return entries


def front_figure(folder: ResultFolder, front: Front) -> list[str]:
    """Write front.png, the front in one panel for each pair of terms; return its name.

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
            third = next(aim for aim in front.aims if aim.name not in (x, y))
            values = [point.terms[third.name] for point in front.points]
            norm = Normalize(min(values), max(values))
            colours = ScalarMappable(norm, "viridis")
            made.colorbar(colours, ax=ax, location="top", label=third.label, shrink=0.8)
    words = [aim.words for aim in front.aims]
    title = f"trade-off of {', '.join(words[:-1])} against {words[-1]}"
    title = f"{front.config.profile.family.upper()}: {title}"
    return [write(folder, "front", made, title, _entries(front), 6)]


def plot_designs(ax: Axes, front: Front, x: str) -> Axes:
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


__all__ = ["front_figure", "plot_designs", "plot_front"]
