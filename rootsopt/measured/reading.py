"""Reads a CSV or DXF file as one closed loop of points (mm, as x + iy)."""

import contextlib
import dataclasses
import math
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from rootsopt.config.sources import content
from rootsopt.config.units import named
from rootsopt.errors import InputError
from rootsopt.measured.estimates import SEEN, SIZED, unit_of_size, written
from rootsopt.measured.loop import JOIN, Loop, joined, moment, place, signed_area, tails
from rootsopt.measured.table import from_csv

LOBES = range(2, 7)
"""Numbers of lobes that a rotor may have."""

# Joining distances (mm) tried to find the value of the key that closes an outline. The last one is
# the greatest value of the key.
_JOINS = 2e-3, 5e-3, 1e-2, 2e-2, 5e-2, 0.1, 0.2, 0.5, 1.0

# Number of loops, largest first, in which to search for the rotor. Number of rotors that a message
# names.
_LOOPS, _NAMED = 500, 4

# Area (squared extents) below which a loop is a sliver, and area (areas of the convex hull) above
# which it counts as convex.
_THIN, _CONVEX = 1e-2, 0.98

# Number of cusps per lobe above which they are scatter, and size (pitch radii) above which a
# swallow-tail is not cut off.
_CUSPS, _TAIL = 16, 0.02

# Number of polar angles at which the radius of a loop is compared with the lobes' symmetry, and
# norm of the harmonics that break the symmetry (harmonics of the lobes) above which it has none.
_RAYS, _UNLIKE = 720, 0.25

# Distance between the last and the first point above which a loop is rejected as open. The unit
# is the longest step between successive points.
_WIDEST = 5.0

# Number of points above which an outline is rejected. Reading and fitting take about 20 µs per
# point.
_POINTS = 500_000

# Least and greatest size (mm) of an outline. Outside this range it is rejected, because its units
# must be wrong.
_SIZES = 0.1, 1e5

# Distance (fraction of the outline's greatest coordinate) below which successive points are
# merged into one.
_SAME = 1e-9


@dataclasses.dataclass(frozen=True)
class Sought:
    """The rotor that a file should contain.

    `lobes`: number of lobes; `pitch_radius_mm`: pitch radius; both `None` if unknown. `center`: its
    axis in the file, as in `profile.outline_center`."""

    lobes: int | None = None
    pitch_radius_mm: float | None = None
    center: Literal["fit"] | tuple[float, float] | None = None


class _Shape(NamedTuple):
    """A loop with lobes: their number, centroid (mm, as x + iy), greatest radius, and its mean with
    the least."""

    lobes: int
    center: complex
    most: float
    middle: float


def read(
    path: Path, unit: str | None = None, sought: Sought | None = None, join: float = JOIN
) -> Loop:
    """Return the outline in the CSV (.csv, .txt) or DXF file `path` as a closed loop (mm).

    CSV: x and y in mm, separated by commas, semicolons, tabs or blanks, with or without a header.
    The columns are those that the header calls x and y, or r and theta; without these names, the
    first two are x and y. A header may also state the units.

    DXF, text or binary: a closed loop formed by LINE, ARC, ELLIPSE, SPLINE, LWPOLYLINE and
    POLYLINE. Only entities on the layer OUTLINE are used. If that layer is empty, entities drawn
    directly are used, and otherwise those in blocks. Lengths are in the unit that the file states,
    or in mm if it states none. The ends of a LINE and the corners of a polyline are read as points
    on a smooth curve, not as corners of the outline.

    `unit`: name (from `UNITS`) of the unit of the file's numbers, instead of these rules.
    `sought`: the rotor that is chosen if there are several loops. `None`: the largest loop.
    `join`: distance (mm) up to which ends of entities are joined.

    Raises `InputError` if the file cannot be read or contains no closed outline.
    """
    name, kind = named(path.name), path.suffix.lower()
    if kind not in (".csv", ".txt", ".dxf"):
        raise InputError(
            f"`profile.outline_file` must be a .csv, .txt or .dxf file, but is {name!r}; save "
            "the outline in one of these formats"
        )
    data = content(path, "profile.outline_file")
    if not data.strip():
        raise InputError(f"{name}: must hold an outline, but is empty; export it again")
    if kind == ".dxf":
        from rootsopt.measured.dxf import from_dxf  # Imported for drawings only: it takes 0.25 s.

        loop = _joined(from_dxf(data, name, unit), sought, name, join)
    else:
        loops = from_csv(data, name, unit)
        loop = (
            loops[0] if len(loops) == 1 else _rotor(loops, sought, name) or _likely(loops, sought)
        )
    return _closed(loop, name, unit, sought)


