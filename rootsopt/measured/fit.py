"""Makes a profile from the closed loop of an outline."""

import dataclasses
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from rootsopt.errors import InputError
from rootsopt.measured.curves import MeasuredCurve, stretch, through
from rootsopt.measured.estimates import Checks, Estimates, estimates
from rootsopt.measured.loop import Loop, lengths_along, moment, signed_area
from rootsopt.profiles.outline import Outline, Table

_MM = 1e-3

# Number of nodes in the table of the addendum, and in that of the dedendum. The number is fixed, so
# that one compiled program serves all outlines.
_NODES = 1536

# Number of smooth pieces of an addendum or dedendum above which an outline is rejected.
_PIECES = _NODES // 4

# Polar angle (fraction of the angle from tip to root) by which the fitted points extend beyond a
# flank's tip and root.
_BEYOND = 0.3

# Number of points at which two flanks are compared.
_SHARES = 400

# Polar angle (rad) covered by a backward run of the outline above which the outline is rejected.
# Smaller runs are noise and rounding. An outline is also rejected if a tangent passes the axis on
# the wrong side by more than this distance (pitch radii).
_FOLD = 1e-3

# Deviation between flanks (pitch radii) above which an outline is rejected. This is also the
# value (pitch radii) above which `profile.outline_smoothing_mm` is rejected.
_OFF = 0.02

# Angle (rad) of half a tip land below which the land is ignored.
_LAND = 0.5 * np.pi / 180

# Radii beside a tip land from which its end is extrapolated. They lie below the greatest radius
# by `_DROP` (pitch radii) or `_SCATTERED` times the scatter, whichever is more, and by up to
# `_WIDE` times as much.
_DROP, _SCATTERED, _WIDE = 1e-4, 8.0, 8.0

# Change of the normal's direction (rad) at a joint below which both sides get the mean direction.
# A joint with a larger change is a corner.
_CORNER = 1e-2

# Distance (pitch radii) from the pitch circle below which a joint is taken as the point where the
# flank crosses the circle.
_AT = 1e-4

# Ratio of an outline's greatest radius to the pitch radius, or its inverse, above which an
# outline is rejected because its units must be wrong.
_FAR = 1e3

# Backward run of the outline (multiples of the scatter) above which an outline to be smoothed is
# rejected, in addition to `_FOLD`.
_WANDER = 8.0

# Ratio of the flanks' deviation to the scatter below which a message names scatter as the cause.
_MANY = 20.0

# Number of points above which no values of the smoothing are tried for a message. A trial takes
# 20 µs per point.
_TRIED = 100_000
_GAUSS = np.polynomial.legendre.leggauss(12)


@dataclasses.dataclass(frozen=True)
class _Flank:
    """A flank in the frame of its lobe, with the tip on +x; a trailing flank is mirrored.

    `curve`: curve of the flank (mm); `tip`, `pitch`, `root`: the curve's parameters at the tip, the
    pitch circle and the root; `off`: RMS distance of the points from the curve (mm), 0 without
    smoothing."""

    curve: MeasuredCurve
    tip: float
    pitch: float
    root: float
    off: float

    def at(self, share: NDArray[np.float64]) -> NDArray[np.complex128]:
        """Return z, z′, z″ as an array (3, n) at `share` (n,).

        A share is a fraction of the range of the curve's parameter: 0 at the tip, 1 at the root.
        Lengths are in mm, and derivatives are with respect to the parameter."""
        return self.curve(self.tip + (self.root - self.tip) * share)


