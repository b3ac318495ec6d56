"""Timescales of a rotor pair, from which the solver's first and longest steps follow."""

from collections.abc import Iterable

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from rootsopt.contact.law import ContactLaw
from rootsopt.dynamics.parts import Part


class Timescales(eqx.Module):
    """Timescales of the fastest oscillation and of free flight.

    `swing`: 1/ω (s), where ω is the angular frequency of the fastest oscillation: of rotor 2 on
    flank and timing gear, or of another part; `fall`: time (s) in which the load closes the whole
    backlash of the timing gear; `free`: |ε| (rad) below which the clearance keeps the flanks apart
    at the nominal centre distance. If the backlash is at most the rotation at static penetration,
    there is no free flight, and `fall` is infinite.
    """

    swing: Float[Array, ""]
    fall: Float[Array, ""]
    free: Float[Array, ""]

    @classmethod
    def of(
        cls,
        law: ContactLaw,
        parts: Iterable[Part],
        inertia: Float[Array, ""],
        force: Float[Array, ""],
        radius: Float[Array, ""],
        clearance: Float[Array, ""],
    ) -> "Timescales":
        """Return the timescales of a pair, without derivatives.

        `law`: contact law; `parts`: all parts of the scene; `inertia` (kg·m²) of one rotor; `force`
        (N): static flank force at the pitch `radius` (m); `clearance` (m) of the flanks. The
        contact stiffness is taken at the greater of two depths: the static penetration, and the
        penetration of an impact after free flight through the whole backlash. The energy of this
        impact is the work of the load."""
        parts = tuple(parts)
        play = jnp.zeros_like(force)
        for part in parts:
            play = play if part.play is None else play + 2 * part.play
        static = law.depth_at(force)
        deepest = jnp.maximum(static, law.depth_absorbing(force * radius * play))
        stiffness = radius**2 * law.stiffness_at(deepest)
        for part in parts:
            holding = part.holding_stiffness
            stiffness = stiffness if holding is None else stiffness + holding
        flies = play > static / radius
        fall = jnp.sqrt(2 * jnp.where(flies, play, 1.0) * inertia / (force * radius))
        swing = jnp.sqrt(inertia / stiffness)
        for part in parts:
            own = part.quickest(inertia)
            swing = swing if own is None else jnp.minimum(swing, own)
        # No lever is longer than the pitch radius.
        free = jnp.maximum(clearance, 0.0) / radius
        found = cls(swing, jnp.where(flies, fall, jnp.inf), free)
        return lax.stop_gradient(found)
