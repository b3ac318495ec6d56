"""Rows, summary and terminal tables of a sweep, which are written beside its dataset."""

from collections import Counter
from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray
from rich.console import Group, RenderableType
from rich.text import Text

from rootsopt.output.labels import number as number_text
from rootsopt.output.tables import plain_table, status_text
from rootsopt.status import Status
from rootsopt.sweeps.plan import Plan
from rootsopt.sweeps.points import Row
from rootsopt.sweeps.table import is_numeric, written

_SHOWN = ("mean_force_N", "peak_force_N", "rms_force_N")
_FEW = 40
"""Number of points above which the terminal shows only a summary."""
_NARROW = 3
"""Number of keys above which the terminal shows only a summary."""


def rows_of(plan: Plan, records: Mapping[int, Row]) -> list[dict[str, Any]]:
    """Return one row per simulated point: its number, values, forces, kind of motion, status."""
    found = []
    for number in sorted(records):
        record, values = records[number], plan.at(number)
        plain = {key: v if is_numeric([v]) else written(v) for key, v in values.items()}
        steady = record["steady_state"]
        response = record["response"]
        found.append(
            {"point": number}
            | plain
            | {name: response.get(name) for name in (*_SHOWN, *response)}
            | {name: steady.get(name) for name in ("kind", "period", "floquet_multiplier")}
            | {"status": record["status"]}
        )
    return found


def outcome(plan: Plan, records: Mapping[int, Row]) -> tuple[Status, str]:
    """Return status and message of a whole sweep.

    They are those of the first usable point, or of the first point if none is usable. If points are
    missing, the sweep was interrupted."""
    first = sorted(records)
    known = [number for number in first if Status[records[number]["status"].upper()].usable]
    counts = f"{len(known)} of {plan.count} points have a usable result."
    if len(records) < plan.count:
        return Status.INTERRUPTED, (
            f"The sweep was stopped: {len(records)} of {plan.count} points are done. Run it again "
            "with --resume for the others."
        )
    record = records[(known or first)[0]]
    status = Status[record["status"].upper()]
    return status, counts if known else f"{counts} The first one: {record['message']}"


def summary(plan: Plan, records: Mapping[int, Row]) -> dict[str, Any]:
    """Return the record of a sweep for the result file."""
    status, message = outcome(plan, records)
    counts = Counter(records[number]["status"] for number in sorted(records))
    missing = plan.count - len(records)
    return {
        "sweep": plan.record() | {"points": plan.count},
        "statuses": dict(counts) | ({"not_simulated": missing} if missing else {}),
        "status": status.label,
        "message": message,
    }


def tables_of(plan: Plan, records: Mapping[int, Row], dataset: xarray.Dataset) -> RenderableType:
    """Return the tables of a sweep for the terminal: its points if they are few, and a summary."""
    parts: list[RenderableType] = []
    rows = rows_of(plan, records)
    if len(rows) <= _FEW and len(plan.keys) <= _NARROW:
        names = [key.rpartition(".")[2] for key in plan.keys]
        table = plain_table("Points of the sweep", *names, "mean, N", "peak, N", "status")
        table.columns[0].header = Text("point")
        for row in rows:
            cells = [*plan.keys, "mean_force_N", "peak_force_N"]
            numbers = (number_text(row[key]) for key in cells)
            table.add_row(str(row["point"]), *numbers, status_text(row))
        parts.append(table)
    counts = Counter(row["status"] for row in rows)
    table = plain_table(f"Statuses of {plan.count} points", "points")
    for label, count in counts.most_common():
        table.add_row(status_text({"status": label}), str(count))
    if len(rows) < plan.count:
        table.add_row("not_simulated", str(plan.count - len(rows)))
    parts.append(table)
    usable = [Status[str(label).upper()].usable for label in dataset.status.values.ravel()]
    if any(usable):
        parts.append(_ranges(plan, dataset, np.array(usable)))
    return Group(*parts)


def _ranges(plan: Plan, dataset: xarray.Dataset, usable: np.ndarray) -> RenderableType:
    """Return a table of the least and greatest forces of usable points, and where they are."""
    table = plain_table("Usable points", "least, N", "point", "greatest, N", "point")
    for name in _SHOWN:
        values = np.where(usable, dataset[name].values.ravel(), np.nan)
        if not np.isfinite(values).any():
            continue
        low, high = int(np.nanargmin(values)), int(np.nanargmax(values))
        cells = number_text(values[low]), str(low), number_text(values[high]), str(high)
        table.add_row(name.removesuffix("_N").replace("_", " "), *cells)
    return table


__all__ = ["outcome", "rows_of", "summary", "tables_of"]
