"""Tables on standard output."""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from rich.console import Console
from rich.table import Table

_WIDTH = 250
"""Width of a table (characters): wider than a terminal, so that no column is cut in a file."""


def show(
    title: str, rows: Sequence[Mapping[str, Any]], columns: Iterable[str] | None = None
) -> None:
    """Print rows as a table under a title.

    `columns`: keys to show, in order, by default the keys of the first row. Text columns are
    left-aligned, all others right-aligned.
    """
    keys = list(rows[0]) if columns is None else list(columns)
    table = Table(title=title)
    for key in keys:
        words = any(isinstance(row.get(key), str) for row in rows)
        table.add_column(key.replace("_", " "), justify="left" if words else "right")
    for row in rows:
        table.add_row(*(_cell(row.get(key)) for key in keys))
    Console(width=_WIDTH).print(table)


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
