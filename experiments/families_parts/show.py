"""Tables and figures of `experiments/families.py`."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from rootsopt.plot import BLUE, GREY, ORANGE, VERMILION, figure, plot_flank

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
    made, axes = figure(6.2 * len(studies), 1.6 + 0.36 * longest, 1, len(studies))
    for ax, (name, rows) in zip(axes[0], studies.items(), strict=True):
        reference = data["references"][name]
        forces = reference["response"]
        kept = [row for row in rows if not _missing(row)]
        places = np.arange(len(kept))
        short = [row["family"].replace("_", " ") for row in kept]
        labels = [
            text if row["reached"] else f"{text}\n(area {row['area_efficiency']:.4f})"
            for text, row in zip(short, kept, strict=True)
        ]
        styles = (("mean", BLUE, "o"), ("peak", VERMILION, "^"))
        for key, color, marker in styles:
            force = [
                row[f"{key}_force_N"] / reference["response"][f"{key}_force_N"] for row in kept
            ]
            ax.plot(force, places, marker, color=color, ms=7, label=f"{key} force")
        values = [row["objective"] for row in kept]
        ax.barh(places, values, color=[ORANGE if r["reached"] else GREY for r in kept], alpha=0.45)
        ax.barh([0], [0], color=ORANGE, alpha=0.45, label="objective")
        if any(not row["reached"] for row in kept):
            ax.barh([0], [0], color=GREY, alpha=0.45, label="objective, with less area efficiency")
        ax.axvline(1, color="black", lw=0.9, ls=":", label=f"{name}.yaml")
        ax.set_yticks(places, labels)
        ax.invert_yaxis()
        keys = ("mean_force_N", "peak_force_N")
        low = min(row[key] / forces[key] for row in kept for key in keys)
        ax.set_xlim(left=max(0.0, np.floor(10 * low - 1) / 10))
        ax.set(xlabel="force / reference's", title=_title(name, reference))
        ax.title.set_size(10)
        ax.grid(axis="x", color="0.9", linewidth=0.6)
        ax.set_axisbelow(True)
        ax.legend(fontsize=8, frameon=True)
    return made


def profiles_figure(data: dict[str, Any]) -> Figure:
    """The flanks that were found: each over that of the best."""
    studies = by_study(data)
    heights = [-(-len(rows) // _COLUMNS) for rows in studies.values()]
    made, axes = figure(3.1 * _COLUMNS, 3.0 * sum(heights), sum(heights), _COLUMNS)
    begin = 0
    for (name, rows), height in zip(studies.items(), heights, strict=True):
        panels = axes[begin : begin + height].ravel()
        begin += height
        best = np.array(rows[0]["outline_mm"])
        shape = data["references"][name]
        for ax in panels[len(rows) :]:
            ax.axis("off")
        for ax, row in zip(panels, rows, strict=False):
            outline = np.array(row["outline_mm"])
            text = row["family"].replace("_", " ")
            ahead = {f"best: {rows[0]['family'].replace('_', ' ')}": best}
            lobes, radius = row["lobes"], row["pitch_radius_mm"]
            plot_flank(ax, {text: outline} | (ahead if row is not rows[0] else {}), lobes, radius)
            bore = 2 * shape["geometry"]["outer_radius_mm"]
            ax.set_title(f"{text}, bore {bore:.1f} mm", fontsize=9)
            ax.title.set_size(9)
    return made
