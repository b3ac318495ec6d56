"""Figures that compare designs: points of a front, and designs over many scenes.

A front has one panel for each pair of terms. Scenes are those assumed, or those of scattered
values."""

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from rootsopt.config.units import words
from rootsopt.status import Standing
from rootsopt.view.comparison import label_of, named
from rootsopt.view.figures.style import (
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    VERMILION,
    figure,
    looks,
    write,
)
from rootsopt.view.files import ResultFolder
from rootsopt.view.names import brief, in_words, label, name_and_unit

if TYPE_CHECKING:
    from rootsopt.optimize.tradeoffs.front import Front


# Colour and marker of each kind of point.
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
    point in a term, also appear as their usual kind."""
    points, base = result["points"], result.get("baseline") or {}
    sides = {gap[end] for gap in result.get("gaps") or () for end in ("first", "second")}
    sure = Standing.CERTIFIED.label
    groups = {
        "side of a gap": [one for one in points if one["point"] in sides],
        "certified": [one for one in points if one["status"] == sure],
        "not certified": [one for one in points if one["status"] != sure],
        "best in one term": [one for one in points if one.get("end_of")],
        "dominated": [
            one for one in result.get("dropped") or () if one["status"] == Standing.DOMINATED.label
        ],
        "baseline": [base] if base.get("terms") else [],
    }
    return {kind: group for kind, group in groups.items() if group}


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
        across, up, values = (
            [point.terms[name] for point in front.points] for name in (x, y, third.name)
        )
        colours = ax.scatter(across, up, c=values, cmap="viridis", s=40, zorder=3)
        ax.figure.colorbar(colours, ax=ax, location="top", label=third.label, shrink=0.8)
    ax.set(xlabel=_axis(aims[x]), ylabel=_axis(aims[y]))
    return ax


def _axis(aim) -> str:
    return f"{aim.label}, {'less' if aim.sense == 'min' else 'more'} is better"


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
    *others, last = [aim.words for aim in front.aims]
    family = front.config.profile.family.upper()
    title = f"{family}: trade-off of {', '.join(others)} against {last}"
    write(folder, "front", made, title, axes[0, 0].get_legend_handles_labels()[0], 6)


def plot_designs(ax: Axes, front: "Front", x: str) -> None:
    """Draw the design parameters along a front over the term `x`, each in units of its bounds.

    Lines are interrupted at gaps."""
    keys = [*front.points[0].design]
    points = np.array([point.point for point in front.points])
    aim = next(aim for aim in front.aims if aim.name == x)
    at = np.array([point.terms[x] for point in front.points])
    for k, look in enumerate(looks(map(words, keys[:12]))):
        for edge in front.edges:
            ends = np.array(edge) - 1
            ax.plot(at[ends], points[ends, k], color=look["color"], linestyle=look["linestyle"])
        ax.plot(at, points[:, k], "o", color=look["color"], markersize=4)
        ax.plot([], [], "o", markersize=4, **look)
    ax.set(xlabel=_axis(aim), ylabel="design (0: lower, 1: upper bound)", ylim=(-0.05, 1.05))
    ax.legend(frameon=False, fontsize=8, ncols=math.ceil(len(keys[:12]) / 4))


_OBJECTIVE = "objective (baseline in the same scene = 1)"

# Multiple of the 90 % quantile of the objectives at which their axis ends.
_WIDE = 1.5


def plot_ranges(ax: Axes, keys: Sequence[Mapping[str, Any]], own: float) -> None:
    """Draw the objective at both ends of the range of each quantity, one row per quantity.

    `keys`: rows of the result file; `own`: objective in the config's own scene."""
    for k, row in enumerate(keys):
        low, high = (np.nan if row[f"objective_{end}"] is None else row[f"objective_{end}"]
                     for end in ("low", "high"))  # fmt: skip
        ax.plot([low, own, high], [k] * 3, "-", color=GREY, linewidth=1)
        ax.plot(low, k, "o", mfc="white", mec=BLUE, label="low end" if k == 0 else None)
        ax.plot(high, k, "o", color=BLUE, label="high end" if k == 0 else None)
    names = [
        f"{named(row['key'])}\n{brief(row['low'], 3)} … {brief(row['high'], 3)} "
        f"{name_and_unit(row['key'])[1]}".rstrip()
        for row in keys
    ]
    ax.set_yticks(range(len(keys)), names)
    ax.axvline(own, color=BLUE, linewidth=0.8, linestyle=":", label="as given")
    ax.axvline(1, color="black", linewidth=0.8)
    ax.invert_yaxis()
    ax.set_xlabel(_OBJECTIVE)


