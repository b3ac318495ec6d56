"""Reads points from a text table (CSV), and the transmission error of a timing gear."""

import csv
import io
import itertools
import math
import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rootsopt.config.sources import content
from rootsopt.config.units import DEG, UM, named
from rootsopt.errors import InputError
from rootsopt.measured.estimates import UNITS
from rootsopt.measured.loop import Loop, guarded

# Number of characters in a line above which a table is rejected.
_LONGEST = 100_000

# Number of lines from which the character that separates the columns is found.
_TRIED = 100
_REMEDY = "save the points as x,y in mm, one pair per line, as UTF-8 text"

# Cells by which a spreadsheet or an instrument marks a missing number.
_LACKING = re.compile(
    r"#(?:n/?a|nv|div/0!|value!|wert!|ref!|bezug!|name\?|num!|zahl!|null!)|n/?a|nan|null|none|-+",
    re.IGNORECASE,
)

# Names of a column by axis, as regular expressions.
_AXES = {
    "x": "x",
    "y": "y",
    "r": "r|rho|ρ|radius",
    "theta": r"theta|θ|ϑ|phi|φ|ϕ|angle|winkel|polar[\s_]?angle",
}
_LENGTHS = {
    "mm": r"mm|millimet(?:er|re)s?",
    "cm": r"cm|centimet(?:er|re)s?",
    "m": r"m|met(?:er|re)s?",
    "um": r"um|µm|μm|microns?|micromet(?:er|re)s?",
    "inch": r"in|inch(?:es)?|zoll",
}
_ANGLES = {"deg": "deg|degrees?|°", "rad": "rad|radians?"}

# Units that a header may state but that are not supported.
_OTHERS = r"ft|foot|feet|yd|yards?|mils?|thou|nm|dm|km|px|pixels?|grad|gon"
_UNIT = "|".join([*_LENGTHS.values(), *_ANGLES.values(), _OTHERS])
_TURN = {"deg": 360.0, "rad": 2 * math.pi}

# Range of the angles in a column (turns) in which its unit can be told from the numbers.
_WHOLE = 0.8, 1.01

# Step between successive points (median of all steps) above which another outline may begin, and
# least number of points of an outline in a table that holds several.
_APART, _FEWEST = 5.0, 8


def from_csv(data: bytes, name: str, unit: str | None = None) -> list[Loop]:
    """Return the outlines (mm) in a table, in the order of its lines, as loops without joints.

    `data`: content of the file; `name`: name of the file in messages; `unit`: name of the unit of
    its lengths, instead of the one that the header states. Raises `InputError` if the table cannot
    be read or a line is not a point."""
    text = _text(data, name)
    lines = [one for one in enumerate(text.splitlines(), 1) if one[1].strip(" \t,;\r")]
    comments = [line.lstrip("# \t") for _, line in lines if _comment(line)]
    lines = [(n, line) for n, line in lines if not _comment(line)]
    if not lines:
        raise InputError(f"{name}: must hold points, but has none; {_REMEDY}")
    for number, line in lines:
        if len(line) > _LONGEST:
            raise InputError(
                f"{name}, line {number}: must have at most {_LONGEST} characters, but has "
                f"{len(line)}; {_REMEDY}"
            )
    with guarded(name, "is not a table that can be read", _REMEDY):
        split = _separator([line for _, line in lines[:_TRIED]])
        rows = [(number, _cells(line, split)) for number, line in lines]
        heads = [_cells(line, split) for line in comments]
    if split == "," and len(rows) > 1 and not any("." in line for _, line in lines[1:]):
        _check_commas(rows[1:], name)
    titles = []
    while rows and _counted(rows[0][1]) < (1 if titles else 2):
        titles.append(rows.pop(0)[1])
    # If units stand below the names, both lines form one header.
    joint = [" ".join(cells).strip() for cells in itertools.zip_longest(*titles, fillvalue="")]
    places, stated, angle = _columns([joint, *titles[::-1], *heads[::-1]], name)
    what = f"{'x and y' if angle is None else 'r and theta, r'} in {stated or 'mm'}"
    values = np.array([_values(row, places, what, f"{name}, line {n}") for n, row in rows])
    values, notes = values.reshape(-1, 2), []
    points = values @ [1, 1j]
    if angle is not None:
        angle = angle or _angle(values[:, 1], name)
        points = values[:, 0] * np.exp(2j * np.pi * values[:, 1] / _TURN[angle])
        notes.append(f"the columns are read as polar coordinates r, theta ({angle})")
    if unit is None and stated not in (None, "mm"):
        notes.append(f"lengths are read in {stated}, as the header of the file says")
    length = UNITS[unit or stated or "mm"]
    return [
        Loop(part * length, np.zeros(len(part), bool), length, notes=tuple(notes))
        for part in _parts(points)
    ]


