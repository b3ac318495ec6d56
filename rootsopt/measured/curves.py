"""Smooth curves through the points of a flank, split into pieces where its curvature jumps.

Points are complex numbers x + iy (mm). A curve's parameter t combines the length of the polygon
through its points with the polygon's turning. It therefore stays regular where a radius of
curvature vanishes (EE at the pitch circle). The turning of measured points is noise; for them, the
parameter is the length alone.
"""

import dataclasses
import itertools

import numpy as np
from jaxtyping import Bool, Complex128, Float64
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.interpolate import BSpline, make_interp_spline, make_splprep, splprep

from rootsopt.errors import InputError
from rootsopt.measured.estimates import Estimates
from rootsopt.measured.loop import guarded, lengths_along

# Length (pitch radii) that contributes as much to a curve's parameter as a turn of 1 rad.
_TURNING = 0.3

# Limits above which a change of curvature at a point makes this point a joint. Both must be
# exceeded. `_JUMP` is a fraction of the sum of the curvatures (absolute values) on both sides.
# `_ABOVE` is a multiple of the median change at the surrounding points.
_JUMP, _ABOVE = 0.02, 20.0

# Numbers of points on each side of a joint. A joint affects the change of curvature at the
# nearest `_BESIDE` points. The median for `_ABOVE` is taken over the nearest `_AROUND` points,
# without these.
_BESIDE, _AROUND = 3, 12

# Sum of the polygon's turns (rad, absolute values) along a flank above which the points are
# rejected as scattered. With smoothing, there is no limit.
_WINDING = 7.0

# Number of intervals between points below which a piece is not split off, because it is too
# short.
_SHORTEST = 4

# `_MOST_KNOTS`: number of knots above which a smoothing spline is rejected because it follows the
# noise. `_NO_ROOM`: flag that FITPACK returns in this case.
_MOST_KNOTS, _NO_ROOM = 500, 1
_KEY = "`profile.outline_file`"
_UNEVEN = "remove points that are much closer together than others"

# `_CUSP`: speed |z′| (fraction of the mean speed) below which the end of a piece is a cusp.
# `_SPARED`: number of knot intervals next to a cusp that are not sampled. Beyond these, points
# are not sampled either until the speed exceeds the limit.
_CUSP, _SPARED = 2e-2, 2


@dataclasses.dataclass(frozen=True)
class MeasuredCurve:
    """A plane curve z(t) = x(t) + i y(t) (mm), made of successive spline pieces.

    `ends` (k,): values of t at the ends of the pieces; `pieces`: the k - 1 splines between them."""

    ends: Float64[np.ndarray, " k"]
    pieces: tuple[BSpline, ...]

    def derivatives(self, t: NDArray[np.float64], place: int) -> NDArray[np.complex128]:
        """Return z, z′, z″ as an array (3, n) at the parameters `t` (n,).

        Derivatives are with respect to t; lengths are in mm. `place`: index of the piece that is
        evaluated."""
        return np.stack([self.pieces[place](t, order) for order in range(3)])

    def __call__(self, t: NDArray[np.float64]) -> NDArray[np.complex128]:
        """Return z, z′, z″ as an array (3, n) at the parameters `t` (n,).

        Each value of `t` is evaluated on the piece that contains it. Lengths are in mm."""
        place = np.clip(np.searchsorted(self.ends, t, side="right") - 1, 0, len(self.pieces) - 1)
        values = np.empty((3, len(t)), complex)
        for k in map(int, np.unique(place)):
            values[:, place == k] = self.derivatives(t[place == k], k)
        return values

    def between(self, start: float, stop: float) -> list[tuple[int, float, float]]:
        """Return (index, low, high) of each piece that overlaps the interval `start` ≤ t ≤ `stop`.

        `low` and `high` are the values of t at the ends of the overlap."""
        parts = []
        for k, (low, high) in enumerate(zip(self.ends[:-1], self.ends[1:], strict=True)):
            low, high = max(low, start), min(high, stop)
            if high - low > 1e-9 * (stop - start):
                parts.append((k, low, high))
        return parts