def plot_scenes(ax: Axes, key: str, columns: Mapping[str, Sequence[Any]]) -> None:
    """Draw the objective of all designs in the random scenes over the quantity `key`.

    `columns`: those of `assumptions.csv`."""
    names = [
        name for name in columns if name.startswith("objective_") and name != "objective_baseline"
    ]
    values = np.array(columns[key], float)
    drawn = np.array([name.startswith("random") for name in columns["scene"]])
    marks = {"objective_optimized": (BLUE, "o"), "objective_design_1": (VERMILION, "x")}
    for name in names:
        color, mark = marks.get(name, (GREY, "+"))
        word = in_words(name.removeprefix("objective_")).replace("ized", "ised")
        ax.plot(values[drawn], np.array(columns[name], float)[drawn], mark, color=color, label=word)
    ax.axhline(1, color="black", linewidth=0.8, label="baseline")
    places = np.concatenate([np.column_stack(line.get_data()) for line in ax.get_lines()[:-1]])
    places = places[np.isfinite(places).all(axis=1)].reshape(-1, 2)
    # Scenes with almost no baseline force would otherwise stretch the axis.
    high = _WIDE * max(1.0, np.quantile(places[:, 1], 0.9)) if len(places) else np.inf
    beyond = places[places[:, 1] > high]
    if len(beyond):
        low = np.min(places[:, 1])
        ax.set_ylim(low - 0.05 * (high - low), high)
        at = {"transform": ax.get_xaxis_transform(), "clip_on": False, "label": "above the axis"}
        ax.plot(beyond[:, 0], np.full(len(beyond), 0.98), "^", color=GREY, **at)
    ax.set(xlabel=f"{label_of(key)}, all else random, too", ylabel=_OBJECTIVE)


def spread_figure(
    folder: "ResultFolder", record: Mapping[str, Any], columns: Mapping[str, Sequence[Any]]
) -> None:
    """Write `figures/assumptions.png`.

    `record`: entry `assumptions` of the result file; `columns`: those of `assumptions.csv`."""
    rows, rivals = record["keys"], record["rivals"]
    made, ((left, right),) = figure(11, 1.6 + 0.5 * max(5, len(rows)), 1, 2)
    plot_ranges(left, rows, columns["objective_optimized"][0])
    plot_scenes(right, rivals[0]["key"] if rivals else record["decides"], columns)
    entries = [x for ax in (left, right) for x in ax.get_legend_handles_labels()[0]]
    write(folder, "assumptions", made, "The optimum where the pump may run", entries, 6)


# Look of each design in `distributions`.
_STYLES: dict[str, dict[str, Any]] = {
    "baseline": {"label": "baseline", "color": GREY},
    "nominal": {"label": "nominal optimum", "color": BLUE},
    "robust": {"label": "robust optimum", "color": GREEN, "linestyle": (0, (4, 1.5))},
}

# Maximum number of bins of a histogram.
_BINS = 50

# Least average number of scenes per bin, if there are few scenes.
_PER_BIN = 6


def plot_distribution(ax: Axes, designs: Mapping[str, ArrayLike], force: str) -> None:
    """Draw a histogram of each design's force, and a vertical line at its 95 % quantile.

    `designs`: force in each scene (n,) by name of the design (keys of `_STYLES`); scenes without a
    usable motion are NaN and left out. `force`: its key.
    """
    known = {name: np.asarray(values, float) for name, values in designs.items()}
    known = {name: x[np.isfinite(x)] for name, x in known.items() if np.isfinite(x).any()}
    every = np.concatenate([np.zeros(0), *known.values()])
    most = max((values.size for values in known.values()), default=0)
    bins = max(1, min(_BINS, most // _PER_BIN))
    edges = np.histogram_bin_edges(every, bins).tolist()
    for name, values in known.items():
        style, weights = _STYLES[name], np.full(len(values), 100 / len(values))
        ax.hist(values, edges, weights=weights, histtype="step", linewidth=1.6, **style)
        line = style | {"label": None, "linewidth": 1.0, "alpha": 0.8}
        ax.axvline(float(np.quantile(values, 0.95)), **line)
    ax.set(xlabel=label(force), ylabel="share of the scenes (%)")


def distributions(designs: Mapping[str, Mapping[str, ArrayLike]], title: str) -> Figure:
    """Return a figure of the distributions of mean and peak force, one panel each.

    `designs`: by name of the design, its forces in each scene by key."""
    made, axes = figure(11, 4.4, 1, 2)
    for ax, force in zip(axes[0], ("mean_force_N", "peak_force_N"), strict=True):
        plot_distribution(ax, {name: one[force] for name, one in designs.items()}, force)
    entries = axes[0, 0].get_legend_handles_labels()
    made.legend(*entries, loc="outside lower center", ncols=3, frameon=False)
    made.suptitle(f"{title}; vertical lines: 95 % quantiles")
    return made
