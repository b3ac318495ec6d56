"""Margins that measure how far a profile is from being unsound."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from rootsopt.profiles.base import Profile
from rootsopt.runtime.programs import Program

PURE = ("turning", "rolling", "order")
"""Names of the margins that are angles or ratios. All other margins are lengths, or lengths per
angle."""
_POINTS = 400
"""Number of points per smooth part of a flank at which margins are evaluated."""


class ProfileMargins(NamedTuple):
    """Margins of a flank: least values of nine quantities, none negative on a sound profile.

    `turning`: range of normal angles of a segment (rad), negative where joints are out of order.
    `convexity`: radius of curvature of the addendum (m).
    `reach`: pitch radius minus |lever| of a normal (m), negative where a normal misses the pitch
    circle.
    `fall`: lever (m), negative where the outline rises again beyond the tip.
    `rolling`: dβ/dν, negative where two points of a flank mesh at once and carry over the gas
    between them. The centre of curvature then lies outside the pitch circle.
    `order`: β (rad), negative where a flank meshes before its tip, together with the lobe's other
    flank.
    `undercut`: `Profile.dedendum_speed` (m/rad).
    `star`: distance of a tangent of addendum or dedendum from the axis (m), negative where the
    outline folds back as seen from the axis. While it is positive, the two flanks of a lobe, or of
    a valley, do not cross.
    `root`: root radius (m).
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


@Program
def margins(profile: Profile) -> ProfileMargins:
    """Return the margins of a profile.

    Least values along the flank are taken over `_POINTS` points per smooth part: a segment, or a
    knot span of a wavy flank. Both sides of a joint are evaluated. Between the points, a minimum is
    that of the parabola through three points. No parabola crosses a joint or a knot, where it might
    fall below all values of the flank."""
    parts = profile.stretches() if profile.wavy else profile.segments()
    start = jnp.stack([s.start for s in parts])[:, None]
    length = jnp.stack([s.stop for s in parts])[:, None] - start
    nu = start + length * jnp.linspace(1e-9, 1 - 1e-9, _POINTS)
    point, addendum, dedendum = profile.speeds(nu)
    r = profile.pitch_radius
    sliding = r * jnp.sin(point.psi)
    lever = profile.lever(nu)
    present = length > 0

    def least(values):
        # Include minima between the points, from the parabola through three points.
        before, here, after = values[:, :-2], values[:, 1:-1], values[:, 2:]
        bend = before - 2 * here + after
        low = (here <= before) & (here <= after) & (bend > 0)
        dip = (after - before) ** 2 / (8 * jnp.where(low, bend, 1.0))
        values = values.at[:, 1:-1].add(-jnp.where(low, dip, 0.0))
        return jnp.min(jnp.where(present, values, jnp.inf))

    return ProfileMargins(
        turning=jnp.min(jnp.stack([s.stop - s.start for s in profile.segments()])),
        convexity=least(addendum),
        reach=least(r - jnp.abs(lever)),
        fall=least(lever),
        rolling=least(profile.roll_rate(nu)),
        order=least(point.beta),
        undercut=least(dedendum),
        star=least(jnp.minimum(sliding + point.s, sliding - point.s)),
        root=r - profile.contact_distance(jnp.zeros_like(r)),
    )
