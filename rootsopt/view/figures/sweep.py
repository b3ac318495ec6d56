"""Figures of a sweep and of coexisting motions.

Forces over speed, over any key or over two; basins of attraction, and the force of each motion."""

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm, ListedColormap, Normalize, to_hex, to_rgb
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray

from rootsopt.config.reading import Config
from rootsopt.dynamics.steady import CLOSED, OPEN
from rootsopt.response.attractors import Attractor, Basins
from rootsopt.response.result import Part
from rootsopt.response.sweeps.plan import Plan
from rootsopt.response.sweeps.scenes import is_numeric, written
from rootsopt.status import Status
from rootsopt.view.figures.style import COLORS, GREY, figure, lay_grid, looks, write
from rootsopt.view.files import ResultFolder
from rootsopt.view.names import in_words, label, name_and_unit

if TYPE_CHECKING:
    import xarray


_KNOWN = {"periodic": "o", "averaged": "s", "chaotic": "x", "not_settled": "+", "idle": "1"}
_OTHERS = (status.label for status in Status if status.label not in _KNOWN)
MARKERS = _KNOWN | dict(zip(_OTHERS, "v^<>d*phP2H3D4|X_8.", strict=False))
"""Marker of each status, by its label."""

# Number of points above which a line has no markers at its steady motions, except at isolated
# ones.
_DENSE = 24
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


def status_entries(statuses: Iterable[str], face: str = "black") -> list[Line2D]:
    """Return legend entries for the markers of the `statuses`; `face`: colour of faces."""
    entries = []
    for status in dict.fromkeys(statuses):
        words, known = in_words(status), Status[status.upper()]
        if known in OPEN:
            words += ", average of a window"
        elif not known.usable:
            words += ", no gradient" if known in CLOSED else ", no force"
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
    statuses = [
        part.evaluation.status.label
        for parts in designs.values()
        for part in parts
        if len(parts) <= _DENSE or not part.evaluation.usable
    ]
    lines = [Line2D([], [], linewidth=1.5, **look) for look in looks(designs)]
    return lines + (status_entries(statuses) if {*statuses} != {"periodic"} else [])


def speed_figure(folder: ResultFolder, designs: Mapping[str, Sequence[Part]], title: str) -> None:
    """Write speeds.png, mean and peak force over speed.

    `designs`: as in `plot_speeds`; `title`: title of the figure."""
    made, axes = figure(9, 6.6, 2, 1, sharex=True)
    for ax, force in zip(axes[:, 0], LABELS, strict=True):
        plot_speeds(ax, designs, force).set_ylim(0, None)
    axes[-1, 0].set_xlabel("speed (rpm)")
    write(folder, "speeds", made, title, legend_entries(designs))


# What is drawn where no flanks touch.
_APART = "contact_reserve_um", "gear_force_N"

# Number of values of the second key above which it is drawn as a map, not as lines.
_FEW = len(COLORS)


class _Axis:
    """A key on an axis of a figure: positions, label, and ticks for values that are not numbers."""

    def __init__(self, key: str, values: Sequence[Any]):
        self.values = values
        self.numeric = is_numeric(values)
        self.at = np.array(values, float) if self.numeric else np.arange(len(values), dtype=float)
        self.name, self.unit = name_and_unit(key)
        self.label = label(key)
        positive = self.numeric and bool(np.all(self.at > 0)) and len({*values}) > 2
        steps = np.diff(np.sort(self.at))
        wide = positive and self.at.max() > 30 * self.at.min()
        self.log = wide and steps.max() > 30 * steps.min()

    def words(self, value: Any) -> str:
        """Return a value as text for a legend."""
        if self.numeric:
            return f"{self.name} {value:g} {self.unit}".rstrip()
        return _short(written(value))

    def on(self, axis: Any) -> None:
        """Set scale and ticks of a matplotlib axis."""
        if self.log:
            getattr(axis.axes, f"set_{axis.axis_name}scale")("log")
        if not self.numeric:
            axis.set_ticks(self.at, [_short(written(value)) for value in self.values])


def _short(text: str) -> str:
    return text if len(text) <= 24 else f"{text[:21]}..."


def sweep_figure(folder: ResultFolder, plan: Plan, dataset: "xarray.Dataset") -> None:
    """Write sweep.png, mean and peak force over one key or two.

    A sweep over more keys has no figure."""
    if len(plan.keys) > 2:
        return
    axes = [_Axis(key, values) for one in plan.dimensions for key, values in one.columns.items()]
    lines = len(axes) == 1 or (len(plan.shape) == 2 and min(plan.shape) <= _FEW)
    (_lines if lines else _map)(folder, axes, plan, dataset)


