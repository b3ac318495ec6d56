"""Ranking of the families, and the Markdown tables of their designs and forces."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from experiments.families.study import SCENES

Row = dict[str, Any]


def by_study(data: dict[str, Any]) -> dict[str, list[Row]]:
    """Return the rows of each housing, sorted with the best first.

    Designs that reach the reference's area efficiency come first, then designs that do not, then
    designs without a periodic motion.
    """
    studies: dict[str, list[Row]] = {name: [] for name in data["references"]}
    for row in data["rows"]:
        studies[row["study"]].append(row)
    for rows in studies.values():
        rows.sort(key=lambda row: (is_missing(row), not row["reached"], row["objective"] or 0.0))
    return studies


def is_missing(row: Row) -> bool:
    """Return whether a row has no periodic motion."""
    return row["objective"] is None or not np.isfinite(row["objective"])


def title(name: str, reference: Row) -> str:
    """Return a title for a housing: bore, area efficiency, and `name` of the reference config."""
    shape = reference["geometry"]
    return (
        f"Bore {2 * shape['outer_radius_mm']:.1f} mm, area efficiency "
        f"{shape['area_efficiency']:.4f} (those of {name}.yaml)"
    )


def markdown(data: dict[str, Any]) -> str:
    """Return Markdown tables: ranking for each housing, designs, and forces in further scenes."""
    parts = []
    for name, rows in by_study(data).items():
        reference = data["references"][name]
        forces = reference["response"]
        parts.append(f"### {title(name, reference)}\n")
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
    heads = "|family|objective|mean, N|peak, N|area efficiency|reachable|seal, mm"
    heads += "|undercut margin, mm|smallest radius, mm|smallest relative radius, mm"
    lines, place = [], 0
    for row in rows:
        ranked = row["reached"] and not is_missing(row)
        place += ranked
        range_ = ""
        if "most_efficiency" in row:
            range_ = f"{row['least_efficiency']:.4f} to {row['most_efficiency']:.4f}"
        lines.append(
            [
                str(place) if ranked else "-",
                _name(row),
                row["status"] if is_missing(row) else f"{row['objective']:.4f}",
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
            text = f"started at `{row['begun_at']}`, {row['departure_um']:.0f} µm from it"
        else:
            text = ", ".join(f"{key} {value:.4g}" for key, value in values.items())
        lines.append([_name(row), text or "(none)"])
    return _table(["family", "design"], lines)


def _elsewhere(rows: list[Row]) -> str:
    heads = ["family", *(f"{scene}: mean, peak (N)" for scene in SCENES)]
    lines = []
    for row in rows:
        cells = []
        for scene in SCENES:
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
