"""Figures of coexisting motions: basins of attraction, and the force of each motion."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm, ListedColormap, to_hex, to_rgb
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from rootsopt.config import Config
from rootsopt.response.attractors import Attractor, Basins
from rootsopt.view.figures.style import COLORS, GREY, figure, lay_grid, write
from rootsopt.view.files import ResultFolder

_LOST = "#000000"
_UNSETTLED = "#B0B0B0"
_PANELS = 6


def plot_basins(ax: Axes, basins: Basins) -> Axes:
    """Draw a map of the initial states, coloured by the motion to which each leads.

    Points mark the state of each motion at the start of every mesh period. Return `ax`."""
    colors = [_LOST, *_colors(basins)]
    bounds = np.arange(len(colors) + 1) - 1.5
    pale = [_pale(color) for color in colors]
    ax.pcolormesh(
        1e3 * basins.relative,
        basins.rate,
        basins.leads_to,
        cmap=ListedColormap(pale),
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
    return ax


def plot_motions(axes: Sequence[Axes], attractors: Sequence[Attractor], colors, lobes: int) -> None:
    """Draw the contact force of each motion over time (mesh periods), one panel per motion.

    All panels cover the same number of mesh periods. `axes`, `colors`: one for each motion;
    `lobes`: number of lobes of a rotor."""
    longest = max(one.evaluation.steady_state.get("period", lobes) for one in attractors)
    shown = max(longest, 2)
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
    entries: list[Patch | Line2D] = []
    for number, (one, color) in enumerate(zip(basins.attractors, _colors(basins), strict=True), 1):
        entries.append(Patch(facecolor=_pale(color), edgecolor=color, label=_label(number, one)))
    for label, share in basins.lost.items():
        words = label.replace("_", " ")
        entries.append(Patch(facecolor=_pale(_LOST), label=f"{words}, {share:.0%}"))
    start = Line2D([], [], marker="+", color="black", linestyle="", markersize=11)
    start.set_label("start at rest")
    point = Line2D([], [], marker="o", color=GREY, linestyle="", markeredgecolor="white")
    point.set_label("motion, once every mesh period")
    return [*entries, point, start]


def _label(number: int, one: Attractor) -> str:
    steady, response = one.evaluation.steady_state, one.evaluation.response
    period = steady.get("period")
    kind = f"period {period}" if period else one.evaluation.status.label.replace("_", " ")
    force = ""
    if response:
        force = f", mean {response['mean_force_N']:.4g} N, peak {response['peak_force_N']:.4g} N"
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
