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

from rootsopt.config import DESIGN_KEYS
from rootsopt.config.families import is_list
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
    keys: Sequence[str] = DESIGN_KEYS,
) -> Sequence[Axes] | NDArray:
    """Draw the objective, its best value so far and the design parameters over the evaluations.

    `keys`: names of the design parameters; `axes`: a panel for the objective, followed by one for
    each key. `history`: one row per evaluation. A row whose `start` is absent or negative belongs
    to the screening. The entries of a list-valued parameter share one panel, which omits the
    screening. Crosses at the top mark unusable designs, whose objective is not finite. Return
    `axes`.
    """
    keys = ("objective", *keys)
    for ax, key in zip(axes, keys, strict=True):
        for rows, style in _starts(history):
            if is_list(key):
                _traces(ax, rows, key)
            else:
                _trace(ax, rows, key, style)
        ax.set_ylabel("objective / baseline" if key == "objective" else label(key))
    axes[0].axhline(1, color="black", linewidth=0.8, linestyle=":", label="baseline")
    _best(axes, keys, history)
    _outside(axes[0], history)
    beside(axes[0])
    axes[-1].set_xlabel("evaluation")
    return axes


def _traces(ax, rows, key):
    """Draw each entry of the list-valued parameter `key` over the evaluations of a local search.

    `rows`: rows of the history. If they belong to the screening, nothing is drawn."""
    rows = [row for row in rows if _start(row) >= 0]
    if not rows:
        return
    names = [name for name in rows[0] if name.startswith(key)]
    x = _values(rows, "evaluation")
    for k, name in enumerate(names):
        shade = colormaps["cividis"](k / max(len(names) - 1, 1))
        end = {0: "first, at the tip", len(names) - 1: "last, at the pitch circle"}.get(k)
        ax.plot(x, _values(rows, name), color=shade, linewidth=1.2, label=end)
    if not ax.get_legend():
        beside(ax)


