"""Ellipse: an elliptic arc and its conjugate envelope."""

import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Float

from rootsopt.profiles.curve import Curve, Piece


def ellipse(
    lobes: int,
    pitch_radius: Float[ArrayLike, ""],
    ellipse_center: Float[ArrayLike, ""],
    ellipse_height: Float[ArrayLike, ""],
) -> Curve:
    """Return a lobe formed by an arc of an ellipse through both pitch crossings.

    `lobes`: number of lobes N; `pitch_radius`: r (m). `ellipse_center`: b (m), distance of the
    ellipse's centre from the rotor's axis, along the lobe's axis. `ellipse_height`: A (m),
    semi-axis along the lobe's axis. The other semi-axis B follows from the pitch crossings:
    (r cos π/2N - b)² / A² + (r sin π/2N)² / B² = 1. If A = B, the lobe is a single circular arc."""
    center, height = ellipse_center, ellipse_height
    r, half = jnp.asarray(pitch_radius), jnp.pi / (2 * lobes)
    x, y = (r * jnp.cos(half) - center) / height, r * jnp.sin(half)
    stop = jnp.arccos(x)
    width = y / jnp.sin(stop)

    def position(t):
        angle = stop * t
        return jnp.stack([center + height * jnp.cos(angle), width * jnp.sin(angle)])

    return Curve.of(lobes, r, [Piece("ellipse", position)])