def imported(
    loop: Loop,
    lobes: int,
    pitch_radius_mm: float,
    smoothing_mm: float,
    center: Literal["fit"] | tuple[float, float] | None = None,
    seen: Estimates | None = None,
) -> tuple[Outline, Checks]:
    """Return (profile, deviations) for the outline of a rotor with N = `lobes` lobes.

    `loop`: points of the outline; `pitch_radius_mm`: pitch radius; `smoothing_mm`: RMS scatter of
    the points (mm), 0 for a curve through them; `center`: x and y of the rotor's axis (mm), or
    "fit" for the centre of the lobes' rotational symmetry. `None`: the origin. `seen`: estimates
    from its points, if they are known; messages then state no smoothing that has been tried.

    First, the loop is made counter-clockwise and turned to put a lobe's axis on +x. The phase of
    the N-th moment ∬ z^N dA gives this axis. Then the profile is made from one flank: the leading
    flank of the lobe next to +x, for a rotor that turns counter-clockwise. The other flanks are
    compared with this flank.

    Raises `InputError` if the loop does not have this number of lobes, or if such a rotor cannot be
    simulated.
    """
    if smoothing_mm > _OFF * pitch_radius_mm:
        raise InputError(
            "`profile.outline_smoothing_mm` must be the scatter (RMS) of the points in mm, at most "
            f"{_OFF:g} of the pitch radius, but is {smoothing_mm:g}; lower it"
        )
    # Overflow and division by zero are detected in the result.
    with np.errstate(all="ignore"):
        tried = seen is None and len(loop.points) <= _TRIED
        seen = estimates(loop.points, lobes) if seen is None else seen
        axis = seen.center if center == "fit" else complex(*(center or (0.0, 0.0)))
        if not np.isfinite(axis):
            raise InputError(
                "`profile.outline_center` must be x and y (mm), because the centre of symmetry "
                "of this outline cannot be found; give both numbers"
            )
        points, backwards = loop.points - axis, signed_area(loop.points) < 0
        way = -1 if backwards else 1
        loop = dataclasses.replace(loop, points=points[::way], joints=loop.joints[::way])
        seen = dataclasses.replace(seen, center=seen.center - axis)

        def reads(smoothing: float) -> bool:
            try:
                _imported(loop, lobes, pitch_radius_mm, smoothing, seen)
            except InputError:
                return False
            return True

        advising = dataclasses.replace(seen, reads=reads) if tried else seen
        outline, checks = _imported(loop, lobes, pitch_radius_mm, smoothing_mm, advising)
    deviations = [x for x in vars(checks).values() if isinstance(x, float)]
    if not all(np.all(np.isfinite(x)) for x in (*jax.tree.leaves(outline), *deviations)):
        raise InputError(
            "`profile.outline_file` must hold a smooth outline, but the curve through its points "
            "is not finite; remove points that are much closer together than others"
        )
    return outline, dataclasses.replace(checks, seen=seen, axis=axis, reversed=backwards)


def _imported(
    loop: Loop, lobes: int, pitch_radius_mm: float, smoothing_mm: float, seen: Estimates
) -> tuple[Outline, Checks]:
    """Return (profile, deviations) of a counter-clockwise `loop` about the origin.

    `seen`: estimates for messages and for tolerances; for the rest, see `imported`."""
    _check_lobes(loop, lobes, pitch_radius_mm, smoothing_mm, seen)
    turn = np.angle(moment(loop.points, lobes)) / lobes
    points = loop.points * np.exp(-1j * turn)
    how = points, loop.joints, lobes, pitch_radius_mm, smoothing_mm, seen
    flanks = [[_flank(k, side, *how) for k in range(lobes)] for side in (1, -1)]
    own = flanks[0][0]
    apart = np.array([[_distances(flank, own) for flank in group] for group in flanks])
    mean = apart.mean(axis=1)
    lobe_off, flank_off = np.max(np.abs(apart - mean[:, None])), np.max(np.abs(mean[1] - mean[0]))
    worst = max(lobe_off, flank_off)
    if worst > _OFF * pitch_radius_mm:
        raise InputError(
            f"`profile.outline_file` must hold a rotor of {lobes} equal lobes with equal flanks, "
            f"but they differ by up to {worst:.4g} mm (lobes {lobe_off:.4g}, flanks "
            f"{flank_off:.4g}); "
            + (
                seen.centering()
                or (_MANY * seen.scatter > worst and seen.excess)
                or "only rotors of symmetrical lobes are supported, with the axis at the origin"
            )
        )
    try:
        outline, star, convexity = _outline(own, lobes, pitch_radius_mm, smoothing_mm, seen)
    except InputError as error:
        if size := seen.sizing(pitch_radius_mm, loop.unit):
            raise InputError(f"{error}; or {size}") from None
        raise
    centroid = moment(points, 1) / signed_area(points)
    checks = Checks(
        points=len(points),
        turned_deg=float(np.degrees(-turn)),
        axis_offset_um=float(abs(centroid)) / _MM,
        lobe_deviation_um=float(lobe_off) / _MM,
        flank_deviation_um=float(flank_off) / _MM,
        fit_deviation_um=own.off / _MM,
        star_margin_mm=star,
        convexity_margin_mm=convexity,
        seen=seen,
    )
    return outline, checks


