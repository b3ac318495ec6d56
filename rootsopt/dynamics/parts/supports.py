"""Bearings that give way."""

import equinox as eqx
from jaxtyping import Array, Float


class Supports(eqx.Module):
    """Each rotor, of `mass` (kg), on bearings with `stiffness` (N/m) and `damping` (N·s/m) in
    every direction across its axis, both bearings together. `unit` (m): displacements are counted
    in it."""

    stiffness: Float[Array, ""]
    damping: Float[Array, ""]
    mass: Float[Array, ""]
    unit: Float[Array, ""]

    def force(
        self, displacement: Float[Array, "*n"], velocity: Float[Array, "*n"]
    ) -> Float[Array, "*n"]:
        """Forces (N) on the rotors at displacements (m) and velocities (m/s) of their axes."""
        return -self.stiffness * displacement - self.damping * velocity
