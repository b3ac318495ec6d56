"""Fluid, pressures and clearances of a pump: the quantities on which only leakage depends."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from rootsopt.config import Config
from rootsopt.config.units import MM

# One millipascal-second (Pa·s).
_MPA_S = 1e-3


class Gas(eqx.Module):
    """An ideal gas: `inlet_pressure` (Pa), `temperature` (K), `gas_constant` (J/(kg·K)) and
    `heat_ratio`, the ratio of its specific heats."""

    inlet_pressure: Float[Array, ""]
    temperature: Float[Array, ""]
    gas_constant: Float[Array, ""]
    heat_ratio: Float[Array, ""]


class Medium(eqx.Module):
    """What leakage needs beyond a simulation, in SI units.

    `viscosity` (Pa·s); `pressure_difference` (Pa), discharge minus suction. `tip_clearance`,
    `end_clearance` (m), `None`: no leakage there; `tips`: tips that seal in series.
    `radial_allowance` (m): radius by which both rotors are smaller everywhere. `strain`: growth of
    the housing minus that of the rotors, as a fraction of any length; `None`: all have the same
    temperature. `gas`: `None` for a liquid."""

    viscosity: Float[Array, ""]
    pressure_difference: Float[Array, ""]
    tip_clearance: Float[Array, ""] | None
    end_clearance: Float[Array, ""] | None
    radial_allowance: Float[Array, ""]
    strain: Float[Array, ""] | None
    gas: Gas | None
    tips: int = eqx.field(static=True)


def medium_of(config: Config) -> Medium | None:
    """Return the medium of a config; `None` if it has no section `pump`."""
    pump = config.pump
    if pump is None:
        return None
    gas, across = pump.gas, pump.pressure_difference_Pa
    wear, heat, tip = config.contact.wear, config.scene.heat, pump.tip_clearance_mm
    if wear is not None and tip is not None:
        tip = tip + wear.offset_mm
    assert across is not None
    return Medium(
        viscosity=jnp.asarray(pump.viscosity_mPa_s * _MPA_S),
        pressure_difference=jnp.asarray(across),
        tip_clearance=_optional(tip, MM),
        end_clearance=_optional(pump.end_clearance_mm, MM),
        radial_allowance=jnp.asarray(pump.radial_allowance_mm * MM),
        strain=None if heat is None else jnp.asarray(heat.strain),
        gas=None
        if gas is None
        else Gas(
            inlet_pressure=jnp.asarray(gas.inlet_pressure_Pa),
            temperature=jnp.asarray(gas.temperature_K),
            gas_constant=jnp.asarray(gas.gas_constant_J_per_kg_K),
            heat_ratio=jnp.asarray(gas.heat_ratio),
        ),
        tips=pump.tips_in_series,
    )


def _optional(value: float | None, unit: float = 1.0) -> Float[Array, ""] | None:
    return None if value is None else jnp.asarray(value * unit)
