"""C² map of the flank gap over the pose: the fast rung.

The gap of `closest.FlankPair` is tabulated once per design on a uniform grid over roll
coordinate and relative rotation and interpolated by bicubic B-splines. Levers are the
derivatives of the interpolated gap itself, so forces still come from a potential. The
design derivative enters at the grid points, by the envelope theorem.
"""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float
from numpy.typing import NDArray

from rootsopt.contact.closest import FlankPair
from rootsopt.profiles.base import Profile

# Grid cells of ε beyond zero, so that the spline is in its interior where contact starts.
_MARGIN = 3


@functools.lru_cache(maxsize=32)
def _interpolation_matrix(count: int) -> NDArray[np.float64]:
    """Matrix (count + 2, count) from values at uniform knots to cubic B-spline
    coefficients, with not-a-knot ends."""
    system = np.zeros((count + 2, count + 2))
    for i in range(count):
        system[i + 1, i : i + 3] = [1 / 6, 4 / 6, 1 / 6]
    # Third derivative continuous across the second and the last but one knot.
    jump = np.array([1.0, -4.0, 6.0, -4.0, 1.0])
    system[0, :5] = jump
    system[-1, -5:] = jump
    right = np.zeros((count + 2, count))
    right[1:-1] = np.eye(count)
    return np.asarray(np.linalg.solve(system, right), dtype=np.float64)


def _weights(t):
    """B-spline weights of the four coefficients around a cell and their slopes."""
    u = 1 - t
    value = jnp.stack([u**3, 3 * t**3 - 6 * t**2 + 4, 3 * u**3 - 6 * u**2 + 4, t**3]) / 6
    slope = jnp.stack([-(u**2), 3 * t**2 - 4 * t, -3 * u**2 + 4 * u, t**2]) / 2
    return value, slope


class MapContact(eqx.Module):
    """Gap and levers of a flank pair at a pose, from a spline map.

    Call it with roll coordinate and ε (rad); see `FlankPair` for their meaning. Below
    ε = `deepest` the gap goes on linearly in ε, which keeps a simulation alive long
    enough to see that the map must be larger.
    """

    coefficients: Float[Array, "m n"]
    first_roll: Float[Array, ""]
    roll_step: Float[Array, ""]
    deepest: Float[Array, ""]
    relative_step: Float[Array, ""]
    half_pitch: float = eqx.field(static=True)

    @classmethod
    def of(
        cls, profile: Profile, deepest: Float[Array, ""], rolls: int, relatives: int
    ) -> "MapContact":
        """Tabulate `profile` down to ε = `deepest` < 0 (rad) on `rolls` × `relatives`
        points (both at least 8)."""
        pair = FlankPair.of(profile)
        half = float(profile.half_pitch)
        # Contact can start before the tip passes the line of centres, by about √|ε|.
        first_roll = -jnp.minimum(0.9 * half, 2 * jnp.sqrt(-deepest) + 0.02)
        # Past the middle of the flank the map is continued by symmetry, so that the
        # spline is in its interior there as well.
        roll_step = (half - first_roll) / (rolls - 1 - _MARGIN)
        relative_step = -deepest / (relatives - 1 - _MARGIN)
        roll = first_roll + roll_step * jnp.arange(rolls)
        relative = deepest + relative_step * jnp.arange(relatives)

        def gap(roll, relative):
            contact = pair(roll, relative)
            # No common normal: the tip land is passing. A parabola continues the gap
            # that the end of the land leaves.
            start = lax.stop_gradient(_land_end(profile))
            away = roll - start - relative / 2
            return jnp.where(contact.found, contact.gap, profile.pitch_radius * away**2)

        values = jax.vmap(lambda x: jax.vmap(lambda e: gap(x, e))(relative))(roll)
        left = jnp.asarray(_interpolation_matrix(rolls))
        right = jnp.asarray(_interpolation_matrix(relatives))
        coefficients = left @ values @ right.T
        return cls(coefficients, first_roll, roll_step, deepest, relative_step, half)

    def __call__(
        self, roll: Float[Array, ""], relative: Float[Array, ""]
    ) -> tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""]]:
        """Gap (m) and the levers about rotor 1 and rotor 2 (m)."""
        half = self.half_pitch
        centered = roll - half
        centered = centered - 4 * half * jnp.round(centered / (4 * half))
        mirror = jnp.where(centered > 0, -1.0, 1.0)
        folded = half - jnp.abs(centered)
        rows, columns = self.coefficients.shape
        i, x_value, x_slope, _ = self._cell(folded, self.first_roll, self.roll_step, rows)
        j, e_value, e_slope, beyond = self._cell(
            relative, self.deepest, self.relative_step, columns
        )
        local = lax.dynamic_slice(self.coefficients, (i, j), (4, 4))
        e_slope = e_slope / self.relative_step
        # Sums of products, which the compiler merges; a matrix product would be a call.
        along = jnp.sum(local * (e_value + e_slope * beyond), axis=1)
        gap = jnp.sum(x_value * along)
        by_relative = jnp.sum(x_value * jnp.sum(local * e_slope, axis=1))
        by_roll = mirror * jnp.sum(x_slope * along) / self.roll_step
        # φ̄ = -x: ∂G/∂φ1 = -∂G/∂x / 2 - ∂G/∂ε = -lever1, ∂G/∂φ2 = lever2.
        return gap, by_relative + by_roll / 2, by_relative - by_roll / 2

    @staticmethod
    def _cell(x, first, step, size):
        """Index of the first of four coefficients, their weights, and how far x lies
        beyond the map."""
        position = (x - first) / step
        held = jnp.clip(position, 0.0, size - 3 - 1e-9)
        index = lax.stop_gradient(jnp.floor(held)).astype(jnp.int32)
        value, slope = _weights(held - index)
        return index, value, slope, (position - held) * step


def _land_end(profile):
    first = profile.segments()[0]
    return first.stop if first.land else jnp.zeros_like(first.stop)
