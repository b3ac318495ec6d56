"""Laminar flow through narrow gaps: Reynolds' equation without the motion of the walls."""

import jax.numpy as jnp
from jaxtyping import Array, Float


def slot_flow(
    height: Float[Array, "*n"],
    length: Float[Array, "*n"],
    pressure: Float[Array, ""],
    viscosity: Float[Array, ""],
) -> Float[Array, "*n"]:
    """Return the flow (m²/s) per width through slots, h³ Δp / (12 μ L).

    `height`: h (m); `length`: L (m) along the flow; `pressure`: Δp (Pa); `viscosity`: μ (Pa·s)."""
    return height**3 * pressure / (12 * viscosity * length)


def parabolic_length(
    height: Float[Array, "*n"], curvature: Float[Array, "*n"]
) -> Float[Array, "*n"]:
    """Return the length (m) of a slot with the same laminar flow as a parabolic gap.

    The gap's height is h + x²/2R, and the length is h³ ∫ dx / (h + x²/2R)³ = (3π/8) √(2 R h).
    `height`: least height h (m); `curvature`: 1/R (1/m), greater than 0."""
    return 3 * jnp.pi / 8 * jnp.sqrt(2 * height / curvature)
