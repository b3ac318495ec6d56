"""Names, units and numbers of the result file in words, and the tables that hold them.

All of them use the signs of print, such as µm and ×. `rootsopt.view.terminal` replaces these by
ASCII where a table is printed.
"""

import dataclasses
import itertools
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from rootsopt.config.reading import Config
from rootsopt.config.units import unit_of, words
from rootsopt.status import Standing, Status

DASH = "–"
"""Text in place of an unknown number."""
_NAMES = {
    "seconds": ("time", "s"),
    "kind": ("steady state", ""),
    "period": ("period", "mesh periods"),
    "window_mesh_periods": ("window", "mesh periods"),
    "lyapunov_exponent_per_mesh_period": ("Lyapunov exponent", "1/mesh period"),
    "lyapunov_standard_error": ("standard error of the Lyapunov exponent", "1/mesh period"),
    "floquet_multiplier": ("largest Floquet multiplier", ""),
    "residual": ("orbit residual", ""),
    "peak_norm_force_N": ("p-norm of the force", "N"),
    "knudsen_number": ("Knudsen number", ""),
    "time_apart": ("share of time with the gear's teeth apart", ""),
    "impacts_per_revolution": ("impacts of the gear's teeth per revolution", ""),
    "greatest_impact_N_m": ("greatest torque of these impacts", "N·m"),
    "silent_eccentricity_um": ("eccentricity up to which the gear is silent", "µm"),
    "relative_rotation_rad": ("relative rotation", "rad"),
    "relative_speed_rad_s": ("relative speed", "rad/s"),
    "penetration_m": ("penetration", "m"),
    "sigma": ("standard deviation", ""),
    "quantile_5": ("5 % quantile", ""),
    "quantile_95": ("95 % quantile", ""),
}
_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


Record = Mapping[str, Any]
"""The result file, or an entry of it."""


def name_and_unit(key: str) -> tuple[str, str]:
    """Return (name in words, unit) for a key of the result file, or for a dotted one of the config.

    Of a dotted key, the last part is named."""
    if key.partition(".")[0] in Config.model_fields:
        key = key.rpartition(".")[2]
    if key in _NAMES:
        return _NAMES[key]
    line = re.fullmatch(r"line_(.*)_force_N", key)
    return f"line at {line[1]} × mesh frequency" if line else words(key), unit_of(key)


def label(key: str) -> str:
    """Return the name in words of a `key` as in `name_and_unit`, with its unit in parentheses."""
    name, unit = name_and_unit(key)
    return f"{name} ({unit})" if unit else name


def in_words(name: str) -> str:
    """Return a `name` with blanks in place of underscores."""
    return name.replace("_", " ")


