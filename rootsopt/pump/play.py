"""Angular play of rotor 2 between its flank contacts, while rotor 1 is held.

A turn of rotor 2 moves its points on circles about its axis. It ends where the angle between the
two outlines, seen from this axis, becomes zero at some radius. This holds for any outline that does
not fold back as seen from the axis, conjugate or not, and for turns of any size. `docs/pump.md`
derives the closed forms."""

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Complex, Float

from rootsopt.profiles import Profile
from rootsopt.pump.gap import Flank, both_flanks, half_valley, sampled_flank

POINTS = 1000
"""Number of points per segment of a flank. The angles are then accurate to about 1e-6 rad, and
mostly to 1e-8 rad."""
_STEP, _SHARE = 3e-8, 1e-2
"""Least clearance that is added to separate rotors that overlap, beyond their greatest depth: in
pitch radii, and as a share of this depth. It is trebled until they are apart."""
_FINE = 361
"""Number of angles of rotor 1 over a quarter of a lobe pitch in the search for an overlap."""
POSES = 96
"""Number of angles of rotor 1 over one lobe pitch. It is a multiple of 4, so that the poses in
which the pitch crossings touch are included."""


class Play(eqx.Module):
    """Relative rotations ε = φ2 - φ1 (rad) at which the flanks touch, with rotor 1 held at φ1.

    `phi` (n,): φ1 (rad). `behind`, `ahead` (n,): least and greatest ε without contact. If rotor 2
    is behind, rotor 1 pushes it; if it is ahead, it pushes rotor 1. `pitch_radius`: r (m).

    `overlap`: greatest depth (m), along the normal, by which the rotors overlap at ε = 0;
    `overlap_at`: φ1 (rad) there. No turn lifts a tip out of a root. With an overlap, `behind` and
    `ahead` are therefore those at the least further clearance without overlap, each moved inwards
    by this clearance over the greatest lever. They are continuous in the overlap."""

    phi: Float[Array, " n"]
    behind: Float[Array, " n"]
    ahead: Float[Array, " n"]
    pitch_radius: Float[Array, ""]
    overlap: Float[Array, ""]
    overlap_at: Float[Array, ""]

    @property
    def total(self) -> Float[Array, " n"]:
        """Angular play (rad) of rotor 2 at each φ1."""
        return self.ahead - self.behind

    @property
    def gear_backlash(self) -> Float[Array, ""]:
        """Greatest backlash (m) at the pitch radius of a timing gear that keeps the flanks apart.

        The gear has no phase error. Flanks that overlap in perfect rolling have a negative value,
        about -2 r `overlap` over the greatest lever."""
        return 2 * self.pitch_radius * jnp.minimum(jnp.min(self.ahead), -jnp.max(self.behind))