def _starts(history) -> Iterator[tuple[list[Mapping[str, Any]], dict[str, Any]]]:
    """Yield (rows, line style) for the screening, then for the local search from each start."""
    groups: dict[Any, list] = {}
    for row in history:
        groups.setdefault(_start(row), []).append(row)
    for i, (start, rows) in enumerate(sorted(groups.items())):
        if start < 0:
            style = {"color": GREY, "marker": ".", "linestyle": "", "label": "screening"}
        else:
            color = COLORS[start % len(COLORS)]
            marker = _MARKERS[(start // len(COLORS) + start) % len(_MARKERS)]
            style = {"color": color, "marker": marker, "linestyle": "-", "linewidth": 1}
            style["label"] = f"start {start}" if i < 10 else None
        yield rows, style


def _start(row) -> int:
    start = row.get("start")
    return int(start) if isinstance(start, int | np.integer) else -1


def _trace(ax, rows, key, style):
    """Draw the values of `key` over the evaluations in `rows`.

    A marker is hollow if the design violates a constraint. `style`: style of the line."""
    x, y = _values(rows, "evaluation"), _values(rows, key)
    met = np.asarray([bool(row.get("feasible", True)) for row in rows])
    ax.plot(x, y, **(style | {"marker": "", "label": None}), alpha=0.6)
    dots = style | {"linestyle": "", "markersize": 5}
    ax.plot(x[met], y[met], **dots)
    ax.plot(x[~met], y[~met], **(dots | {"label": None}), markerfacecolor="white")


def _values(rows, key) -> NDArray[np.float64]:
    values = (row.get(key) for row in rows)
    return np.asarray([np.nan if value is None else value for value in values], dtype=float)


def _best(axes, keys, history):
    """Draw the best objective so far as a line, and mark the best design with a star in each panel.

    The panels of list-valued parameters have no star."""
    x, best = [row["evaluation"] for row in history], _values(history, "best_objective")
    axes[0].step(x, best, where="post", color="black", linewidth=1.8, label="best so far")
    if not np.isfinite(best).any():
        return
    last = best[np.isfinite(best)][-1]
    winner = [row for row in history if row["objective"] == last][:1]
    star = {"color": "black", "markerfacecolor": "#F0E442", "markersize": 14, "zorder": 5}
    for ax, key in zip(axes, keys, strict=True):
        if is_list(key):
            continue
        x, y = [row["evaluation"] for row in winner], _values(winner, key)
        ax.plot(x, y, "*", label=f"best, {number(last)}", **star)


def _outside(ax, history):
    """Set axis limits that exclude a few bad designs, and mark these designs at the top edge."""
    values = _values(history, "objective")
    x = _values(history, "evaluation")
    known = values[np.isfinite(values)]
    known = np.append(known, 1.0)
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
    if not all(bool(row.get("feasible", True)) for row in history):
        ax.plot([], [], "o", color=GREY, markerfacecolor="white", label="constraint not met")


# Columns of `feasible.csv` after the two parameters.
_FEASIBLE = "slack", "objective"


def plot_feasible(
    ax: Axes,
    columns: Mapping[str, Sequence[float]],
    design: Mapping[str, float],
    others: Sequence[Mapping[str, Any]],
) -> Axes:
    """Draw the objective where all limits of the geometry are met, over two parameters.

    `columns`: those of `feasible.csv`, the two parameters first; `design`: the optimum, whose other
    parameters hold in the whole figure; `others`: designs at other vertices of the limits, drawn
    where their projection lies. Return `ax`."""
    from scipy.interpolate import RBFInterpolator  # Slow import (0.3 s).

    one, two = [*columns][:2]
    x, y, slack, objective = (np.asarray(columns[k], float) for k in (one, two, *_FEASIBLE))
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
    ax.set(xlim=(np.min(x), np.max(x)), ylim=(np.min(y), np.max(y)))
    for place, row in enumerate(others):
        name = None if place else "other vertices (projected)"
        ax.plot(row["design"][one], row["design"][two], "s", mfc="none", color="black", label=name)
    rest = [f"{label(key)} = {brief(x)}" for key, x in design.items() if key not in (one, two)]
    ax.set(xlabel=label(one), ylabel=label(two), title=", ".join(rest))
    return ax


def plot_profiles(
    ax: Axes, outlines: Mapping[str, NDArray[np.float64]], pitch_radius_mm: float
) -> Axes:
    """Draw closed outlines on top of each other, with the pitch circle.

    `outlines`: points (n, 2) in mm of each outline, keyed by its name; `pitch_radius_mm`: pitch
    radius. Return `ax`."""
    _overlay(ax, outlines, pitch_radius_mm)
    reach = 1.06 * max(np.max(np.hypot(*points.T)) for points in outlines.values())
    ax.plot(0, 0, "+", color="black", markersize=9)
    ax.set(xlim=(-reach, reach), ylim=(-reach, reach), title="Rotor")
    return ax


def plot_flank(
    ax: Axes, outlines: Mapping[str, NDArray[np.float64]], lobes: int, pitch_radius_mm: float
) -> Axes:
    """Draw one flank of each outline from the tip (on the +x axis) to the root, enlarged.

    `outlines`: points (n, 2) in mm of each closed outline, keyed by its name; `lobes`: number of
    lobes; `pitch_radius_mm`: pitch radius. The rest of an outline follows by symmetry. Return
    `ax`.
    """
    _overlay(ax, outlines, pitch_radius_mm)
    flanks = []
    for points in outlines.values():
        angle = np.arctan2(points[:, 1], points[:, 0])
        flanks.append(points[(angle >= 0) & (angle <= np.pi / lobes + 1e-9)])
    low, high = np.min(np.vstack(flanks), axis=0), np.max(np.vstack(flanks), axis=0)
    margin = 0.06 * np.max(high - low)
    ax.set(xlim=(low[0] - margin, high[0] + margin), ylim=(low[1] - margin, high[1] + margin))
    ax.set_title("One flank, tip to root, enlarged")
    return ax


def _overlay(ax, outlines, pitch_radius_mm):
    for points, look in zip(outlines.values(), looks(outlines), strict=True):
        ax.plot(*points.T, linewidth=1.6, **look)
    _circle(ax, (0, 0), pitch_radius_mm, f"pitch circle, {pitch_radius_mm:g} mm")
    ax.set_aspect("equal")
    ax.set(xlabel="x (mm)", ylabel="y (mm)")


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
) -> Sequence[Axes] | NDArray:
    """Draw the meshing pair at several angles of rotor 1, one panel per angle.

    `axes`: one for each of `angles_deg`; `outline_mm` (n, 2): closed outline, equal for both
    rotors; `lobes`: number of lobes; `pitch_radius_mm`: pitch radius. Return `axes`."""
    center = 2 * pitch_radius_mm
    for ax, angle in zip(axes, angles_deg, strict=True):
        turn = np.radians(angle)
        pair = place_pair(np.asarray(outline_mm), lobes, center, turn, turn)
        names = "rotor 1 ↺", "rotor 2 ↻"
        for points, color, x, name in zip(pair, (SKY, ORANGE), (0, center), names, strict=True):
            draw_rotor(ax, points, color, x, pitch_radius_mm)
            ax.annotate(name, (x, 0), (0, 7), textcoords="offset points", ha="center")
        ax.axhline(0, color="black", linewidth=0.6, linestyle="-.")
        ax.set_aspect("equal")
        ax.set_title(f"rotor 1 at {angle:g}°")
    return axes


def plot_conjugacy(ax: Axes, gaps: Mapping[str, tuple[NDArray, NDArray]]) -> Axes:
    """Draw the gap of one or more pairs in perfect rolling over the angle of rotor 1.

    `gaps`: (angles (n,) in degrees, gaps (n,) in µm) of each pair, keyed by its name. The angle is
    0 when a tip of rotor 1 is on the line of centres. Return `ax`."""
    for (angle, gap), look in zip(gaps.values(), looks(gaps), strict=True):
        ax.plot(angle, gap, linewidth=1.6, **look)
    ax.axhline(0, color="black", linewidth=0.8)
    low, high = ax.get_ylim()
    if low < 0:
        ax.axhspan(low, 0, color=VERMILION, alpha=0.08, linewidth=0, label="overlap")
    ax.set(ylim=(low, high), xlabel="angle of rotor 1 from tip on the line of centres (°)")
    ax.set(ylabel="gap at ε = 0 (µm)", title="Gap in rolling")
    return ax


def plot_forces_together(ax: Axes, series: Mapping[str, Series], turn: float) -> Axes:
    """Draw the contact force of several designs over the same rotation of rotor 1.

    `series`: simulated motions, keyed by the design's name; `turn`: rotation (rad) to show. Return
    `ax`."""
    for run, look in zip(series.values(), looks(series), strict=True):
        first = turn * np.ceil(run.rotation[0] / turn - 1e-9)
        if run.rotation[-1] < first + turn:
            first = run.rotation[0]
        shown = (run.rotation >= first - 1e-12) & (run.rotation <= first + turn + 1e-12)
        angle = np.degrees(run.rotation[shown] - first)
        ax.plot(angle, run.force[shown], linewidth=1.4, **look)
    ax.set(xlim=(0, np.degrees(turn)), xlabel="rotation of rotor 1 (°)")
    ax.set(ylabel="contact force (N)", title="Contact force")
    ax.set_ylim(bottom=0)
    ax.legend(frameon=False)
    return ax


def plot_departure(
    ax: Axes,
    baseline: NDArray[np.float64],
    optimized: NDArray[np.float64],
    lobes: int,
    pitch_radius_mm: float,
) -> Axes:
    """Draw how far the flank of an optimum departs from that of its baseline, from tip to root.

    `baseline`, `optimized`: points (n, 2) in mm of the closed outlines, counter-clockwise from a
    tip on the +x axis; `lobes`: number of lobes; `pitch_radius_mm`: pitch radius. The departure is
    measured along the normal, positive outwards. Return `ax`."""
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
    ax.set(xlim=(0, along[-1]), xlabel="length along the optimised flank, tip to root (mm)")
    ax.set_ylabel("departure from the baseline (µm)")
    most, way = f"{float(f'{abs(greatest):.3g}'):g}", "out" if greatest > 0 else "in"
    ax.set_title(f"Departure, at most {most} µm {way}wards")
    return ax


def _flank(outline: NDArray[np.float64], lobes: int) -> NDArray[np.float64]:
    """Return the points (m, 2) of a closed outline from a tip on the +x axis to the next root."""
    angle = np.arctan2(outline[:, 1], outline[:, 0])
    points = outline[(angle >= -1e-9) & (angle <= np.pi / lobes + 1e-9)]
    points = points[np.argsort(np.arctan2(points[:, 1], points[:, 0]), kind="stable")]
    apart = np.linalg.norm(np.diff(points, axis=0), axis=1) > 1e-9
    return points[np.concatenate([[True], apart])]
