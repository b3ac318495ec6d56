"""Integral and extreme properties of a profile: area, inertia, radii, margins, outline."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rootsopt.profiles.base import Profile, Segment

# Gauss-Legendre per smooth segment: the integrands are analytic inside a segment, and
# 24 points bring area and inertia of every family here to rounding error.
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(24)


class Geometry(eqx.Module):
    """Geometry of one rotor, per unit length where a length is not given (SI units).

    `outer_radius`, `root_radius` (m); `area` (m²); `area_efficiency` 1 - A/(π r_a²);
    `polar_area_moment` ∫r² dA about the axis (m⁴); `undercut_margin` (m/rad), least
    `Profile.dedendum_speed`; `seal_width` (m), arc length of the whole tip land.
    """

    outer_radius: Float[Array, ""]
    root_radius: Float[Array, ""]
    area: Float[Array, ""]
    area_efficiency: Float[Array, ""]
    polar_area_moment: Float[Array, ""]
    undercut_margin: Float[Array, ""]
    seal_width: Float[Array, ""]


def _quadrature(segment: Segment) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    half = (segment.stop - segment.start) / 2
    return segment.start + half * (1 + jnp.asarray(_NODES)), half * jnp.asarray(_WEIGHTS)


def geometry(profile: Profile) -> Geometry:
    """Area and inertia by Green's theorem on the roll-angle form; exact to rounding.

    With the support function h = P·n and arc length element dl, dA = h dl / 2 and
    ∫r² dA = ∫ |P|² h dl / 4 over the outline.
    """
    r = profile.pitch_radius
    area = jnp.zeros_like(r)
    moment = jnp.zeros_like(r)
    margins = []
    seal_angle = jnp.zeros_like(r)
    for segment in profile.segments():
        nu, weight = _quadrature(segment)
        _, psi, s = profile.addendum(nu)
        for sign, speed in ((1, profile.addendum_speed), (-1, profile.dedendum_speed)):
            support = r * jnp.sin(psi) + sign * s
            radius_squared = r**2 + sign * 2 * r * s * jnp.sin(psi) + s**2
            element = support * speed(nu) * weight
            area += jnp.sum(element) / 2
            moment += jnp.sum(radius_squared * element) / 4
        margins.append(_dedendum_margin(profile, segment, nu))
        if segment.land:
            seal_angle += 2 * (segment.stop - segment.start)
    flanks = 2 * profile.lobes
    reach = profile.contact_distance(jnp.zeros_like(r))
    outer_radius = r + reach
    return Geometry(
        outer_radius=outer_radius,
        root_radius=r - reach,
        area=flanks * area,
        area_efficiency=1 - flanks * area / (jnp.pi * outer_radius**2),
        polar_area_moment=flanks * moment,
        undercut_margin=jnp.min(jnp.stack(margins)),
        seal_width=outer_radius * seal_angle,
    )


def _dedendum_margin(profile, segment, nu):
    """Least dedendum speed on a segment, seen from inside so that its ends belong to it."""
    inset = 1e-9 * (segment.stop - segment.start)
    ends = jnp.stack([segment.start + inset, segment.stop - inset])
    speed = profile.dedendum_speed(jnp.concatenate([ends[:1], nu, ends[1:]]))
    # An absent segment (no tip land, say) sets no limit.
    return jnp.where(segment.stop > segment.start, jnp.min(speed), jnp.inf)


def flank_nodes(profile: Profile, points: int) -> Float[Array, " n"]:
    """Normal angles (rad) that lay about `points` nodes along the addendum, every
    segment end included, evenly in arc length on each segment."""
    segments = [s for s in profile.segments() if float(s.stop) > float(s.start)]
    lengths, curves = [], []
    for segment in segments:
        nu = np.linspace(float(segment.start), float(segment.stop), 401)
        middle = jnp.asarray((nu[1:] + nu[:-1]) / 2)
        # The longer of the two conjugate elements decides, so that both flanks are even.
        speed = jnp.maximum(
            jnp.abs(profile.addendum_speed(middle)), jnp.abs(profile.dedendum_speed(middle))
        )
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


def flank(profile: Profile, points: int = 120) -> Float[Array, "n 2"]:
    """Coordinates (m) of one flank from tip centre to root centre, about 2 `points` nodes."""
    nu = flank_nodes(profile, points)
    addendum = jax.jit(lambda p, n: p.position(p.addendum(n)))(profile, nu)
    dedendum = jax.jit(lambda p, n: p.position(p.dedendum(n)))(profile, nu)
    return jnp.concatenate([addendum, dedendum[::-1][1:]])


def outline(profile: Profile, points: int = 120) -> Float[Array, "n 2"]:
    """Closed counter-clockwise outline (m), a lobe tip on +x, the first point repeated
    at the end; about 4 `points` nodes per lobe."""
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