def _joined(chains: list[Loop], sought: Sought | None, name: str, join: float) -> Loop:
    """Return the rotor's loop among those formed by the `chains` of a drawing.

    `sought`, `join`: as in `read`. Raises `InputError` if the chains form no loop, or form the
    rotor only if wider gaps are joined; the message states the value of the key."""
    loops, fault = joined(chains, name, join)
    if rotor := _rotor(loops, sought, name):
        return rotor
    for wider in (step for step in _JOINS if sought and step > join and len(chains) > 1):
        opened = None
        with contextlib.suppress(InputError):  # Too many ends meet, or there are several rotors.
            opened = _rotor(joined(chains, name, wider)[0], sought, name)
        if opened is not None:
            gap, at = opened.gap
            raise InputError(
                f"{name}: the outline must be closed within {join:g} mm "
                f"(`profile.outline_join_mm`), but its widest gap is {gap:.4g} mm, at {place(at)}; "
                f"set `profile.outline_join_mm` = {_above(gap):.2g}, or join the ends in the "
                "drawing"
            )
    if fault is not None:
        raise fault
    return _likely(loops, sought)


def _rotor(loops: list[Loop], sought: Sought | None, name: str) -> Loop | None:
    """Return the loop that has lobes, symmetry and size of the rotor; `None` if none has.

    Raises `InputError` if there are several such loops and none or more than one is at the axis."""
    if sought is None:
        return None
    radius = sought.pitch_radius_mm
    rotors = [
        (loop, shape)
        for loop, shape in _lobed(loops, sought)
        if radius is None or abs(shape.middle / radius - 1) < SIZED
    ]
    axis = complex(*sought.center) if isinstance(sought.center, tuple) else 0j
    near = [one for one in rotors if abs(one[1].center - axis) < (radius or one[1].middle) / 2]
    # The two rotors of a pair are equal, so that either will do.
    same = radius is None and len({(s.lobes, round(s.most, 2)) for _, s in rotors}) == 1
    if len(rotors) > 1 and len(near) != 1 and not same:
        raise InputError(_several([shape for _, shape in near or rotors], bool(near), name))
    if not rotors:
        return None
    loop, shape = (near or rotors)[0]
    return _noted(loop, len(loops), f"the {shape.lobes}-lobed one at {written(shape.center)} mm")


def _several(shapes: list[_Shape], near: bool, name: str) -> str:
    """Return the message for several rotors; `near`: whether all of them are at the axis."""
    if near:
        radii = " and ".join(f"{shape.most:.5g}" for shape in shapes[:_NAMED])
        return (
            f"{name}: must hold one outline of the rotor, but holds {len(shapes)} at the axis, "
            f"with outer radii of {radii} mm; keep one of them (in a drawing, on a layer OUTLINE)"
        )
    centers = " and ".join(written(shape.center) for shape in shapes[:_NAMED])
    choice = written(shapes[0].center).replace("(", "[").replace(")", "]")
    return (
        f"{name}: must hold one rotor at the axis, but holds {len(shapes)} elsewhere, at {centers} "
        f"mm; choose one by its centre, for example `profile.outline_center` = {choice}"
    )


def _noted(loop: Loop, count: int, which: str) -> Loop:
    """Return the loop with notes on its choice among `count` loops and on gaps that were closed."""
    gap, at = loop.gap
    notes = [f"of {count} closed loops in the file, {which} is read"] * (count > 1)
    if gap > SEEN:
        notes.append(f"ends of entities up to {gap * 1e3:.3g} um apart were joined, at {place(at)}")
    return dataclasses.replace(loop, notes=(*loop.notes, *notes))


def _likely(loops: list[Loop], sought: Sought | None) -> Loop:
    """Return the loop to go on with if none fits the rotor: later checks report what is wrong.

    If possible, it has the rotor's lobes and, in another unit, its size. Otherwise, if possible, it
    has the lobes alone. Of several loops, return the largest."""
    if sought is None or len(loops) == 1:
        return _noted(_largest(loops)[0], len(loops), "the largest")
    lobed, radius = _lobed(loops, sought), sought.pitch_radius_mm
    sized = [one for one, s in lobed if radius and unit_of_size(s.middle / one.unit, radius)]
    return [*sized, *(one for one, _ in lobed), *_largest(loops)][0]


def _largest(loops: list[Loop]) -> list[Loop]:
    return sorted(loops, key=lambda loop: -abs(signed_area(loop.points)))[:_LOOPS]


def _lobed(loops: list[Loop], sought: Sought) -> list[tuple[Loop, _Shape]]:
    """Return the loops with the symmetry of the rotor's lobes and their shapes, largest first."""
    counts = LOBES if sought.lobes is None else (sought.lobes,)
    shapes = ((loop, _shape(loop.points, n)) for loop in _largest(loops) for n in counts)
    return [(loop, shape) for loop, shape in shapes if shape is not None]


def lobes_of(loop: Loop) -> int | None:
    """Return the number of lobes (`LOBES`) of a loop; `None` if it is not that of a rotor."""
    return next((shape.lobes for _, shape in _lobed([loop], Sought())), None)


