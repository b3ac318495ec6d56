"""Leakage of an ideal gas: nozzle flow, compressible laminar flow, and their limits."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from rootsopt.scene.medium import Gas

CONTINUUM = 0.01
"""Knudsen number above which gas slips at the walls, so that it leaks more than the laminar formula
states.
"""
MOLECULAR = 1.0
"""Knudsen number above which molecules meet the walls more often than each other. The formulas of
this module do not hold there."""


def critical_ratio(heat_ratio: Float[Array, ""]) -> Float[Array, ""]:
    """Return the pressure ratio below which a nozzle is choked, (2 / (κ + 1))^(κ / (κ - 1)).

    `heat_ratio`: κ."""
    return (2 / (heat_ratio + 1)) ** (heat_ratio / (heat_ratio - 1))


def nozzle_flux(
    upstream: Float[Array, "*n"], downstream: Float[Array, "*n"], gas: Gas
) -> Float[Array, "*n"]:
    """Return the mass flow (kg/(s·m²)) per area of an ideal nozzle (Saint-Venant and Wantzel).

    `upstream`, `downstream`: pressures (Pa), the former greater; `gas`: its temperature is the one
    upstream."""
    k = gas.heat_ratio
    ratio = jnp.maximum(downstream / upstream, critical_ratio(k))
    expansion = jnp.maximum(ratio ** (2 / k) - ratio ** ((k + 1) / k), 0.0)
    # The slope of a root is infinite where there is no pressure difference.
    moving = expansion > 0
    speed = jnp.sqrt(2 * k / (k - 1) * jnp.where(moving, expansion, 1.0))
    density = upstream / jnp.sqrt(gas.gas_constant * gas.temperature)
    return jnp.where(moving, density * speed, 0.0)


def laminar_mass_flow(
    height: Float[Array, "*n"],
    length: Float[Array, "*n"],
    upstream: Float[Array, ""],
    downstream: Float[Array, ""],
    viscosity: Float[Array, ""],
    gas: Gas,
) -> Float[Array, "*n"]:
    """Return the isothermal laminar mass flow (kg/(s·m)) per width of slots.

    h³ (p1² - p2²) / (24 μ R T L): the slot's flow with the density at the mean pressure.
    `height`: h (m); `length`: L (m); `upstream`, `downstream`: p1, p2 (Pa); `viscosity`: μ (Pa·s);
    `gas`: gives R T."""
    driven = (upstream**2 - downstream**2) / (gas.gas_constant * gas.temperature)
    return height**3 * driven / (24 * viscosity * length)


def mean_free_path(
    pressure: Float[Array, ""], viscosity: Float[Array, ""], gas: Gas
) -> Float[Array, ""]:
    """Return the mean free path (m) of the molecules, (μ/p) √(π R T / 2) (Maxwell).

    `pressure`: p (Pa); `viscosity`: μ (Pa·s)."""
    return viscosity / pressure * jnp.sqrt(jnp.pi / 2 * gas.gas_constant * gas.temperature)