def scalars(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the entries of `values` that fit into a cell: all except lists and mappings."""
    tables = Mapping, list, tuple
    return {key: value for key, value in values.items() if not isinstance(value, tables)}


def value(given: Any) -> str:
    """Return a value as it is printed, numbers with five significant digits.

    Booleans become `yes` or `no`; None and non-finite numbers become a dash. Whole numbers are not
    rounded."""
    if isinstance(given, bool):
        return "yes" if given else "no"
    if isinstance(given, list | tuple):
        return ", ".join(map(value, given))
    if given is None or (isinstance(given, float) and not math.isfinite(given)):
        return DASH
    if isinstance(given, str):
        return in_words(given)
    if isinstance(given, int) or given == 0:
        return _printed(f"{given:.0f}")
    size = math.floor(math.log10(abs(given)))
    return _printed(f"{given:.{max(0, 4 - size)}f}" if -4 <= size < 7 else f"{given:.3e}")


def brief(given: float, digits: int = 5) -> str:
    """Return a number for a sentence: at most `digits` significant digits, no final zeros."""
    shown = f"{given:.{digits}g}"
    power = int(shown.partition("e")[2] or 0)
    return _printed(f"{float(shown):.0f}" if 0 < power < 7 else shown)


def quantity(given: float | None, unit: str) -> str:
    """Return a number for a sentence, with its `unit`."""
    shown = DASH if given is None else brief(given)
    return f"{shown}{'' if unit == '°' else ' '}{unit}".strip()


def stated(key: str, given: Any, named: bool = False) -> str:
    """Return the value of a `key` for a sentence, with its unit if it is a number.

    `named`: whether the name of the key stands before it."""
    name, unit = name_and_unit(key)
    is_number = isinstance(given, int | float) and not isinstance(given, bool)
    shown = quantity(given, unit) if is_number else value(given)
    return f"{name} {shown}" if named else shown


def signed(given: float, unit: str) -> str:
    """Return a number with its sign and three digits, followed by its `unit`."""
    return f"{'0' if given == 0 else _printed(f'{given:+.3g}')} {unit}".strip()


def percent(first: Any, second: Any) -> str:
    """Return the change from `first` to `second` in % of `first`, or "" if this is not defined."""
    numbers = [x for x in (first, second) if isinstance(x, int | float) and math.isfinite(x)]
    if len(numbers) < 2 or first == 0:
        return ""
    change = 100 * (second - first) / abs(first)
    shown = f"{change:+.2f}" if abs(change) < 1000 else f"{change:+.3g}"
    return f"{_printed(shown if float(shown) else shown[1:])} %"


def limit(row: Mapping[str, Any]) -> str:
    """Return a limit in words, as "seal width ≥ 25 mm"; `row`: {name, sense, limit, unit}."""
    sense = {">=": "≥", "<=": "≤"}.get(row["sense"], row["sense"])
    return f"{in_words(row['name'])} {sense} {quantity(row['limit'], row.get('unit') or '')}"


def listed(parts: Sequence[str]) -> str:
    """Return parts of a sentence with commas and a final "and" between them."""
    return parts[0] if len(parts) == 1 else f"{', '.join(parts[:-1])} and {parts[-1]}"


def _printed(shown: str) -> str:
    """Return a formatted number with minus signs and with its power of ten as an exponent."""
    mantissa, _, power = shown.partition("e")
    if power:
        mantissa += f" × 10{str(int(power)).translate(_RAISED)}"
    return mantissa.replace("-", "−")


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


def statuses_in(data: Any) -> dict[str, None]:
    """Return the labels of all statuses in the result file as keys, in order."""
    if isinstance(data, list | tuple):
        return {word: None for inner in data for word in statuses_in(inner)}
    if not isinstance(data, Mapping):
        return {}
    own = {data[key]: None for key in ("status", "evaluation_status") if key in data}
    return {word: None for word in own if isinstance(word, str)} | statuses_in([*data.values()])


def status_cell(word: str) -> Cell:
    """Return the cell of a status: its label in words, marked favourable or not."""
    known = {
        **{status.label: status.usable for status in Status},
        **{one.label: one is Standing.CERTIFIED for one in Standing},
    }
    return Cell(in_words(word), known.get(word))


def varied(rows: Sequence[Record]) -> list[str]:
    """Return the keys of the quantities that vary between scenes, beginning with a numeric one.

    These are the keys before the forces in each row."""
    keys = list(itertools.takewhile(lambda key: not key.endswith("_force_N"), rows[0]))
    kept = [key for key in keys if key not in ("status", "point", "message")]
    varied = [key for key in kept if len({row.get(key) for row in rows}) > 1] or kept[:1]
    return sorted(varied, key=lambda key: not isinstance(rows[0].get(key), int | float))


def table(
    title: str, heads: Sequence[str], groups: Iterable[tuple[str, Iterable[Row]]], note: str = ""
) -> Table | None:
    """Return a table without its empty groups, or None if it has no rows.

    Arguments: fields of `Table`. Short rows are filled with empty cells."""
    kept = []
    for heading, rows in groups:
        filled = ([*row, *[""] * (len(heads) - len(row))] for row in rows)
        cells = tuple(
            tuple(Cell(one) if isinstance(one, str) else one for one in row) for row in filled
        )
        if cells:
            kept.append((heading, cells))
    return Table(title, tuple(heads), tuple(kept), note) if kept else None