def stretch(
    curve: MeasuredCurve, place: int, low: float, high: float, count: int
) -> tuple[NDArray, ...]:
    """Return (t, z, direction, speed, turning): `count` samples of one piece of `curve`.

    The samples run from t = `low` to t = `high`; `place`: index of the piece. Points z are in mm;
    `direction` (rad) is that of the outward normal, for a curve from the tip to the root; `speed`
    is |z′| (mm per unit of t), and `turning` the rate at which the tangent turns (rad per unit of
    t).

    The data hardly determine the curve next to a cusp, where z′ vanishes. The last intervals before
    the cusp are therefore not sampled, and the tangent and its turning are extrapolated to the
    cusp."""
    t = np.linspace(low, high, count)
    speed = np.abs(curve.derivatives(t, place)[1])
    slow, knots = _CUSP * np.mean(speed), np.unique(curve.pieces[place].t)
    cusp = (speed[[0, -1]] < slow) & (len(knots) > 2 * _SPARED)
    if np.any(cusp):
        fast = t[speed > slow]
        spared = [max(knots[_SPARED], fast[0]), min(knots[-1 - _SPARED], fast[-1])]
        ends = np.where(cusp, spared, [low, high])
        t = np.linspace(ends[0], ends[1], count - int(np.sum(cusp)))
        t = np.concatenate([[low][: int(cusp[0])], t, [high][: int(cusp[1])]])
    z, first, second = curve.derivatives(t, place)
    speed = np.abs(first)
    turning = np.imag(np.conj(first) * second) / np.where(speed > 0, speed, 1.0) ** 2
    direction = np.angle(-1j * first)
    for end, inside in ((0, 1), (-1, -2)):
        if cusp[end]:
            turning[end], speed[end] = turning[inside], 0.0
            direction[end] = direction[inside] + turning[end] * (t[end] - t[inside])
    return t, z, direction, speed, turning


