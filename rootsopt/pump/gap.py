"""The gap between the rotors over the mesh, the shape of its narrowest place, and the play in it.

A rotor's section is sampled as points with normals, for measures that do not use the roll angle.

The play is that of rotor 2 between its flank contacts while rotor 1 is held. A turn of rotor 2
moves its points on circles about its axis. It ends where the angle between the two outlines, seen
from this axis, becomes zero at some radius. This holds for any outline that does not fold back as
seen from the axis, conjugate or not, and for turns of any size. `docs/pump.md` derives the closed
forms."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Complex, Float

from rootsopt.contact.closest import FlankPair
from rootsopt.profiles import Outline, Profile, RollPoint, Table


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
    # A measured root or land is not quite round. Use its first point that rises to the radius.
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


# Number of roll angles, evenly spaced over the quarter of the mesh in which one addendum touches.
# By symmetry, the other quarters have the same gap.
_POSES = 48
# Number of points per segment of a flank at which the gap's width is computed.
_POINTS = 400
# Cosine of the angle between a flank's normal and that at the narrowest place: below the first, a
# point is not part of the gap; above the second, it fully is. A sharp limit would make the length
# jump when it passes a sampled point.
_TURNED, _FACING = 0.1, 0.3

# Gap (m) below which the shape of the gap is that of a gap of this height.
_NARROWEST = 1e-9


class Allowances(NamedTuple):
    """Distances (m) that separate the flanks of a pair.

    `normal`: distance added to every flank gap, along the normal; one number, or one per roll angle
    of `rolls`. `center`: centre distance minus twice the pitch radius. `radial`: radius by which
    both rotors are smaller everywhere."""

    normal: Float[Array, "*#n"]
    center: Float[Array, ""]
    radial: Float[Array, ""]


class MeshGap(NamedTuple):
    """The gap between the rotors over the mesh.

    `roll` (n,): roll angle β (rad). `least` (n,): least distance (m), negative where they overlap.
    `curvature` (n,): relative curvature (1/m), 0 where the flanks conform. `length` (n,): length
    (m) of a gap of constant height `least` with the same laminar flow."""

    roll: Float[Array, " n"]
    least: Float[Array, " n"]
    curvature: Float[Array, " n"]
    length: Float[Array, " n"]


def relative_curvature(profile: Profile, nu: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Return the relative curvature 1/R1 + 1/R2 (1/m) of conjugate flanks at their contact.

    `nu`: normal angle (rad) of the addendum point. With the arc lengths v1 and v2 per normal angle,
    it is 2 r sin ψ β′² / (v1 v2). It is 0 where a whole arc touches at once."""
    point, addendum, dedendum = profile.speeds(nu)
    turned = 2 * profile.pitch_radius * jnp.sin(point.psi) * profile.roll_rate(nu) ** 2
    return turned / (addendum * dedendum)


def rolls(profile: Profile) -> Float[Array, " n"]:
    """Return the roll angles (n,) in rad at which `mesh_gap` gives the gap."""
    return profile.half_pitch * (jnp.arange(_POSES) + 0.5) / _POSES


def mesh_gap(profile: Profile, allowances: Allowances) -> MeshGap:
    """Return the gap over the mesh.

    To first order in the allowances, a gap opens by c + Δ sin ψ + a (h1/ρ1 + h2/ρ2): c, Δ and a
    are the allowances, h the support functions and ρ the radii of the two points. For a measured
    outline, whose flanks are not conjugate, c is in addition to the gap in perfect rolling."""
    roll = rolls(profile)
    nu, gap = profile.normal_at(roll), jnp.zeros_like(roll)
    if isinstance(profile, Outline):
        pair = FlankPair.of(profile, 2 * profile.pitch_radius, two_sided=True)
        points = lax.map(lambda x: pair(x, jnp.zeros_like(x)), roll)
        nu, gap = points.normal2, points.gap
    r = profile.pitch_radius
    _, psi, s = profile.addendum(nu)
    shares = jnp.zeros_like(s)
    for side in (s, -s):
        away = jnp.sqrt(r**2 + 2 * r * side * jnp.sin(psi) + side**2)
        shares += (r * jnp.sin(psi) + side) / away
    gap = gap + allowances.normal + allowances.center * jnp.sin(psi) + allowances.radial * shares
    length = _lengths(profile, nu, gap)
    return MeshGap(roll, gap, relative_curvature(profile, nu), length)


