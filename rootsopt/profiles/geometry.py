"""Integral and extreme properties of a profile, its outline, and distances between two outlines.

Two profiles of equal lobes have the same mirror lines: the axes of the lobes and of the valleys. A
flank from tip to root lies in the sector between two neighbouring mirror lines. Mirroring a point
never brings it closer to a point of the other outline in the same sector. The distances between the
flanks are therefore those between the closed outlines."""

import functools
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float
from numpy.typing import NDArray

from rootsopt.profiles.base import Profile, Quadrature
from rootsopt.profiles.outline import Outline
from rootsopt.runtime.programs import CachedFunction

# Constant g of the graded quadrature rule, which maps Gauss-Legendre nodes x to tanh(g x) /
# tanh(g).
#
# Powers, hyperbolic tangents and double exponentials with 32 to 96 nodes were compared. The
# integrand was a square root whose branch point lies 1e-4 to 0.3 of the length beyond an end. This
# rule had the least error, 1e-13.
_GRADING = 4.0


class Geometry(eqx.Module):
    """Geometry of one rotor's cross-section (SI units).

    `outer_radius` r_a, `root_radius`: greatest and least distance (m) of the outline from the axis.
    `area`: A (m²). `area_efficiency`: 1 - A/(π r_a²). `polar_area_moment`: ∫r² dA about the axis
    (m⁴). `undercut_margin`: least speed of the dedendum (m/rad, `Profile.speeds`). `seal_width`:
    arc length of the whole tip land (m).
    """

    outer_radius: Float[Array, ""]
    root_radius: Float[Array, ""]
    area: Float[Array, ""]
    area_efficiency: Float[Array, ""]
    polar_area_moment: Float[Array, ""]
    undercut_margin: Float[Array, ""]
    seal_width: Float[Array, ""]


def geometry(profile: Profile) -> Geometry:
    """Return the `Geometry` of a profile; area and polar moment of area are exact to rounding.

    Both follow from Green's theorem on the roll-angle form. Let h = P·n be the support function and
    dl the arc length element. Then dA = h dl / 2 and ∫r² dA = ∫ |P|² h dl / 4 over the outline. For
    an `Outline`, return the values computed when its file was read."""
    if isinstance(profile, Outline):
        return _given(profile)
    r = profile.pitch_radius
    segments = profile.stretches()
    nu, weights, length = quadrature_nodes(profile)
    (_, psi, s), addendum, dedendum = profile.speeds(nu)
    sliding = r * jnp.sin(psi)
    sides = ((s, addendum), (-s, dedendum))
    area = jnp.zeros_like(r)
    moment = jnp.zeros_like(r)
    for s, dl in sides:
        area += jnp.sum((sliding + s) * dl * weights) / 2
        radius_squared = r**2 + 2 * s * sliding + s**2
        moment += jnp.sum(radius_squared * (sliding + s) * dl * weights) / 4
    flanks = 2 * profile.lobes
    area, moment = flanks * area, flanks * moment
    reach = profile.contact_distance(jnp.zeros_like(r))
    outer_radius = r + reach
    seal_angle = sum(2 * (s.stop - s.start) for s in segments if s.land)
    # An empty segment, such as an absent tip land, does not limit the margin.
    candidates = jnp.where(length > 0, dedendum, jnp.inf).ravel()
    # Take the minimum by index. The derivative of `min` compares recomputed floats, which a
    # compiled program may round differently; the derivative is then zero.
    margin = candidates[lax.stop_gradient(jnp.argmin(candidates))]
    return Geometry(
        outer_radius=outer_radius,
        root_radius=r - reach,
        area=area,
        area_efficiency=1 - area / (jnp.pi * outer_radius**2),
        polar_area_moment=moment,
        undercut_margin=margin,
        seal_width=outer_radius * seal_angle,
    )


def quadrature_nodes(
    profile: Profile,
) -> tuple[Float[Array, "k n"], Float[Array, "k n"], Float[Array, "k 1"]]:
    """Return (nodes, weights, lengths) of a rule for integrals over the addendum's normal angle.

    All are in rad, with one row per part in `Profile.stretches`. Nodes at which only undercut is
    checked have weight 0."""
    segments = profile.stretches()
    start = jnp.stack([s.start for s in segments])[:, None]
    length = jnp.stack([s.stop for s in segments])[:, None] - start
    shares, weights = map(jnp.asarray, _rule(profile.quadrature))
    weights = weights * length
    return start + length * shares, weights, length


