"""Laminar flow through narrow gaps: Reynolds' equation without the motion of the walls."""

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