def titled(data: bytes, name: str, what: str) -> tuple[list[str], dict[int, list[str]]]:
    """Return (titles in the first line of a table, cells of each further line by its number).

    `data`: content of the file; `name`: name of the file, and `what`: names of its columns, for
    messages. Raises `InputError` if the table cannot be read."""
    numbered = enumerate(_text(data, name).splitlines(), 1)
    lines = [(n, line) for n, line in numbered if line.strip() and not _comment(line)]
    split = next((c for c in ";\t," if lines and c in lines[0][1]), None)
    with guarded(name, "is not a table that can be read", f"save it with the columns {what}"):
        rows = {number: [cell.strip() for cell in _cells(line, split)] for number, line in lines}
    first = next(iter(rows), 0)
    return rows.pop(first, []), rows


def measured_number(cell: str) -> float:
    """Return the number in a cell.

    NaN if the cell is empty or marks a missing number, infinity for any other text."""
    if not cell.strip() or _LACKING.fullmatch(cell.strip()):
        return math.nan
    number = _number(cell)
    return math.inf if number is None else number


def _comment(line: str) -> bool:
    cell = re.split(r"[\s;,]", line.strip(), maxsplit=1)[0]
    return cell.startswith("#") and not _LACKING.fullmatch(cell)


def _separator(lines: list[str]) -> str | None:
    """Return the character that splits most lines into two numbers or more, `None` for blanks."""
    known = next((c for c in ";\t," if c in lines[0]), None)
    return max(
        (known, ";", "\t", None, ","),
        key=lambda split: sum(_counted(_cells(line, split)) == 2 for line in lines),
    )


def _check_commas(rows: list[tuple[int, list[str]]], name: str) -> None:
    """Raise `InputError` if commas may be decimal commas and separate the columns, too."""
    number, row = max(rows, key=lambda one: len(one[1]))
    if 2 < len(row) <= 4 and all(re.fullmatch(r"\s*[+-]?\d+\s*", cell) for cell in row):
        raise InputError(
            f"{name}, line {number}: must separate columns by another character than decimals, "
            f"but {named(','.join(row))!r} has commas only; save the table with semicolons, or "
            "with decimal points"
        )


def _columns(headers: list[list[str]], name: str) -> tuple[tuple[int, int], str | None, str | None]:
    """Return (indices of the columns, unit of lengths, unit of the polar angle) from the headers.

    The first of the `headers` that names x and y, or r and theta, counts. Without such a header,
    the columns are the first two, x and y. A unit is `None` if none is stated. The unit of angle is
    "deg", "rad", "" if it must be told from the numbers, or `None` for x and y. Raises `InputError`
    if a header states units that are not known or differ."""
    for header, axes in itertools.product(headers, (("x", "y"), ("r", "theta"))):
        columns = [_named(axis, header) for axis in axes]
        if None in columns:
            continue
        (first, one), (second, two) = (one for one in columns if one)
        polar = axes[0] == "r"
        if one not in (None, *_LENGTHS) or two not in ((None, *_ANGLES) if polar else (one,)):
            stated = named(f"{header[first]}, {header[second]}")
            raise InputError(
                f"{name}: the header must state no unit of length or one of {', '.join(_LENGTHS)}"
                f"{' and of angle deg or rad' if polar else ''}, but is {stated!r}; correct it, or "
                "remove the units and set `profile.outline_unit`"
            )
        return (first, second), one, (two or "") if polar else None
    return (0, 1), None, None


def _named(axis: str, header: list[str]) -> tuple[int, str | None] | None:
    """Return (index, unit) of the cell that names an `axis`; `None` if there is not exactly one.

    The unit is "?" if it is not supported, and `None` if there is none. Of several cells with this
    name, the one in mm counts."""
    stated = rf"[\s_/]*(?:[(\[]\s*(?P<inside>.*?)\s*[)\]]|(?P<bare>{_UNIT}))|[\s_]+\w+"
    test = re.compile(f"(?:{_AXES[axis]})(?:{stated})?", re.IGNORECASE)
    cells = [(k, match) for k, cell in enumerate(header) if (match := test.fullmatch(cell.strip()))]
    columns = []
    for k, match in cells:
        text, known = match["inside"] or match["bare"], (_LENGTHS | _ANGLES).items()
        units = (unit for unit, test in known if re.fullmatch(test, text or "", re.IGNORECASE))
        columns.append((k, next(units, "?") if text else None))
    columns = columns if len(columns) == 1 else [one for one in columns if one[1] == "mm"]
    return columns[0] if len(columns) == 1 else None


def _counted(cells: list[str]) -> int:
    """Return how many of the first two cells are numbers or marks of a missing number."""
    return sum(_number(x) is not None or bool(_LACKING.fullmatch(x.strip())) for x in cells[:2])


def _values(row: list[str], places: tuple[int, int], what: str, where: str) -> list[float]:
    """Return the two numbers of a line at these `places`.

    `what`: what they are, and `where`: file and line, for messages."""
    cells = [row[k] if k < len(row) else "" for k in places]
    numbers = [value for cell in cells if (value := _number(cell)) is not None]
    if len(numbers) < 2 or not all(map(math.isfinite, numbers)):
        raise InputError(
            f"{where}: must hold {what}, but is {named(', '.join(row))!r}; correct or remove the "
            "line"
        )
    return numbers


