"""Loads on the bearings: resultant of the gas pressure, force of the timing gear, equivalent load.

Forces are complex numbers, x + iy, in the fixed frame: rotor 1 at the origin, rotor 2 at (2r, 0).
Rotor 1 turns counter-clockwise. Gas is carried along the housing from suction, above, to discharge,
below. `docs/bearings.md` derives the formulas.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Complex, Float, Inexact

from rootsopt.dynamics.parts import resultants
from rootsopt.profiles import Geometry, Profile

PORT = 0.0
"""Default angle (rad) before the lowest point of the bore at which a pocket opens to discharge."""
BALL, ROLLER = 3.0, 10 / 3
"""Exponents of the life of ball and roller bearings (ISO 281)."""


def contact_place(profile: Profile, phi: Float[Array, "*n"]) -> Complex[Array, "*n"]:
    """Return the place (m) where the rotors touch, x + iy from the axis of rotor 1.

    `phi`: φ1 (rad)."""
    x, y = jnp.vectorize(lambda one: resultants.contact_place(profile, one), signature="()->(k)")(
        phi
    ).T
    return x + 1j * y


def gas_forces(
    profile: Profile,
    shape: Geometry,
    pressure_length: Float[Array, ""],
    phi: Float[Array, " n"],
    port: float = PORT,
) -> Complex[Array, "2 n"]:
    """Return the resultants (2, n) in N of the gas pressure on both rotors.

    `pressure_length`: Δp L (N/m); `phi` (n,): φ1 (rad); `port`: see `PORT`. Discharge pressure acts
    on a rotor's surface between the contact and the tip at the housing that passes the port next.
    The resultant is Δp L times the chord between the two, rotated by a right angle."""
    opening = jnp.asarray(port)
    gas = resultants.GasResultant(pressure_length, profile, shape.outer_radius, opening)
    found = jnp.sum(jax.vmap(gas.slice_forces)(phi), axis=1)
    return (found[..., 0] + 1j * found[..., 1]).T


def gas_moments(
    profile: Profile, shape: Geometry, pressure_length: Float[Array, ""], phi: Float[Array, " n"]
) -> Float[Array, "2 n"]:
    """Return the torques (2, n) in N·m with which the gas opposes both rotors, Δp L (r_a² - ρ²) /
    2.

    `pressure_length`: Δp L (N/m); `phi` (n,): φ1 (rad). ρ (m) is the distance of the contact from
    the rotor's axis."""
    contact = contact_place(profile, phi)
    away = jnp.abs(jnp.stack([contact, contact - 2 * profile.pitch_radius]))
    return pressure_length / 2 * (shape.outer_radius**2 - away**2)


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
