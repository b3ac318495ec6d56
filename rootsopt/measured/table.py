"""Reads points from a text table (CSV)."""

import codecs
import csv
import io
import math
import re

import numpy as np

from rootsopt.errors import InputError
from rootsopt.measured.guard import guarded, short
from rootsopt.measured.loop import Loop

_LONGEST = 100_000
"""Number of characters in a line above which a table is rejected."""
_REMEDY = "save the points as x,y in mm, one pair per line, as UTF-8 text"
_HEADER = r"[\s_/]*(?:\(mm\)|\[mm\]|mm)?"
_NAMES = tuple(re.compile(f"{axis}{_HEADER}", re.IGNORECASE) for axis in "xy")
_WIDE = {codecs.BOM_UTF16_LE: "utf-16", codecs.BOM_UTF16_BE: "utf-16"}


def from_csv(data: bytes, name: str) -> Loop:
    """Return the points (mm) of a table in the order of its lines, as a `Loop` without joints.

    `data`: content of the file; `name`: name of the file in messages. Raises `InputError` if the
    table cannot be read or a line is not a point."""
    text = _text(data, name)
    lines = [(n, line) for n, line in enumerate(text.splitlines(), 1) if line.strip()]
    lines = [(n, line) for n, line in lines if not line.lstrip().startswith("#")]
    if not lines:
        raise InputError(f"{name}: must hold points, but has none; {_REMEDY}")
    for number, line in lines:
        if len(line) > _LONGEST:
            raise InputError(
                f"{name}, line {number}: must have at most {_LONGEST} characters, but has "
                f"{len(line)}; {_REMEDY}"
            )
    split = next((c for c in ";\t," if c in lines[0][1]), None)
    with guarded(name, "is not a table that can be read", _REMEDY):
        rows = [(number, _cells(line, split)) for number, line in lines]
    columns = 0, 1
    if any(_number(cell, split) is None for cell in rows[0][1][:2]):
        columns = _columns(rows.pop(0)[1])
    points = np.empty(len(rows), complex)
    for k, (number, row) in enumerate(rows):
        x, y = (_number(row[c], split) if c < len(row) else None for c in columns)
        if x is None or y is None or not (math.isfinite(x) and math.isfinite(y)):
            raise InputError(
                f"{name}, line {number}: must hold x and y in mm, but is "
                f"{short(', '.join(row))!r}; correct or remove the line"
            )
        points[k] = complex(x, y)
    return Loop(points, np.zeros(len(points), bool))


def _text(data: bytes, name: str) -> str:
    encoding = next((wide for mark, wide in _WIDE.items() if data.startswith(mark)), "utf-8-sig")
    try:
        text = data.decode(encoding)
    except UnicodeDecodeError as error:
        raise InputError(
            f"{name}: must be UTF-8 text, but is not at byte {error.start}; save it as CSV in UTF-8"
        ) from None
    if "\0" in text:
        line = text.count("\n", 0, text.index("\0")) + 1
        raise InputError(
            f"{name}, line {line}: must be text, but has a zero byte; save it as CSV in UTF-8"
        )
    return text


def _cells(line: str, split: str | None) -> list[str]:
    if split is None:
        return line.split()
    return next(csv.reader(io.StringIO(line), delimiter=split), [])


def _number(cell: str, split: str | None) -> float | None:
    """Convert a cell to float; return `None` for text that is not a number.

    `split`: character that separates cells, `None` for blanks. A decimal comma is accepted unless
    commas separate the cells."""
    cell = cell.strip()
    if split != "," and cell.count(",") == 1 and "." not in cell:
        cell = cell.replace(",", ".")
    try:
        return None if "_" in cell else float(cell)
    except ValueError:
        return None


def _columns(header: list[str]) -> tuple[int, int]:
    """Return the indices of the x and y columns, found by their names in the `header`.

    If the names do not identify both columns, return 0 and 1."""
    names = [cell.strip() for cell in header]
    found = [[k for k, cell in enumerate(names) if test.fullmatch(cell)] for test in _NAMES]
    if all(len(places) == 1 for places in found):
        return found[0][0], found[1][0]
    lower = [cell.lower() for cell in names]
    if "x_mm" in lower and "y_mm" in lower:
        return lower.index("x_mm"), lower.index("y_mm")
    return 0, 1