def _angle(angles: NDArray[np.float64], name: str) -> str:
    """Return the unit in which the `angles` go round once. Raises `InputError` if there is none."""
    span = float(np.ptp(angles)) if len(angles) else 0.0
    for unit, turn in _TURN.items():
        if _WHOLE[0] * turn <= span <= _WHOLE[1] * turn:
            return unit
    raise InputError(
        f"{name}: the polar angles must go round once, in degrees or rad, but range over "
        f"{span:.4g}; state their unit in the header, as in r_mm,theta_deg"
    )


def _parts(points: NDArray[np.complex128]) -> list[NDArray[np.complex128]]:
    """Return the successive outlines in a table; all `points` if not each of them is closed."""
    with np.errstate(all="ignore"):
        steps = np.abs(np.diff(points))
        cuts = np.flatnonzero(steps > _APART * np.median(steps)) + 1 if len(steps) else []
        parts = np.split(points, cuts)
        closed = all(
            len(part) >= _FEWEST
            and abs(part[-1] - part[0]) <= _APART * np.max(np.abs(np.diff(part)))
            for part in parts
        )
    return parts if closed else [points]


def _text(data: bytes, name: str) -> str:
    encoding = "utf-16" if data.startswith((b"\xff\xfe", b"\xfe\xff")) else "utf-8-sig"
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
        return re.sub(r"\s+(?=[(\[])", "", line).split()  # "x (mm)" is one cell.
    return next(csv.reader(io.StringIO(line), delimiter=split), [])


def _number(cell: str) -> float | None:
    """Convert a cell to float; return `None` for text that is not a number.

    A decimal comma is accepted: a cell with a comma that separates columns is in quotes."""
    decimal = cell.count(",") == 1 and "." not in cell
    try:
        return None if "_" in cell else float(cell.replace(",", ".") if decimal else cell)
    except ValueError:
        return None


# Key that names the file.
_KEY = "scene.timing_gear.transmission_error_file"
_COLUMNS = "rotation_deg", "error_um"

# Least number of rows of a table, greatest step between them (°), greatest error (µm).
_FEWEST_ROWS, _WIDEST, _MOST = 8, 60.0, 1000.0

# Differences of rotation (°) and error (µm) up to which the last row repeats the first.
_SAME = 1e-6, 1e-3

# Degree of the spline. A lower one would have kinks that slow the closing of orbits.
_DEGREE = 5


def transmission_error(path: Path) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return (knots, powers) of the periodic spline through a table of the transmission error.

    Columns of the table: rotation of rotor 1 (°), and by how much the middle of the backlash is
    ahead on rotor 2 at the pitch circle (µm). `knots` (n,): rotations (rad); `powers` (6, n):
    coefficients (m/rad^k) of the polynomials that continue each knot, highest power first.

    Raises `InputError` if the file cannot be read, or the table is not that of one turn."""
    name, what = path.name, " and ".join(_COLUMNS)
    first, rows = titled(content(path, _KEY), name, what)
    if missing := [title for title in _COLUMNS if title not in first]:
        raise InputError(
            f"{name}: must name the columns {what} in its first line, but has no {missing[0]}; add "
            f"the line {','.join(_COLUMNS)}"
        )
    places = first.index(_COLUMNS[0]), first.index(_COLUMNS[1])
    pairs = [_values(row, places, what, f"{name}, line {number}") for number, row in rows.items()]
    turned, error = np.array(pairs).reshape(-1, 2).T
    whole = len(turned) > 1 and abs(turned[-1] - turned[0] - 360) < _SAME[0]
    apart = float(abs(error[-1] - error[0])) if whole else 0.0
    turned, error = (x[: len(x) - whole] for x in (turned, error))
    steps = np.diff(turned, append=turned[:1] + 360)
    widest, most = (float(np.max(x, initial=0)) for x in (steps, np.abs(error)))
    fall = int(np.argmin(steps)) + 1 if len(steps) and np.min(steps) <= 0 else 0
    for holds, wanted, actual in (
        (apart <= _SAME[1], "repeat its first error after 360°", f"differs by {apart:g} µm"),
        (len(turned) >= _FEWEST_ROWS, f"have at least {_FEWEST_ROWS} rows", f"has {len(turned)}"),
        (not fall, "go once round, with rising rotations", f"does not at row {fall}"),
        (widest <= _WIDEST, f"have a row every {_WIDEST:g}° or less", f"has a gap of {widest:g}°"),
        (most <= _MOST, f"have errors of at most {_MOST:g} µm", f"has one of {most:g} µm"),
    ):
        if not holds:
            raise InputError(f"{name}: must {wanted}, but {actual}; correct the table")
    from scipy.interpolate import make_interp_spline  # Slow import.

    knots = turned * DEG
    around = np.append(knots, knots[0] + 2 * math.pi), np.append(error, error[0]) * UM
    spline = make_interp_spline(*around, k=_DEGREE, bc_type="periodic")
    orders = range(_DEGREE, -1, -1)
    return knots, np.array([spline(knots, order) / math.factorial(order) for order in orders])
