"""Families of tangent circular arcs: one, four and five, with their conjugate envelopes.

The sources' own formulas for four and five arcs were not at hand: what is made of them here is a
derivation from their names and figures' descriptions, stated with each.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from rootsopt.profiles.arcs import Arcs


def arc(lobes: int, pitch_radius: Float[Array, ""], center: Float[Array, ""]) -> Arcs:
    """The lobe is one circular arc through both pitch crossings, with its `center` b (m) on the
    lobe's axis: its radius is √(r² + b² - 2 r b cos π/2N). (The single arc of the literature.)"""
    return Arcs.chain(lobes, pitch_radius, jnp.asarray(center), (), (), ("arc",))


def four_arcs(
    lobes: int,
    pitch_radius: Float[Array, ""],
    center: Float[Array, ""],
    tip_radius: Float[Array, ""],
    turn: Float[Array, ""],
) -> Arcs:
    """Four curves a flank: two tangent arcs on the addendum, and their conjugates.

    The tip arc has its `center` b (m) on the lobe's axis and the radius `tip_radius` ρ (m), and
    ends at the normal angle `turn` (rad). The flank arc goes on from there through the pitch
    crossing, which gives its radius. With ρ that of `arc` the two are one.
    """
    names = ("tip arc", "flank arc")
    return Arcs.chain(lobes, pitch_radius, jnp.asarray(center), (tip_radius,), (turn,), names)


def five_arcs(
    lobes: int,
    pitch_radius: Float[Array, ""],
    outer_radius: Float[Array, ""],
    land: Float[Array, ""],
    tip_radius: Float[Array, ""],
    turn: Float[Array, ""],
) -> Arcs:
    """Five arcs a lobe: a tip land, and on either side a tip arc and a flank arc, all tangent.

    The land of half angle `land` θ1 (rad) lies at the `outer_radius` (m); the tip arc has the
    radius `tip_radius` (m) and ends at the normal angle `turn` (rad); the flank arc goes on
    through the pitch crossing.
    """
    names = ("tip land", "tip arc", "flank arc")
    radii, joints = (outer_radius, tip_radius), (land, turn)
    return Arcs.chain(lobes, pitch_radius, 0.0, radii, joints, names)
