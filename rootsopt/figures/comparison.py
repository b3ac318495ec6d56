"""Figures that compare an optimum with its baseline: forces on top of each other, and departure."""

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from rootsopt.figures.style import BLUE, GREY, looks
from rootsopt.profiles.departure import beyond, feet
from rootsopt.response.series import Series


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