def _check_lobes(loop: Loop, lobes: int, radius: float, smoothing: float, seen: Estimates) -> None:
    """Raise `InputError` unless the `loop` has this number of lobes around the origin.

    `radius`: pitch radius (mm); `smoothing`: RMS scatter (mm) to be removed; `seen`: estimates."""
    points, there = loop.points, seen.centering()
    size = seen.sizing(radius, loop.unit)
    away = InputError(
        "`profile.outline_file` must hold an outline around the rotor's axis, the origin, but "
        f"it does not go round the origin once; {there or 'move the outline there'}"
    )
    least, most = np.min(np.abs(points)), np.max(np.abs(points))
    if not radius / _FAR < most < radius * _FAR:
        raise InputError(
            f"`profile.pitch_radius_mm` = {radius:g} must fit the outline, but the outline's "
            f"greatest radius is {most:.5g} mm; {size or 'correct the key or the unit of the file'}"
        )
    if not least > most / _FAR**2:
        raise away
    around = np.angle(np.roll(points, -1) / points)
    if round(np.sum(around) / (2 * np.pi)) != 1:
        raise away
    # Noise may make the angle decrease. Measure how far it falls below its maximum so far.
    angle = np.cumsum(around)
    back = np.max(np.maximum.accumulate(angle) - angle)
    wander = _WANDER * seen.scatter if smoothing > 0 and seen.scatter < _OFF * radius else 0.0
    if back > _FOLD + wander / least:
        remedy = (
            seen.remedy(smoothing) if seen.rough(smoothing) else "other rotors are not supported"
        )
        raise InputError(
            "`profile.outline_file` must hold an outline that does not fold back, seen from the "
            f"axis, but it does, by {np.degrees(back):.3g} deg; {there or remedy}"
        )
    # Near the pitch circle, scattered points may cross it several times.
    inside = (np.abs(points) < radius)[np.abs(np.abs(points) - radius) >= wander]
    crossings = int(np.sum(inside != np.roll(inside, 1)))
    if crossings != 2 * lobes:
        remedy = size or there or (seen.rough(smoothing) and seen.remedy(smoothing))
        raise InputError(
            f"`profile.lobes` = {lobes} and `profile.pitch_radius_mm` = {radius:g} must fit the "
            f"outline: it crosses the pitch circle {crossings} times, and {lobes} lobes do so "
            f"{2 * lobes} times (its radii: {least:.5g} to {most:.5g} mm); "
            f"{remedy or 'correct the wrong key'}"
        )


