"""Figures of the ranking of profile families, and of the optimised flanks."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

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
from rootsopt.config.units import MM, si_unit
from rootsopt.profiles import Profile, geometry
from rootsopt.profiles.geometry import outline
from rootsopt.view.figures.designs import plot_flank

_COLUMNS = 4

# Number of lobes and pitch radius of the families' examples.
LOBES, RADIUS_MM = 3, 33.0

# Panels in a row of the overview.
_PANELS = 4
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
        forces = reference["response"]
        kept = [row for row in rows if not np.isnan(row["objective"])]
        for place, row in enumerate(kept):
            shares = [row[key] / forces[key] for key in ("mean_force_N", "peak_force_N")]
            face = "black" if row["reached"] else "white"
            ax.plot(shares, [place, place], color="0.8", lw=2, zorder=1)
            ax.plot(shares[0], place, "o", color=BLUE, ms=7)
            ax.plot(shares[1], place, "^", color=VERMILION, ms=7)
            ax.plot(row["objective"], place, "D", color="black", ms=6, markerfacecolor=face)
        ax.axvline(1, color="black", lw=0.9, ls=":")
        ax.set_yticks(range(len(kept)), list(map(_panel_name, kept)))
        ax.invert_yaxis()
        ax.set(xlabel="force / reference's", title=title(name, reference))
        ax.title.set_size(10)
    lines = (
        ("o", BLUE, BLUE, "mean force"),
        ("^", VERMILION, VERMILION, "peak force"),
        ("D", "black", "black", "objective: mean of both"),
        ("D", "black", "white", "the same, with less area efficiency than required"),
    )
    handles = [
        Line2D([], [], marker=marker, color=color, markerfacecolor=face, ls="", label=label)
        for marker, color, face, label in lines
    ]
    handles.append(Line2D([], [], color="black", ls=":", lw=0.9, label="reference"))
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
    begin = 0
    for (name, rows), height in zip(studies.items(), heights, strict=True):
        panels = axes[begin : begin + height].ravel()
        begin += height
        best = np.array(rows[0]["outline_mm"])
        for ax in panels[len(rows) :]:
            ax.axis("off")
        for place, (ax, row) in enumerate(zip(panels, rows, strict=False)):
            lines = {"family": np.array(row["outline_mm"]), "best": best}
            plot_flank(ax, lines, row["lobes"], row["pitch_radius_mm"])
            text = f"{row['family'].replace('_', ' ')}, bore {2 * HOUSINGS[name]:.1f} mm"
            ax.set_title(text, fontsize=9)
            ax.set(xlabel="x (mm)" if place + _COLUMNS >= len(rows) else "")
            ax.set(ylabel="" if place % _COLUMNS else "y (mm)")
    lines = (BLUE, "-", "this family"), (VERMILION, (0, (5, 1.5)), "best of this housing")
    handles = [Line2D([], [], color=color, ls=ls, label=label) for color, ls, label in lines]
    handles.append(Line2D([], [], color=GREY, ls="--", lw=0.9, label="pitch circle"))
    made.legend(handles=handles, loc="outside lower center", ncols=3, frameon=False)
    return made


def overview() -> Figure:
    """Draw one rotor per family, its example, with the pieces of the addendum in colours."""
    shown = {name: family for name, family in families().items() if family.classical}
    made, axes = sheet(12.2, 9.4, -(-(len(shown) + 1) // _PANELS), _PANELS)
    panels = axes.ravel()
    colors: dict[str, str] = {}
    for place, (ax, (name, family)) in enumerate(zip(panels, shown.items(), strict=False)):
        units = {key: si_unit(key) for key in family.keys}
        values = [family.example[key] * unit for key, unit in units.items()]
        names = [parameter.argument for parameter in family.parameters]
        profile = family.make(LOBES, RADIUS_MM * MM, **dict(zip(names, values, strict=True)))
        _rotor(ax, profile, colors)
        shape = geometry(profile)
        radius, share = float(shape.outer_radius) / MM, float(shape.area_efficiency)
        ax.set_title(f"{name}\nr_a {radius:.2f} mm, area efficiency {share:.3f}", fontsize=9)
        ax.set(xlabel="x (mm)" if place + _PANELS >= len(shown) else "")
        ax.set(ylabel="" if place % _PANELS else "y (mm)")
    for ax in panels[len(shown) :]:
        ax.axis("off")
    handles = [Line2D([], [], color=color, lw=2.5, label=kind) for kind, color in colors.items()]
    handles.append(Line2D([], [], color=BLACK, lw=0.8, label="conjugate dedendum"))
    handles.append(Line2D([], [], color=GREY, ls="--", lw=0.9, label="pitch circle, 33 mm"))
    panels[-1].legend(handles=handles, loc="center", frameon=False)
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
        look = {
            "linewidth": 2.5,
            "marker": "o" if np.ptp([arc.real, arc.imag], 1).max() < 1 else "",
            "markersize": 4,
        }
        for turn in 2 * np.pi * np.arange(LOBES) / LOBES:
            for side in (arc, arc.conj()):
                line = side * np.exp(1j * turn) * 1j
                ax.plot(line.real, line.imag, color=color, **look)
    angle = np.linspace(0, 2 * np.pi, 181)
    ax.plot(RADIUS_MM * np.cos(angle), RADIUS_MM * np.sin(angle), "--", color=GREY, linewidth=0.9)
    ax.plot(0, 0, "+", color=BLACK)
    ax.set_aspect("equal")