def _lines(folder: ResultFolder, axes, plan: Plan, dataset: "xarray.Dataset") -> None:
    """Draw the forces over one key, with a line for each value of the other key, if there is one.

    The first key is on the axis. The keys change places if the second one has more than `_FEW`
    values, or if only the second one has numbers and the first one has at most `_FEW` values."""
    across, along = axes[0], axes[1] if len(axes) == 2 else None
    few, numbers = [size <= _FEW for size in plan.shape], [axis.numeric for axis in axes]
    swapped = along is not None and (not few[1] or (few[0] and numbers == [False, True]))
    if along is not None and swapped:
        across, along = along, across
    names = [""] if along is None else [*map(along.words, along.values)]
    order = np.argsort(across.at, kind="stable")
    drawn = _drawn(dataset)
    made, panels = figure(9, 6.6, len(drawn), 1, sharex=True)
    for ax, (name, text) in zip(panels[:, 0], drawn.items(), strict=True):
        values, labels = (_table(dataset, key, swapped)[order] for key in (name, "status"))
        for column, look in enumerate(looks(names)):
            plot_line(ax, across.at[order], values[:, column], labels[:, column].astype(str), look,
                      across.numeric, column)  # fmt: skip
        ax.set_ylabel(text)
        if np.isfinite(values).any():
            ax.set_ylim(0, 1.05 * np.nanmax(values) or 1)
    across.on(panels[-1, 0].xaxis)
    panels[-1, 0].set_xlabel(across.label)
    entries = [] if along is None else [Line2D([], [], **look) for look in looks(names)]
    entries += status_entries(dataset.status.values.ravel().astype(str))
    write(folder, "sweep", made, _title(drawn, across), entries)


def _drawn(dataset: "xarray.Dataset") -> dict[str, str]:
    """Return {variable: label} of the two panels.

    They show the forces or, if no flank touches at any point, contact reserve and gear force."""
    if any(np.any(dataset[name].values > 0) for name in LABELS) or _APART[0] not in dataset:
        return LABELS
    return {name: label(name) for name in _APART}


def _table(dataset: "xarray.Dataset", name: str, swapped: bool) -> NDArray:
    """Return a variable as an array (n, m); m is 1 for a sweep over one key."""
    values = dataset[name].values
    values = values.reshape(len(values), -1)
    return values.T if swapped else values


def _map(folder: ResultFolder, axes, plan: Plan, dataset: "xarray.Dataset") -> None:
    """Draw the forces over two keys as colours: a map of a grid, or points of a sample."""
    across, up = axes
    shown = _drawn(dataset)
    made, panels = figure(12, 5.4, 1, len(shown), grid=False, sharex=True, sharey=True)
    labels = dataset.status.values.astype(str)
    lost = [one for one in dict.fromkeys(labels.ravel()) if not Status[one.upper()].usable]
    grid = len(plan.shape) == 2
    for ax, (name, text) in zip(panels[0], shown.items(), strict=True):
        values = dataset[name].values
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
        made.colorbar(drawn, ax=ax, label=text)
        for status in lost:
            here = labels == status
            ax.plot(places[0][here], places[1][here], MARKERS[status], color="black",
                    markersize=6, markerfacecolor="none")  # fmt: skip
        across.on(ax.xaxis)
        up.on(ax.yaxis)
        ax.set_xlabel(across.label)
    panels[0, 0].set_ylabel(up.label)
    write(folder, "sweep", made, _title(shown, across, up), status_entries(lost, "none"), 5)


def _title(drawn: dict[str, str], *axes: _Axis) -> str:
    what = "Contact force" if drawn is LABELS else "Flanks that stay apart,"
    return f"{what} over {' and '.join(axis.name for axis in axes)}"


_LOST = "#000000"
_UNSETTLED = "#B0B0B0"
_PANELS = 6


def plot_basins(ax: Axes, basins: Basins) -> None:
    """Draw a map of the initial states, coloured by the motion to which each leads.

    Points mark the state of each motion at the start of every mesh period."""
    colors = [_LOST, *_colors(basins)]
    bounds = np.arange(len(colors) + 1) - 1.5
    ax.pcolormesh(
        1e3 * basins.relative,
        basins.rate,
        basins.leads_to,
        cmap=ListedColormap([*map(_pale, colors)]),
        norm=BoundaryNorm(bounds, len(colors)),
        shading="nearest",
    )
    for one, color in zip(basins.attractors, colors[1:], strict=True):
        if one.evaluation.usable:
            relative = 1e3 * basins.angle_scale * one.cycle[:, 0]
            rate = basins.angle_scale / basins.mesh_period * one.cycle[:, 1]
            ax.plot(
                relative, rate, "o", color=color, markersize=7, markeredgecolor="white", zorder=3
            )
    ax.plot(0, 0, "+", color="black", markersize=11, markeredgewidth=1.6)
    ax.set(
        xlabel="initial relative rotation (mrad)",
        ylabel="initial relative speed (rad/s)",
        title="Where motions start and where they lead",
    )


