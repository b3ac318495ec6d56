"""Figures of the ranking of profile families, and of the optimised flanks."""

import itertools
from collections.abc import Iterator, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from experiments._common.scenes import FORCES
from experiments._common.style import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PURPLE,
    SKY,
    VERMILION,
    sheet,
)
from experiments.families.study import HOUSINGS, Row, by_study, title
from rootsopt.config.families import families
from rootsopt.config.units import MM
from rootsopt.profiles import Profile, geometry
from rootsopt.profiles.geometry import outline
from rootsopt.view.figures.designs import plot_flank

# Number of panels in a row.
_COLUMNS = 4

# Number of lobes and pitch radius of the families' examples.
LOBES, RADIUS_MM = 3, 33.0
_COLORS = BLUE, ORANGE, PURPLE, GREEN, SKY, VERMILION, "#7a5c00", "#888888"

# Points drawn on a piece of an addendum.
_POINTS = 60


def ranking_figure(data: dict[str, Any]) -> Figure:
    """Draw the forces of each family relative to the reference's forces, one panel per housing."""
    studies = by_study(data)
    longest = max(len(rows) for rows in studies.values())
    made, axes = sheet(6.2 * len(studies), 2.0 + 0.34 * longest, 1, len(studies))
    for ax, (name, rows) in zip(axes[0], studies.items(), strict=True):
        reference = data["references"][name]
        kept = [row for row in rows if not np.isnan(row["objective"])]
        for place, row in enumerate(kept):
            mean, peak = (row[key] / reference["response"][key] for key in FORCES)
            face = "black" if row["reached"] else "white"
            ax.plot([mean, peak], [place, place], color="0.8", lw=2, zorder=1)
            ax.plot(mean, place, "o", color=BLUE, ms=7)
            ax.plot(peak, place, "^", color=VERMILION, ms=7)
            ax.plot(row["objective"], place, "D", color="black", ms=6, markerfacecolor=face)
        ax.axvline(1, color="black", lw=0.9, ls=":")
        ax.set_yticks(range(len(kept)), list(map(_panel_name, kept)))
        ax.invert_yaxis()
        ax.set_xlabel("force / reference's")
        ax.set_title(title(name, reference), fontsize=10)
    lines = (
        ("o", BLUE, BLUE, "mean force"),
        ("^", VERMILION, VERMILION, "peak force"),
        ("D", "black", "black", "objective: mean of both"),
        ("D", "black", "white", "the same, with less area efficiency than required"),
    )
    handles = [
        *(Line2D([], [], marker=marker, color=color, markerfacecolor=face, ls="", label=label)
          for marker, color, face, label in lines),
        Line2D([], [], color="black", ls=":", lw=0.9, label="reference"),
    ]  # fmt: skip
    made.legend(handles=handles, loc="outside lower center", ncols=5, frameon=False, fontsize=9)
    return made


def _panel_name(row: Row) -> str:
    area = "" if row["reached"] else f" (area {row['area_efficiency']:.4f})"
    return row["family"].replace("_", " ") + area


def profiles_figure(data: dict[str, Any]) -> Figure:
    """Draw each optimised flank together with the best flank for the same housing."""
    studies = by_study(data)
    heights = [-(-len(rows) // _COLUMNS) for rows in studies.values()]
    made, axes = sheet(3.0 * _COLUMNS, 2.15 * sum(heights) + 0.4, sum(heights), _COLUMNS)
    lines_of_panels = np.split(axes, np.cumsum(heights)[:-1])
    for (name, rows), panels in zip(studies.items(), lines_of_panels, strict=True):
        best = np.array(rows[0]["outline_mm"])
        for ax, row in _panels(panels, rows):
            lines = {"family": np.array(row["outline_mm"]), "best": best}
            plot_flank(ax, lines, row["lobes"], row["pitch_radius_mm"])
            text = f"{row['family'].replace('_', ' ')}, bore {2 * HOUSINGS[name]:.1f} mm"
            ax.set_title(text, fontsize=9)
    lines = (BLUE, "-", "this family"), (VERMILION, (0, (5, 1.5)), "best of this housing")
    handles = [
        *(Line2D([], [], color=color, ls=ls, label=label) for color, ls, label in lines),
        Line2D([], [], color=GREY, ls="--", lw=0.9, label="pitch circle"),
    ]
    made.legend(handles=handles, loc="outside lower center", ncols=3, frameon=False)
    return made


def _panels(axes, things: Sequence[Any]) -> Iterator[tuple[Axes, Any]]:
    """Yield a panel of `axes` (n, 4) with each of the `things`; hide the panels that are left."""
    for place, (ax, thing) in enumerate(itertools.zip_longest(axes.ravel(), things)):
        if thing is None:
            ax.axis("off")
            continue
        yield ax, thing
        ax.set(xlabel="x (mm)" if place + _COLUMNS >= len(things) else "")
        ax.set(ylabel="" if place % _COLUMNS else "y (mm)")


def overview() -> Figure:
    """Draw one rotor per family, its example, with the pieces of the addendum in colours."""
    shown = [family for family in families().values() if family.classical]
    made, axes = sheet(12.2, 9.4, -(-(len(shown) + 1) // _COLUMNS), _COLUMNS)
    colors: dict[str, str] = {}
    for ax, family in _panels(axes, shown):
        values = {p.argument: family.example[p.key] * p.unit for p in family.parameters}
        profile = family.make(LOBES, RADIUS_MM * MM, **values)
        _rotor(ax, profile, colors)
        shape = geometry(profile)
        radius, share = float(shape.outer_radius) / MM, float(shape.area_efficiency)
        text = f"{family.name}\nr_a {radius:.2f} mm, area efficiency {share:.3f}"
        ax.set_title(text, fontsize=9)
    handles = [
        *(Line2D([], [], color=color, lw=2.5, label=kind) for kind, color in colors.items()),
        Line2D([], [], color=BLACK, lw=0.8, label="conjugate dedendum"),
        Line2D([], [], color=GREY, ls="--", lw=0.9, label="pitch circle, 33 mm"),
    ]
    axes[-1, -1].legend(handles=handles, loc="center", frameon=False)
    return made


def _rotor(ax, profile: Profile, colors: dict[str, str]) -> None:
    """Draw a rotor with a lobe tip upwards; `colors` gets an entry for each new kind of piece."""
    points = np.asarray(outline(profile)) / MM @ [1j, -1]
    ax.fill(points.real, points.imag, facecolor="0.9", edgecolor=BLACK, linewidth=0.8)
    for piece in profile.segments():
        if not piece.stop > piece.start:
            continue
        color = BLACK if piece.land else _COLORS[len(colors) % len(_COLORS)]
        color = colors.setdefault("land about the axis" if piece.land else piece.name, color)
        nu = jnp.linspace(piece.start, piece.stop, _POINTS)
        arc = np.asarray(profile.position(profile.addendum(nu))) / MM @ [1, 1j]
        marker = "o" if np.ptp([arc.real, arc.imag], 1).max() < 1 else ""
        for turn in np.exp(2j * np.pi * np.arange(LOBES) / LOBES):
            lines = np.stack([arc, arc.conj()], axis=1) * turn * 1j
            ax.plot(lines.real, lines.imag, color=color, lw=2.5, marker=marker, ms=4)
    angle = np.linspace(0, 2 * np.pi, 181)
    ax.plot(RADIUS_MM * np.cos(angle), RADIUS_MM * np.sin(angle), "--", color=GREY, linewidth=0.9)
    ax.plot(0, 0, "+", color=BLACK)
    ax.set_aspect("equal")
