"""Outlines from files: CSV and DXF in, one closed loop of points out (mm, as x + iy)."""

import csv
import dataclasses
import io
import itertools
import logging
import math
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Complex128

from rootsopt.errors import InputError

_TOGETHER = 1e-3
"""Ends of entities closer than this (mm) are one point."""
_SPACING = 1 / 400
"""Distance between points on arcs and splines, relative to the drawing's size."""
_FEWEST = 24
"""Intervals of an arc or spline, at least."""
_PER_SPAN = 4
"""Intervals between two knots of a spline, at least."""
_WIDEST = 5.0
"""The way from the last point to the first, relative to the longest step between others, with which
a loop that does not repeat its first point counts as closed."""
_LAYER = "OUTLINE"
_LINES = ("LINE",)
_CURVES = ("ARC", "SPLINE", "ELLIPSE")
_CHAINS = ("LWPOLYLINE", "POLYLINE")


@dataclasses.dataclass(frozen=True)
class Loop:
    """Points of a closed outline in order, the first not repeated, and which of them are `joints`
    of a drawing's arcs and splines, where curvature may jump."""

    points: Complex128[np.ndarray, " n"]
    joints: Bool[np.ndarray, " n"]


def read(path: Path) -> Loop:
    """The outline in a CSV or DXF file.

    CSV: x and y in mm (columns `x_mm` and `y_mm` if the header names them, else the first two),
    with or without a header, split by commas, semicolons, tabs or blanks. DXF: the closed loop
    of the largest area out of LINE, ARC, ELLIPSE, SPLINE, LWPOLYLINE and POLYLINE on the layer
    OUTLINE, or on all layers if there is none of that name, in the units the file states (mm if
    none). The ends of a LINE and the corners of a polyline are taken as points of a curve.

    Raises `InputError` for a file that cannot be read or holds no closed outline.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(
            f"`profile.outline_file` must be a file that can be read, but is {str(path)!r}: "
            f"{(error.strerror or str(error)).lower()}; a path in a config is relative to the "
            "config's folder, one given with --set to the current folder"
        ) from None
    kind = path.suffix.lower()
    if kind not in (".csv", ".txt", ".dxf"):
        raise InputError(
            f"`profile.outline_file` must be a .csv, .txt or .dxf file, but is {path.name!r}; save "
            "the outline in one of these formats"
        )
    loop = _from_dxf(data, path.name) if kind == ".dxf" else _from_csv(data, path.name)
    return _closed(loop, path.name)


def _closed(loop: Loop, name: str) -> Loop:
    """The loop without repeated points. Raises `InputError` unless it is closed."""
    points, joints = loop.points, loop.joints
    steps = np.abs(np.diff(points))
    if len(points) < 4 or not np.max(steps) > 0:
        raise InputError(f"{name}: must hold the points of an outline, but has {len(points)}")
    gap = abs(points[-1] - points[0])
    if gap > _WIDEST * np.max(steps):
        raise InputError(
            f"{name}: the outline must be closed, but its last point is {gap:.4g} mm from its "
            f"first (longest step between others: {np.max(steps):.4g} mm); add what is missing"
        )
    same = np.append(steps, gap) <= 1e-9 * np.max(np.abs(points))
    # Of two points in one place the first is left out, and the joint is the other's.
    joints = joints | np.roll(joints & same, 1)
    return Loop(points[~same], joints[~same])


def _from_csv(data: bytes, name: str) -> Loop:
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise InputError(f"{name}: is not UTF-8 text; save it as CSV in UTF-8") from None
    lines = [(n, line) for n, line in enumerate(text.splitlines(), 1) if line.strip()]
    lines = [(n, line) for n, line in lines if not line.lstrip().startswith("#")]
    first = lines[0][1] if lines else ""
    split = next((c for c in ";\t," if c in first), None)
    rows = [(n, _cells(line, split)) for n, line in lines]
    columns = (0, 1)
    if rows and not all(map(_is_number, rows[0][1][:2])):
        names = [cell.strip().lower() for cell in rows[0][1]]
        if "x_mm" in names and "y_mm" in names:
            columns = names.index("x_mm"), names.index("y_mm")
        rows = rows[1:]
    points = []
    for number, row in rows:
        try:
            x, y = (float(row[column]) for column in columns)
        except (ValueError, IndexError):
            x = y = math.nan
        if not (math.isfinite(x) and math.isfinite(y)):
            raise InputError(
                f"{name}, line {number}: must hold x and y in mm, but is {', '.join(row)!r}; mend "
                "or remove the line"
            )
        points.append(complex(x, y))
    return Loop(np.array(points, complex), np.zeros(len(points), bool))


def _cells(line: str, split: str | None) -> list[str]:
    if split is None:
        return line.split()
    return next(csv.reader(io.StringIO(line), delimiter=split))


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _from_dxf(data: bytes, name: str) -> Loop:
    # A quarter of a second to import; it announces itself in the log.
    logging.getLogger("ezdxf").setLevel(logging.WARNING)
    from ezdxf import recover, units
    from ezdxf.enums import InsertUnits
    from ezdxf.lldxf.const import DXFError

    try:
        document, _ = recover.read(io.BytesIO(data))
    except (DXFError, OSError, ValueError) as error:
        raise InputError(f"{name}: is not a DXF file that can be read: {error}") from None
    given = document.header.get("$INSUNITS", 0)
    scale = units.conversion_factor(given, InsertUnits.Millimeters) if given else 1.0
    kinds = (*_LINES, *_CURVES, *_CHAINS)
    entities = [e for e in document.modelspace() if e.dxftype() in kinds]
    entities = [e for e in entities if e.dxf.layer.upper() == _LAYER] or entities
    if not entities:
        raise InputError(
            f"{name}: must hold an outline of {', '.join(kinds)}, but has none of them"
        )
    from ezdxf import bbox

    size = scale * bbox.extents(entities).size.vec2.magnitude
    chains = [Loop(*part) for e in entities for part in _sampled(e, scale, _SPACING * size)]
    return _joined(chains, name)


def _sampled(entity: Any, scale: float, spacing: float):
    """Points of an entity from end to end and which are joints, once or for each of its parts."""
    kind = entity.dxftype()
    if kind in _CHAINS:
        if entity.has_arc:
            for part in entity.virtual_entities():
                yield from _sampled(part, scale, spacing)
            return
        corners = [complex(p[0], p[1]) for p in _corners(entity)]
        corners += corners[:1] if entity.is_closed else []
        points = scale * np.array(corners)
        yield points, np.zeros(len(points), bool)
        return
    if kind in _LINES:
        ends = entity.dxf.start, entity.dxf.end
        yield scale * np.array([complex(p.x, p.y) for p in ends]), np.zeros(2, bool)
        return
    tool = entity.construction_tool()
    if kind == "ARC":
        sweep = math.radians((entity.dxf.end_angle - entity.dxf.start_angle) % 360 or 360)
        count = max(_FEWEST, math.ceil(scale * entity.dxf.radius * sweep / spacing))
        angles = math.radians(entity.dxf.start_angle) + sweep * np.arange(count + 1) / count
        center = complex(entity.dxf.center.x, entity.dxf.center.y)
        points = center + entity.dxf.radius * np.exp(1j * angles)
    elif kind == "ELLIPSE":
        count = max(_FEWEST, math.ceil(scale * tool.major_axis.magnitude * 2 * math.pi / spacing))
        places = tool.vertices(tool.params(count + 1))
        points = np.array([complex(p.x, p.y) for p in places])
    else:
        rough = np.array([complex(p.x, p.y) for p in tool.approximate(64)])
        per_span = scale * np.sum(np.abs(np.diff(rough))) / spacing
        knots = np.unique(tool.knots())
        knots = knots[(knots >= tool.knots()[tool.order - 1]) & (knots <= tool.max_t)]
        count = max(_PER_SPAN, math.ceil(max(_FEWEST, per_span) / (len(knots) - 1)))
        shares = np.arange(count) / count
        at = np.append((knots[:-1, None] + np.diff(knots)[:, None] * shares).ravel(), knots[-1])
        points = np.array([complex(p.x, p.y) for p in tool.points(map(float, at))])
    joints = np.zeros(len(points), bool)
    joints[[0, -1]] = True
    yield scale * points, joints


def _corners(entity: Any):
    return entity.get_points("xy") if entity.dxftype() == "LWPOLYLINE" else entity.points()


def _joined(chains: list[Loop], name: str) -> Loop:
    """The closed loop of the largest area that `chains` make, each in either direction."""
    left, loops, widest = list(chains), [], 0.0
    while left:
        points, joints = left[0].points, left.pop(0).joints
        while abs(points[-1] - points[0]) > _TOGETHER or len(points) < 3:
            found = [
                (abs(chain.points[end] - points[-1]), place, end)
                for (place, chain), end in itertools.product(enumerate(left), (0, -1))
            ]
            apart, place, end = min(found, default=(math.inf, 0, 0))
            if apart > _TOGETHER:
                widest = max(widest, abs(points[-1] - points[0]))
                break
            chain = left.pop(place)
            way = slice(None) if end == 0 else slice(None, None, -1)
            # The end they share stands once, as a joint if it is one of either.
            after = chain.joints[way]
            joints = np.concatenate([joints[:-1], [joints[-1] | after[0]], after[1:]])
            points = np.concatenate([points, chain.points[way][1:]])
        else:
            joints[0] |= joints[-1]
            loops.append(Loop(points[:-1], joints[:-1]))
    if not loops:
        raise InputError(
            f"{name}: the outline must be closed within {_TOGETHER:g} mm, but the entities make no "
            f"closed loop (widest gap {widest:.4g} mm); join them in the drawing, on a layer "
            f"{_LAYER}"
        )
    return max(loops, key=lambda loop: abs(signed_area(loop.points)))


def signed_area(points: Complex128[np.ndarray, " n"]) -> float:
    """Area inside a closed polygon (mm²), positive if it runs counter-clockwise."""
    return float(np.sum(np.imag(np.conj(points) * np.roll(points, -1)))) / 2
