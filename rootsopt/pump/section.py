"""The section of a rotor as points with normals, for measures that do not use the roll angle."""

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Complex, Float

from rootsopt.profiles import Profile


class Flank(NamedTuple):
    """Points of one flank, from the tip to the root, as complex numbers; the lobe's tip is on +x.

    `point` (n,): position (m). `normal` (n,): unit outward normal."""

    point: Complex[Array, " n"]
    normal: Complex[Array, " n"]


def sampled_flank(profile: Profile, count: int) -> Flank:
    """Return points of a flank: `count` per segment of the addendum, and as many of the dedendum.

    They are evenly spaced in the normal angle of the addendum point, and include all joints."""
    shares = jnp.arange(count) / count
    pieces = [one.start + (one.stop - one.start) * shares for one in profile.segments()]
    nu = jnp.append(jnp.concatenate(pieces), profile.pitch_normal)
    upper, lower = profile.addendum(nu), profile.dedendum(nu[:-1][::-1])
    beta, psi, s = (jnp.append(a, b) for a, b in zip(upper, lower, strict=True))
    turn = jnp.exp(1j * beta)
    point = turn * (profile.pitch_radius + s * (jnp.sin(psi) + 1j * jnp.cos(psi)))
    return Flank(point, turn * jnp.exp(1j * (jnp.pi / 2 - psi)))


def both_flanks(flank: Flank) -> Flank:
    """Return the points of a whole lobe, from one root to the other through the tip."""
    mirrored = Flank(*(jnp.conj(one[:0:-1]) for one in flank))
    return Flank(*(jnp.append(a, b) for a, b in zip(mirrored, flank, strict=True)))


def whole_valley(flank: Flank, lobes: int) -> Flank:
    """Return the points from a lobe's tip through the root to the next lobe's tip.

    `lobes`: N."""
    turn = jnp.exp(2j * jnp.pi / lobes)
    mirrored = Flank(*(turn * jnp.conj(one[-2::-1]) for one in flank))
    return Flank(*(jnp.append(a, b) for a, b in zip(flank, mirrored, strict=True)))


def half_valley(flank: Flank, lobes: int, radius: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Return half the angle (rad) of the space between two lobes at a `radius` (m) from the axis.

    `lobes`: N. Beyond the tip there is no lobe: the result is infinite. Below the root it is
    negative."""
    point, normal = flank.point[::-1], flank.normal[::-1]
    # A measured root or land is not quite round: its first point that rises to the radius counts.
    away, across = lax.cummax(jnp.abs(point)), jnp.angle(point)
    # Cubics between the points: with chords, the play would ripple as points slide past each other.
    # Where the flank runs nearly along a circle about the axis, its slope is not finite: a chord.
    chord = jnp.diff(across) / jnp.maximum(jnp.diff(away), 1e-12)
    seen = normal * jnp.conj(point)
    flat = jnp.abs(jnp.imag(seen)) < 0.02 * jnp.abs(point)
    slope = -jnp.real(seen) / (away * jnp.where(flat, 1.0, jnp.imag(seen)))
    k = jnp.clip(jnp.searchsorted(away, radius, side="right") - 1, 0, len(away) - 2)
    width = jnp.maximum(away[k + 1] - away[k], 1e-12)
    t = jnp.clip((radius - away[k]) / width, 0.0, 1.0)
    straight = flat[k] | flat[k + 1]
    first, last = (jnp.where(straight, 0.0, slope[j] - chord[k]) for j in (k, k + 1))
    bend = width * t * (1 - t) * ((1 - t) * first - t * last)
    free = jnp.pi / lobes - (across[k] + t * (across[k + 1] - across[k]) + bend)
    free = jnp.where(radius > away[-1], jnp.inf, free)
    return jnp.where(radius < away[0], (radius - away[0]) / away[0], free)
