"""Figures over speed: mean and peak contact force of one design or several."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from rootsopt.figures.style import figure, looks, write
from rootsopt.output.files import ResultFolder
from rootsopt.output.names import in_words, label
from rootsopt.response.result import Part
from rootsopt.status import Status

_KNOWN = {"periodic": "o", "averaged": "s", "chaotic": "x", "not_settled": "+", "idle": "1"}
_OTHERS = (status.label for status in Status if status.label not in _KNOWN)
MARKERS = _KNOWN | dict(zip(_OTHERS, "v^<>d*phP2H3D4|X_", strict=False))
"""Marker of each status, by its label."""
_DENSE = 24
"""Number of points above which a line has no markers at its steady motions, except at isolated
ones."""
LABELS = {key: label(key) for key in ("mean_force_N", "peak_force_N")}


def plot_line(
    ax: Axes, at: NDArray, values: NDArray, labels: Any, look: dict[str, Any],
    joined: bool = True, row: int = 0,
) -> None:  # fmt: skip
    """Draw a force over a key: a line through usable points, and a marker for each status.

    `at`, `values` (n,): positions in ascending order, forces (NaN: not known); `labels` (n,):
    statuses; `look`: as from `looks`; `joined`: whether there is a line; `row`: number of the row
    at the bottom of the panel in which points without a force stand."""
    labels = np.asarray(labels)
    usable = np.array([Status[str(one).upper()].usable for one in labels])
    if joined:
        ax.plot(at, np.where(usable, values, np.nan), linewidth=1.5, **look)
    # A steady motion between two motions that are not steady gives no line, so it is marked.
    beside = np.concatenate([[False], usable, [False]])
    marked = ~usable | ~(beside[:-2] | beside[2:]) | (len(at) <= _DENSE) | (not joined)
    for status in dict.fromkeys(labels.tolist()):
        here = marked & (labels == status)
        known, lost = here & np.isfinite(values), here & ~np.isfinite(values)
        style = {"color": look["color"], "markersize": 5.5}
        ax.plot(at[known], values[known], MARKERS[status], **style)
        low = np.full(lost.sum(), 0.03 + 0.035 * row)
        ax.plot(at[lost], low, MARKERS[status], transform=ax.get_xaxis_transform(), **style)


def status_entries(found: Iterable[str], face: str = "black") -> list[Line2D]:
    """Return legend entries for the markers of the statuses `found`; `face`: colour of faces."""
    entries = []
    for status in dict.fromkeys(found):
        words = in_words(status)
        if status in ("chaotic", "not_settled"):
            words += ", average of a window"
        elif not Status[status.upper()].usable:
            words += ", no force"
        style: dict[str, Any] = {"marker": MARKERS[status], "markerfacecolor": face}
        entries.append(Line2D([], [], color="black", linestyle="", label=words, **style))
    return entries


def plot_speeds(ax: Axes, designs: Mapping[str, Sequence[Part]], force: str) -> Axes:
    """Draw a force over speed, one line per design.

    `designs`: evaluations of each design at all speeds, keyed by its name; `force`: key of the
    force in `Evaluation.response`. Lines connect steady motions. Other motions are drawn as single
    markers, at the bottom of the panel if their force is not known. Return `ax`.
    """
    for parts, look in zip(designs.values(), looks(designs), strict=True):
        speeds = np.array([part.speed_rpm for part in parts])
        values = np.array([part.evaluation.response.get(force, np.nan) for part in parts])
        plot_line(ax, speeds, values, [part.evaluation.status.label for part in parts], look)
    ax.set(ylabel=label(force))
    return ax


def legend_entries(designs: Mapping[str, Sequence[Part]]) -> list[Line2D]:
    """Return legend entries for the lines of the designs and for the markers of the statuses."""
    found = [
        part.evaluation.status.label
        for parts in designs.values()
        for part in parts
        if len(parts) <= _DENSE or not part.evaluation.usable
    ]
    lines = [Line2D([], [], linewidth=1.5, **look) for look in looks(designs)]
    return lines + (status_entries(found) if {*found} != {"periodic"} else [])


def speed_figure(
    folder: ResultFolder, designs: Mapping[str, Sequence[Part]], title: str
) -> list[str]:
    """Write speeds.png, mean and peak force over speed; return the names of the files written.

    `designs`: as in `plot_speeds`; `title`: title of the figure."""
    made, axes = figure(9, 6.6, 2, 1, sharex=True)
    for ax, force in zip(axes[:, 0], LABELS, strict=True):
        plot_speeds(ax, designs, force).set_ylim(0, None)
    axes[-1, 0].set_xlabel("speed (rpm)")
    return [write(folder, "speeds", made, title, legend_entries(designs))]