def _lengths(profile: Profile, nu: Float[Array, " n"], gap: Float[Array, " n"]):
    """Return h³ ∫ dl / d³ (n,) in m across gaps of least height h = `gap` (n,) in m.

    `nu` (n,): normal angles (rad) of the addendum points there. l is the arc length on rotor 1, and
    d the thickness along its normal: h, plus the distance that the flanks have without clearance.
    """
    flank = sampled_flank(profile, _POINTS)
    lobe, valley = both_flanks(flank), whole_valley(flank, profile.lobes)
    step = jnp.abs(jnp.diff(lobe.point))

    def seen(curve: Flank, point: RollPoint):
        """Return positions along the tangent at the contact (m), depths behind it (m), and normals.
        The normals are complex numbers whose real axis is the contact's normal."""
        beta, psi, s = point
        turn = jnp.exp(1j * beta)
        place = turn * (profile.pitch_radius + s * (jnp.sin(psi) + 1j * jnp.cos(psi)))
        back = jnp.conj(turn * jnp.exp(1j * (jnp.pi / 2 - psi)))
        local = (curve.point - place) * back
        return jnp.imag(local), -jnp.real(local), curve.normal * back

    def length(pose):
        nu, gap = pose
        x1, depth1, normal = seen(lobe, profile.addendum(nu))
        cosine = jnp.real(normal)
        # Seen from rotor 1, the flank of rotor 2 runs the other way.
        x2, depth2, facing = (one[::-1] for one in seen(valley, profile.dedendum(nu)))
        faces = jnp.real(facing) > _TURNED
        x2 = jnp.where(faces, -x2, jnp.nan)
        first, last = jnp.nanmin(x2), jnp.nanmax(x2)
        x2 = lax.cummax(jnp.where(jnp.isnan(x2), first, x2))
        inside = (cosine > _TURNED) & (x1 > first) & (x1 < last)
        x1 = jnp.where(inside, x1, (first + last) / 2)
        slope = jnp.where(faces, -jnp.imag(facing) / jnp.where(faces, jnp.real(facing), 1.0), 0.0)
        # Linear interpolation would make the length ripple as points slide past each other.
        (across,) = Table(x2, depth2[:, None], slope[:, None])(x1)
        height = jnp.where(inside, gap + cosine * (depth1 + across), 1.0)
        part = _part(cosine) * _part(jnp.interp(x1, x2, jnp.real(facing)))
        inverse = jnp.where(inside, part * (gap / height) ** 3, 0.0)
        return jnp.sum((inverse[1:] + inverse[:-1]) / 2 * step)

    return lax.map(length, (nu, jnp.maximum(gap, _NARROWEST)))


def _part(cosine):
    """Return the weight of a point in the gap, a smooth function of its `cosine`."""
    share = jnp.clip((cosine - _TURNED) / (_FACING - _TURNED), 0.0, 1.0)
    return share**2 * (3 - 2 * share)


# Number of points per segment of a flank. It makes the angles accurate to about 1e-6 rad, mostly
# 1e-8 rad.
_PLAY_POINTS = 1000
# Number of points that are looked at together. In most poses, most of these blocks are out of the
# other rotor's reach, and the room or depth of a point takes ten times as long as its distance.
_BLOCK = 256
# Least clearance that is added to separate rotors that overlap, beyond their greatest depth: in
# pitch radii, and as a share of this depth. It is trebled until they are apart.
_STEP, _SHARE = 3e-8, 1e-2
# Number of angles of rotor 1 over a quarter of a lobe pitch in the search for an overlap.
_FINE = 361
# Number of angles of rotor 1 over one lobe pitch. It is a multiple of 4, so that the poses in which
# the pitch crossings touch are included.
_PLAY_POSES = 96