def _flank(lobe, side, points, joints, lobes, radius, smoothing, seen) -> _Flank:
    """Return the leading (`side` = 1) or trailing (-1) flank of the lobe with index `lobe`.

    `points`, `joints`: points (mm) of the outline and mask of the joints; `lobes`: number of lobes;
    `radius`: pitch radius (mm); `smoothing`: RMS scatter (mm); `seen`: estimates for messages. The
    curve is also fitted to points beyond tip and root, which belong to neighbouring flanks. Raises
    `InputError` if the points do not include the tip, the root and the pitch crossing."""
    local = points * np.exp(-2j * np.pi * lobe / lobes)
    if side < 0:
        local, joints = np.conj(local)[::-1], joints[::-1]
    half = np.pi / lobes
    # Open the loop opposite the flank.
    angle = np.angle(local * np.exp(-0.5j * half))
    start = np.argmin(angle)
    local, joints, angle = (np.roll(x, -start) for x in (local, joints, angle + half / 2))
    kept = np.flatnonzero((angle > -_BEYOND * half) & (angle < (1 + _BEYOND) * half))
    part = slice(kept[0], kept[-1] + 1) if len(kept) else slice(0)
    local, joints, angle = local[part], joints[part], angle[part]
    curve = through(local, joints, radius, smoothing, seen)
    low, high = curve.ends[[0, -1]]

    def root(low, high, function) -> float:
        scan = np.linspace(low, high, 4 * len(local))
        below = function(curve(scan)[0]) < 0
        places = np.flatnonzero(below[:-1] != below[1:])
        ends = scan[places[len(places) // 2] :][:2] if len(places) else scan[:2]
        if not (low < high and np.prod(function(curve(ends)[0])) <= 0):
            raise InputError(
                "`profile.outline_file` must have points all along every flank, but the one at "
                f"{np.degrees(2 * np.pi * lobe / lobes):.4g} deg lacks its tip, root or pitch "
                "crossing; add points"
            )
        zero = brentq(lambda t: function(curve(np.array([t]))[0])[0], *ends, xtol=1e-13)
        return float(zero)  # type: ignore[arg-type]

    tip = root(low, high, np.imag)
    end = root(low, high, lambda z: np.imag(z * np.exp(-1j * half)))
    pitch = root(tip, end, lambda z: np.abs(z) - radius)
    # At a cusp on the pitch circle (EE) the radius hardly determines the parameter.
    near = curve.ends[np.abs(np.abs(curve(curve.ends)[0]) - radius) < _AT * radius]
    pitch = next((float(t) for t in near if tip < t < end), pitch)
    off = 0.0
    if smoothing > 0:
        off = float(np.sqrt(np.mean(np.abs(curve(lengths_along(local))[0] - local) ** 2)))
    return _Flank(curve, tip, pitch, end, off)


def _distances(flank: _Flank, own: _Flank) -> NDArray[np.float64]:
    """Return the signed distances (n,) in mm of points on `flank` from the flank `own`.

    Distances are measured along the normals of `own`, and are positive outside it."""
    share = np.linspace(0.0, 1.0, _SHARES)
    place = flank.at(share)[0]
    for _ in range(4):
        z, slope = own.at(share)[:2]
        # Find the foot of the perpendicular. The speed is 0 at a cusp, so it has a floor.
        speed = np.maximum(np.abs(slope), 1e-3 * np.mean(np.abs(slope)))
        step = np.real((place - z) * np.conj(slope)) / speed**2 / (own.root - own.tip)
        share = np.clip(share + np.clip(step, -0.01, 0.01), 0.0, 1.0)
    z, slope = own.at(share)[:2]
    normal = -1j * slope / np.maximum(np.abs(slope), 1e-300)
    return np.real((place - z) * np.conj(normal))


def _stretch(flank: _Flank, start: float, stop: float) -> list[tuple[NDArray, ...]]:
    """Return the samples (see `stretch`) of each piece of a flank from `start` to `stop`.

    The pieces have `_NODES` parameters in total. The parameter of a joint occurs in both adjacent
    pieces. Raises `InputError` if there are too many pieces."""
    parts = flank.curve.between(start, stop)
    if len(parts) > _PIECES:
        raise InputError(
            f"`profile.outline_file` must have flanks of at most {_PIECES} smooth pieces, but one "
            f"has {len(parts)}; if the points are measured, set `profile.outline_smoothing_mm` to "
            "their scatter, otherwise draw the flank with longer arcs or one spline"
        )
    lengths = np.array([high - low for _, low, high in parts])
    counts = 2 + np.floor((_NODES - 2 * len(parts)) * lengths / lengths.sum()).astype(int)
    counts[np.argmax(counts)] += _NODES - counts.sum()
    return [
        stretch(flank.curve, *part, int(count)) for part, count in zip(parts, counts, strict=True)
    ]


def _outline(
    flank: _Flank, lobes: int, radius: float, smoothing: float, seen: Estimates
) -> tuple[Outline, float, float]:
    """Return (profile, star margin in mm, convexity margin in mm) of a rotor with this `flank`.

    `radius`: pitch radius (mm); `smoothing`: RMS scatter (mm) that the flank's curve leaves;
    `seen`: estimates for messages. The margins are defined in `Checks`. Raises `InputError` if the
    addendum is not convex or the flank folds back."""
    upper = _stretch(flank, flank.tip, flank.pitch)
    lower = _stretch(flank, flank.pitch, flank.root)
    t, z, direction, speed, turning = (
        np.concatenate(rows) for rows in zip(*(upper + lower), strict=True)
    )
    direction = _agreed(t, np.unwrap(direction))
    normal = np.exp(1j * direction)
    height, lever = np.real(z * np.conj(normal)), -np.imag(z * np.conj(normal))
    nu = direction[:_NODES]
    curvature_radius = speed[:_NODES] / np.where(turning > 0, turning, 1.0)[:_NODES]
    folds = ~(turning[:_NODES] > 0) | np.append(np.diff(nu) < 0, not nu[-1] > max(0.0, nu[0]))
    if np.any(folds):
        place = z[np.argmax(folds)]
        raise InputError(
            "`profile.outline_file` must have a convex addendum, but its curvature is not positive "
            f"at radius {abs(place):.5g} mm ({np.degrees(np.angle(place)):.3g} deg from the tip); "
            f"{seen.remedy(smoothing)}"
        )
    scale = nu[-1] / (flank.root - flank.pitch)
    f, g, h, q = turning[_NODES:], speed[_NODES:], height[_NODES:], lever[_NODES:]
    crown = _table(
        nu,
        np.stack([height[:_NODES], lever[:_NODES]], axis=1) * _MM,
        np.stack([-lever[:_NODES], height[:_NODES] - curvature_radius], axis=1) * _MM,
    )
    valley = _table(
        (flank.root - t[_NODES:][::-1]) * scale,
        np.stack([direction[_NODES:] - np.pi / lobes, q * _MM, h * _MM], axis=1)[::-1],
        np.stack([f, (h * f - g) * _MM, -q * f * _MM], axis=1)[::-1] / -scale,
    )
    star = float(np.min(height))
    if star < -_FOLD * radius:
        raise InputError(
            "`profile.outline_file` must hold an outline that does not fold back, seen from the "
            f"axis, but a tangent passes it on the other side by {-star:.4g} mm; "
            f"{seen.remedy(smoothing)}"
        )
    area, moment = _integrals(flank, lobes)
    outline = Outline(
        lobes=lobes,
        pitch_radius=jnp.asarray(radius * _MM),
        crown=crown,
        valley=valley,
        area=jnp.asarray(area * _MM**2),
        polar_area_moment=jnp.asarray(moment * _MM**4),
        outer_radius=jnp.asarray(np.max(np.abs(z)) * _MM),
        root_radius=jnp.asarray(np.min(np.abs(z)) * _MM),
        seal_width=jnp.asarray(_land(z[:_NODES], radius, np.fmax(smoothing, seen.scatter)) * _MM),
    )
    return outline, star, float(np.min(curvature_radius))


def _agreed(t: NDArray[np.float64], direction: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the directions of the normal (rad), averaged over both sides of each joint.

    `t`: curve parameters, equal on both sides of a joint. A joint is a corner if the directions
    differ by `_CORNER` or more; they are then left unchanged."""
    joint = np.flatnonzero((np.diff(t) == 0) & (np.abs(np.diff(direction)) < _CORNER))
    agreed = direction.copy()
    agreed[joint] = agreed[joint + 1] = (direction[joint] + direction[joint + 1]) / 2
    return agreed


def _table(node: NDArray, value: NDArray, slope: NDArray) -> Table:
    return Table(*(jnp.asarray(np.ascontiguousarray(x)) for x in (node, value, slope)))


def _land(z, radius: float, scatter: float) -> float:
    """Return the arc length (mm) of the tip land on both sides of the tip; 0 without a land.

    `z`: nodes of the addendum (mm), from the tip; `radius`: pitch radius (mm); `scatter`: of the
    points (mm). The normals of scattered points do not show where a land ends. Beside a land, the
    root of the drop in radius grows in proportion to the angle; this line is extrapolated to 0."""
    away, angle = np.abs(z), np.angle(z)
    top = np.median(away[away > np.max(away) - 2 * scatter - 1e-6 * radius])
    drop, least = top - away, max(_SCATTERED * scatter, _DROP * radius)
    beside = (drop > least) & (drop < _WIDE * least)
    root = np.sqrt(drop[beside])
    rows = np.stack([np.ones_like(root), root, root**3], axis=1)
    end = np.linalg.lstsq(rows, angle[beside])[0][0] if len(root) > 3 else 0.0
    return float(2 * top * end) if end > _LAND else 0.0


def _integrals(flank: _Flank, lobes: int) -> tuple[float, float]:
    """Return (area in mm², polar moment of area in mm⁴) of a rotor with `lobes` lobes.

    `flank`: flank of the rotor; all other flanks are its images."""
    nodes, weights = _GAUSS
    area = moment = 0.0
    for place, low, high in flank.curve.between(flank.tip, flank.root):
        knots = np.unique(np.clip(flank.curve.pieces[place].t, low, high))
        width = np.diff(knots)[:, None]
        t = (knots[:-1, None] + width * (1 + nodes) / 2).ravel()
        z, slope = flank.curve.derivatives(t, place)[:2]
        element = np.imag(np.conj(z) * slope) * (width * weights / 2).ravel()
        area += float(np.sum(element)) / 2
        moment += float(np.sum(np.abs(z) ** 2 * element)) / 4
    return 2 * lobes * area, 2 * lobes * moment
