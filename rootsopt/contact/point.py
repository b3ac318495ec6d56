"""Position of the closest approach on the flanks, for friction and elastic supports."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from rootsopt.contact.closest import ClosestApproach, FlankPair


class ContactPoint(NamedTuple):
    """Position and direction of a flank contact.

    n is the common normal, directed from rotor 1 to rotor 2; O1 and O2 are the axes.
    `support1`: (P - O1)·n (m), where P is the point of contact.
    `support2`: (O2 - P)·n (m).
    `radial`: component of n along the line of centres.
    """

    support1: Float[Array, ""]
    support2: Float[Array, ""]
    radial: Float[Array, ""]


def contact_point(
    pair: FlankPair, roll: Float[Array, ""], relative: Float[Array, ""], found: ClosestApproach
) -> ContactPoint:
    """Return position and direction of a contact, given the closest approach `found`.

    `pair`: the flanks; `roll`, `relative`: x and ε (rad) at which `found` was computed."""
    folded, mirrored = pair.folded(roll)
    support1, support2, radial = pair.supports_along(found.normal1, found.normal2, folded, relative)
    return ContactPoint(
        support1=jnp.where(mirrored, support2, support1),
        support2=jnp.where(mirrored, support1, support2),
        radial=radial,
    )
