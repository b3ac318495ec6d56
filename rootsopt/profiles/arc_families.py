"""Families of tangent circular arcs: one arc, four arcs, five arcs, one arc with a rounded edge.

Except for the single arc, the sources' own formulas were not available. Each construction is
derived from the family's name and description, as its docstring states.
"""

import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Float

from rootsopt.profiles.arcs import Arcs
from rootsopt.profiles.edge import SHARPEST


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