def _shape(points: NDArray[np.complex128], lobes: int) -> _Shape | None:
    """Return the shape of a loop with the rotational symmetry of `lobes` lobes, otherwise `None`.

    Circles, rectangles and other convex loops have no lobes. The radius over the polar angle must
    have its strongest harmonic at the number of lobes, and only multiples of this harmonic."""
    points = points[np.append(True, np.diff(points) != 0)]
    z = points - np.mean(points)
    area, extent = signed_area(z), max(np.ptp(z.real), np.ptp(z.imag))
    if len(z) < 4 * lobes or not abs(area) > _THIN * extent**2:
        return None
    # A rotor is narrower between its tips: its hull is larger.
    if abs(area) > _CONVEX * ConvexHull(np.stack([z.real, z.imag], axis=1)).volume:
        return None
    center = moment(z, 1) / area
    angle, radius = np.angle(z - center), np.abs(z - center)
    order = np.argsort(angle)
    grid = np.arange(_RAYS) * 2 * np.pi / _RAYS
    around = np.interp(grid, angle[order], radius[order], period=2 * np.pi)
    harmonics = np.abs(np.fft.rfft(around))[1:]
    own = harmonics[lobes - 1]
    others = np.delete(harmonics, slice(lobes - 1, None, lobes))
    if own < np.max(harmonics) or np.linalg.norm(others) > _UNLIKE * own:
        return None
    least, most = float(np.min(radius)), float(np.max(radius))
    return _Shape(lobes, complex(np.mean(points) + center), most, (least + most) / 2)


def _above(length: float) -> float:
    """Round a `length` up to two significant digits."""
    digit = 10.0 ** (math.floor(math.log10(length)) - 1)
    return math.ceil(length / digit * (1 + 1e-9)) * digit


def _closed(loop: Loop, name: str, unit: str | None, sought: Sought | None) -> Loop:
    """Return the loop without repeated points.

    `name`: name of the file in messages; `unit`, `sought`: as in `read`.

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
    sides = np.stack([np.real(points), np.imag(points)])
    reach = float(np.max(np.abs(sides)))
    size = float(np.max(np.ptp(sides, axis=1))) if reach <= high else reach
    if not low <= size <= high:
        raise InputError(
            f"{name}: must hold an outline of {low:g} to {high:g} mm, but "
            + ("all its points are in one place" if size == 0 else f"it measures {size:.4g} mm")
            + "; "
            + (_unit(points, unit, sought) or "check its units (CSV: mm; DXF: $INSUNITS)")
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
    joints = np.zeros(len(kept), bool)
    joints[np.searchsorted(kept, np.flatnonzero(loop.joints)) % len(kept)] = True
    return dataclasses.replace(loop, points=points[kept], joints=joints)


def untangled(loop: Loop, lobes: int, pitch_radius_mm: float) -> Loop:
    """Return the loop without small swallow-tails: the crossings replace them, as joints.

    An offset curve has them where the offset exceeds the radius of curvature, as at the pitch
    circle of EE. A cutter that follows the curve cuts them off, so that the trimmed loop is the
    rotor as cut. Raises `InputError` for swallow-tails that are not small."""
    tangles = tails(loop.points, _CUSPS * lobes)
    if not tangles:
        return loop
    some = [
        f"{place(at)} ({np.degrees(np.angle(at)):.5g} deg, {size * 1e3:.3g} um long)"
        for _, at, size in tangles[:_NAMED]
    ]
    more = f" and {len(tangles) - _NAMED} more" if len(tangles) > _NAMED else ""
    where = f"{len(tangles)} small loops (swallow-tails of an offset) at {', '.join(some)}{more}"
    if max(size for *_, size in tangles) > _TAIL * pitch_radius_mm:
        raise InputError(
            f"`profile.outline_file` must hold an outline that does not cross itself, but it has "
            f"{where}; cut them off in the drawing, or remove their points"
        )
    points, joints = loop.points.copy(), loop.joints.copy()
    kept = np.ones(len(points), bool)
    for inner, at, _ in tangles:
        kept[inner[1:]] = False
        points[inner[0]], joints[inner[0]] = at, True
    notes = (*loop.notes, f"{where} are cut off where they cross")
    return dataclasses.replace(loop, points=points[kept], joints=joints[kept], notes=notes)


def _unit(points, unit: str | None, sought: Sought | None) -> str | None:
    """Return advice on the unit in which the `points` would fit the pitch radius, or `None`.

    `unit`, `sought`: as in `read`."""
    if unit is not None or sought is None or sought.pitch_radius_mm is None:
        return None
    with np.errstate(all="ignore"):
        radius = np.abs(points - np.mean(points))
        middle = float(np.max(radius) + np.min(radius)) / 2
    if fitting := unit_of_size(middle, sought.pitch_radius_mm):
        return f"in {fitting} it would fit the pitch radius: set `profile.outline_unit` = {fitting}"
    return None
