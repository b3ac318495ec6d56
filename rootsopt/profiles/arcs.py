"""Addenda of tangent circular arcs, and the families made of them.

Except for the single arc, the sources' own formulas were not available. Each construction is
derived from the family's name and description, as its docstring states.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from rootsopt.config.units import hint
from rootsopt.errors import InputError
from rootsopt.profiles import base as trig
from rootsopt.profiles.base import Profile, Segment

if TYPE_CHECKING:
    from rootsopt.config.rotor import ProfileConfig

SHARPEST = 0.002
"""Edge radius (pitch radii) below which a config is rejected. On a sharper edge, nodes of the
outline and of the contact would coincide."""


def check(profile: "ProfileConfig") -> None:
    """Raise `InputError` if the edge radius is below `SHARPEST` pitch radii."""
    edge: Any = profile.parameters["edge_radius_mm"]
    least = SHARPEST * profile.pitch_radius_mm
    if edge < least:
        raise InputError(
            f"`profile.edge_radius_mm` must be at least {least:g} ({SHARPEST:g} pitch radii), but "
            f"is {edge:g}: the contact law does not apply to a sharp edge; round it"
            + hint("edge_radius_mm", edge, 0.01 * profile.pitch_radius_mm, profile.pitch_radius_mm)
        )


class Arcs(Profile):
    """An addendum of n circular arcs, with its envelope on the partner as the conjugate dedendum.

    On the arc with centre C and radius ρ, the point with normal direction ν is C + ρ n(ν). Its
    support function is C·n + ρ, and the lever of its normal is C × n. The normal meets the pitch
    circle where sin(ν - β) = lever / r, and s = support - r cos(ν - β).

    `center` (n, 2) and `radius` (n,): centres and radii of the arcs (m), in the rotor frame with
    the lobe's axis on +x. `joints` (n + 1,): normal angles (rad) from the tip, 0, to the pitch
    crossing. `names`: names of the arcs. `land`: whether the first arc is centred on the rotor's
    axis. `lobes`: number of lobes N; `pitch_radius`: r (m).
    """

    lobes: int = eqx.field(static=True)
    names: tuple[str, ...] = eqx.field(static=True)
    land: bool = eqx.field(static=True)
    pitch_radius: Float[Array, ""]
    center: Float[Array, "n 2"]
    radius: Float[Array, " n"]
    joints: Float[Array, " n+1"]

    cusp = False

    @classmethod
    def chain(
        cls,
        lobes: int,
        pitch_radius: Float[ArrayLike, ""],
        center: Float[ArrayLike, ""] | None,
        radii: Sequence[Float[ArrayLike, ""]],
        joints: Sequence[Float[ArrayLike, ""]],
        names: Sequence[str],
    ) -> "Arcs":
        """Return n tangent arcs from the tip to the pitch crossing.

        `lobes`: number of lobes N; `pitch_radius`: r (m). `center`: distance (m) of the first arc's
        centre from the rotor's axis, along the lobe's axis; `None`: the first arc is a land.
        `radii` (n - 1,): radii (m) of all arcs except the last. `joints` (n - 1,): normal angles
        (rad) at which these arcs end. The last arc's radius follows from the pitch crossing.
        `names` (n,): names of the arcs."""
        r = jnp.asarray(pitch_radius)
        half = jnp.pi / (2 * lobes)
        crossing = r * jnp.stack([jnp.cos(half), jnp.sin(half)])
        place = jnp.stack([jnp.asarray(0.0 if center is None else center), jnp.zeros_like(r)])
        centers, all_radii = [place], list(map(jnp.asarray, radii))
        for k, joint in enumerate(joints):
            normal = jnp.stack([jnp.cos(joint), jnp.sin(joint)])
            if k + 1 == len(radii):
                # The last arc: |X - C| = ρ at the crossing X, with C on the normal of the joint.
                to = crossing - centers[-1] - all_radii[-1] * normal
                all_radii.append(-jnp.dot(to, to) / (2 * jnp.dot(to, normal)))
            centers.append(centers[-1] + (all_radii[k] - all_radii[k + 1]) * normal)
        if not radii:
            all_radii.append(jnp.linalg.norm(crossing - place))
        x, y = crossing - centers[-1]
        stop = jnp.arctan2(y, x)
        return cls(
            lobes=lobes,
            names=tuple(names),
            land=center is None,
            pitch_radius=r,
            center=jnp.stack(centers),
            radius=jnp.stack(all_radii),
            joints=jnp.stack([jnp.zeros_like(r), *map(jnp.asarray, joints), stop]),
        )

    def segments(self) -> tuple[Segment, ...]:
        ends = zip(self.names, self.joints[:-1], self.joints[1:], strict=True)
        return tuple(
            Segment(name, start, stop, self.land and place == 0)
            for place, (name, start, stop) in enumerate(ends)
        )

    def stretches(self) -> tuple[Segment, ...]:
        parts: list[Segment] = []
        for segment, (x, y) in zip(self.segments(), self.center, strict=True):
            # The lever C × n is greatest where n is perpendicular to C.
            place = jnp.arctan2(lax.stop_gradient(x), -lax.stop_gradient(y)) % jnp.pi
            parts += (segment,) if segment.land else self._cut(segment, place)
        return tuple(parts)

    def _arc(self, nu):
        """Return the index of the arc that has the normal angle `nu` (rad).

        Below the first joint and above the last, return the index of the first or the last arc."""
        return jnp.sum(nu[..., None] > self.joints[1:-1], axis=-1)

    def lever(self, nu):
        return self.lever_from(nu, trig.cos(nu), trig.sin(nu))

    def lever_from(self, nu, cos, sin):
        x, y = jnp.moveaxis(self.center[self._arc(nu)], -1, 0)
        return x * sin - y * cos

    def support(self, nu):
        arc = self._arc(nu)
        x, y = jnp.moveaxis(self.center[arc], -1, 0)
        return x * trig.cos(nu) + y * trig.sin(nu) + self.radius[arc]

    def roll_angle(self, nu):
        return nu - jnp.arcsin(self.lever(nu) / self.pitch_radius)

    def contact_distance(self, nu):
        lever = self.lever(nu)
        return self.support(nu) - jnp.sqrt(
            (self.pitch_radius - lever) * (self.pitch_radius + lever)
        )

    def normal_at(self, roll_angle):
        # The normals of an arc pass through its centre and the pitch point. Where the roll angle
        # turns back, the last arc that starts before `roll_angle` is nearest to the pitch point.
        begins = self.roll_angle(self.joints[1:-1])
        places = jnp.arange(1, begins.shape[0] + 1)
        begun = roll_angle[..., None] > begins
        arc = jnp.max(jnp.where(begun, places, 0), axis=-1, initial=0)
        r = self.pitch_radius
        pitch = r * jnp.stack([jnp.cos(roll_angle), jnp.sin(roll_angle)], axis=-1)
        reach = pitch - self.center[arc]
        # The normal points to the pitch point or away from it, to the side to which the arc's own
        # normals point.
        middle = (self.joints[arc] + self.joints[arc + 1]) / 2
        side = jnp.stack([jnp.cos(middle), jnp.sin(middle)], axis=-1)
        away = jnp.sum(reach * side, axis=-1, keepdims=True) < 0
        x, y = jnp.moveaxis(jnp.where(away, -reach, reach), -1, 0)
        return jnp.arctan2(y, x)


class EdgedArcs(Arcs):
    """Arcs of which the second is an edge that must not be too sharp."""

    def limit_margin(self):
        return self.radius[1] / self.pitch_radius - SHARPEST


def arc(lobes: int, pitch_radius: Float[ArrayLike, ""], arc_center: Float[ArrayLike, ""]) -> Arcs:
    """Return a lobe of one circular arc through both pitch crossings (literature: "single arc").

    `lobes`: number of lobes N; `pitch_radius`: r (m). `arc_center`: b (m), distance of the arc's
    centre from the rotor's axis, along the lobe's axis. The arc's radius is √(r² + b² - 2 r b cos
    π/2N)."""
    return Arcs.chain(lobes, pitch_radius, arc_center, (), (), ("arc",))


def four_arcs(
    lobes: int,
    pitch_radius: Float[ArrayLike, ""],
    arc_center: Float[ArrayLike, ""],
    tip_arc_radius: Float[ArrayLike, ""],
    tip_arc_turn: Float[ArrayLike, ""],
) -> Arcs:
    """Return a flank of four curves: two tangent arcs on the addendum, and their conjugates.

    `lobes`: number of lobes N; `pitch_radius`: r (m). The centre of the tip arc lies on the lobe's
    axis, at the distance `arc_center` b (m) from the rotor's axis. The tip arc has the radius
    `tip_arc_radius` ρ (m) and ends at the normal angle `tip_arc_turn` (rad). The flank arc
    continues to the pitch crossing, which determines the flank arc's radius. If ρ is the radius of
    the single arc (`arc`), both arcs lie on one circle.
    """
    names = ("tip arc", "flank arc")
    return Arcs.chain(lobes, pitch_radius, arc_center, (tip_arc_radius,), (tip_arc_turn,), names)


def five_arcs(
    lobes: int,
    pitch_radius: Float[ArrayLike, ""],
    outer_radius: Float[ArrayLike, ""],
    tip_arc_angle: Float[ArrayLike, ""],
    tip_arc_radius: Float[ArrayLike, ""],
    tip_arc_turn: Float[ArrayLike, ""],
) -> Arcs:
    """Return a lobe of five tangent arcs: a tip land, and on each side a tip arc and a flank arc.

    `lobes`: number of lobes N; `pitch_radius`: r (m). The land has the half angle `tip_arc_angle`
    θ1 (rad) and the radius `outer_radius` (m). The tip arc has the radius `tip_arc_radius` (m) and
    ends at the normal angle `tip_arc_turn` (rad). The flank arc continues to the pitch crossing,
    which determines the flank arc's radius.
    """
    names = ("tip land", "tip arc", "flank arc")
    radii, joints = (outer_radius, tip_arc_radius), (tip_arc_angle, tip_arc_turn)
    return Arcs.chain(lobes, pitch_radius, None, radii, joints, names)


def arcs_epicycloid(
    lobes: int,
    pitch_radius: Float[ArrayLike, ""],
    arc_center: Float[ArrayLike, ""],
    tip_arc_angle: Float[ArrayLike, ""],
    edge_radius: Float[ArrayLike, ""],
) -> EdgedArcs:
    """Return a lobe of a single arc, cut off by a tip land with rounded edges.

    `lobes`: number of lobes N; `pitch_radius`: r (m). The single arc is that of `arc`: its centre
    is at the distance `arc_center` b (m) from the axis, and its radius is ρ. The land has the half
    angle `tip_arc_angle` θ1 (rad). The edge between arc and land is an arc of radius `edge_radius`
    e (m), tangent to both. The edge's centre lies on the ray θ1, at the distance d from the axis:

        d = b cos θ1 ± √((ρ - e)² - b² sin² θ1).

    The sign is + for e < ρ. For e > ρ it is -, and the outline turns back. The outer radius is
    d + e.

    The centre of the edge traces an extended epicycloid on the partner. The edge generates the
    parallel curve at the distance e from this epicycloid. The parallel curve joins the conjugates
    of land and arc.

    If the centre of the edge lies outside the pitch circle (d > r), its contact moves backwards:
    sin(ν - β) = (d / r) sin(ν - θ1) gives dβ/dν = 1 - d cos(ν - θ1) / (r sin ψ) < 0. The dedendum
    is not undercut, because its arc length per ν, (r sin ψ - 2 s) dβ/dν + s, stays positive.
    However, edge and arc then mesh at the same time, and carry the gas trapped between them to the
    other side. An edge with d ≤ r has no such carryover. Its radius is at least the tip's height
    above the pitch circle. These formulas are derived here, not taken from a source.
    """
    r = jnp.asarray(pitch_radius)
    b, theta, e = jnp.asarray(arc_center), jnp.asarray(tip_arc_angle), jnp.asarray(edge_radius)
    half = jnp.pi / (2 * lobes)
    zero = jnp.zeros_like(r)
    away, across = r * jnp.cos(half) - b, r * jnp.sin(half)
    radius = jnp.sqrt(away**2 + across**2)
    side = jnp.sign(radius - e)
    reach = b * jnp.cos(theta) + side * jnp.sqrt((radius - e) ** 2 - (b * jnp.sin(theta)) ** 2)
    edge = reach * jnp.stack([jnp.cos(theta), jnp.sin(theta)])
    turn = jnp.arctan2(side * edge[1], side * (edge[0] - b))
    return EdgedArcs(
        lobes=lobes,
        names=("tip land", "edge", "arc"),
        land=True,
        pitch_radius=r,
        center=jnp.stack([jnp.zeros(2), edge, jnp.stack([b, zero])]),
        radius=jnp.stack([reach + e, e, radius]),
        joints=jnp.stack([zero, theta, turn, jnp.arctan2(across, away)]),
    )
