"""A closed orbit together with its variation: how the whole motion changes with parameters.

Quantities that the closing of an orbit does not compute follow from it with their derivatives:
local maxima of the force, and loads on bearings."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from rootsopt.dynamics.collocation.elements import Elements
from rootsopt.dynamics.collocation.gauss import GAUSS
from rootsopt.dynamics.collocation.system import Step, moved_at
from rootsopt.dynamics.steady import Steady


class VariedOrbit(NamedTuple):
    """A closed orbit, and its changes along d directions of the parameters.

    `elements`: the orbit; `variation`: its changes, one column for each direction."""

    elements: Elements
    variation: Step

    def at(
        self, tau: Float[Array, "*m"]
    ) -> tuple[Float[Array, "*m n"], Float[Array, "*m n"], Float[Array, "*m n d"]]:
        """Return the scaled states at the times `tau` (mesh periods), and their derivatives with
        respect to time and along the directions.

        The orbit continues periodically. Derivatives along the directions are those at constant
        time."""
        elements = self.elements
        k, tau = elements.holding(tau)
        share = elements.share(k, tau)
        rate = jnp.sum(GAUSS.lagrange(share)[..., None] * elements.slopes[k], axis=-2)
        times, moved = moved_at(elements, self.variation, k, share)
        return elements.inside(k, tau), rate, moved - rate[..., None] * times[..., None, :]


def varied(found: Steady) -> VariedOrbit:
    """Return the closed orbit of a motion, with its variation.

    The motion must have been found with `Solver.variation`."""
    assert found.orbit.variation is not None
    return VariedOrbit(found.known.elements, found.orbit.variation)
