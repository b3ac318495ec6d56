"""Where on the flanks the closest approach is: what friction and supports need beside the gap."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from rootsopt.contact.closest import ClosestApproach, FlankPair


class ContactPoint(NamedTuple):
    """Place and direction of a flank contact.

    With the common normal n from rotor 1 to rotor 2 and the axes at O1, O2: `support1`,
    `support2` (m) are the distances of the contact from the axes along n, (P - O1)·n and
    (O2 - P)·n; `radial` is the part of n along the line of centres.
    """

    support1: Float[Array, ""]
    support2: Float[Array, ""]
    radial: Float[Array, ""]


def contact_point(
    pair: FlankPair, roll: Float[Array, ""], relative: Float[Array, ""], found: ClosestApproach
) -> ContactPoint:
    """The place of the closest approach `found` at x = `roll` and ε = `relative` (rad)."""
    folded, mirrored = pair.folded(roll)
    support1, support2, radial = pair.reach(found.normal1, found.normal2, folded, relative)
    return ContactPoint(
        support1=jnp.where(mirrored, support2, support1),
        support2=jnp.where(mirrored, support1, support2),
        radial=radial,
    )
