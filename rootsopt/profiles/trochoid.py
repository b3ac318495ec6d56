"""Extended cycloid with a variable trochoid ratio."""

import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Float

from rootsopt.profiles.curve import Curve, RollPiece


def extended_cycloid(
    lobes: int, pitch_radius: Float[ArrayLike, ""], trochoid_ratio: Float[ArrayLike, ""]
) -> Curve:
    """Return an epicycloid traced by a point at varying distance from the rolling circle's centre.

    `lobes`: number of lobes N; `pitch_radius`: r (m). With r_e = r / 2N the curve is P(θ) = e^{iθ}
    [r + r_e + λ(θ) r_e e^{2iNθ}]. It runs from the tip (θ = 0) to the pitch crossing (θ = π/2N).
    The ratio λ varies from `trochoid_ratio` λ0 at the tip to 1 at the crossing: λ = 1 + (λ0 - 1) u³
    (10 - 15 u + 6 u²) with u = 1 - 2Nθ/π. This quintic has zero first and second derivatives at
    both ends. The idea comes from Hsieh and Hwang (J. Mech. Des. 129 (2007) 1278), whose own
    formulas were not available. λ0 = 1 gives EE. The outer radius is r + (1 + λ0) r_e.

    The crossing is a cusp: dP/dθ vanishes in proportion to δ = π/2N - θ. The formula of the normal
    is therefore divided by δ. In the frame turned by θ, with w = e^{-2iNδ} and M = |X δ + iY|, the
    normal is (X δ + iY) / M. Here,

        X δ + iY = (r + r_e) (1 - λ w) / δ + i r_e w λ′ / δ.

    The normal makes the angle η = arctan(X δ / Y) with the tangent of the pitch circle at θ. For a
    constant λ the normal passes through the pitch point at θ, and ψ = η. Otherwise it misses this
    point by e = r_e² λ′ (cos 2Nδ - λ) / (δ M), and cos ψ = cos η + e / r. Hence sin²(ψ/2) =
    sin²(η/2) - e / 2r, of second order in δ, and β = θ - η + ψ. These formulas are derived here,
    not taken from a source."""
    r, ratio = jnp.asarray(pitch_radius), jnp.asarray(trochoid_ratio)
    half, n = jnp.pi / (2 * lobes), lobes
    rolling = r / (2 * lobes)

    def roll(t):
        u = 1 - t
        delta = half * u
        # (λ - 1) / δ² and λ′ / δ.
        beyond = (ratio - 1) * u * (10 - 15 * u + 6 * u**2) / half**2
        steepness = -(ratio - 1) * 30 * u * t**2 / half**2
        here = 1 + beyond * delta**2
        # sin(Nδ) / δ and sin(2Nδ) / δ, and (1 - λ cos 2Nδ) / δ².
        single, double = n * jnp.sinc(u / 2), 2 * n * jnp.sinc(u)
        open_ = 2 * single**2 - beyond * jnp.cos(2 * n * delta)
        x = (r + rolling) * open_ + rolling * steepness * double
        y = (r + rolling) * here * double + rolling * steepness * jnp.cos(2 * n * delta)
        length = jnp.sqrt(y**2 + (x * delta) ** 2)
        miss = -(rolling**2) * steepness * (2 * single**2 + beyond) / length
        square = x**2 / (2 * length * (length + y)) - miss / (2 * r)
        psi = 2 * jnp.arcsin(delta * jnp.sqrt(square))
        return jnp.stack([half * t - jnp.arctan2(x * delta, y) + psi, psi])

    return Curve.of(lobes, r, [RollPiece("extended cycloid", roll)], sharp=True)
