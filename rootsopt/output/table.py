"""A table of facts about a run, which a terminal or a page lays out."""

import dataclasses
from collections.abc import Iterable, Sequence

from rootsopt.output.names import in_words
from rootsopt.status import Status
from rootsopt.tradeoffs.front import Standing


@dataclasses.dataclass(frozen=True)
class Cell:
    """A cell of a table: its text, and whether its content is favourable (None: neutral)."""

    text: str
    good: bool | None = None


Row = Sequence[Cell | str]
"""Cells of a row; a text is a neutral cell."""


@dataclasses.dataclass(frozen=True)
class Table:
    """A table: title, headings of its columns, groups of rows, and a note below it.

    `groups`: (heading of the group or "", rows) for each group. Each row has a cell per column; the
    first is its heading."""

    title: str
    heads: tuple[str, ...]
    groups: tuple[tuple[str, tuple[tuple[Cell, ...], ...]], ...]
    note: str = ""


def table(
    title: str, heads: Sequence[str], groups: Iterable[tuple[str, Iterable[Row]]], note: str = ""
) -> Table | None:
    """Return a table without its empty groups, or None if it has no rows.

    Arguments: fields of `Table`. Short rows are filled with empty cells."""
    found = []
    for heading, rows in groups:
        filled = ([*row, *[""] * (len(heads) - len(row))] for row in rows)
        cells = tuple(
            tuple(Cell(one) if isinstance(one, str) else one for one in row) for row in filled
        )
        if cells:
            found.append((heading, cells))
    return Table(title, tuple(heads), tuple(found), note) if found else None


def status_cell(word: str) -> Cell:
    """Return the cell of a status: its label in words, marked favourable or not."""
    known = {status.label: status.usable for status in Status}
    known |= {one.label: one is Standing.CERTIFIED for one in Standing}
    return Cell(in_words(word), known.get(word))


__all__ = ["Cell", "Table", "status_cell", "table"]