class Play(eqx.Module):
    """Relative rotations ε = φ2 - φ1 (rad) at which the flanks touch, with rotor 1 held at φ1.

    `phi` (n,): φ1 (rad). `behind`, `ahead` (n,): least and greatest ε without contact. If rotor 2
    is behind, rotor 1 pushes it; if it is ahead, it pushes rotor 1. `pitch_radius`: r (m).

    `overlap`: greatest depth (m), along the normal, by which the rotors overlap at ε = 0;
    `overlap_at`: φ1 (rad) there. No rotation moves a tip out of a root. With an overlap, `behind`
    and `ahead` are therefore computed with the least additional clearance that removes it. Each is
    then moved inwards by this clearance over the greatest lever. They are continuous in the
    overlap."""

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

    def greatest(self, points, angle, measure):
        """Return the greatest values (k,) of a `measure` of the points in reach of rotor 2, and
        their indices (k,).

        `measure` returns the values (k, n) of n points; those out of reach have its least value."""
        blocks = jnp.pad(points, (0, -len(points) % _BLOCK), mode="edge").reshape(-1, _BLOCK)
        away = jnp.abs(jnp.exp(1j * angle) * blocks - self.distance)
        near = jnp.any(away <= jnp.max(jnp.abs(self.flank.point)), axis=1)
        order = jnp.argsort(~near)

        def among(k):
            values = measure(blocks[order[k]])
            return jnp.max(values, axis=1), order[k] * _BLOCK + jnp.argmax(values, axis=1)

        def greater(k, best):
            one = among(k)
            return tuple(jnp.where(one[0] > best[0], *pair) for pair in zip(one, best, strict=True))

        return lax.fori_loop(1, jnp.sum(near), greater, among(0))

    def places(self, points, angle):
        """Return the indices (2,) of the points with the least room on each side.

        The first and the last point are left out, because they lack a neighbour."""
        _, places = self.greatest(points, angle, lambda some: -self.rooms(some, angle))
        return jnp.clip(places, 1, len(points) - 2)

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
            return still.greatest(points, angle, lambda some: still.depth(some, angle)[None])

        depth, place = lax.map(at, phi)
        pose = jnp.argmax(depth)
        return self.depth(self.points(0.0)[place[pose, 0]], phi[pose]), phi[pose]


def play(
    profile: Profile,
    clearance: Float[Array, ""],
    center_distance: Float[Array, ""] | None = None,
    phi: Float[Array, " n"] | None = None,
    radial: Float[Array, ""] | None = None,
) -> Play:
    """Return the play of rotor 2 over the rotation.

    `clearance` (m): distance added to every flank gap, along the normal. `center_distance` (m): by
    default that of perfect rolling, 2r. `phi` (n,): angles of rotor 1 (rad), by default
    `_PLAY_POSES` of them over one lobe pitch. `radial` (m): radius by which both rotors are smaller
    everywhere."""
    lobes, r = profile.lobes, profile.pitch_radius
    distance = 2 * r if center_distance is None else center_distance
    if phi is None:
        phi = 2 * jnp.pi / lobes * jnp.arange(_PLAY_POSES) / _PLAY_POSES
    flank = sampled_flank(profile, _PLAY_POINTS)
    if radial is not None:
        flank = flank._replace(point=flank.point * (1 - radial / jnp.abs(flank.point)))
    pair = _Pair(flank, both_flanks(flank), clearance, distance, lobes)

    # The place of each limit is found without derivatives; three neighbouring points give its
    # value.
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
    # The gap of conjugate flanks is smooth. Others may overlap between the sampled poses.
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
