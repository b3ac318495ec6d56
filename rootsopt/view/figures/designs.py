"""Figures of profiles, of meshing and conjugacy, and of a search.

Figures of a search: its history, the optimum with the baseline, and the feasible designs.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from numpy.typing import NDArray

from rootsopt.config.families import is_list
from rootsopt.measured.conjugacy import Conjugacy
from rootsopt.profiles import place_pair
from rootsopt.profiles.geometry import beyond, feet
from rootsopt.response.result import Series
from rootsopt.view.figures.force import number
from rootsopt.view.figures.style import BLUE, COLORS, GREY, ORANGE, SKY, VERMILION, beside, looks
from rootsopt.view.names import brief, label

_MARKERS = "os^Dvp"


def plot_history(
    axes: Sequence[Axes] | NDArray,
    history: Sequence[Mapping[str, Any]],
    keys: Sequence[str],
) -> None:
    """Draw the objective, its best value so far and the design parameters over the evaluations.

    `keys`: names of the design parameters; `axes`: a panel for the objective, followed by one for
    each key. `history`: one row per evaluation, all with the same keys. A row whose `start` is
    negative belongs to the screening. The entries of a list-valued parameter share one panel, which
    omits the screening. Crosses at the top mark unusable designs, whose objective is not finite.
    """
    table = {name: np.array([row[name] for row in history]) for name in history[0]}
    keys = ("objective", *keys)
    for ax, key in zip(axes, keys, strict=True):
        for start, style in _starts(table["start"]):
            rows = {name: column[table["start"] == start] for name, column in table.items()}
            if not is_list(key):
                _trace(ax, rows, key, style)
            elif start >= 0:
                _traces(ax, rows, key)
        ax.set_ylabel("objective / baseline" if key == "objective" else label(key))
    axes[0].axhline(1, color="black", linewidth=0.8, linestyle=":", label="baseline")
    _best(axes, keys, table)
    _outside(axes[0], table)
    beside(axes[0])
    axes[-1].set_xlabel("evaluation")


def _traces(ax, rows, key):
    """Draw each entry of the list-valued parameter `key` over the evaluations of a local search.

    `rows`: columns of the history, with the rows of this search."""
    names = [name for name in rows if name.startswith(key)]
    for k, name in enumerate(names):
        shade = colormaps["cividis"](k / max(len(names) - 1, 1))
        end = {0: "first, at the tip", len(names) - 1: "last, at the pitch circle"}.get(k)
        ax.plot(rows["evaluation"], rows[name], color=shade, linewidth=1.2, label=end)
    if not ax.get_legend():
        beside(ax)


def _starts(starts: NDArray[np.int_]) -> Iterator[tuple[int, dict[str, Any]]]:
    """Yield (start, line style) of the screening, then of the local search from each start."""
    for i, start in enumerate(np.unique(starts).tolist()):
        if start < 0:
            style = {"color": GREY, "marker": ".", "linestyle": "", "label": "screening"}
        else:
            color = COLORS[start % len(COLORS)]
            marker = _MARKERS[(start // len(COLORS) + start) % len(_MARKERS)]
            style = {"color": color, "marker": marker, "linestyle": "-", "linewidth": 1,
                     "label": f"start {start}" if i < 10 else None}  # fmt: skip
        yield start, style


def _trace(ax, rows, key, style):
    """Draw the values of `key` over the evaluations in `rows`, columns of the history.

    A marker is hollow if the design violates a constraint. `style`: style of the line."""
    x, y, met = rows["evaluation"], rows[key], rows["feasible"]
    ax.plot(x, y, **(style | {"marker": "", "label": None}), alpha=0.6)
    dots = style | {"linestyle": "", "markersize": 5}
    ax.plot(x[met], y[met], **dots)
    ax.plot(x[~met], y[~met], **(dots | {"label": None}), markerfacecolor="white")


def _best(axes, keys, table):
    """Draw the best objective so far as a line, and mark the best design with a star in each panel.

    `table`: columns of the history. The panels of list-valued parameters have no star."""
    x, best = table["evaluation"], table["best_objective"]
    axes[0].step(x, best, where="post", color="black", linewidth=1.8, label="best so far")
    if not np.isfinite(best).any():
        return
    last = best[np.isfinite(best)][-1]
    winner = np.flatnonzero(table["objective"] == last)[:1]
    star = {"color": "black", "markerfacecolor": "#F0E442", "markersize": 14, "zorder": 5}
    for ax, key in zip(axes, keys, strict=True):
        if not is_list(key):
            ax.plot(x[winner], table[key][winner], "*", label=f"best, {number(last)}", **star)


def _outside(ax, table):
    """Set axis limits that exclude a few bad designs, and mark these designs at the top edge.

    `table`: columns of the history."""
    x, values = table["evaluation"], table["objective"]
    known = np.append(values[np.isfinite(values)], 1.0)
    high = known[known <= max(1.5, 2 * np.median(known))].max()
    low = known.min()
    margin = 0.12 * max(high - low, 0.02)
    ax.set_ylim(low - margin, high + 1.5 * margin)
    marks = ((values > high, "^", "above the axis"), (~np.isfinite(values), "x", "unusable design"))
    for mask, marker, name in marks:
        if np.any(mask):
            top = np.full(np.count_nonzero(mask), 0.96)
            over = {"transform": ax.get_xaxis_transform(), "linestyle": "", "color": "black"}
            ax.plot(x[mask], top, marker=marker, markersize=6, label=name, **over)
    if not table["feasible"].all():
        ax.plot([], [], "o", color=GREY, markerfacecolor="white", label="constraint not met")


def plot_feasible(
    ax: Axes,
    columns: Mapping[str, Sequence[float]],
    design: Mapping[str, float],
    others: Sequence[Mapping[str, Any]],
) -> None:
    """Draw the objective where all limits of the geometry are met, over two parameters.

    `columns`: those of `feasible.csv`, in its order; `design`: the optimum, whose other parameters
    hold in the whole figure; `others`: designs at other vertices of the limits, drawn where their
    projection lies."""
    from scipy.interpolate import RBFInterpolator  # Slow import (0.3 s).

    one, two, *_ = columns
    x, y, slack, objective = (np.asarray(column, float) for column in columns.values())
    places, known = np.column_stack([x, y]), np.isfinite(objective)
    sides, shape = np.ptp(places, axis=0), (-1, len(np.unique(x)))
    slack = np.where(np.isnan(slack), np.nanmin(slack), slack)  # No sound profile.
    at = places[known]
    if np.linalg.matrix_rank((at - at.mean(axis=0)) / sides, tol=1e-6) == 2:
        between = RBFInterpolator(at / sides, objective[known])(places / sides)
        low, high = np.min(objective[known]), np.max(objective[known])
        grid = [column.reshape(shape) for column in (x, y, np.clip(between, low, high))]
        shades = ax.pcolormesh(*grid, shading="gouraud", cmap="viridis")
        ax.figure.colorbar(shades, ax=ax, label="objective (baseline = 1)")
    grid = [column.reshape(shape) for column in (x, y, slack)]
    ax.contourf(*grid, levels=[-np.inf, 0], colors="white")
    ax.contour(*grid, levels=[0], colors="black", linewidths=1)
    ax.plot(*at.T, ".", color=GREY, markersize=3, label="simulated")
    ax.plot(design[one], design[two], "*", color=VERMILION, markersize=14, label="optimum")
    for place, row in enumerate(others):
        ax.plot(
            row["design"][one], row["design"][two], "s", mfc="none", color="black",
            label=None if place else "other vertices (projected)",
        )  # fmt: skip
    rest = [f"{label(key)} = {brief(x)}" for key, x in design.items() if key not in (one, two)]
    ax.set(
        xlim=(np.min(x), np.max(x)),
        ylim=(np.min(y), np.max(y)),
        xlabel=label(one),
        ylabel=label(two),
        title=", ".join(rest),
    )


def plot_profiles(
    ax: Axes, outlines: Mapping[str, NDArray[np.float64]], pitch_radius_mm: float
) -> None:
    """Draw closed outlines on top of each other, with the pitch circle.

    `outlines`: points (n, 2) in mm of each outline, keyed by its name; `pitch_radius_mm`: pitch
    radius."""
    _overlay(ax, outlines, pitch_radius_mm)
    reach = 1.06 * max(np.max(np.hypot(*points.T)) for points in outlines.values())
    ax.plot(0, 0, "+", color="black", markersize=9)
    ax.set(xlim=(-reach, reach), ylim=(-reach, reach), title="Rotor")


def plot_flank(
    ax: Axes, outlines: Mapping[str, NDArray[np.float64]], lobes: int, pitch_radius_mm: float
) -> None:
    """Draw one flank of each outline from the tip (on the +x axis) to the root, enlarged.

    `outlines`: points (n, 2) in mm of each closed outline, keyed by its name; `lobes`: number of
    lobes; `pitch_radius_mm`: pitch radius. The rest of an outline follows by symmetry.
    """
    _overlay(ax, outlines, pitch_radius_mm)
    shown = np.vstack([_flank(points, lobes) for points in outlines.values()])
    margin = 0.06 * np.max(np.ptp(shown, axis=0))
    (left, low), (right, high) = shown.min(axis=0) - margin, shown.max(axis=0) + margin
    ax.set(xlim=(left, right), ylim=(low, high), title="One flank, tip to root, enlarged")


def _overlay(ax, outlines, pitch_radius_mm):
    for points, look in zip(outlines.values(), looks(outlines), strict=True):
        ax.plot(*points.T, linewidth=1.6, **look)
    _circle(ax, (0, 0), pitch_radius_mm, f"pitch circle, {pitch_radius_mm:g} mm")
    ax.set(xlabel="x (mm)", ylabel="y (mm)", aspect="equal")


def _circle(ax, center, radius, label=None):
    turn = np.linspace(0, 2 * np.pi, 361)
    x, y = center[0] + radius * np.cos(turn), center[1] + radius * np.sin(turn)
    ax.plot(x, y, "--", color=GREY, linewidth=0.9, label=label)


def draw_rotor(
    ax: Axes, points: NDArray[np.float64], color: str, x: float, pitch_radius_mm: float
) -> PolyCollection:
    """Draw a rotor whose outline is `points` (n, 2), with its axis at `x` and its pitch circle.

    Lengths are in mm. Return the outline, which `set_verts` moves."""
    look = {"facecolor": color, "alpha": 0.75, "edgecolor": "black", "linewidth": 0.8}
    drawn = PolyCollection([points], **look)  # `fill` takes ten times as long.
    ax.add_collection(drawn)
    _circle(ax, (x, 0), pitch_radius_mm)
    ax.plot(x, 0, "o", color="black", markersize=4)
    return drawn


def plot_meshing(
    axes: Sequence[Axes] | NDArray,
    outline_mm: NDArray[np.float64],
    lobes: int,
    pitch_radius_mm: float,
    angles_deg: Sequence[float] | NDArray[np.float64],
) -> None:
    """Draw the meshing pair at several angles of rotor 1, one panel per angle.

    `axes`: one for each of `angles_deg`; `outline_mm` (n, 2): closed outline, equal for both
    rotors; `lobes`: number of lobes; `pitch_radius_mm`: pitch radius."""
    center = 2 * pitch_radius_mm
    for ax, angle in zip(axes, angles_deg, strict=True):
        turn = np.radians(angle)
        pair = place_pair(np.asarray(outline_mm), lobes, center, turn, turn)
        names = "rotor 1 ↺", "rotor 2 ↻"
        for points, color, x, name in zip(pair, (SKY, ORANGE), (0, center), names, strict=True):
            draw_rotor(ax, points, color, x, pitch_radius_mm)
            ax.annotate(name, (x, 0), (0, 7), textcoords="offset points", ha="center")
        ax.axhline(0, color="black", linewidth=0.6, linestyle="-.")
        ax.set(aspect="equal", title=f"rotor 1 at {angle:g}°")


def plot_conjugacy(ax: Axes, gaps: Mapping[str, Conjugacy]) -> None:
    """Draw the gap of one or more pairs in perfect rolling over the angle of rotor 1.

    `gaps`: gap of each pair, keyed by its name. The angle is 0 when a tip of rotor 1 is on the line
    of centres."""
    for mesh, look in zip(gaps.values(), looks(gaps), strict=True):
        ax.plot(np.degrees(mesh.roll), 1e6 * mesh.gap, linewidth=1.6, **look)
    ax.axhline(0, color="black", linewidth=0.8)
    low, high = ax.get_ylim()
    if low < 0:
        ax.axhspan(low, 0, color=VERMILION, alpha=0.08, linewidth=0, label="overlap")
    ax.set(
        ylim=(low, high),
        xlabel="angle of rotor 1 from tip on the line of centres (°)",
        ylabel="gap at ε = 0 (µm)",
        title="Gap in rolling",
    )


def plot_forces_together(ax: Axes, series: Mapping[str, Series], turn: float) -> None:
    """Draw the contact force of several designs over the same rotation of rotor 1.

    `series`: simulated motions, keyed by the design's name; `turn`: rotation (rad) to show."""
    for run, look in zip(series.values(), looks(series), strict=True):
        first = turn * np.ceil(run.rotation[0] / turn - 1e-9)
        if run.rotation[-1] < first + turn:
            first = run.rotation[0]
        shown = (run.rotation >= first - 1e-12) & (run.rotation <= first + turn + 1e-12)
        angle = np.degrees(run.rotation[shown] - first)
        ax.plot(angle, run.force[shown], linewidth=1.4, **look)
    ax.set(
        xlim=(0, np.degrees(turn)),
        ylim=(0, None),
        xlabel="rotation of rotor 1 (°)",
        ylabel="contact force (N)",
        title="Contact force",
    )
    ax.legend(frameon=False)


