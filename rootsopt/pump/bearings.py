"""Loads on the bearings: force of the timing gear, equivalent load.

Forces are complex numbers, x + iy, in the fixed frame: rotor 1 at the origin, rotor 2 at (2r, 0).
Rotor 1 turns counter-clockwise. `docs/bearings.md` derives the formulas.
"""

import jax.numpy as jnp
from jaxtyping import Array, Complex, Float, Inexact

BALL, ROLLER = 3.0, 10 / 3
"""Exponents of the life of ball and roller bearings (ISO 281)."""


def gear_force(
    torque: Float[Array, "*n"], radius: Float[Array, ""], pressure_angle: Float[Array, ""]
) -> Complex[Array, "*n"]:
    """Return the force (N) of the timing gear's teeth on rotor 2; on rotor 1 it is the opposite.

    `torque` (N·m): torque that the gear passes on to rotor 2, in its sense of rotation; `radius`
    (m): pitch radius; `pressure_angle` (rad): of the teeth. The teeth press along their common
    normal: torque / radius upwards at the pitch point, and away from rotor 1."""
    across = torque / radius
    return 1j * across + jnp.abs(across) * jnp.tan(pressure_angle)


def equivalent_load(force: Inexact[Array, "*k n"], exponent: float = ROLLER) -> Float[Array, "*k"]:
    """Return the constant load (N) with the same bearing life, (mean |F|^p)^(1/p).

    `force` (…, n): loads (N) at equal steps of rotation; `exponent`: p."""
    return jnp.mean(jnp.abs(force) ** exponent, axis=-1) ** (1 / exponent)
