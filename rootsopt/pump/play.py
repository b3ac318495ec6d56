"""Angular play of rotor 2 between its flank contacts, while rotor 1 is held.

A turn of rotor 2 moves its points on circles about its axis. It ends where the angle between the
two outlines, seen from this axis, becomes zero at some radius. This holds for any outline that does
not fold back as seen from the axis, conjugate or not, and for turns of any size. `docs/play.md`
derives the closed forms."""

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Inexact

from rootsopt.profiles import Profile
from rootsopt.pump.section import Flank, both_flanks, half_valley, sampled_flank

POINTS = 1000
"""Number of points per segment of a flank. The angles are then accurate to about 1e-6 rad, and
mostly to 1e-8 rad."""
POSES = 96
"""Number of angles of rotor 1 over one lobe pitch. It is a multiple of 4, so that the poses in
which the pitch crossings touch are included."""


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
    radial: Float[Array, ""] | None = None,
) -> Play:
    """Return the play of rotor 2 over the rotation.

    `clearance` (m): distance added to every flank gap, along the normal. `center_distance` (m): by
    default that of perfect rolling, 2r. `phi` (n,): angles of rotor 1 (rad), by default `POSES` of
    them over one lobe pitch. `radial` (m): radius by which both rotors are smaller everywhere."""
    lobes, r = profile.lobes, profile.pitch_radius
    distance = 2 * r if center_distance is None else center_distance
    if phi is None:
        phi = 2 * jnp.pi / lobes * jnp.arange(POSES) / POSES
    flank = sampled_flank(profile, POINTS)
    if radial is not None:
        flank = flank._replace(point=flank.point * (1 - radial / jnp.abs(flank.point)))
    lobe = both_flanks(flank)
    # The whole clearance is taken off rotor 1.
    reduced = lobe.point - clearance * lobe.normal
    turns = jnp.exp(2j * jnp.pi * jnp.arange(lobes) / lobes)

    # Where a limit is reached is found without derivatives; three neighbours there give its value.
    still, settled = lax.stop_gradient((flank, reduced))

    def place(angle, sign):
        free, aside = _seen(still, settled * turns[:, None], angle, distance, lobes)
        room = free + sign * aside
        row, column = jnp.unravel_index(jnp.argmin(room), room.shape)
        return row, jnp.clip(column, 1, room.shape[1] - 2)

    def at(angle):
        limits = []
        for sign in (-1.0, 1.0):
            row, column = place(angle, sign)
            points = turns[row] * lax.dynamic_slice_in_dim(reduced, column - 1, 3)
            free, aside = _seen(flank, points, angle, distance, lobes)
            limits.append(_dip(free + sign * aside))
        return -limits[0], limits[1]

    behind, ahead = lax.map(at, phi)
    return Play(phi, behind, ahead, r)


def _seen(flank: Flank, points: Inexact[Array, "*n"], angle, distance, lobes: int):
    """Return (half the space between two lobes of rotor 2, how far aside of it the points are).

    Both are angles (rad) as seen from the axis of rotor 2. `flank`: one of its flanks; `points`
    (m): of rotor 1 at φ1 = 0; `angle`: φ1 (rad) at present; `distance` (m): between the axes."""
    pitch = 2 * jnp.pi / lobes
    # In a frame in which rotor 2 turns by +φ2.
    seen = -jnp.conj(jnp.exp(1j * angle) * points - distance)
    turned = jnp.angle(seen) - angle - pitch
    return half_valley(flank, lobes, jnp.abs(seen)), turned - pitch * jnp.round(turned / pitch)


def _dip(values: Float[Array, "3"]) -> Float[Array, ""]:
    """Return the least of three neighbours on a smooth curve, with the parabola through them."""
    # Beyond the tip of rotor 2 the room is infinite, and a parabola through it has no derivative.
    values = jnp.minimum(values, jnp.pi)
    before, here, after = values
    bend = before - 2 * here + after
    curved = (bend > 0) & (here <= before) & (here <= after)
    dip = jnp.where(curved, (after - before) ** 2 / (8 * jnp.where(curved, bend, 1.0)), 0.0)
    return jnp.where(curved, here - dip, jnp.min(values))