@functools.cache
def _rule(quadrature: Quadrature) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return (nodes, weights) of the quadrature rule on a part of length 1.

    Points at which only undercut is checked have weight 0."""
    nodes, weights = np.polynomial.legendre.leggauss(quadrature.nodes)
    if quadrature.graded:
        weights = weights * _GRADING / np.cosh(_GRADING * nodes) ** 2 / np.tanh(_GRADING)
        nodes = np.tanh(_GRADING * nodes) / np.tanh(_GRADING)
    # Evaluate each end just inside the stretch, so that it belongs to its segment.
    between = np.arange(1, quadrature.between) / quadrature.between
    shares = np.concatenate([(1 + nodes) / 2, [1e-12, 1 - 1e-12], between])
    return shares, np.append(weights / 2, np.zeros(len(shares) - len(nodes)))


def _given(profile: Outline) -> Geometry:
    """Return the geometry of the outline `profile`, as computed when its file was read.

    The undercut margin is NaN, because the dedendum of an outline is not the partner's envelope."""
    return Geometry(
        outer_radius=profile.outer_radius,
        root_radius=profile.root_radius,
        area=profile.area,
        area_efficiency=1 - profile.area / (jnp.pi * profile.outer_radius**2),
        polar_area_moment=profile.polar_area_moment,
        undercut_margin=jnp.full_like(profile.area, jnp.nan),
        seal_width=profile.seal_width,
    )


def flank_nodes(profile: Profile, points: int) -> Float[Array, " n"]:
    """Return normal angles (n,) in rad of about `points` nodes along the addendum of `profile`.

    Every segment end is a node. On each segment, nodes are denser where the arc length per normal
    angle is greater, on the addendum or on its conjugate."""
    segments = [s for s in profile.segments() if float(s.stop) > float(s.start)]
    lengths, curves = [], []
    for segment in segments:
        nu = np.linspace(float(segment.start), float(segment.stop), 401)
        speed = _element(profile, (nu[1:] + nu[:-1]) / 2)
        arc = np.concatenate([[0.0], np.cumsum(np.asarray(speed) * np.diff(nu))])
        lengths.append(arc[-1])
        curves.append((nu, arc))
    total = sum(lengths)
    nodes = []
    for (nu, arc), length in zip(curves, lengths, strict=True):
        count = max(2, int(np.ceil(points * length / total)) + 1)
        nodes.append(np.interp(np.linspace(0, length, count), arc, nu)[:-1])
    nodes.append(np.array([curves[-1][0][-1]]))
    return jnp.asarray(np.concatenate(nodes))


@CachedFunction
def _both(profile, nu):
    return profile.position(profile.addendum(nu)), profile.position(profile.dedendum(nu))


@CachedFunction
def _element(profile, nu):
    """Return the density of nodes (m/rad) of `profile` at the normal angles `nu` (rad).

    The density is the longer of the two conjugate arc elements plus a constant. The constant
    ensures enough nodes at sharp points, such as the pitch crossing of EE."""
    _, addendum, dedendum = profile.speeds(nu)
    longest = jnp.maximum(jnp.abs(addendum), jnp.abs(dedendum))
    return longest + 0.3 * profile.pitch_radius


def flank(profile: Profile, points: int = 120) -> Float[Array, "n 2"]:
    """Return points (n, 2) in m on one flank of `profile`, from tip centre to root centre.

    `points`: approximate number of nodes on each side of the pitch circle."""
    nu = flank_nodes(profile, points)
    addendum, dedendum = map(np.asarray, _both(profile, nu))
    return jnp.asarray(np.concatenate([addendum, dedendum[::-1][1:]]))


def outline(profile: Profile, points: int = 120) -> Float[Array, "n 2"]:
    """Return the closed counter-clockwise outline (n, 2) in m of `profile`, with a lobe tip on +x.

    The first point is repeated at the end. `points`: approximate number of nodes on each side of
    the pitch circle of each flank."""
    upper = np.array(flank(profile, points))
    upper[0, 1] = 0.0
    lower = upper[::-1] * [1, -1]
    lobe = np.concatenate([lower[:-1], upper])[:-1]
    start = len(lower) - 1
    turns = 2 * np.pi * np.arange(profile.lobes) / profile.lobes
    cos, sin = np.cos(turns), np.sin(turns)
    rotation = np.stack([np.stack([cos, sin], -1), np.stack([-sin, cos], -1)], -2)
    closed = np.concatenate([lobe @ matrix for matrix in rotation])
    closed = np.roll(closed, -start, axis=0)
    return jnp.asarray(np.concatenate([closed, closed[:1]]))


def place_pair(
    outline: NDArray[np.float64], lobes: int, center_distance: float, phi1: float, phi2: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return both outlines (n, 2) in the fixed frame: rotor 1 at the origin, rotor 2 at (E, 0).

    `outline` (n, 2): closed outline of both rotors, with a lobe tip on +x. E is `center_distance`;
    `lobes`: number of lobes; `phi1`, `phi2`: rotations φ1 and φ2 (rad). Rotations are positive in
    each rotor's own direction of rotation, so that rotor 2 is the mirror image. At φ1 = φ2 = 0 a
    lobe of rotor 1 points at a valley of rotor 2. All lengths have the unit of `outline`.
    """
    first = _rotate(outline, phi1)
    second = _rotate(outline, phi2 + np.pi / lobes) * [-1.0, 1.0]
    return first, second[::-1] + np.array([center_distance, 0.0])


def _rotate(points: NDArray[np.float64], angle: float) -> NDArray[np.float64]:
    cos, sin = np.cos(angle), np.sin(angle)
    return points @ np.array([[cos, sin], [-sin, cos]])


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
