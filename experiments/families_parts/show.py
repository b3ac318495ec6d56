"""Tables and figures of `experiments/families.py`."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from rootsopt.plot import BLUE, GREY, VERMILION, figure, plot_flank

Row = dict[str, Any]
_COLUMNS = 4
_SCENES = ("1000 rpm", "6000 rpm", "20 N m")


def by_study(data: dict[str, Any]) -> dict[str, list[Row]]:
    """The rows of each housing, best first: those that reach the reference's area efficiency, then
    the others, then what has no motion that repeats."""
    studies: dict[str, list[Row]] = {name: [] for name in data["references"]}
    for row in data["rows"]:
        studies[row["study"]].append(row)
    for rows in studies.values():
        rows.sort(key=lambda row: (_missing(row), not row["reached"], row["objective"] or 0.0))
    return studies


def _missing(row: Row) -> bool:
    return row["objective"] is None or not np.isfinite(row["objective"])


def _title(name: str, reference: Row) -> str:
    shape = reference["geometry"]
    return (
        f"Bore {2 * shape['outer_radius_mm']:.1f} mm, area efficiency "
        f"{shape['area_efficiency']:.4f} (those of {name}.yaml)"
    )


def tables(data: dict[str, Any]) -> str:
    """The ranking of each housing, the designs, and the forces in the further scenes, as
    Markdown."""
    parts = []
    for name, rows in by_study(data).items():
        reference = data["references"][name]
        forces = reference["response"]
        parts.append(f"### {_title(name, reference)}\n")
        parts.append(
            f"The reference has {forces['mean_force_N']:.2f} N mean and "
            f"{forces['peak_force_N']:.1f} N peak.\n"
        )
        parts.append(_ranking(rows) + "\n")
        parts.append(_designs(rows) + "\n")
        parts.append(_elsewhere(rows) + "\n")
    return "\n".join(parts)


def _table(heads: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    rows = [heads, ["---"] * len(heads), *lines]
    return "\n".join("| " + " | ".join(row) + " |" for row in rows)


def _name(row: Row) -> str:
    return f"`{row['family']}`"


def _ranking(rows: list[Row]) -> str:
    heads = "|family|objective|mean, N|peak, N|area efficiency|can have|seal, mm"
    heads += "|undercut margin, mm|least radius, mm|least relative radius, mm"
    lines, place = [], 0
    for row in rows:
        ranked = row["reached"] and not _missing(row)
        place += ranked
        range_ = ""
        if "most_efficiency" in row:
            range_ = f"{row['least_efficiency']:.4f} to {row['most_efficiency']:.4f}"
        lines.append(
            [
                str(place) if ranked else "-",
                _name(row),
                row["status"] if _missing(row) else f"{row['objective']:.4f}",
                f"{row['mean_force_N'] or np.nan:.2f}",
                f"{row['peak_force_N'] or np.nan:.1f}",
                f"{row['area_efficiency']:.4f}",
                range_,
                f"{row['seal_width_mm']:.2f}",
                f"{row['undercut_margin_mm']:.2f}",
                f"{row['least_radius_mm']:.2f}",
                f"{row['least_relative_radius_mm']:.2f}",
            ]
        )
    return _table(heads.split("|"), lines)


def _designs(rows: list[Row]) -> str:
    lines = []
    for row in rows:
        values = row["design"]
        if row["family"] == "free_form":
            text = f"begun at `{row['begun_at']}`, {row['departure_um']:.0f} µm from it"
        else:
            text = ", ".join(f"{key} {value:.4g}" for key, value in values.items())
        lines.append([_name(row), text or "(none)"])
    return _table(["family", "design"], lines)


def _elsewhere(rows: list[Row]) -> str:
    heads = ["family", *(f"{scene}: mean, peak (N)" for scene in _SCENES)]
    lines = []
    for row in rows:
        cells = []
        for scene in _SCENES:
            mean, peak = (row[f"{scene}: {key}_force_N"] for key in ("mean", "peak"))
            known = mean is not None and np.isfinite(mean)
            status = row[f"{scene}: status"]
            cells.append(
                f"{mean:.2f}, {peak:.1f}" + ("" if status == "periodic" else f" ({status})")
                if known
                else status
            )
        lines.append([_name(row), *cells])
    return _table(heads, lines)


def ranking_figure(data: dict[str, Any]) -> Figure:
    """Mean and peak force of each family relative to the reference's, a panel for each housing."""
    studies = by_study(data)
    longest = max(len(rows) for rows in studies.values())
    made, axes = figure(6.2 * len(studies), 2.0 + 0.34 * longest, 1, len(studies))
    for ax, (name, rows) in zip(axes[0], studies.items(), strict=True):
        reference = data["references"][name]
        forces = reference["response"]
        kept = [row for row in rows if not _missing(row)]
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
        ax.set(xlabel="force / reference's", title=_title(name, reference))
        ax.title.set_size(10)
        ax.grid(axis="x", color="0.9", linewidth=0.6)
        ax.set_axisbelow(True)
    lines = (
        ("o", BLUE, BLUE, "mean force"),
        ("^", VERMILION, VERMILION, "peak force"),
        ("D", "black", "black", "objective: mean of both"),
        ("D", "black", "white", "the same, with less area efficiency than asked"),
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
    """The flanks that were found, each over that of the best in its housing."""
    studies = by_study(data)
    heights = [-(-len(rows) // _COLUMNS) for rows in studies.values()]
    made, axes = figure(3.0 * _COLUMNS, 2.15 * sum(heights) + 0.4, sum(heights), _COLUMNS)
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
