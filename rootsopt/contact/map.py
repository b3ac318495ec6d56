"""C² map of the flank gap over the pose: a fast approximation of the search.

The gap of `closest.FlankPair` is tabulated once per design on a uniform grid over roll coordinate
and relative rotation, and interpolated by bicubic B-splines. Levers are the derivatives of the
interpolated gap, so that forces still come from a potential. Derivatives with respect to the design
enter at the grid points, by the envelope theorem.
"""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float
from numpy.typing import NDArray

from rootsopt.contact.closest import FlankPair, contact_begins
from rootsopt.contact.gap import Contact
from rootsopt.profiles.base import Profile
from rootsopt.runtime.threads import one_thread

# Grid cells beyond ε = 0, and beyond the middle of the flank. With them, no contact is close to an
# end of the spline.
MARGIN = 3


def first_roll(deepest: Float[Array, ""] | float, half_pitch: float) -> Float[Array, ""]:
    """Return the roll coordinate (rad) at which a map down to ε = `deepest` (rad) starts.

    `half_pitch`: π/2N (rad)."""
    return jnp.maximum(-0.9 * half_pitch, contact_begins(jnp.asarray(deepest)))


def continued_gap(
    pair: FlankPair, roll: Float[Array, ""], relative: Float[Array, ""]
) -> Float[Array, ""]:
    """Return the gap (m) at x = `roll` and ε = `relative` (rad), continued over the tip land.

    `pair`: the flanks. Where the tip land passes, the flanks have no common normal. There, the gap
    is continued from the land's end by a parabola in x and ε.
    """
    contact = pair(roll, relative)
    away = roll - lax.stop_gradient(_land_end(pair.profile)) - relative / 2
    return jnp.where(contact.found, contact.gap, pair.profile.pitch_radius * away**2)


@functools.lru_cache(maxsize=32)
@one_thread
def _interpolation_matrix(count: int) -> NDArray[np.float64]:
    """Return the matrix (count + 2, count) that computes the coefficients of a cubic B-spline.

    The matrix multiplies the values at `count` uniform knots. The end conditions are not-a-knot."""
    system = np.zeros((count + 2, count + 2))
    for i in range(count):
        system[i + 1, i : i + 3] = [1 / 6, 4 / 6, 1 / 6]
    # The third derivative is continuous across the second and the second-last knot.
    jump = np.array([1.0, -4.0, 6.0, -4.0, 1.0])
    system[0, :5] = jump
    system[-1, -5:] = jump
    right = np.zeros((count + 2, count))
    right[1:-1] = np.eye(count)
    return np.asarray(np.linalg.solve(system, right), dtype=np.float64)


def _weights(t):
    """Return (values, slopes, second derivatives) of the 4 B-splines that are not zero in a cell.

    `t`: position in the cell, from 0 to 1."""
    u = 1 - t
    value = jnp.stack([u**3, 3 * t**3 - 6 * t**2 + 4, 3 * u**3 - 6 * u**2 + 4, t**3]) / 6
    slope = jnp.stack([-(u**2), 3 * t**2 - 4 * t, -3 * u**2 + 4 * u, t**2]) / 2
    bend = jnp.stack([u, 3 * t - 2, 3 * u - 2, t])
    return value, slope, bend


