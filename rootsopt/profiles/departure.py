"""Distances between the outlines of two profiles.

Two profiles of equal lobes have the same mirror lines: the axes of the lobes and of the valleys. A
flank from tip to root lies in the sector between two neighbouring mirror lines. Mirroring a point
never brings it closer to a point of the other outline in the same sector. The distances between the
flanks are therefore those between the closed outlines.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from rootsopt.profiles.base import Profile
from rootsopt.runtime.programs import CachedFunction

# Default of `nodes`, the least number of points of a flank on each side of the pitch circle.
_NODES = 400
# Number of points of each neighbouring flank that are appended to the ends of a flank.
_BEYOND = 8
# Angle (rad) between successive segments of a polygonal line above which their joint is a corner.
_CORNER = 0.1


class Departure(NamedTuple):
    """Distances (m) between the closed outlines of two profiles.

    `greatest`: Hausdorff distance, the greatest distance of a point of either outline from the
    other outline. `rms`: root mean square, over the arc length of the first outline, of the
    distances of its points from the second outline."""

    greatest: float
    rms: float


class Feet(NamedTuple):
    """The points of a polygonal line that are nearest to given points.

    `away` (n,): signed distances of the given points, positive to the right of the line (outside,
    if the line runs counter-clockwise); `toward` (n, 2): unit vectors along which the signed
    distances are measured; `segment` (n,): indices of the segments with the nearest points; `share`
    (n,): places of the nearest points, as fractions of the segments."""

    away: NDArray[np.float64]
    toward: NDArray[np.float64]
    segment: NDArray[np.intp]
    share: NDArray[np.float64]


def departure(profile: Profile, other: Profile, nodes: int = _NODES) -> float:
    """Return the Hausdorff distance (m) between the closed outlines of two profiles.

    `nodes`: least number of points on each side of the pitch circle of a flank."""
    return departures(profile, other, nodes).greatest


def departures(
    profile: Profile, other: Profile, nodes: int = _NODES, inset: float = 0.0
) -> Departure:
    """Return the distances between the closed outlines of two profiles with equal lobes.

    `nodes`: least number of points on each side of the pitch circle of a flank; `inset`: distance
    (m) by which `other` is first made smaller along its normals."""
    first, second = (flank_points(one, nodes) for one in (profile, other))
    there, back = (
        np.abs(feet(points, beyond(line, profile.lobes), smooth=True).away + shift)
        for points, line, shift in ((first, second, inset), (second, first, -inset))
    )
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(first, axis=0), axis=1))])
    rms = np.sqrt(np.trapezoid(there**2, arc) / arc[-1])
    return Departure(float(max(there.max(), back.max())), float(rms))


def flank_points(profile: Profile, nodes: int = _NODES) -> NDArray[np.float64]:
    """Return points (n, 2) in m on a flank of `profile` from tip to root.

    The points are evenly spaced in normal angle; the ends of segments are further points. `nodes`:
    least number of points on each side of the pitch circle."""
    stop = float(profile.pitch_normal)
    ends = [float(s.stop) for s in profile.segments()]
    return np.asarray(_points(profile, np.union1d(np.linspace(0, stop, nodes), ends)))


@CachedFunction
def _points(profile: Profile, nu):
    addendum, dedendum = (profile.position(f(nu)) for f in (profile.addendum, profile.dedendum))
    return jnp.concatenate([addendum, dedendum[::-1]])


def beyond(flank: Float[np.ndarray, "n 2 *d"], lobes: int) -> NDArray[np.float64]:
    """Return a `flank`, from tip to root, with pieces of both neighbouring flanks at its ends.

    `flank`: points in a first axis, coordinates in a second; further axes hold derivatives of the
    points. `lobes`: number of lobes. The neighbours are mirror images, `_BEYOND` points of each:
    the tip of a measured flank need not lie on the lobe's axis exactly."""
    turn = 2 * np.pi / lobes
    tip = np.array([[1.0, 0.0], [0.0, -1.0]])
    root = np.array([[np.cos(turn), np.sin(turn)], [np.sin(turn), -np.cos(turn)]])
    before, after = flank[_BEYOND:0:-1], flank[-2 : -2 - _BEYOND : -1]
    before = np.einsum("jk,nk...->nj...", tip, before)
    after = np.einsum("jk,nk...->nj...", root, after)
    return np.concatenate([before, flank, after])


def feet(
    points: Float[np.ndarray, "n 2"], line: Float[np.ndarray, "m 2"], smooth: bool = False
) -> Feet:
    """Return the nearest point of a polygonal `line` to each of the `points`.

    Points, line and distances have the same unit of length. `smooth`: whether the line's vertices
    lie on a smooth curve. The distances are then those from this curve. Their relative error is at
    most an eighth of the squared turn (rad) of the curve along a segment."""
    start, step = line[:-1], np.diff(line, axis=0)
    squares = np.maximum(np.sum(step**2, axis=1), np.finfo(float).tiny)
    # One coordinate at a time: a third axis of length 2 takes four times as long.
    x, y = (points[:, None, k] - start[:, k] for k in (0, 1))
    share = np.clip((x * step[:, 0] + y * step[:, 1]) / squares, 0.0, 1.0)
    x -= share * step[:, 0]
    y -= share * step[:, 1]
    segment = np.argmin(x**2 + y**2, axis=1)
    every = np.arange(len(points))
    toward = np.stack([x[every, segment], y[every, segment]], axis=1)
    away, share = np.linalg.norm(toward, axis=1), share[every, segment]
    along = step[segment] / np.sqrt(squares[segment])[:, None]
    normal = np.stack([along[:, 1], -along[:, 0]], axis=1)
    sign = np.where(np.sum(toward * normal, axis=1) < 0, -1.0, 1.0)
    # Beside a corner, the distance is not measured along a normal of the line.
    corner = ((share <= 0) | (share >= 1)) & (away > 0)
    toward = np.where(corner[:, None], toward / np.where(away > 0, away, 1.0)[:, None], normal)
    toward[corner] *= sign[corner, None]
    away = sign * away
    if smooth:
        away = away - share * (1 - share) * _bulge(step)[segment]
    return Feet(away, toward, segment, share)


def _bulge(step: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return four times the height (n,) of a smooth curve over each segment of a polygonal line.

    `step` (n, 2): the segments. The curve passes through the vertices, and turns along a segment by
    the mean of the turns at both of its ends. A turn by more than `_CORNER` is a corner of the
    curve. Heights are positive to the right of the line."""
    along = step @ np.array([1, 1j])
    ahead = along[1:] * np.conj(along[:-1])
    turn = np.where(ahead == 0, 0.0, np.angle(ahead))
    turn = np.where(np.abs(turn) < _CORNER, turn, 0.0)
    ends = np.concatenate([turn[:1], turn, turn[-1:]])
    return np.abs(along) * (ends[1:] + ends[:-1]) / 4
