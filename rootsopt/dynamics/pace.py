"""How quickly a rotor pair can change, from which first and longest steps of a solver follow."""

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from rootsopt.contact.impact import ImpactLaw
from rootsopt.dynamics.parts import Supports, TimingGear


class Pace(eqx.Module):
    """Times (s) of the quickest swing and of free flight.

    `swing`: in which the phase of rotor 2's swing on flank and timing gear, or that of a rotor on
    its supports, advances by one radian; `fall`: from one end of the gear's play to the other under
    the load, infinite where the play is less than the static penetration and the pair never flies.
    `free`: |ε| (rad) below which the clearance keeps the flanks apart at the nominal centre
    distance.
    """

    swing: Float[Array, ""]
    fall: Float[Array, ""]
    free: Float[Array, ""]

    @classmethod
    def of(
        cls,
        law: ImpactLaw,
        gear: TimingGear | None,
        supports: Supports | None,
        inertia: Float[Array, ""],
        force: Float[Array, ""],
        radius: Float[Array, ""],
        clearance: Float[Array, ""],
    ) -> "Pace":
        """Pace of a pair whose flanks carry the static `force` (N) at the pitch `radius` (m).

        The contact is as stiff as at the static depth, or at that of an impact after a fall
        through the play if this is deeper (its energy is the work of the load).
        """
        none = jnp.zeros_like(force)
        play = none if gear is None else 2 * gear.half_backlash
        e = law.exponent
        static = law.depth_at(force)
        impact = ((e + 1) * force * radius * play / law.stiffness) ** (1 / (e + 1))
        deepest = jnp.maximum(static, impact)
        stiffness = radius**2 * e * law.stiffness * deepest ** (e - 1)
        stiffness += none if gear is None else gear.stiffness
        flies = play > static / radius
        fall = jnp.sqrt(2 * jnp.where(flies, play, 1.0) * inertia / (force * radius))
        swing = jnp.sqrt(inertia / stiffness)
        if supports is not None:
            swing = jnp.minimum(swing, jnp.sqrt(supports.mass / supports.stiffness))
        # No lever is longer than the pitch radius.
        free = jnp.maximum(clearance, 0.0) / radius
        found = cls(swing, jnp.where(flies, fall, jnp.inf), free)
        return lax.stop_gradient(found)