class MapContact(Contact):
    """Gap and levers of a flank pair at a pose, from a spline map.

    Call an instance with the roll coordinate x and the relative rotation ε (rad), which `Contact`
    defines. Below ε = `deepest`, the gap is extrapolated linearly in ε. A simulation can then
    continue, and its caller can see that the map must be larger.

    `coefficients` (m, n): coefficients of the B-spline, in metres; `first_roll`, `deepest`: roll
    and ε (rad) of the first grid point; `roll_step`, `relative_step`: grid steps (rad);
    `half_pitch`: π/2N (rad).
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
        """Return the map of the gap of `profile` down to ε = `deepest` < 0 (rad).

        The grid has `rolls` points over x and `relatives` points over ε, both at least 8."""
        pair = FlankPair.of(profile)
        half = float(profile.half_pitch)
        first = first_roll(deepest, half)
        # Symmetry continues the map beyond the middle of the flank, so that the spline is in
        # its interior there as well.
        roll_step = (half - first) / (rolls - 1 - MARGIN)
        relative_step = -deepest / (relatives - 1 - MARGIN)
        roll = first + roll_step * jnp.arange(rolls)
        relative = deepest + relative_step * jnp.arange(relatives)

        def gap(roll, relative):
            return continued_gap(pair, roll, relative)

        values = jax.vmap(lambda x: jax.vmap(lambda e: gap(x, e))(relative))(roll)
        left = jnp.asarray(_interpolation_matrix(rolls))
        right = jnp.asarray(_interpolation_matrix(relatives))
        coefficients = left @ values @ right.T
        return cls(coefficients, first, roll_step, deepest, relative_step, half)

    def __call__(
        self, roll: Float[Array, ""], relative: Float[Array, ""]
    ) -> tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""]]:
        """Return gap and levers (m) of rotor 1 and rotor 2 at x = `roll`, ε = `relative` (rad)."""
        half = self.half_pitch
        centered = roll - half
        centered = centered - 4 * half * jnp.round(centered / (4 * half))
        mirror = jnp.where(centered > 0, -1.0, 1.0)
        folded = half - jnp.abs(centered)
        rows, columns = self.coefficients.shape
        x = jnp.clip((folded - self.first_roll) / self.roll_step, 0.0, rows - 3 - 1e-6)
        position = (relative - self.deepest) / self.relative_step
        y = jnp.clip(position, 0.0, columns - 3 - 1e-6)
        value, by_x, by_y, by_xy = _bicubic(self.coefficients, x, y)
        beyond = position - y
        by_relative = by_y / self.relative_step
        by_roll = mirror * (by_x + by_xy * beyond) / self.roll_step
        # φ̄ = -x: ∂G/∂φ1 = -∂G/∂x / 2 - ∂G/∂ε = -lever1, ∂G/∂φ2 = lever2.
        return value + by_y * beyond, by_relative + by_roll / 2, by_relative - by_roll / 2


@jax.custom_jvp
def _bicubic(coefficients, x, y):
    """Return the spline's value and derivatives ∂x, ∂y, ∂x∂y at (`x`, `y`), in units of cells.

    `coefficients` (m, n): coefficients of the B-spline."""
    i, j = (lax.stop_gradient(jnp.floor(t)).astype(jnp.int32) for t in (x, y))
    return _sums(_local(coefficients, i, j), _weights(x - i), _weights(y - j))


@_bicubic.defjvp
def _(primals, tangents):
    # Written by hand, because derivatives along many directions share nearly all of this. The
    # second derivatives are computed once; only the table's own change is per direction.
    coefficients, x, y = primals
    changed, x_dot, y_dot = tangents
    i, j = (lax.stop_gradient(jnp.floor(t)).astype(jnp.int32) for t in (x, y))
    local, across, along = _local(coefficients, i, j), _weights(x - i), _weights(y - j)
    out = _sums(local, across, along)
    by_x = _sums(local, across[1:], along)
    by_y = _sums(local, across, along[1:])
    own = _sums(_local(changed, i, j), across, along)
    moved = tuple(o + a * x_dot + b * y_dot for o, a, b in zip(own, by_x, by_y, strict=True))
    return out, moved


def _local(coefficients, i, j):
    return lax.dynamic_slice(coefficients, (i, j), (4, 4))


def _sums(local, across, along):
    """Return f, ∂x f, ∂y f, ∂x∂y f as sums Σ c w(x) v(y) over 4 × 4 coefficients c in `local`.

    `across`, `along`: values and derivatives of the B-splines in x (w) and in y (v). The compiler
    fuses such sums, while a matrix product would be a library call."""
    value, slope = (jnp.sum(local * w, axis=1) for w in along[:2])
    return (
        jnp.sum(across[0] * value),
        jnp.sum(across[1] * value),
        jnp.sum(across[0] * slope),
        jnp.sum(across[1] * slope),
    )


def _land_end(profile):
    first = profile.segments()[0]
    return first.stop if first.land else jnp.zeros_like(first.stop)