def plot_departure(
    ax: Axes,
    baseline: NDArray[np.float64],
    optimized: NDArray[np.float64],
    lobes: int,
    pitch_radius_mm: float,
) -> None:
    """Draw how far the flank of an optimum departs from that of its baseline, from tip to root.

    `baseline`, `optimized`: points (n, 2) in mm of the closed outlines, counter-clockwise from a
    tip on the +x axis; `lobes`: number of lobes; `pitch_radius_mm`: pitch radius. The departure is
    measured along the normal, positive outwards."""
    line, points = (_flank(one, lobes) for one in (baseline, optimized))
    away = 1e3 * feet(points, beyond(line, lobes), smooth=True).away
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    ax.axhline(0, color=GREY, linewidth=0.9)
    ax.plot(along, away, color=BLUE, linewidth=1.8)
    inside = np.hypot(*points.T) < pitch_radius_mm
    if inside.any():
        place = along[np.argmax(inside)]
        ax.axvline(place, color=GREY, linewidth=0.9, linestyle=":")
        # On the side that the curve beyond the pitch circle leaves free.
        height = 0.93 if np.mean(away[inside]) < 0 else 0.02
        ax.annotate(
            "pitch circle", (place, height), (3, 0), xycoords=("data", "axes fraction"),
            textcoords="offset points", fontsize=9,
        )  # fmt: skip
    greatest = away[np.argmax(np.abs(away))]
    most, way = f"{float(f'{abs(greatest):.3g}'):g}", "out" if greatest > 0 else "in"
    ax.set(
        xlim=(0, along[-1]),
        xlabel="length along the optimised flank, tip to root (mm)",
        ylabel="departure from the baseline (µm)",
        title=f"Departure, at most {most} µm {way}wards",
    )


def _flank(outline: NDArray[np.float64], lobes: int) -> NDArray[np.float64]:
    """Return the points (m, 2) of a closed outline from a tip on the +x axis to the next root."""
    angle = np.arctan2(outline[:, 1], outline[:, 0])
    points = outline[(angle >= -1e-9) & (angle <= np.pi / lobes + 1e-9)]
    points = points[np.argsort(np.arctan2(points[:, 1], points[:, 0]), kind="stable")]
    apart = np.linalg.norm(np.diff(points, axis=0), axis=1) > 1e-9
    return points[np.concatenate([[True], apart])]
