"""Points on the entities of a drawing (mm, as x + iy).

An entity is a chain of strokes. Each states its number of points before it is sampled, so that the
size of every array is known in advance. Arcs and splines are sampled on the exact curve: the
library's own paths replace them by cubic Bézier curves, its flattening spaces the points unevenly,
and its splines end at degree 10.
"""

import dataclasses
import math
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from ezdxf.math import ConstructionEllipse, open_uniform_knot_vector
from numpy.typing import NDArray
from scipy.interpolate import BSpline

from rootsopt.config.units import named
from rootsopt.errors import InputError
from rootsopt.measured.loop import Loop, guarded

# Minimum number of sampling intervals on an arc or spline.
_FEWEST = 24

# Maximum number of sampling intervals derived from the length of an arc or spline.
_MOST = 100_000

# Minimum number of sampling intervals between two adjacent knots of a spline, and number of
# intervals on a spline when its extent is measured.
_PER_SPAN, _ROUGH = 4, 64

# Degree above which a spline is rejected.
_DEGREES = 25

# Number of fit points above which a spline without control points is rejected.
_FITTED = 5_000

# Difference between adjacent knots (fraction of their range) below which they become one knot.
_SAME_KNOT = 1e-9

# Sweep (rad) below which an arc is read as a full circle or ellipse.
_FULL = 1e-9

# Absolute value of the bulge below which a side of a polyline is read as a straight line.
_STRAIGHT = 1e-12

# DXF flag of a vertex that is a control point of a spline-fitted polyline, not a point on it.
_FRAME = 16

# Angle (rad) between an entity's plane and the drawing's plane above which the entity is
# rejected.
_TILT = 1e-6

# Kinds of entities whose points are in the drawing's coordinates, so that their stated plane is
# ignored.
_SPATIAL = ("LINE", "SPLINE")


@dataclasses.dataclass(frozen=True)
class Stroke:
    """One piece of an entity: a polygonal line, an arc of a circle or ellipse, or a spline.

    `rough`: some points (mm, as x + iy) along it, for its extent; of a polygonal line, the corners.
    `at`: function that returns points along the stroke, both ends included, from the number of
    intervals. `length`: approximate length (mm). `spans`: number of smooth parts in which intervals
    are equal, 0 for a polygonal line."""

    rough: NDArray[np.complex128]
    at: Callable[[int], NDArray[np.complex128]] | None = None
    length: float = 0.0
    spans: int = 0

    def intervals(self, spacing: float) -> int:
        """Return the number of intervals for points about `spacing` (mm) apart.

        Of a polygonal line, return the number of its corners."""
        if not self.spans:
            return len(self.rough)
        count = math.ceil(min(max(_FEWEST, self.length / spacing), _MOST))
        return self.spans * max(_PER_SPAN, math.ceil(count / self.spans))

    def points(self, spacing: float) -> NDArray[np.complex128]:
        """Return points (mm, as x + iy) about `spacing` (mm) apart, both ends included."""
        return self.rough if self.at is None else self.at(self.intervals(spacing))


def chain(strokes: list[Stroke], spacing: float, unit: float) -> Loop:
    """Return the points on one entity, about `spacing` (mm) apart on curves, as an open `Loop`.

    `strokes`: those of the entity in order; `unit`: length (mm) of the drawing's unit. The ends of
    arcs and splines are joints."""
    points, joints = [], []
    for stroke in strokes:
        own = stroke.points(spacing)
        marks = np.zeros(len(own), bool)
        marks[[0, -1]] = stroke.spans > 0
        if points:
            joints[-1][-1] |= marks[0]
            own, marks = own[1:], marks[1:]
        points.append(own)
        joints.append(marks)
    return Loop(np.concatenate(points), np.concatenate(joints), unit)


def strokes(entity: Any, scale: float, name: str) -> list[Stroke]:
    """Return the strokes of an ezdxf `entity`, or an empty list if it has no extent.

    `scale`: mm per drawing unit; `name`: name of the drawing in messages. Raises `InputError` if
    the entity cannot be read or is not valid."""
    kind = entity.dxftype()
    with guarded(name, f"{kind} cannot be read", "repair or remove it in the drawing"):
        handle = named(entity.dxf.handle or "unknown", 20)

        def fault(must: str, but: str) -> InputError:
            return InputError(
                f"{name}: {kind} (handle {handle}) must {must}, but {but}; repair or remove it in "
                "the drawing, or draw the outline alone on a layer OUTLINE"
            )

        x, y, z = entity.dxf.get("extrusion", (0, 0, 1))
        if kind not in _SPATIAL and math.hypot(x, y) > _TILT * abs(z):
            raise fault("lie in the plane of x and y", "is in another")
        made = KINDS[kind](entity, scale, fault)
        if not all(np.all(np.isfinite(stroke.rough)) for stroke in made):
            raise fault("have a finite size", "has none")
    return made


def _plain(points: Iterable[Any], scale: float) -> NDArray[np.complex128]:
    """Convert the library's points to complex numbers x + iy (mm); z is dropped."""
    rows = np.array([(p[0], p[1]) for p in points], float).reshape(-1, 2)
    return scale * (rows[:, 0] + 1j * rows[:, 1])


def _line(entity: Any, scale: float, fault) -> list[Stroke]:
    ends = _plain([entity.dxf.start, entity.dxf.end], scale)
    return [Stroke(ends)] if ends[0] != ends[1] else []


def _arc(entity: Any, scale: float, fault) -> list[Stroke]:
    dxf = entity.dxf
    if not dxf.radius > 0:
        raise fault("have a radius above 0", f"has {dxf.radius:g}")
    how = dxf.center, dxf.radius, dxf.extrusion, dxf.start_angle, dxf.end_angle
    return [_swept(ConstructionEllipse.from_arc(*how), scale)]


