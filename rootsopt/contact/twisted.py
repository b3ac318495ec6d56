"""Contact of twisted rotors: the section's contact, at several places along the axis."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rootsopt.contact.gap import Contact, Slices
from rootsopt.contact.wrapped import WrappedContact


class TwistedContact(WrappedContact):
    """The contact of a section, with the Gauss points along the length of twisted rotors.

    Gap, levers and point are those of the `section`, an untwisted contact; the rotor pair evaluates
    it once per slice. `twist` (rad): angle from the section at the near end of a rotor to that at
    the far end, positive in the rotor's own sense of rotation. `count`: number n of slices.

    Let u be the distance of a slice from the middle, as a share of the length, -1/2 ≤ u ≤ 1/2. Its
    pose is φ1 + Φ u, φ2 + Φ u, with the twist Φ. Gauss-Legendre quadrature integrates polynomials
    in u up to the degree 2n - 1 exactly."""

    section: Contact
    twist: Float[Array, ""]
    count: int = eqx.field(static=True)

    @property
    def sections(self) -> int:
        return self.count

    @property
    def slices(self) -> Slices:
        return slices_of(self.twist, self.count)


def slices_of(twist: Float[Array, ""], count: int) -> Slices:
    """Return `count` Gauss points along rotors with the `twist` (rad) over their length."""
    nodes, weights = np.polynomial.legendre.leggauss(count)
    places = jnp.asarray(nodes / 2, twist.dtype)
    return Slices(places, jnp.asarray(weights / 2, twist.dtype), twist * places, twist)
