"""Tables and records on standard output."""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

# A line of a table: values by column.
Row = dict[str, Any]


def show(
    title: str, rows: Sequence[Mapping[str, Any]], columns: Iterable[str] | None = None
) -> None:
    """Print rows as a Markdown table under a title, so that a page can take it over.

    `columns`: keys to show, in order, by default the keys of the first row. Nothing is printed
    without rows.
    """
    if not rows:
        return
    keys = list(rows[0] if columns is None else columns)
    body = [[_cell(row.get(key)) for key in keys] for row in rows]
    print(f"\n{title}\n")
    for line in ([key.replace("_", " ") for key in keys], ["---"] * len(keys), *body):
        print(f"| {' | '.join(line)} |")


def print_record(record: Mapping[str, Any]) -> None:
    """Print one line per entry of a record."""
    for key, value in record.items():
        print(f"{key}: {value}")


def _cell(value: Any) -> str:
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.3g}" if isinstance(value, float) else str(value)