def through(
    points: Complex128[np.ndarray, " n"],
    joints: Bool[np.ndarray, " n"],
    pitch_radius: float,
    smoothing: float,
    seen: Estimates,
) -> MeasuredCurve:
    """Return the curve through `points` (mm), or at an RMS distance `smoothing` (mm) from them.

    `joints`: mask of the points at which curvature may jump; `pitch_radius`: in mm; `seen`:
    estimates for messages. If `smoothing` is 0, the curve has one spline between every two
    successive joints, quintic if there are enough points. Points at which the curvature of the
    polygon through the points jumps are also joints. If `smoothing` is greater than 0, the curve is
    a single quintic spline and `joints` is ignored.

    Raises `InputError` if the points are too few or, without smoothing, too scattered; if
    `smoothing` is so small that the spline would follow the noise; or if a spline cannot be
    computed.
    """
    if len(points) < 8:
        raise InputError(
            f"`profile.outline_file` must have at least 8 points on a flank, but has {len(points)}"
        )
    turned = np.sum(np.abs(np.angle(np.diff(points)[1:] / np.diff(points)[:-1])))
    if smoothing == 0 and turned > _WINDING:
        raise InputError(
            f"{_KEY} must hold smooth flanks, but from point to point a flank turns by "
            f"{turned:.3g} rad in total, a smooth one by 4; {seen.remedy(smoothing)}"
        )
    if smoothing > 0:
        return _smoothed(points, smoothing, seen)
    last = len(points) - 1
    ends = [0]
    for joint in np.flatnonzero(joints | _jumps(points)):
        if joint - ends[-1] >= _SHORTEST and last - joint >= _SHORTEST:
            ends.append(int(joint))
    ends.append(last)
    pieces, places = [], [0.0]
    for start, stop in itertools.pairwise(ends):
        part = points[start : stop + 1]
        t = places[-1] + _parameter(part, _TURNING * pitch_radius)
        degree = min(5, (stop - start) // 2 * 2 - 1)
        with guarded(_KEY, "no curve goes through its points", _UNEVEN):
            pieces.append(make_interp_spline(t, part, k=degree))
        places.append(t[-1])
    return MeasuredCurve(np.array(places), tuple(pieces))


def _smoothed(points: NDArray[np.complex128], smoothing: float, seen: Estimates) -> MeasuredCurve:
    """Return the smoothest quintic spline at an RMS distance `smoothing` (mm) from the points."""
    t = lengths_along(points)
    sides = [np.real(points), np.imag(points)]
    squares = len(points) * smoothing**2
    with guarded(_KEY, "its points cannot be smoothed", "check `profile.outline_smoothing_mm`"):
        # `splprep` detects too many knots in a hundredth of the time that `make_splprep` needs.
        *_, flag, _ = splprep(
            sides, u=t, k=5, s=squares, nest=_MOST_KNOTS, full_output=True, quiet=True
        )
    if flag == _NO_ROOM:
        raise InputError(
            "`profile.outline_smoothing_mm` must be the scatter (RMS) of the points, but with "
            f"{smoothing:g} a flank needs more than {_MOST_KNOTS} knots to follow them; "
            f"{seen.thinning(float(np.median(np.diff(t)))) or seen.remedy(smoothing)}"
        )
    with guarded(_KEY, "its points cannot be smoothed", "check `profile.outline_smoothing_mm`"):
        spline, _ = make_splprep(sides, u=t, k=5, s=squares)  # type: ignore[arg-type]
    controls = np.asarray(spline.c)
    controls = controls[0] + 1j * controls[1] if controls.shape[0] == 2 else controls @ [1, 1j]
    return MeasuredCurve(t[[0, -1]], (BSpline(spline.t, controls, spline.k),))


def _parameter(points: NDArray[np.complex128], weight: float) -> NDArray[np.float64]:
    """Return the parameters t (n,) of the points of a smooth piece, starting at 0.

    `weight`: length (mm) that contributes as much to t as a turn of 1 rad."""
    bend, lengths = _curvature(points)
    # Extrapolate the curvature to the ends, as the next piece turns differently.
    first, last = 2 * bend[0] - bend[1], 2 * bend[-1] - bend[-2]
    bend = np.concatenate([[first], bend, [last]])
    mean = weight * (bend[1:] + bend[:-1]) / 2
    return np.concatenate([[0.0], np.cumsum(lengths * np.hypot(1.0, mean))])


def _curvature(points: NDArray[np.complex128]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return (curvatures (1/mm) at the inner corners of a polygon, lengths (mm) of its sides)."""
    steps = np.diff(points)
    lengths = np.abs(steps)
    return 2 * np.angle(steps[1:] / steps[:-1]) / (lengths[1:] + lengths[:-1]), lengths


def _jumps(points: NDArray[np.complex128]) -> NDArray[np.bool_]:
    """Return a mask (n,) of the points at which the polygon has a jump of curvature or a cusp."""
    mask = np.zeros(len(points), bool)
    if len(points) < 2 * _AROUND:
        return mask
    # Entry i belongs to point i + 1.
    curvature, _ = _curvature(points)
    # Entry i belongs to point i + 3. Extrapolate the curvature to it from both sides.
    ahead, behind = 2 * curvature[3:-1] - curvature[4:], 2 * curvature[1:-3] - curvature[:-4]
    jump = np.abs(behind - ahead)
    size = np.abs(curvature[1:-3]) + np.abs(curvature[3:-1])
    # At a cusp between convex and concave, curvature grows without bound on both sides.
    bend = np.abs(curvature)
    grows = (bend[3:-5] > bend[1:-7]) & (bend[2:-6] > bend[:-8])
    grows &= (bend[5:-3] > bend[7:-1]) & (bend[6:-2] > bend[8:])
    grows &= curvature[3:-5] * curvature[5:-3] < 0
    growth = np.pad(np.where(grows, np.minimum(bend[3:-5], bend[5:-3]), 0.0), 2)
    cusp = (jump > 0.9 * size) & (growth > 0) & (growth == _beside(growth))
    joint = (jump > _JUMP * size) & (jump == _beside(jump)) & ~_beside(cusp)
    for i in np.flatnonzero(joint):
        before = jump[max(i - _AROUND, 0) : max(i - _BESIDE, 0)]
        around = np.append(before, jump[i + _BESIDE + 1 : i + _AROUND + 1])
        joint[i] = jump[i] > _ABOVE * np.median(around)
    mask[3:-3] = cusp | joint
    return mask


def _beside(values: NDArray) -> NDArray:
    """Return the greatest of the `values` within `_BESIDE` places of each."""
    return np.max(sliding_window_view(np.pad(values, _BESIDE), 2 * _BESIDE + 1), axis=1)
