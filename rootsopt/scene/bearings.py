"""The rotors' bearings: their places, and their loads other than those of the flanks."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from rootsopt.config import Config
from rootsopt.config.units import DEG, MM

GRAVITY = 9.80665
"""Standard acceleration of free fall (m/s²)."""
# Exponents of the life of bearings (ISO 281).
_EXPONENTS = {"ball": 3.0, "roller": 10 / 3}


class Bearings(eqx.Module):
    """Two bearings per rotor, equally far from its end faces, and the gear beyond one.

    `tooth_angle` (rad): pressure angle of the timing gear; `port` (rad): angle before the lowest
    point of the bore at which a pocket opens to discharge; `distance` (m): of each bearing from the
    nearer end face; `gear_distance` (m): of the timing gear from the end face at z = L/2;
    `exponent`: p of the equivalent load, (mean |F|^p)^(1/p); `heavy`: whether the rotors' weight
    counts."""

    tooth_angle: Float[Array, ""]
    port: Float[Array, ""]
    distance: Float[Array, ""]
    gear_distance: Float[Array, ""]
    exponent: float = eqx.field(static=True)
    heavy: bool = eqx.field(static=True)


def bearings_of(config: Config) -> Bearings | None:
    """Return the bearings of a config; `None` if it has no section `scene.bearings`."""
    given = config.scene.bearings
    if given is None:
        return None
    return Bearings(
        tooth_angle=jnp.asarray(given.gear_pressure_angle_deg * DEG),
        port=jnp.asarray(given.port_deg * DEG),
        distance=jnp.asarray(given.bearing_distance_mm * MM),
        gear_distance=jnp.asarray(given.gear_distance_mm * MM),
        exponent=_EXPONENTS[given.kind],
        heavy=given.weight,
    )
