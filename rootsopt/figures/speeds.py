"""Figures over speed: mean and peak contact force of one design or several."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from rootsopt.figures.style import (
    COLORS,
    DASHES,
    figure,
)
from rootsopt.output.files import ResultFolder
from rootsopt.output.names import label
from rootsopt.response.result import Part

_MARKERS = {"periodic": "o", "averaged": "s", "chaotic": "x", "not_settled": "+"}
_NO_FORCE = "v"
_FEW = 24
"""Number of speeds above which a line has no markers at its steady motions, except at isolated
ones."""
LABELS = {key: label(key) for key in ("mean_force_N", "peak_force_N")}


def plot_speeds(ax: Axes, designs: Mapping[str, Sequence[Part]], force: str) -> Axes:
    """Draw a force over speed, one line per design.

    `designs`: evaluations of each design at all speeds, keyed by its name; `force`: key of the
    force in `Evaluation.response`. Lines connect steady motions. Other motions are drawn as single
    markers, at the bottom of the panel if their force is not known. Return `ax`.
    """
    for (name, parts), color, dashes in zip(designs.items(), COLORS, DASHES * 2, strict=False):
        speeds = np.array([part.speed_rpm for part in parts])
        values = np.array([part.evaluation.response.get(force, np.nan) for part in parts])
        usable = np.array([part.evaluation.usable for part in parts])
        line = np.where(usable, values, np.nan)
        ax.plot(speeds, line, color=color, linestyle=dashes, linewidth=1.5, label=name)
        # A steady motion between two motions that are not steady gives no line, so it is marked.
        beside = np.concatenate([[False], usable, [False]])
        marked = ~usable | (len(parts) <= _FEW) | ~(beside[:-2] | beside[2:])
        for part, value, mark in zip(parts, values, marked, strict=True):
            if not mark:
                continue
            status = part.evaluation.status.label
            marker = _MARKERS.get(status, _NO_FORCE)
            height = value if np.isfinite(value) else 0.03
            (point,) = ax.plot(part.speed_rpm, height, marker, color=color, markersize=5.5)
            if not np.isfinite(value):
                point.set_transform(ax.get_xaxis_transform())
    ax.set(ylabel=label(force))
    ax.grid(color="0.92", linewidth=0.6)
    ax.set_axisbelow(True)
    return ax


def legend_entries(designs: Mapping[str, Sequence[Part]]) -> list[Line2D]:
    """Return legend entries for the lines of the designs and for the markers of the statuses."""
    entries = []
    for name, color, dashes in zip(designs, COLORS, DASHES * 2, strict=False):
        entries.append(Line2D([], [], color=color, linestyle=dashes, linewidth=1.5, label=name))
    found = dict.fromkeys(
        part.evaluation.status.label
        for parts in designs.values()
        for part in parts
        if len(parts) <= _FEW or not part.evaluation.usable
    )
    if list(found) != ["periodic"]:
        for status in found:
            words = status.replace("_", " ")
            if status in ("chaotic", "not_settled"):
                words += ", average of a window"
            elif status not in _MARKERS:
                words += ", no force"
            marker = _MARKERS.get(status, _NO_FORCE)
            entry = Line2D([], [], color="black", linestyle="", marker=marker, label=words)
            entries.append(entry)
    return entries


def speed_figure(
    folder: ResultFolder, designs: Mapping[str, Sequence[Part]], title: str
) -> list[str]:
    """Write speeds.png, mean and peak force over speed; return the names of the files written.

    `designs`: as in `plot_speeds`; `title`: title of the figure."""
    made, axes = figure(9, 6.6, 2, 1, sharex=True)
    for ax, force in zip(axes[:, 0], LABELS, strict=True):
        plot_speeds(ax, designs, force).set_ylim(0, None)
    axes[-1, 0].set_xlabel("speed (rpm)")
    entries = legend_entries(designs)
    made.legend(handles=entries, loc="outside lower center", ncols=min(len(entries), 4),
                frameon=False)  # fmt: skip
    made.suptitle(title)
    name = "figures/speeds.png"
    folder.write_figure(name, made)
    return [name]
