"""Figures of the ranking of profile families, and of the optimised flanks."""

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from experiments._common.style import BLUE, GREY, VERMILION, grid_below, sheet
from experiments.families.tables import Row, by_study, is_missing, title
from rootsopt.figures.profiles import plot_flank

_COLUMNS = 4


def ranking_figure(data: dict[str, Any]) -> Figure:
    """Draw the forces of each family relative to the reference's forces, one panel per housing."""
    studies = by_study(data)
    longest = max(len(rows) for rows in studies.values())
    made, axes = sheet(6.2 * len(studies), 2.0 + 0.34 * longest, 1, len(studies))
    for ax, (name, rows) in zip(axes[0], studies.items(), strict=True):
        reference = data["references"][name]
        forces = reference["response"]
        kept = [row for row in rows if not is_missing(row)]
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
        grid_below(ax, axis="x", color="0.9")
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
    name = row["family"].replace("_", " ")
    return name if row["reached"] else f"{name} (area {row['area_efficiency']:.4f})"


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
        bore = 2 * data["references"][name]["geometry"]["outer_radius_mm"]
        for ax in panels[len(rows) :]:
            ax.axis("off")
        for place, (ax, row) in enumerate(zip(panels, rows, strict=False)):
            lines = {"family": np.array(row["outline_mm"]), "best": best}
            plot_flank(ax, lines, row["lobes"], row["pitch_radius_mm"])
            text = f"{row['family'].replace('_', ' ')}, bore {bore:.1f} mm"
            ax.set_title(text, fontsize=9)
            ax.set(xlabel="x (mm)" if place + _COLUMNS >= len(rows) else "")
            ax.set(ylabel="" if place % _COLUMNS else "y (mm)")
    lines = (BLUE, "-", "this family"), (VERMILION, (0, (5, 1.5)), "best of this housing")
    handles = [Line2D([], [], color=color, ls=ls, label=label) for color, ls, label in lines]
    handles.append(Line2D([], [], color=GREY, ls="--", lw=0.9, label="pitch circle"))
    made.legend(handles=handles, loc="outside lower center", ncols=3, frameon=False)
    return made
