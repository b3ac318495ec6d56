"""Figures of rotor profiles, of meshing and conjugacy, and of an optimum beside its baseline."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from numpy.typing import NDArray

from rootsopt.profiles import place_pair
from rootsopt.profiles.departure import beyond, feet
from rootsopt.response.records import Series
from rootsopt.view.figures.style import BLUE, GREY, ORANGE, SKY, VERMILION, looks


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
        ax.annotate(
            "pitch circle", (place, 0.02), (3, 0), xycoords=("data", "axes fraction"),
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