def plot_motions(axes: Sequence[Axes], attractors: Sequence[Attractor], colors, lobes: int) -> None:
    """Draw the contact force of each motion over time (mesh periods), one panel per motion.

    All panels cover the same number of mesh periods. `axes`, `colors`: one for each motion;
    `lobes`: number of lobes of a rotor."""
    shown = max(2, *(one.evaluation.steady_state.get("period", lobes) for one in attractors))
    for ax, one, color in zip(axes, attractors, colors, strict=True):
        series = one.evaluation.series
        assert series is not None
        periods = (series.rotation - series.rotation[0]) * lobes / (2 * np.pi)
        # The series covers whole repetitions of the motion.
        length = round(len(periods) / (len(periods) - 1) * periods[-1])
        copies = -(-shown // length)
        time = np.concatenate([periods + k * length for k in range(copies)])
        ax.plot(time, np.tile(series.force, copies), color=color, linewidth=1.1)
        ax.set(ylabel="force (N)", xlim=(0, shown))
    axes[0].set_title("Contact force of each motion")
    axes[-1].set_xlabel("time (mesh periods)")


def _entries(basins: Basins) -> list[Patch | Line2D]:
    """Return legend entries for the colours of a map, and for its marks."""
    pairs = enumerate(zip(basins.attractors, _colors(basins), strict=True), 1)
    motions = [
        Patch(facecolor=_pale(color), edgecolor=color, label=_label(number, one))
        for number, (one, color) in pairs
    ]
    lost = [
        Patch(facecolor=_pale(_LOST), label=f"{in_words(name)}, {share:.0%}")
        for name, share in basins.lost.items()
    ]
    point: dict[str, Any] = {"marker": "o", "color": GREY, "markeredgecolor": "white"}
    rest: dict[str, Any] = {"marker": "+", "color": "black", "markersize": 11}
    return [
        *motions,
        *lost,
        Line2D([], [], linestyle="", label="motion, once every mesh period", **point),
        Line2D([], [], linestyle="", label="start at rest", **rest),
    ]


def _label(number: int, one: Attractor) -> str:
    steady, response = one.evaluation.steady_state, one.evaluation.response
    period = steady.get("period")
    kind = f"period {period}" if period else in_words(one.evaluation.status.label)
    force = (
        f", mean {response['mean_force_N']:.4g} N, peak {response['peak_force_N']:.4g} N"
        if response
        else ""
    )
    return f"{number}: {kind}, {one.share:.1%} of the states{force}"


def _colors(basins: Basins) -> list[str]:
    colors = iter(COLORS * (1 + len(basins.attractors) // len(COLORS)))
    return [next(colors) if a.evaluation.usable else _UNSETTLED for a in basins.attractors]


def _pale(color: str) -> str:
    red, green, blue = (0.55 + 0.45 * channel for channel in to_rgb(color))
    return to_hex((red, green, blue))


def basin_figures(folder: ResultFolder, basins: Basins, config: Config) -> None:
    """Write basins.png into `folder`.

    The contact force is shown only for the motions to which the most initial states lead."""
    pairs = list(zip(basins.attractors, _colors(basins), strict=True))
    shown = [(one, color) for one, color in pairs if one.evaluation.series is not None][:_PANELS]
    entries = _entries(basins)
    made, (panels,) = figure(13, 5.6 + 0.12 * len(entries), 1, 2, grid=False, width_ratios=[1, 1.1])
    plot_basins(panels[0], basins)
    panels[1].remove()
    if shown:
        rows = panels[1].get_subplotspec().subgridspec(len(shown), 1)
        axes = rows.subplots(squeeze=False, sharex=True, sharey=True)[:, 0]
        attractors, colors = zip(*shown, strict=True)
        lay_grid(axes)
        plot_motions(list(axes), attractors, colors, config.profile.lobes)
        axes[0].set_ylim(0, None)
    title = f"{config.profile.family.upper()} at {config.scene.speed_rpm:g} rpm: coexisting motions"
    write(folder, "basins", made, title, entries, 2)
