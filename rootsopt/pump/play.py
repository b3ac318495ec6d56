"""Angular play of rotor 2 between its flank contacts, while rotor 1 is held.

A turn of rotor 2 moves its points on circles about its axis. It touches where the angle between the
two outlines, seen from this axis, is used up at one radius. This holds for any outline that does
not fold back as seen from the axis, conjugate or not, and for turns of any size. `docs/play.md`
derives the closed forms.
"""

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from rootsopt.profiles import Profile
from rootsopt.pump.section import both_flanks, flank_points, half_valley

POINTS = 1000
"""Number of points per segment of a flank. The angles are then exact to some 1e-6 of a radian, and
mostly to 1e-8."""
POSES = 96
"""Number of angles of rotor 1 over one lobe pitch, a multiple of 4: the poses in which the pitch
crossings touch are among them."""


class Play(eqx.Module):
    """Relative rotations ε = φ2 - φ1 (rad) at which the flanks touch, with rotor 1 held at φ1.

    `phi` (n,): φ1 (rad). `behind`, `ahead` (n,): least and greatest ε without contact. If rotor 2
    is behind, rotor 1 pushes it; if it is ahead, it pushes rotor 1. Where the rotors overlap at
    ε = 0, `behind` is positive or `ahead` negative. `pitch_radius`: r (m)."""

    phi: Float[Array, " n"]
    behind: Float[Array, " n"]
    ahead: Float[Array, " n"]
    pitch_radius: Float[Array, ""]

    @property
    def total(self) -> Float[Array, " n"]:
        """Angular play (rad) of rotor 2 at each φ1."""
        return self.ahead - self.behind

    @property
    def gear_backlash(self) -> Float[Array, ""]:
        """Greatest backlash (m) at the pitch radius of a timing gear that keeps the flanks apart.

        The gear has no phase error. A negative value is the overlap in perfect rolling."""
        return 2 * self.pitch_radius * jnp.minimum(jnp.min(self.ahead), -jnp.max(self.behind))


def play(
    profile: Profile,
    clearance: Float[Array, ""],
    center_distance: Float[Array, ""] | None = None,
    phi: Float[Array, " n"] | None = None,
) -> Play:
    """Return the play of rotor 2 over the rotation.

    `clearance` (m): distance added to every flank gap, along the normal. `center_distance` (m): by
    default that of perfect rolling, 2r. `phi` (n,): angles of rotor 1 (rad), by default `POSES` of
    them over one lobe pitch."""
    lobes, r = profile.lobes, profile.pitch_radius
    distance = 2 * r if center_distance is None else center_distance
    if phi is None:
        phi = 2 * jnp.pi / lobes * jnp.arange(POSES) / POSES
    flank = flank_points(profile, POINTS)
    lobe = both_flanks(flank)
    # The whole clearance is taken off rotor 1.
    reduced = lobe.point - clearance * lobe.normal
    turns = jnp.exp(2j * jnp.pi * jnp.arange(lobes) / lobes)

    def at(angle):
        # As rotor 2 sees rotor 1, in a frame in which it turns by +φ2.
        seen = -jnp.conj(jnp.exp(1j * angle) * turns[:, None] * reduced - distance)
        free = half_valley(flank, lobes, jnp.abs(seen))
        turned = jnp.angle(seen) - angle - 2 * jnp.pi / lobes
        aside = turned - 2 * jnp.pi / lobes * jnp.round(turned / (2 * jnp.pi / lobes))
        return -_least(free - aside), _least(free + aside)

    behind, ahead = lax.map(at, phi)
    return Play(phi, behind, ahead, r)


def _least(values: Float[Array, "k n"]) -> Float[Array, ""]:
    """Return the least of the `values` along k smooth curves, with the parabola through its
    neighbours."""
    fixed = lax.stop_gradient(values)
    row, column = jnp.unravel_index(jnp.argmin(fixed), fixed.shape)
    column = jnp.clip(column, 1, values.shape[1] - 2)
    before, here, after = (values[row, column + k] for k in (-1, 0, 1))
    bend = before - 2 * here + after
    curved = (bend > 0) & jnp.isfinite(bend) & (here <= before) & (here <= after)
    dip = jnp.where(curved, (after - before) ** 2 / (8 * jnp.where(curved, bend, 1.0)), 0.0)
    least = jnp.min(jnp.stack([before, here, after]))
    return jnp.where(curved, here - dip, least)
