"""Integral and extreme properties of a profile: area, inertia, radii, outline, margins.

Margins measure how far a profile, or a design, is from being unsound."""

import functools
import itertools
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float
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


PURE = ("turning", "rolling", "order", "limits")
"""Names of the margins that are angles or ratios. All other margins are lengths, or lengths per
angle."""
# Number of points at which margins are evaluated, per smooth part of a flank and per knot span of a
# wavy flank.
_POINTS = 400, 100
# Violations above which a design counts as unsound: of an angle (rad) or ratio, and of a length
# (m). A search ends at such points, because it lets constraints be violated by a millionth of their
# scale.
_ROUNDING = 1e-7, 1e-9


class Soundness(NamedTuple):
    """Margins of all checks of a design; it is sound if none of them is negative (`sound`).

    The first nine are least values along a flank (`margins`). A margin is inf if the family or the
    scene has no such check.

    `turning`: range of normal angles of a segment (rad), negative where joints are out of order.
    `convexity`: radius of curvature of the addendum (m).
    `reach`: pitch radius minus |lever| of a normal (m), negative where a normal misses the pitch
    circle.
    `fall`: lever (m), negative where the outline rises again beyond the tip.
    `rolling`: dβ/dν, negative where two points of a flank mesh at once and carry over the gas
    between them. The centre of curvature then lies outside the pitch circle.
    `order`: β (rad), negative where a flank meshes before its tip, together with the lobe's other
    flank.
    `undercut`: speed of the dedendum (m/rad, `Profile.speeds`).
    `star`: distance of a tangent of addendum or dedendum from the axis (m), negative where the
    outline folds back as seen from the axis. While it is positive, the two flanks of a lobe, or of
    a valley, do not cross.
    `root`: root radius (m).
    `limits`: least distance of a ratio of the family from its limits (`Profile.limit_margin`).
    `bore`: root radius minus the radius of the bore (m).
    """

    turning: Float[Array, ""]
    convexity: Float[Array, ""]
    reach: Float[Array, ""]
    fall: Float[Array, ""]
    rolling: Float[Array, ""]
    order: Float[Array, ""]
    undercut: Float[Array, ""]
    star: Float[Array, ""]
    root: Float[Array, ""]
    limits: Float[Array, ""]
    bore: Float[Array, ""]

    @property
    def of_flank(self) -> dict[str, Float[Array, ""]]:
        """The margins of a flank by name: all but `limits` and `bore`."""
        return dict(itertools.islice(self._asdict().items(), 9))

    @property
    def sound(self) -> Bool[Array, ""]:
        """Whether the design is sound. A margin that is not a number counts as negative."""
        slack, length = _ROUNDING
        least = [-slack if name in PURE else -length for name in self._fields]
        return jnp.all(jnp.stack(self) >= jnp.asarray(least, self.root.dtype))

    @property
    def failed(self) -> str:
        """Name of the first check that fails, or "" if all hold; not for traced margins."""
        for name, value in self._asdict().items():
            if not float(value) >= -_ROUNDING[name not in PURE]:
                return name
        return ""


def soundness(
    profile: Profile, bore: Float[Array, ""] | None, inherent: frozenset[str]
) -> Soundness:
    """Return the margins of all checks of a design.

    `bore`: radius of the bore (m), `None` without a bore; `inherent`: names of margins that may be
    negative in the family. Of an outline from a file, only the root radius and the bore are
    checked. The margins are constants to JAX, with derivative 0."""
    profile, bore = lax.stop_gradient((profile, bore))
    free = jnp.full_like(profile.pitch_radius, jnp.inf)
    if isinstance(profile, Outline):
        found = Soundness._make([*[free] * 8, profile.root_radius, free, free])
    else:
        found = margins(profile)
    room = free if bore is None else found.root - bore
    own = jnp.asarray(profile.limit_margin(), free.dtype)
    return found._replace(**dict.fromkeys(inherent, free), limits=own, bore=room)


@CachedFunction
def margins(profile: Profile) -> Soundness:
    """Return the margins of a profile, without `limits` and `bore`.

    Least values along the flank are taken over `_POINTS` of each smooth part: a segment, or a
    knot span of a wavy flank. Both sides of a joint are evaluated. Between the points, a minimum is
    that of the parabola through three points. No parabola crosses a joint or a knot, where it might
    fall below all values of the flank."""
    parts = profile.stretches() if profile.wavy else profile.segments()
    start = jnp.stack([s.start for s in parts])[:, None]
    length = jnp.stack([s.stop for s in parts])[:, None] - start
    nu = start + length * jnp.linspace(1e-9, 1 - 1e-9, _POINTS[profile.wavy])
    point, addendum, dedendum = profile.speeds(nu)
    r = profile.pitch_radius
    sliding = r * jnp.sin(point.psi)
    lever = profile.lever(nu)
    present = length > 0

    star = jnp.minimum(sliding + point.s, sliding - point.s)
    rate = profile.roll_rate(nu)
    values = jnp.stack([addendum, r - jnp.abs(lever), lever, rate, point.beta, dedendum, star])
    # Include minima between the points, from the parabola through three points.
    before, here, after = values[..., :-2], values[..., 1:-1], values[..., 2:]
    bend = before - 2 * here + after
    low = (here <= before) & (here <= after) & (bend > 0)
    dip = (after - before) ** 2 / (8 * jnp.where(low, bend, 1.0))
    values = values.at[..., 1:-1].add(-jnp.where(low, dip, 0.0))
    least = jnp.min(jnp.where(present, values, jnp.inf), axis=(1, 2))
    turning = jnp.min(jnp.stack([s.stop - s.start for s in profile.segments()]))
    root = r - profile.contact_distance(jnp.zeros_like(r))
    free = jnp.full_like(r, jnp.inf)
    return Soundness._make([turning, *least, root, free, free])
