"""Linear algebra with a few unknowns, in plain arithmetic instead of LAPACK.

A LAPACK call costs more than solving two equations. Besides, a compiled program that contains
such a call cannot be stored for other processes.
"""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Complex, Float

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
