"""Points on the entities of a drawing (mm, as x + iy).

An entity is a chain of segments. A segment is a polygonal line, an arc of a circle or ellipse, or a
spline. Each segment states its number of intervals before it is sampled, so that the size of every
array is known in advance.
"""

import abc
import dataclasses
import math
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline

from rootsopt.errors import InputError
from rootsopt.measured.guard import guarded, short
from rootsopt.measured.loop import Loop

_FEWEST = 24
"""Minimum number of sampling intervals on an arc or spline."""
_MOST = 100_000
"""Maximum number of sampling intervals derived from the length of an arc or spline."""
_PER_SPAN = 4
"""Minimum number of sampling intervals between two adjacent knots of a spline."""
_DEGREES = 25
"""Degree above which a spline is rejected."""
_FITTED = 5_000
"""Number of fit points above which a spline without control points is rejected."""
_SAME_KNOT = 1e-9
"""Difference between adjacent knots (fraction of their range) below which they become one knot."""
_FULL = 1e-9
"""Sweep (rad) below which an ELLIPSE is read as a full ellipse."""
_STRAIGHT = 1e-12
"""Absolute value of the bulge below which a side of a polyline is read as a straight line."""
_FRAME = 16
"""DXF flag of a vertex that is a control point of a spline-fitted polyline, not a point on it."""
_TILT = 1e-6
"""Angle (rad) between an entity's plane and the drawing's plane above which the entity is rejected.
"""


class Stroke(abc.ABC):
    """One segment of an entity."""

    curved: bool
    """Whether the segment's ends are joints (see `Loop`)."""
    least: int
    """Number of intervals into which the segment is divided when its extent is measured."""

    @abc.abstractmethod
    def intervals(self, spacing: float) -> int:
        """Return the number of intervals needed for points about `spacing` (mm) apart.

        A polygonal line ignores `spacing` and returns its number of corners."""

    @abc.abstractmethod
    def points(self, count: int) -> NDArray[np.complex128]:
        """Return points (mm, as x + iy) along the segment, including both ends.

        `count`: number of intervals. A spline may return more points than `count` + 1. A polygonal
        line ignores `count` and returns its corners."""


@dataclasses.dataclass(frozen=True)
class _Corners(Stroke):
    """A polygonal line: corners joined by straight lines."""

    corners: NDArray[np.complex128]
    curved = False
    least = 1

    def intervals(self, spacing: float) -> int:
        del spacing
        return len(self.corners)

    def points(self, count: int) -> NDArray[np.complex128]:
        del count
        return self.corners


@dataclasses.dataclass(frozen=True)
class _Ellipse(Stroke):
    """An elliptic or circular arc: the points center + major cos t + minor sin t.

    The angle t runs from start to start + sweep (rad)."""

    center: complex
    major: complex
    minor: complex
    start: float
    sweep: float
    curved = True
    least = _FEWEST

    def intervals(self, spacing: float) -> int:
        return _bounded(abs(self.major) * abs(self.sweep) / spacing)

    def points(self, count: int) -> NDArray[np.complex128]:
        t = self.start + self.sweep * np.arange(count + 1) / count
        return self.center + self.major * np.cos(t) + self.minor * np.sin(t)


