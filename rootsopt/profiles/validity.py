"""How far a profile is from being none."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from rootsopt.profiles.base import Profile
from rootsopt.runtime.programs import Program

PURE = ("turning", "rolling", "order")
"""Margins that are no lengths."""
_POINTS = 400
"""Places on a segment that are looked at."""


class Margins(NamedTuple):
    """Least values along a flank, positive where the profile is sound.

    `turning` (rad): of a segment's range of normals, that is, the order of the joints; `convexity`
    (m): radius of curvature of the addendum; `reach` (m): what the normals' levers lack to the
    pitch radius, beyond which they miss the pitch circle; `fall` (m): the levers, negative where
    the outline rises again behind the tip; `rolling`: dβ/dν, negative where two points of a flank
    mesh at once and carry over what is between them (the centre of curvature then lies outside of
    the pitch circle); `order` (rad): β, negative where a flank meshes before its tip, together
    with the lobe's other flank; `undercut` (m/rad): `Profile.dedendum_speed`; `star` (m): distance
    of a tangent of addendum or dedendum from the axis, seen from which the outline folds back
    below 0 (above it, no flank crosses the other one of its lobe or space, as they meet on its
    axis); `root` (m): root radius.
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
def margins(profile: Profile) -> Margins:
    """Margins of a profile, looked at in many places of each segment (joints from both sides)."""
    segments = profile.segments()
    start = jnp.stack([s.start for s in segments])[:, None]
    length = jnp.stack([s.stop for s in segments])[:, None] - start
    nu = start + length * jnp.linspace(1e-9, 1 - 1e-9, _POINTS)
    point, addendum, dedendum = profile.speeds(nu)
    r = profile.pitch_radius
    sliding = r * jnp.sin(point.psi)
    lever = profile.lever(nu)
    present = length > 0

    def least(values):
        # Between the places, the parabola through three of them.
        before, here, after = values[:, :-2], values[:, 1:-1], values[:, 2:]
        bend = before - 2 * here + after
        low = (here <= before) & (here <= after) & (bend > 0)
        dip = (after - before) ** 2 / (8 * jnp.where(low, bend, 1.0))
        values = values.at[:, 1:-1].add(-jnp.where(low, dip, 0.0))
        return jnp.min(jnp.where(present, values, jnp.inf))

    return Margins(
        turning=jnp.min(length),
        convexity=least(addendum),
        reach=least(r - jnp.abs(lever)),
        fall=least(lever),
        rolling=least(profile.roll_rate(nu)),
        order=least(point.beta),
        undercut=least(dedendum),
        star=least(jnp.minimum(sliding + point.s, sliding - point.s)),
        root=r - profile.contact_distance(jnp.zeros_like(r)),
    )