def _ellipse(entity: Any, scale: float, fault) -> list[Stroke]:
    if not min(entity.dxf.major_axis.magnitude, entity.minor_axis.magnitude) > 0:
        raise fault("have axes longer than 0", "has not")
    return [_swept(entity.construction_tool(), scale)]


def _swept(ellipse: ConstructionEllipse, scale: float) -> Stroke:
    center, major, minor = _plain([ellipse.center, ellipse.major_axis, ellipse.minor_axis], scale)
    sweep = (ellipse.end_param - ellipse.start_param) % math.tau
    return _bow(center, major, minor, ellipse.start_param, sweep if sweep > _FULL else math.tau)


def _bow(center: complex, major: complex, minor: complex, start: float, sweep: float) -> Stroke:
    """Return the arc center + major cos t + minor sin t (mm) from t = `start` (rad)."""

    def at(count: int) -> NDArray[np.complex128]:
        t = start + sweep * np.arange(count + 1) / count
        return center + major * np.cos(t) + minor * np.sin(t)

    return Stroke(at(_FEWEST), at, abs(major) * abs(sweep), 1)


def _spline(entity: Any, scale: float, fault) -> list[Stroke]:
    controls, degree = entity.control_points, int(entity.dxf.degree)
    knots, weights = (np.array(x, float) for x in (entity.knots, entity.weights))
    if len(controls) == 0 and 2 < len(entity.fit_points) <= _FITTED:
        fitted = entity.construction_tool()
        controls, degree, knots = fitted.control_points, fitted.degree, np.array(fitted.knots())
        weights = np.ones(0)
    count = len(controls)
    if not 1 <= degree <= _DEGREES:
        raise fault(f"have a degree from 1 to {_DEGREES}", f"has {degree}")
    if count <= degree:
        raise fault(
            f"have more than {degree} control points (or 3 to {_FITTED} fit points)", f"has {count}"
        )
    knots = knots if len(knots) else np.array(open_uniform_knot_vector(count, degree + 1))
    if len(knots) != count + degree + 1:
        raise fault(f"have {count + degree + 1} knots", f"has {len(knots)}")
    if len(weights) not in (0, count) or not np.all(weights > 0):
        raise fault(f"have {count} weights above 0 or none", "has others")
    if np.any(np.diff(knots) < 0):
        raise fault("have knots in rising order", "has not")
    # Knots that differ by rounding only are one knot.
    first = np.append(0, np.cumsum(np.diff(knots) > _SAME_KNOT * np.ptp(knots)))
    knots = knots[np.unique(first, return_index=True)[1]][first]
    different, repeated = np.unique(knots[degree : count + 1], return_counts=True)
    if len(different) < 2 or np.any(repeated[1:-1] > degree):
        raise fault(f"have at most {degree} equal knots inside", "has more")
    weights = weights if len(weights) else np.ones(count)
    curve = BSpline(knots, np.stack([_plain(controls, scale) * weights, weights], 1), degree)

    def at(count: int) -> NDArray[np.complex128]:
        each = -(-count // (len(different) - 1))
        inside = different[:-1, None] + np.diff(different)[:, None] * (np.arange(each) / each)
        z, weight = curve(np.append(inside.ravel(), different[-1])).T
        return z / weight

    rough = at(_ROUGH)
    length = float(np.sum(np.abs(np.diff(rough))))
    return [Stroke(rough, at, length, len(different) - 1)]


def _polyline(entity: Any, scale: float, fault) -> list[Stroke]:
    """Return the straight runs and arcs of a polyline.

    A side with a bulge is an arc; its bulge is the tangent of a quarter of the arc's angle."""
    if entity.dxftype() == "LWPOLYLINE":
        corners = entity.vertices_in_wcs()
        bulges = [bulge for (bulge,) in entity.get_points("b")]
    elif entity.is_2d_polyline or entity.is_3d_polyline:
        # Control vertices of a spline-fitted polyline are not on the curve.
        entity.vertices[:] = [v for v in entity.vertices if not int(v.dxf.flags) & _FRAME]
        corners = entity.points_in_wcs()
        bulges = [v.dxf.bulge if entity.is_2d_polyline else 0.0 for v in entity.vertices]
    else:
        return []  # A mesh.
    z = _plain(corners, scale)
    z = np.append(z, z[:1]) if entity.is_closed else z
    # CAD mirrors a polyline by looking at its plane from below; its arcs then turn the other way.
    turns = np.array(bulges[: len(z) - 1]) * (-1 if entity.dxf.extrusion.z < 0 else 1)
    steps, made, run = np.diff(z), [], 0
    for k in np.flatnonzero((np.abs(turns[: len(steps)]) > _STRAIGHT) & (steps != 0)):
        if k > run:
            made.append(Stroke(z[run : k + 1]))
        run = k + 1
        center = z[k] + steps[k] / 2 * (1 + 1j * (1 - turns[k] ** 2) / (2 * turns[k]))
        axis = z[k] - center
        made.append(_bow(center, axis, 1j * axis, 0.0, 4 * math.atan(turns[k])))
    if np.any(steps[run:] != 0):
        made.append(Stroke(z[run:]))
    return made


# Function for each kind of entity that returns its strokes, from the library's object, the mm per
# drawing unit, and a function that makes the error for an entity that is not valid.
KINDS = {
    "LINE": _line,
    "ARC": _arc,
    "SPLINE": _spline,
    "ELLIPSE": _ellipse,
    "LWPOLYLINE": _polyline,
    "POLYLINE": _polyline,
}
