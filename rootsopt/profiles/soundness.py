"""Whether a design is sound, and margins that measure how far it is from being unsound."""

import itertools
from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from rootsopt.profiles.base import Profile
from rootsopt.profiles.outline import Outline

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
        checks = Soundness._make([*[free] * 8, profile.root_radius, free, free])
    else:
        checks = margins(profile)
    room = free if bore is None else checks.root - bore
    own = jnp.asarray(profile.limit_margin(), free.dtype)
    return checks._replace(**dict.fromkeys(inherent, free), limits=own, bore=room)


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
