"""Figures of a sweep: forces over one key, or over two."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from rootsopt.figures.style import COLORS, DASHES, figure
from rootsopt.output.files import ResultFolder
from rootsopt.status import Status
from rootsopt.sweeps.plan import Plan
from rootsopt.sweeps.table import is_numeric, unit, written

FORCES = {"mean_force_N": "mean force (N)", "peak_force_N": "peak force (N)"}
_MARKERS = {"periodic": "o", "averaged": "s", "chaotic": "x", "not_settled": "+", "idle": "1"}
_OTHERS = "v^<>d*Pph2"
"""Markers for statuses without a marker of their own, in the order in which these appear."""
_FEW = len(COLORS)
"""Number of values of the second key above which it is drawn as a map, not as lines."""
_DENSE = 24
"""Number of values on a line above which steady motions have no markers."""


class _Axis:
    """A key on an axis of a figure: positions, label, and ticks for values that are not numbers."""

    def __init__(self, key: str, values: Sequence[Any]):
        self.key, self.values = key, values
        self.numeric = is_numeric(values)
        self.at = np.array(values, float) if self.numeric else np.arange(len(values), dtype=float)
        units = unit(key)
        self.name = key.rpartition(".")[2]
        self.label = key if units == "1" else f"{key} ({units})"
        positive = self.numeric and bool(np.all(self.at > 0)) and len({*values}) > 2
        steps = np.diff(np.sort(self.at))
        self.log = positive and bool(steps.max() > 30 * steps.min() and self._ratio() > 30)

    def _ratio(self) -> float:
        return float(self.at.max() / self.at.min())

    def words(self, value: Any) -> str:
        """Return a value as text for a legend."""
        return f"{self.name} = {value:g}" if self.numeric else _short(written(value))

    def on(self, axis: Any) -> None:
        """Set scale and ticks of a matplotlib axis."""
        if self.log:
            getattr(axis.axes, f"set_{axis.axis_name}scale")("log")
        if not self.numeric:
            axis.set_ticks(self.at, [_short(written(value)) for value in self.values])


def _short(text: str) -> str:
    return text if len(text) <= 24 else f"{text[:21]}..."


def sweep_figure(folder: ResultFolder, plan: Plan, dataset: xarray.Dataset) -> list[str]:
    """Write sweep.png, mean and peak force over one key or two; return the files written.

    A sweep over more keys has no figure."""
    if len(plan.keys) > 2:
        return []
    axes = [_Axis(key, values) for one in plan.dimensions for key, values in one.columns.items()]
    markers = _markers(dataset)
    if len(axes) == 1 or (len(plan.shape) == 2 and min(plan.shape) <= _FEW):
        made = _lines(axes, plan, dataset, markers)
    else:
        made = _map(axes, plan, dataset, markers)
    name = "figures/sweep.png"
    folder.write_figure(name, made)
    return [name]


def _markers(dataset: xarray.Dataset) -> dict[str, str]:
    """Return a marker for each status in the dataset."""
    found = [str(label) for label in dict.fromkeys(dataset.status.values.ravel())]
    others = iter(_OTHERS * (1 + len(found) // len(_OTHERS)))
    return {label: _MARKERS.get(label) or next(others) for label in found}


def _lines(axes, plan: Plan, dataset: xarray.Dataset, markers) -> Figure:
    """Draw the forces over one key, with a line for each value of the other key, if there is one.

    The first key is on the axis, unless the second one has too many values, or only the second one
    has numbers."""
    across, along = axes[0], axes[1] if len(axes) == 2 else None
    few, numbers = [size <= _FEW for size in plan.shape], [axis.numeric for axis in axes]
    swapped = along is not None and (not few[1] or (few[0] and numbers == [False, True]))
    if along is not None and swapped:
        across, along = along, across
    made, panels = figure(9, 6.6, len(FORCES), 1, sharex=True)
    for ax, (force, label) in zip(panels[:, 0], FORCES.items(), strict=True):
        values, labels = _table(dataset, force, swapped), _table(dataset, "status", swapped)
        for column in range(values.shape[1]):
            _line(ax, across, (values[:, column], labels[:, column]), column, markers)
        ax.set_ylabel(label)
        if np.isfinite(values).any():
            ax.set_ylim(0, 1.05 * np.nanmax(values) or 1)
        ax.grid(color="0.92", linewidth=0.6)
        ax.set_axisbelow(True)
    across.on(panels[-1, 0].xaxis)
    panels[-1, 0].set_xlabel(across.label)
    entries = _entries(markers)
    if along is not None:
        entries = [
            Line2D([], [], color=COLORS[k], linestyle=_dash(k), label=along.words(value))
            for k, value in enumerate(along.values)
        ] + entries
    made.legend(handles=entries, loc="outside lower center", ncols=4, frameon=False)
    made.suptitle(f"Contact force over {across.key}")
    return made


def _table(dataset: xarray.Dataset, name: str, swapped: bool) -> NDArray:
    """Return a variable as an array (n, m); m is 1 for a sweep over one key."""
    values = dataset[name].values
    values = values.reshape(len(values), -1)
    return values.T if swapped else values


def _dash(number: int) -> Any:
    return DASHES[number % len(DASHES)]


def _line(ax: Axes, across: _Axis, column: tuple[NDArray, NDArray], number: int, markers) -> None:
    """Draw a force over a key: a line through usable points, and a marker for each status."""
    order = np.argsort(across.at, kind="stable")
    at, (values, labels) = across.at[order], (part[order] for part in column)
    usable = np.array([Status[str(label).upper()].usable for label in labels])
    color = COLORS[number]
    style: dict[str, Any] = {"color": color, "linestyle": _dash(number), "linewidth": 1.5}
    if across.numeric:
        ax.plot(at, np.where(usable, values, np.nan), **style)
    beside = np.concatenate([[False], usable, [False]])
    alone = usable & ~(beside[:-2] | beside[2:])
    for label, marker in markers.items():
        here = (labels == label) & (~usable | alone | (len(at) <= _DENSE) | (not across.numeric))
        known, lost = here & np.isfinite(values), here & ~np.isfinite(values)
        ax.plot(at[known], values[known], marker, color=color, markersize=5.5)
        # Points without a force stand at the bottom, a row for each line.
        low = np.full(lost.sum(), 0.03 + 0.035 * number)
        transform = ax.get_xaxis_transform()
        ax.plot(at[lost], low, marker, color=color, markersize=5.5, transform=transform)


def _map(axes, plan: Plan, dataset: xarray.Dataset, markers) -> Figure:
    """Draw the forces over two keys as colours: a map of a grid, or points of a sample."""
    across, up = axes
    made, panels = figure(12, 5.4, 1, len(FORCES), sharex=True, sharey=True)
    labels = dataset.status.values.astype(str)
    grid = len(plan.shape) == 2
    for ax, (force, label) in zip(panels[0], FORCES.items(), strict=True):
        values = dataset[force].values
        known = values[np.isfinite(values)]
        norm = Normalize(*((known.min(), known.max()) if known.size else (0, 1)))
        if grid:
            x, y = (np.argsort(axis.at, kind="stable") for axis in axes)
            drawn = ax.pcolormesh(
                across.at[x], up.at[y], values[np.ix_(x, y)].T,
                norm=norm, cmap="viridis", shading="nearest",
            )  # fmt: skip
            places = np.meshgrid(across.at, up.at, indexing="ij")
        else:
            places = [across.at, up.at]
            drawn = ax.scatter(*places, c=values, norm=norm, cmap="viridis", s=36)
        made.colorbar(drawn, ax=ax, label=label)
        for status, marker in markers.items():
            if not Status[status.upper()].usable:
                here = labels == status
                ax.plot(places[0][here], places[1][here], marker, color="black",
                        markersize=6, markerfacecolor="none")  # fmt: skip
        across.on(ax.xaxis)
        up.on(ax.yaxis)
        ax.set_xlabel(across.label)
    panels[0, 0].set_ylabel(up.label)
    entries = _entries({k: v for k, v in markers.items() if not Status[k.upper()].usable}, "none")
    if entries:
        made.legend(handles=entries, loc="outside lower center", ncols=5, frameon=False)
    made.suptitle(f"Contact force over {across.key} and {up.key}")
    return made


def _entries(markers: dict[str, str], face: str = "black") -> list[Line2D]:
    """Return legend entries for the markers of statuses; `face`: colour of their faces."""
    found = []
    for label, marker in markers.items():
        words = label.replace("_", " ")
        if label in ("chaotic", "not_settled"):
            words += ", average of a window"
        elif face == "black" and Status[label.upper()].usable:
            words += ", joined by lines"
        style: dict[str, Any] = {"linestyle": "", "marker": marker, "markerfacecolor": face}
        found.append(Line2D([], [], color="black", label=words, **style))
    return found


__all__ = ["FORCES", "sweep_figure"]
