"""Reads a CSV or DXF file as one closed loop of points (mm, as x + iy)."""

import os
import stat
from pathlib import Path

import numpy as np

from rootsopt.errors import InputError
from rootsopt.measured.estimates import UNITS, unit_of_size
from rootsopt.measured.guard import short
from rootsopt.measured.loop import Loop, signed_area
from rootsopt.measured.table import from_csv

__all__ = ["Loop", "read", "signed_area"]

_WIDEST = 5.0
"""Distance between the last and the first point above which a loop is rejected as open. The unit is
the longest step between successive points."""
_BYTES = 50_000_000
"""Size (bytes) above which a file is rejected."""
_POINTS = 500_000
"""Number of points above which an outline is rejected. Reading and fitting take about 20 µs per
point."""
_SIZES = 0.1, 1e5
"""Least and greatest size (mm) of an outline. Outside this range it is rejected, because its units
must be wrong."""
_SAME = 1e-9
"""Distance (fraction of the outline's greatest coordinate) below which successive points are merged
into one."""
_NOT_FILES = (
    (stat.S_ISDIR, "a folder"),
    (stat.S_ISFIFO, "a pipe"),
    (stat.S_ISSOCK, "a socket"),
    (lambda mode: stat.S_ISCHR(mode) or stat.S_ISBLK(mode), "a device"),
)


def read(path: Path, unit: str | None = None, pitch_radius_mm: float | None = None) -> Loop:
    """Return the outline in the CSV (.csv, .txt) or DXF file `path` as a closed loop (mm).

    CSV: x and y in mm, separated by commas, semicolons, tabs or blanks, with or without a header.
    The columns are those that the header calls x and y (or `x_mm`, `y_mm`), or else the first two.

    DXF, text or binary: the closed loop of the largest area formed by LINE, ARC, ELLIPSE, SPLINE,
    LWPOLYLINE and POLYLINE. Only entities on the layer OUTLINE are used. If that layer is empty,
    entities drawn directly are used, and otherwise those in blocks. Lengths are in the unit that
    the file states, or in mm if it states none. The ends of a LINE and the corners of a polyline
    are read as points on a smooth curve, not as corners of the outline.

    `unit`: name (from `UNITS`) of the unit of the file's numbers, instead of these rules.
    `pitch_radius_mm`: pitch radius, by which a message may name the right unit.

    Raises `InputError` if the file cannot be read or contains no closed outline.
    """
    name, kind = short(path.name), path.suffix.lower()
    if kind not in (".csv", ".txt", ".dxf"):
        raise InputError(
            f"`profile.outline_file` must be a .csv, .txt or .dxf file, but is {name!r}; save "
            "the outline in one of these formats"
        )
    data = _bytes(path, name)
    if kind == ".dxf":
        from rootsopt.measured.dxf import from_dxf  # Imported for drawings only: it takes 0.25 s.

        return _closed(from_dxf(data, name, unit), name, unit, pitch_radius_mm)
    loop = from_csv(data, name)
    if unit is not None:
        loop = Loop(loop.points * UNITS[unit], loop.joints, UNITS[unit])
    return _closed(loop, name, unit, pitch_radius_mm)


def _bytes(path: Path, name: str) -> bytes:
    """Return the content of the file at `path`. `name`: name of the file in messages.

    Raises `InputError` if `path` is not a regular file, or the file is unreadable, too large or
    empty."""
    try:
        found = path.stat()
        kind = next((what for test, what in _NOT_FILES if test(found.st_mode)), None)
        if kind is not None:
            raise InputError(
                f"`profile.outline_file` must be a file, but {name!r} is {kind}; give the path of "
                "a .csv, .txt or .dxf file"
            )
        # Do not wait for a pipe that has replaced the file in the meantime.
        flags = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
        with open(os.open(path, flags), "rb") as file:
            data = file.read(_BYTES + 1) or b""
    except (OSError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        reason = getattr(error, "strerror", None) or str(error)
        raise InputError(
            "`profile.outline_file` must be a file that can be read, but is "
            f"{short(str(path), 120)!r}: {short(reason.lower())}; a path in a config is relative "
            "to the config's folder, a path given with --set to the current folder"
        ) from None
    if len(data) > _BYTES:
        raise InputError(
            f"{name}: must have at most {_BYTES / 1e6:g} MB, but is larger; export the outline "
            "alone, with fewer points"
        )
    if not data.strip():
        raise InputError(f"{name}: must hold an outline, but is empty; export it again")
    return data


def _closed(loop: Loop, name: str, unit: str | None, pitch_radius_mm: float | None) -> Loop:
    """Return the loop without repeated points.

    `name`: name of the file in messages; `unit`, `pitch_radius_mm`: as in `read`.

    Raises `InputError` if the loop is open, or if its size or number of points is out of range."""
    points = loop.points
    if len(points) > _POINTS:
        raise InputError(
            f"{name}: must have at most {_POINTS} points, but has {len(points)}; thin them out"
        )
    if len(points) < 4:
        raise InputError(
            f"{name}: must hold the points of an outline, but has {len(points)}; add the rest"
        )
    low, high = _SIZES
    # Check the greatest coordinate first, as the difference of large ones may overflow.
    x, y = np.real(points), np.imag(points)
    reach = float(max(np.max(np.abs(x)), np.max(np.abs(y))))
    size = float(max(np.ptp(x), np.ptp(y))) if reach <= high else reach
    if not low <= size <= high:
        raise InputError(
            f"{name}: must hold an outline of {low:g} to {high:g} mm, but "
            + ("all its points are in one place" if size == 0 else f"it measures {size:.4g} mm")
            + "; "
            + (_unit(points, unit, pitch_radius_mm) or "check its units (CSV: mm; DXF: $INSUNITS)")
        )
    steps = np.abs(np.diff(points))
    gap = abs(points[-1] - points[0])
    if gap > _WIDEST * np.max(steps):
        raise InputError(
            f"{name}: the outline must be closed, but its last point is {gap:.4g} mm from its "
            f"first (longest step between others: {np.max(steps):.4g} mm); add what is missing"
        )
    # Keep the last of coincident points; it is a joint if any of them is one.
    kept = np.flatnonzero(np.append(steps, gap) > _SAME * reach)
    owner = np.searchsorted(kept, np.flatnonzero(loop.joints)) % len(kept)
    joints = np.zeros(len(kept), bool)
    joints[owner] = True
    return Loop(points[kept], joints, loop.unit)


def _unit(points, unit: str | None, pitch_radius_mm: float | None) -> str | None:
    """Return advice on the unit in which the `points` would fit the pitch radius, or `None`.

    `unit`, `pitch_radius_mm`: as in `read`."""
    with np.errstate(all="ignore"):
        radius = np.abs(points - np.mean(points))
        middle = float(np.max(radius) + np.min(radius)) / 2
    fitting = None if pitch_radius_mm is None else unit_of_size(middle, pitch_radius_mm)
    if unit is not None or fitting is None:
        return None
    return f"in {fitting} it would fit the pitch radius: set `profile.outline_unit` = {fitting}"