class _Pair(eqx.Module):
    """Two rotors, with the whole clearance taken off rotor 1.

    `flank`: flank of rotor 2; `lobe`: lobe of rotor 1; `clearance`, `distance` (m): along the
    normal, and between the axes; `lobes`: N. The methods take points of rotor 1 (m) at φ1 = 0, and
    the present φ1 = `angle` (rad)."""

    flank: Flank
    lobe: Flank
    clearance: Float[Array, ""]
    distance: Float[Array, ""]
    lobes: int = eqx.field(static=True)

    def points(self, extra: Float[Array, ""] | float) -> Complex[Array, " m"]:
        """Return the points of all lobes of rotor 1, with an `extra` clearance (m)."""
        turns = jnp.exp(2j * jnp.pi * jnp.arange(self.lobes) / self.lobes)
        reduced = self.lobe.point - (self.clearance + extra) * self.lobe.normal
        return (turns[:, None] * reduced).ravel()

    def _seen(self, points, angle):
        """Return radii (m) of the points and their angles (rad) from the middle of the nearest
        valley, as seen from the axis of rotor 2."""
        pitch = 2 * jnp.pi / self.lobes
        # In a frame in which rotor 2 turns by +φ2.
        seen = -jnp.conj(jnp.exp(1j * angle) * points - self.distance)
        turned = jnp.angle(seen) - angle - pitch
        return jnp.abs(seen), turned - pitch * jnp.round(turned / pitch)

    def rooms(self, points, angle):
        """Return the turns ε (rad) to which the points limit rotor 2: (-least, greatest)."""
        radius, aside = self._seen(points, angle)
        free = half_valley(self.flank, self.lobes, radius)
        return jnp.stack([free - aside, free + aside])

    def places(self, points, angle):
        """Return the indices (2,) of the points with the least room on each side.

        The first and the last point are left out, because they lack a neighbour."""
        return 1 + jnp.argmin(self.rooms(points, angle)[:, 1:-1], axis=1)

    def limits(self, points, angle, places):
        """Return the least room (2,) on each side, between the points next to `places`."""
        around = points[places[:, None] + jnp.arange(-1, 2)]
        behind, ahead = self.rooms(around, angle)
        return jnp.stack([_dip(behind[0]), _dip(ahead[1])])

    def depth(self, points, angle):
        """Return the depths (m) of the points in rotor 2, 0 outside.

        The outline of rotor 2 near a point is taken as straight: the depth along the normal is the
        height of a right triangle. Its other sides are the depths along the radius and across."""
        radius, aside = self._seen(points, angle)
        free = half_valley(self.flank, self.lobes, radius)
        # No angle is free below the root.
        across = jnp.where(free < 0, self.distance, radius * (jnp.abs(aside) - free))
        floor, place = jnp.abs(self.flank.point), jnp.angle(self.flank.point)
        along = jnp.interp(jnp.pi / self.lobes - jnp.abs(aside), place, floor) - radius
        inside = (across > 0) & (along > 0)
        along, across = jnp.where(inside, along, 1.0), jnp.where(inside, across, 1.0)
        return jnp.where(inside, along * across / jnp.hypot(along, across), 0.0)

    def overlap(self):
        """Return the greatest depth (m) at ε = 0 over the mesh, and φ1 (rad) there.

        By symmetry, a quarter of the lobe pitch has all gaps."""
        still = lax.stop_gradient(self)
        points = still.points(0.0)
        phi = jnp.pi / (2 * self.lobes) * jnp.arange(_FINE) / (_FINE - 1)

        def at(angle):
            depth = still.depth(points, angle)
            return jnp.max(depth), jnp.argmax(depth)

        depth, place = lax.map(at, phi)
        pose = jnp.argmax(depth)
        return self.depth(self.points(0.0)[place[pose]], phi[pose]), phi[pose]


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
    pair = _Pair(flank, both_flanks(flank), clearance, distance, lobes)

    # Where a limit is reached is found without derivatives; three neighbours there give its value.
    still = lax.stop_gradient(pair)

    def least(extra):
        points = still.points(extra)

        def at(angle):
            place = still.places(points, angle)
            return still.limits(points, angle, place), place

        return extra, *lax.map(at, phi)

    def shrunk(carry):
        more, *_ = carry
        return 3 * more, *least(start + more)

    first = least(jnp.zeros_like(r))
    # The gap of conjugate flanks is smooth. That of others may have an overlap between the poses.
    clear = jnp.min(first[1]) >= 0 if profile.conjugate else jnp.zeros((), bool)
    nothing = jnp.zeros_like(r), jnp.zeros_like(r)
    overlap, pose = lax.cond(clear, lambda: nothing, lambda: pair.overlap())
    start = lax.stop_gradient(overlap)
    # The depth is nearly the clearance needed; add a little until no point overlaps.
    step = lax.stop_gradient(jnp.maximum(_STEP * r, _SHARE * start))

    def touching(carry):
        _, extra, room, _ = carry
        return (jnp.min(room) < 0) | (extra < start)

    _, extra, _, place = lax.while_loop(touching, shrunk, (step, *first))
    extra = extra + overlap - start
    points = pair.points(extra)
    behind, ahead = lax.map(lambda pose: pair.limits(points, *pose), (phi, place)).T
    lever = jnp.max(jnp.abs(jnp.imag(jnp.conj(flank.normal) * flank.point)))
    inwards = extra / lever
    return Play(phi, inwards - behind, ahead - inwards, r, overlap, pose)


def _dip(values: Float[Array, "3"]) -> Float[Array, ""]:
    """Return the least of three neighbours on a smooth curve, with the parabola through them."""
    # Beyond the tip of rotor 2 the room is infinite: no parabola passes through it.
    values = jnp.minimum(values, jnp.pi)
    before, here, after = values
    bend = before - 2 * here + after
    curved = (bend > 0) & (here <= before) & (here <= after) & (jnp.maximum(before, after) < jnp.pi)
    dip = jnp.where(curved, (after - before) ** 2 / (8 * jnp.where(curved, bend, 1.0)), 0.0)
    return jnp.where(curved, here - dip, jnp.min(values))