@dataclasses.dataclass(frozen=True)
class _Spline(Stroke):
    """A spline in homogeneous coordinates (x, y, weight), sampled evenly between its knots."""

    curve: BSpline
    knots: NDArray[np.float64]
    curved = True
    least = 64

    def intervals(self, spacing: float) -> int:
        length = np.sum(np.abs(np.diff(self.points(self.least))))
        spans = len(self.knots) - 1
        return spans * max(_PER_SPAN, math.ceil(_bounded(length / spacing) / spans))

    def points(self, count: int) -> NDArray[np.complex128]:
        spans = len(self.knots) - 1
        each = -(-count // spans)
        shares = np.arange(each) / each
        inside = self.knots[:-1, None] + np.diff(self.knots)[:, None] * shares
        x, y, weight = self.curve(np.append(inside.ravel(), self.knots[-1])).T
        return (x + 1j * y) / weight


def _bounded(count: float) -> int:
    return math.ceil(min(max(_FEWEST, count), _MOST))


def chain(parts: list[Stroke], spacing: float) -> Loop:
    """Return the points on one entity, about `spacing` (mm) apart on curves, as an open `Loop`.

    `parts`: the entity's segments in order. The ends of arcs and splines are joints."""
    points, joints = [], []
    for segment in parts:
        own = segment.points(segment.intervals(spacing))
        marks = np.zeros(len(own), bool)
        marks[[0, -1]] = segment.curved
        if points:
            joints[-1][-1] |= marks[0]
            own, marks = own[1:], marks[1:]
        points.append(own)
        joints.append(marks)
    return Loop(np.concatenate(points), np.concatenate(joints))


@dataclasses.dataclass(frozen=True)
class Entity:
    """One entity of a drawing, in the drawing's units.

    `kind`: DXF type; `what`: name in messages; `normal`: normal of the entity's plane; `data`:
    first arguments of the function in `_KINDS` that makes the segments."""

    kind: str
    what: str
    normal: tuple[float, ...]
    data: tuple[Any, ...]

    @classmethod
    def of(cls, entity: Any, name: str) -> "Entity":
        """Build the entity from an ezdxf `entity`. `name`: name of the drawing in messages.

        Raises `InputError` if the entity cannot be read."""
        kind = entity.dxftype()
        with guarded(name, f"{kind} cannot be read", "repair or remove it in the drawing"):
            handle = short(entity.dxf.handle or "unknown", 20)
            normal = tuple(float(x) for x in entity.dxf.get("extrusion", (0, 0, 1)))
            data = _KINDS[kind][0](entity)
        return cls(kind, f"{name}: {kind} (handle {handle})", normal, data)

    def segments(self, scale: float) -> list[Stroke]:
        """Return the entity's segments in mm, or an empty list if it has no extent.

        `scale`: mm per drawing unit. Raises `InputError` if the entity is not valid.
        """
        fault, across = _Fault(self.what), abs(self.normal[2])
        if self.kind not in _SPATIAL and math.hypot(*self.normal[:2]) > _TILT * across:
            raise fault("lie in the plane of x and y", "is in another")
        made = _KINDS[self.kind][1](*self.data, _Plane(scale, self.normal[2] < 0), fault)
        with np.errstate(all="ignore"):
            whole = all(np.all(np.isfinite(s.points(s.least))) for s in made)
        if not whole:
            raise fault("have a finite size", "has none")
        return made


@dataclasses.dataclass(frozen=True)
class _Plane:
    """An entity's plane. `scale`: mm per drawing unit; `below`: whether it is seen from below."""

    scale: float
    below: bool

    def __call__(self, z: Any) -> Any:
        """Convert points or vectors `z` = x + iy from the entity's plane to the drawing's (mm).

        CAD stores mirrored entities in a plane seen from below, whose x axis is reversed."""
        return self.scale * (-np.conj(z) if self.below else z)


@dataclasses.dataclass(frozen=True)
class _Fault:
    """Builds the `InputError` for one entity. `what`: name of the entity in messages."""

    what: str

    def __call__(self, must: str, but: str) -> InputError:
        return InputError(
            f"{self.what} must {must}, but {but}; repair or remove it in the drawing, or draw the "
            "outline alone on a layer OUTLINE"
        )


def _plain(points: Iterable[Any]) -> NDArray[np.complex128]:
    """Convert the library's points (x, y) or (x, y, z) to complex numbers x + iy; z is dropped."""
    rows = np.array([(p[0], p[1]) for p in points], float).reshape(-1, 2)
    return rows[:, 0] + 1j * rows[:, 1]


def _read_line(entity: Any):
    return (_plain([entity.dxf.start, entity.dxf.end]),)


def _line(ends, plane, fault) -> list[Stroke]:
    del fault
    return [_Corners(plane.scale * ends)] if ends[0] != ends[1] else []


def _read_arc(entity: Any):
    dxf = entity.dxf
    numbers = (float(x) for x in (dxf.radius, dxf.start_angle, dxf.end_angle))
    return _plain([dxf.center])[0], *numbers


def _arc(center, radius, first, last, plane, fault) -> list[Stroke]:
    if not radius > 0:
        raise fault("have a radius above 0", f"has {radius:g}")
    axis = radius * np.exp(1j * math.radians(first))
    sweep = math.radians((last - first) % 360 or 360)
    return [_Ellipse(plane(center), plane(axis), plane(1j * axis), 0.0, sweep)]


def _read_ellipse(entity: Any):
    dxf = entity.dxf
    center, major = _plain([dxf.center, dxf.major_axis])
    minor = _plain([entity.minor_axis])[0]
    return center, major, minor, float(dxf.start_param), float(dxf.end_param)


def _ellipse(center, major, minor, first, last, plane, fault) -> list[Stroke]:
    if not min(abs(major), abs(minor)) > 0:
        raise fault("have axes longer than 0", f"has {abs(major):g} and {abs(minor):g}")
    first, sweep = first % math.tau, (last - first) % math.tau
    sweep = sweep if sweep > _FULL else math.tau
    center, major, minor = (plane.scale * x for x in (center, major, minor))
    return [_Ellipse(center, major, minor, first, sweep)]


def _read_spline(entity: Any):
    if len(entity.control_points) == 0 and 2 < len(entity.fit_points) <= _FITTED:
        tool = entity.construction_tool()
        return _plain(tool.control_points), tool.degree, _floats(tool.knots()), _floats([])
    controls = _plain(entity.control_points)
    return controls, int(entity.dxf.degree), _floats(entity.knots), _floats(entity.weights)


def _floats(values: Iterable[Any]) -> NDArray[np.float64]:
    return np.array([float(x) for x in values], float)


def _spline(controls, degree, knots, weights, plane, fault) -> list[Stroke]:
    if not 1 <= degree <= _DEGREES:
        raise fault(f"have a degree from 1 to {_DEGREES}", f"has {degree}")
    count = len(controls)
    if count <= degree:
        raise fault(
            f"have more than {degree} control points (or 3 to {_FITTED} fit points)", f"has {count}"
        )
    if len(knots) == 0:
        inner = np.arange(1.0, count - degree)
        knots = np.concatenate([np.zeros(degree + 1), inner, np.full(degree + 1, count - degree)])
    if len(knots) != count + degree + 1:
        raise fault(f"have {count + degree + 1} knots", f"has {len(knots)}")
    if len(weights) not in (0, count) or not np.all(weights > 0):
        raise fault(f"have {count} weights above 0 or none", "has others")
    if np.any(np.diff(knots) < 0):
        raise fault("have knots in rising order", "has not")
    # Knots that differ by rounding only are one knot.
    first = np.append(0, np.cumsum(np.diff(knots) > _SAME_KNOT * np.ptp(knots)))
    knots = knots[np.unique(first, return_index=True)[1]][first]
    domain = knots[degree : count + 1]
    different, repeated = np.unique(domain, return_counts=True)
    if len(different) < 2 or np.any(repeated[1:-1] > degree):
        raise fault(f"have at most {degree} equal knots inside", "has more")
    weights = weights if len(weights) else np.ones(count)
    points = plane.scale * controls * weights
    controls = np.stack([points.real, points.imag, weights], axis=1)
    return [_Spline(BSpline(knots, controls, degree), different)]


def _read_polyline(entity: Any):
    if entity.dxftype() == "LWPOLYLINE":
        rows = entity.get_points("xyb")
        return _plain(rows), _floats(row[2] for row in rows), bool(entity.closed), False
    if not (entity.is_2d_polyline or entity.is_3d_polyline):
        return _plain([]), _floats([]), False, False  # A mesh.
    # Control vertices of a spline-fitted polyline are not on the curve.
    vertices = [v for v in entity.vertices if not int(v.dxf.flags) & _FRAME]
    flat = bool(entity.is_2d_polyline)
    bulges = _floats(v.dxf.get("bulge", 0.0) if flat else 0.0 for v in vertices)
    points = _plain(v.dxf.location for v in vertices)
    return points, bulges, bool(entity.is_closed), bool(entity.is_3d_polyline)


def _polyline(corners, bulges, closed, spatial, plane, fault) -> list[Stroke]:
    """Return the straight runs and arcs (mm) of a polyline.

    `corners`: corners x + iy; `bulges`: bulge of the side after each corner; `closed`: whether a
    last side returns to the first corner; `spatial`: whether the corners are in the drawing's
    coordinates. A side with a bulge is an arc; its bulge is the tangent of a quarter of the arc's
    angle."""
    del fault
    corners = plane.scale * corners if spatial else plane(corners)
    bulges = -bulges if plane.below and not spatial else bulges
    if closed and len(corners) > 1:
        corners = np.append(corners, corners[0])
    made: list[Stroke] = []
    run = 0
    steps = np.diff(corners)
    for k in np.flatnonzero((np.abs(bulges[: len(steps)]) > _STRAIGHT) & (steps != 0)):
        if k > run:
            made.append(_Corners(corners[run : k + 1]))
        run = k + 1
        center = corners[k] + steps[k] / 2 * (1 + 1j * (1 - bulges[k] ** 2) / (2 * bulges[k]))
        axis, sweep = corners[k] - center, 4 * math.atan(bulges[k])
        made.append(_Ellipse(center, axis, 1j * axis, 0.0, sweep))
    if run < len(corners) - 1 and np.any(steps[run:] != 0):
        made.append(_Corners(corners[run:]))
    return made


_SPATIAL = ("LINE", "SPLINE")
"""Kinds of entities whose points are in the drawing's coordinates, so that their stated plane is
ignored."""
_KINDS = {
    "LINE": (_read_line, _line),
    "ARC": (_read_arc, _arc),
    "ELLIPSE": (_read_ellipse, _ellipse),
    "SPLINE": (_read_spline, _spline),
    "LWPOLYLINE": (_read_polyline, _polyline),
    "POLYLINE": (_read_polyline, _polyline),
}
"""Two functions for each kind of entity. The first reads an entity's data from the library's object
and is called inside `guarded`; the second makes segments from the data."""
