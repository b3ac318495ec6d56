"""A window of a motion that has not settled: its forces, and its largest Lyapunov exponent.

The exponent distinguishes chaos from a long transient. It is the mean logarithmic growth rate of
the distance to a second motion, which is put back to a fixed distance every mesh period (Benettin
et al., Meccanica 15 (1980) 9-20).

A tangent vector instead of a second motion was tried. On coarse steps, products of linearised
impacts grow although the motion repeats: at 1e-6, by a factor of 8 per mesh period beside an orbit
with the multiplier 0.1. Two motions at a finite distance show what the motion does, provided that
the distance exceeds the noise of steps and rounding. Every second batch therefore uses a distance
eight times smaller: noise then makes the growth factor eight times greater, chaos does not.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Complex, Float, Int

from rootsopt.dynamics.flow import Period, one_period
from rootsopt.dynamics.integrator import Integrator
from rootsopt.dynamics.pair import RotorPair

PERIODS = 128
"""Length of a window (mesh periods)."""
# Number of batches into which a window is divided to estimate the standard error of the Lyapunov
# exponent.
_BATCHES = 16
# Scaled distance between the two motions: the first number times the tolerance, at least the second
# and at most the third number.
_APART = 1e4, 1e-2, 0.2
# Divisor of this distance in every second batch.
_NEARER = 8.0
# Rounding errors that replace the tolerance, if they exceed it, when the distance is chosen.
_ROUNDINGS = 200.0
# Difference between the growth rates at both distances above which noise or the finite distance,
# not the motion, sets them.
_ALIKE = float(np.log(3.0))
# Number of states stored per mesh period.
_KEPT = 105
# Force, in units of the pair's `force_scale`, below which differences are relative to this force.
# Flanks that only just touch push so little that the integration takes no account of it.
_FAINT = 1e-3
# Array type of a window: JAX arrays, or NumPy arrays after a copy from the device.
_Arrays = Array | np.ndarray


class Window(NamedTuple):
    """A motion over p mesh periods, of which the first `done` have been integrated.

    `growth` (p,): logarithm of the factor by which the distance between both motions grew in each
    mesh period; `response` (p, 3): mean (N), mean square (N²) and peak (N) of the contact force in
    each mesh period; `states` (p, s, n): uniform samples, scaled; `depth`: greatest penetration (m;
    negative: least gap); `solved`: whether the solver succeeded; `end` (n,): last scaled state;
    `beside` (n,): scaled state of the second motion; `second`: whether the second motion is
    integrated next; `apart`: distance of both motions at the start of a mesh period, in batches
    with an even number.
    """

    growth: Float[Array, " p"]
    response: Float[Array, "p 3"]
    states: Float[Array, "p s n"]
    depth: Float[Array, ""]
    solved: Bool[Array, ""]
    end: Float[Array, " n"]
    beside: Float[Array, " n"]
    second: Bool[Array, ""]
    apart: Float[Array, ""]
    done: Int[Array, ""]

    @classmethod
    def empty(
        cls, state: Float[Array, " n"], periods: int, tolerance: Float[Array, ""]
    ) -> "Window":
        """Return a window of `periods` mesh periods from the scaled `state` (n,), before any
        integration.

        `tolerance`: relative tolerance of the integrator."""
        count, dtype = state.shape[0], state.dtype
        times, least, most = _APART
        rounding = _ROUNDINGS * float(jnp.finfo(dtype).eps)
        apart = jnp.clip(times * jnp.maximum(tolerance, rounding), least, most).astype(dtype)
        return cls(
            growth=jnp.zeros(periods, dtype),
            response=jnp.zeros((periods, 3), dtype),
            states=jnp.zeros((periods, _KEPT, count), dtype),
            depth=jnp.full((), -jnp.inf, dtype),
            solved=jnp.ones((), bool),
            end=state,
            beside=state.at[0].add(apart),
            second=jnp.zeros((), bool),
            apart=apart,
            done=jnp.zeros((), int),
        )

    @property
    def start(self) -> Float[Array, " n"]:
        """Scaled state from which the next mesh period is integrated."""
        return jnp.where(self.second, self.beside, self.end)

    def after(self, out: Period) -> "Window":
        """Return the window after one more integration over a mesh period; `out`: its flow.

        The two motions take turns: the second one is then put back beside the first."""
        row, every = self.done, out.states.shape[0] // _KEPT

        def first(new, old):
            return jnp.where(self.second, old, new)

        size = jnp.linalg.norm(out.end - self.end)
        least = float(jnp.finfo(size.dtype).eps) * self.apart
        ahead = jnp.zeros_like(self.end).at[0].set(1.0)
        direction = jnp.where(size > least, (out.end - self.end) / size, ahead)
        growth = jnp.log(jnp.maximum(size, least) / self._distance(row))
        beside = self.end + self._distance(row + 1) * direction
        kept = first(out.response[:3], self.response[row])
        states = first(out.states[::every][:_KEPT], self.states[row])
        return self._replace(
            growth=self.growth.at[row].set(growth),
            response=self.response.at[row].set(kept),
            states=self.states.at[row].set(states),
            depth=first(jnp.maximum(self.depth, out.depth), self.depth),
            solved=self.solved & out.solved,
            end=first(out.end, self.end),
            beside=first(self.beside, beside),
            second=~self.second,
            done=row + self.second,
        )

    def _distance(self, period: Int[Array, ""]) -> Float[Array, ""]:
        """Return the distance of both motions at the start of the mesh period number `period`."""
        batch = period * _BATCHES // max(self.growth.shape[0], 1)
        return jnp.where(batch % 2 == 0, self.apart, self.apart / _NEARER)

    @property
    def _rates(self) -> Float[_Arrays, "2 b"]:
        """Mean growth in the batches with even numbers, and in those with odd numbers."""
        xp = _numpy_of(self.growth)
        return xp.mean(self.growth.reshape(_BATCHES // 2, 2, -1), axis=2).T

    @property
    def exponent(self) -> Float[_Arrays, ""]:
        """Largest Lyapunov exponent per mesh period."""
        xp = _numpy_of(self.growth)
        return xp.asarray(xp.mean(self.growth))

    @property
    def error(self) -> Float[_Arrays, ""]:
        """Standard error of `exponent`, from the means of batches with the same distance."""
        xp = _numpy_of(self.growth)
        return xp.asarray(xp.sqrt(xp.mean(xp.var(self._rates, axis=1, ddof=1)) / _BATCHES))

    @property
    def chaotic(self) -> Bool[_Arrays, ""]:
        """Whether motions diverge at both distances alike.

        The exponent must exceed three standard errors, and the rate at each distance two of its
        own, which are √2 times greater."""
        xp = _numpy_of(self.growth)
        far, near = xp.mean(self._rates, axis=1)
        alike = xp.abs(near - far) < _ALIKE
        sure = self.exponent > 3 * self.error
        each = xp.minimum(far, near) > 2 * 2**0.5 * self.error
        return xp.asarray(sure & each & alike)

    @property
    def forces(self) -> Float[_Arrays, " 3"]:
        """Mean (N), mean square (N²) and peak (N) of the contact force over the window."""
        xp = _numpy_of(self.response)
        mean, square, peak = self.response.T
        return xp.stack([xp.mean(mean), xp.mean(square), xp.max(peak)])


def _numpy_of(array: Any) -> Any:
    """Return the module NumPy if `array` is a NumPy array, else jax.numpy.

    NumPy operations need no compilation."""
    return np if isinstance(array, np.ndarray) else jnp


def lyapunov(
    pair: RotorPair, state: Float[Array, " n"], periods: int, integrator: Integrator
) -> Window:
    """Return a window of `periods` mesh periods (a multiple of 16), integrated from the scaled
    `state`."""

    def step(window: Window) -> Window:
        return window.after(one_period(pair.later(window.done), window.start, integrator))

    def goes_on(window: Window) -> Bool[Array, ""]:
        alive = window.solved & jnp.all(jnp.isfinite(window.start))
        return (window.done < periods) & alive

    begun = Window.empty(state, periods, integrator.tolerance)
    return lax.while_loop(goes_on, step, begun)


def integrated_difference(
    pair: RotorPair,
    orbit: tuple[Float[Array, " n"], Float[Array, " r"]],
    period: Int[Array, ""],
    integrator: Integrator,
) -> Float[Array, ""]:
    """Return the difference between a closed orbit and an integration over its period.

    `orbit`: its scaled state (n,) at φ1 = 0, and its forces (r,): mean (N), mean square (N²), and
    others that do not count; `period` (mesh periods). The result is the greatest of the relative
    differences in mean and RMS force, and the scaled distance between start and end. It is inf if
    the solver fails."""
    state, forces = orbit

    def step(number: Any, carry):
        here, total, solved = carry
        made = one_period(pair.later(number), here, integrator)
        rates = jnp.append(made.response[:2], jnp.ones_like(made.duration))
        return made.end, total + made.duration * rates, solved & made.solved

    begun = state, jnp.zeros(3, state.dtype), jnp.ones((), bool)
    end, total, solved = lax.fori_loop(0, period, step, begun)
    sizes = jnp.stack([total[:2] / total[2], forces[:2]])
    found, given = sizes.at[:, 1].set(jnp.sqrt(sizes[:, 1]))
    apart = jnp.abs(found - given) / jnp.maximum(given, _FAINT * pair.force_scale)
    largest = jnp.maximum(jnp.max(apart), jnp.max(jnp.abs(end - state)))
    return jnp.where(solved & jnp.isfinite(largest), largest, jnp.inf)


# Number of squarings of a matrix from which its growth rate is computed. After so many, the result
# no longer depends on the norm used.
_SQUARINGS = 40
# Maximum number of QR iterations, per eigenvalue on average.
_SWEEPS = 40


def solved(matrix: Float[Array, "n n"], right: Float[Array, "n m"]) -> Float[Array, "n m"]:
    """Return the solution X (n, m) of `matrix` X = `right`, by elimination with row pivoting."""
    rows = jnp.concatenate([matrix, right], axis=1)
    count = matrix.shape[0]
    place = jnp.arange(count)
    for k in range(count):
        size = jnp.where(place >= k, jnp.abs(rows[:, k]), -1.0)
        pivot = jnp.argmax(size)
        order = jnp.where(place == k, pivot, jnp.where(place == pivot, k, place))
        rows = rows[order]
        row = rows[k] / rows[k, k]
        rows = jnp.where((place == k)[:, None], row, rows - rows[:, k : k + 1] * row)
    return rows[:, count:]


def spectral_radius(matrix: Float[Array, "n n"]) -> Float[Array, ""]:
    """Return the greatest modulus of the eigenvalues, in real arithmetic.

    For two rows, the result follows from trace and determinant. For more rows, the result is the
    growth rate of the powers of the matrix, computed by repeated squaring.
    """
    if matrix.shape[0] == 2:
        half = jnp.trace(matrix) / 2
        determinant = jnp.linalg.det(matrix)
        square = half**2 - determinant
        root = jnp.sqrt(jnp.abs(square))
        return jnp.where(square >= 0, jnp.abs(half) + root, jnp.sqrt(jnp.abs(determinant)))

    def double(_, carry):
        power, growth, share = carry
        size = jnp.max(jnp.abs(power))
        scaled = power / jnp.where(size > 0, size, 1.0)
        growth = growth + share * jnp.log(size)
        # A sum: for matrices this small, calling a matrix product costs more.
        return jnp.sum(scaled[:, :, None] * scaled[None], axis=1), growth, share / 2

    start = matrix, jnp.zeros((), matrix.dtype), jnp.ones((), matrix.dtype)
    return jnp.exp(lax.fori_loop(0, _SQUARINGS, double, start)[1])


def eigenvalues(matrix: Float[Array, "n n"]) -> Complex[Array, " n"]:
    """Return the eigenvalues, greatest modulus first; NaN if the matrix is not finite.

    In a conjugate pair, the value with positive imaginary part comes first. The method is QR
    iteration with Wilkinson's shift and deflation (Golub and Van Loan, Matrix Computations, section
    7.5). There is no reduction to Hessenberg form, since the matrices have at most about 12 rows.
    """
    count = matrix.shape[0]
    work = matrix.astype(jnp.result_type(matrix.dtype, jnp.complex64))
    unit = jnp.eye(count, dtype=work.dtype)
    place = jnp.arange(count)
    small = float(jnp.finfo(matrix.dtype).eps)

    def shift_of(work, size):
        """Return Wilkinson's shift for the active block, the first `size` rows of `work`.

        The shift is the eigenvalue of the block's last 2 x 2 block that is nearest to its last
        entry."""
        low, high = size - 1, jnp.maximum(size - 2, 0)
        a, b, c, d = work[high, high], work[high, low], work[low, high], work[low, low]
        half = (a - d) / 2
        root = jnp.sqrt(half**2 + b * c)
        root = jnp.where(jnp.abs(half + root) >= jnp.abs(half - root), root, -root)
        far = half + root
        return d - jnp.where(far == 0, 0.0, b * c / jnp.where(far == 0, 1.0, far))

    def go_on(carry):
        _, size, turn = carry
        return (size > 1) & (turn < _SWEEPS * count)

    def sweep(carry):
        work, size, turn = carry
        active = (place < size)[:, None] & (place < size)
        shift = shift_of(work, size)
        # An occasional exceptional shift breaks cycles.
        beside = jnp.max(jnp.where(place < size - 1, jnp.abs(work[size - 1]), 0.0))
        shift = jnp.where(turn % 8 == 7, shift + 0.7 * beside, shift)
        left, right = _orthogonal(jnp.where(active, work - shift * unit, unit))
        turned = jnp.sum(right[:, :, None] * left[None], axis=1) + shift * unit
        work = jnp.where(active, turned, work)
        beside = jnp.where(place < size - 1, jnp.abs(work[size - 1]), 0.0)
        scale = jnp.maximum(jnp.max(jnp.where(active, jnp.abs(work), 0.0)), 1e-300)
        done = jnp.max(beside) <= small * scale
        return work, size - done, turn + 1

    start = work, jnp.asarray(count), jnp.zeros((), int)
    values = jnp.diagonal(lax.while_loop(go_on, sweep, start)[0])
    if count == 2:
        values = _of_two(matrix).astype(work.dtype)
    values = jnp.where(jnp.all(jnp.isfinite(matrix)), values, jnp.nan)
    # Moduli that differ by rounding alone rank as equal, so that the imaginary part orders a
    # conjugate pair.
    modulus = jnp.abs(values)
    rank = jnp.sum(modulus[None] > modulus[:, None] * (1 + 100 * small), axis=1)
    return values[jnp.lexsort((-values.imag, rank))]


def _of_two(matrix: Float[Array, "2 2"]) -> Complex[Array, " 2"]:
    """Return the eigenvalues of a 2 x 2 matrix from its trace and determinant."""
    half = jnp.trace(matrix) / 2
    determinant = matrix[0, 0] * matrix[1, 1] - matrix[0, 1] * matrix[1, 0]
    square = half**2 - determinant
    root = jnp.sqrt(jnp.abs(square))
    first = half + jnp.where(half >= 0, root, -root)
    # The smaller root follows from the product of both; the difference would cancel.
    second = determinant / jnp.where(first == 0, 1.0, first)
    real = lax.complex(jnp.stack([first, second]), jnp.zeros(2, matrix.dtype))
    pair = lax.complex(jnp.stack([half, half]), jnp.stack([root, -root]))
    return jnp.where(square >= 0, real, pair)


def _orthogonal(matrix: Complex[Array, "n n"]) -> tuple[Complex[Array, "n n"], ...]:
    """Return the QR factors (Q, R) of a matrix, by the Gram-Schmidt method with a second pass."""
    count = matrix.shape[0]
    columns, right = [], jnp.zeros_like(matrix)
    for k in range(count):
        column = matrix[:, k]
        for j, done in [*enumerate(columns)] * 2:
            share = jnp.vdot(done, column)
            right = right.at[j, k].add(share)
            column = column - share * done
        size = jnp.sqrt(jnp.sum(jnp.abs(column) ** 2))
        right = right.at[k, k].set(size.astype(matrix.dtype))
        columns.append(column / jnp.where(size > 0, size, 1.0))
    return jnp.stack(columns, axis=1), right
