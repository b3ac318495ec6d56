"""A closed periodic orbit, averages of the force over a motion, and branches for batches.

Mean and mean square are always integrated along with the motion. Two kinds of average are computed
on request: the Fourier coefficients of spectral lines, and the average of a power of the force,
which gives its p-norm."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.custom_batching import custom_vmap
from jaxtyping import Array, Bool, Float, Int

from rootsopt.dynamics.collocation.system import Step


class Orbit(NamedTuple):
    """Results of a closed orbit, with their first derivatives along d directions.

    `state` (n,): scaled state at φ1 = 0; `residual`: greatest entry of Newton's last correction
    (scaled), inf if Newton's method has not converged; `monodromy` (n, n): matrix at the start of
    the mesh, whose eigenvalues are the Floquet multipliers; `multiplier`: greatest modulus of the
    Floquet multipliers; `response` (r,): mean (N), mean square (N²), peak (N) and the further
    measures; `sensitivity` (r, d): derivatives of `response` along the family of orbits; `moved`
    (n, d): likewise, derivatives of `state`; `depth`: greatest penetration (m; negative: least gap)
    at Gauss points and element ends; `newton_steps`: number of Newton steps before the last one;
    `disagreement`: estimated relative error of the derivatives, inf if not known; `variation`:
    changes of the whole motion along the directions, `None` unless they were requested.
    """

    state: Float[Array, " n"]
    residual: Float[Array, ""]
    monodromy: Float[Array, "n n"]
    multiplier: Float[Array, ""]
    response: Float[Array, " r"]
    sensitivity: Float[Array, "r d"]
    moved: Float[Array, "n d"]
    depth: Float[Array, ""]
    newton_steps: Int[Array, ""]
    disagreement: Float[Array, ""]
    variation: Step | None = None

    @classmethod
    def empty(
        cls, state: Float[Array, " n"], directions: int, rows: int, variation: Step | None = None
    ) -> "Orbit":
        """Return a placeholder for an orbit near the scaled `state` (n,).

        `directions`: number d of directions; `rows`: number r of entries of `response`;
        `variation`: zeros like those of the orbit, if it has a variation."""
        count, dtype = state.shape[0], state.dtype
        nothing, infinite = jnp.zeros((), dtype), jnp.asarray(jnp.inf, dtype)
        return cls(
            state=state,
            residual=infinite,
            monodromy=jnp.zeros((count, count), dtype),
            multiplier=infinite,
            response=jnp.zeros(rows, dtype),
            sensitivity=jnp.zeros((rows, directions), dtype),
            moved=jnp.zeros((count, directions), dtype),
            depth=nothing,
            newton_steps=jnp.zeros((), int),
            disagreement=nothing,
            variation=variation,
        )


def choose(condition: Bool[Array, ""], new: Any, old: Any) -> Any:
    """Return the tree `new` if the `condition` holds, else the tree `old`."""
    return jax.tree.map(lambda x, y: jnp.where(condition, x, y), new, old)


def branch(taken: Bool[Array, ""], then: Callable[[], Any], otherwise: Callable[[], Any]) -> Any:
    """Return `then()` if `taken` holds, else `otherwise()`, like `lax.cond`.

    On a GPU, the motions of a batch are computed together, and `lax.cond` would compute both
    branches for all of them. Here, a branch that no motion takes is left out. A motion that does
    not take a branch repeats one that does, so that the loops of the branch do not last longer.
    There, the result cannot be differentiated."""
    if jax.default_backend() == "cpu":
        return lax.cond(taken, then, otherwise)
    both = eqx.filter_closure_convert(then), eqx.filter_closure_convert(otherwise)
    dynamic, static = eqx.partition(both, eqx.is_array)

    @custom_vmap
    def chosen(taken, dynamic):
        one, other = eqx.combine(dynamic, static)
        return lax.cond(taken, lambda: one(), lambda: other())

    @chosen.def_vmap
    def _(size, batched, taken, dynamic):
        taken = jnp.broadcast_to(taken, size)
        axes = jax.tree.map(lambda is_batched: 0 if is_batched else None, batched[1])

        def computed(number, takes):
            """Return the results (size, …) of a branch, zeros if no motion `takes` it."""
            row = jnp.where(takes, jnp.arange(size), jnp.argmax(takes))

            def every():
                own = jax.tree.map(
                    lambda x, is_batched: x[row] if is_batched else x,
                    dynamic[number],
                    batched[1][number],
                )
                call = jax.vmap(
                    lambda x: eqx.combine(x, static[number])(), (axes[number],), axis_size=size
                )
                return call(own)

            nothing = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(every))
            return lax.cond(jnp.any(takes), every, lambda: nothing)

        results = jax.vmap(choose)(taken, computed(0, taken), computed(1, ~taken))
        return results, jax.tree.map(lambda _: True, results)

    return chosen(taken, dynamic)


class Measures(eqx.Module):
    """The averages of the force to compute in addition to mean and mean square.

    `orders` (lines,): spectral lines, in multiples of the mesh frequency. A motion of k mesh
    periods contains a line if k times its order is a whole number. `norm`: exponent p of the p-norm
    (mean of F^p)^(1/p) ≤ max F, a smooth substitute for the peak; None: no p-norm.
    """

    orders: Float[Array, " lines"] | Float[np.ndarray, " lines"]
    norm: Float[Array, ""] | None = None

    @property
    def count(self) -> int:
        """Number q of averages: 2, plus 2 for each line, plus 1 for the p-norm."""
        return 2 + 2 * self.orders.shape[0] + (self.norm is not None)

    def rates(self, tau: Float[Array, ""], force: Float[Array, ""]) -> Float[Array, " q"]:
        """Return the integrands of the averages at time `tau` (mesh periods).

        `force`: the contact force, in units of roughly its greatest value, so that powers of it do
        not overflow."""
        rates = [jnp.stack([force, force**2])]
        if self.orders.shape[0]:
            angle = 2 * jnp.pi * jnp.asarray(self.orders, force.dtype) * tau
            rates += [force * jnp.cos(angle), force * jnp.sin(angle)]
        if self.norm is not None:
            pushes = force > 0
            power = jnp.where(pushes, force, 1.0) ** self.norm.astype(force.dtype)
            rates.append(jnp.where(pushes, power, 0.0)[None])
        return jnp.concatenate(rates)

    def values(
        self, averages: Float[Array, " q"], unit: Float[Array, ""]
    ) -> tuple[Float[Array, " q"], Float[Array, " q"]]:
        """Return the measures from the averages of `rates`, and factors for their derivatives.

        The measures are the mean (N), the mean square (N²), the means of force times cosine and
        force times sine (N), and the p-norm (N). Derivatives of the averages times these factors
        are derivatives of the measures. `unit` (N): unit of the force in `rates`."""
        factors = jnp.full_like(averages, unit).at[1].set(unit**2)
        values = factors * averages
        if self.norm is not None:
            power = jnp.maximum(averages[-1], jnp.finfo(averages.dtype).tiny)
            size = unit * power ** (1 / self.norm.astype(averages.dtype))
            values = values.at[-1].set(size)
            factors = factors.at[-1].set(size / (self.norm.astype(averages.dtype) * power))
        return values, factors

    def amplitudes(self, others: Any, slopes: Any, period: Any, xp: Any = jnp) -> tuple[Any, list]:
        """Return the amplitudes (N) of the spectral lines of a closed orbit, and their derivatives.

        `others` (q - 2,) and `slopes` (q - 2, d): the measures that follow the mean square in
        `values`, and their derivatives; `period`: period of the orbit (mesh periods); `xp`: module
        that computes, NumPy for NumPy arrays. A line that the motion does not contain has amplitude
        0. Amplitudes (lines,) are one array, derivatives a list of arrays (d,)."""
        sizes, rows = [], []
        for k, order in enumerate(self.orders):
            cos, sin = others[k], others[k + self.orders.shape[0]]
            size = xp.hypot(cos, sin)
            present = xp.abs(order * period - xp.round(order * period)) < 1e-6
            slope = cos * slopes[k] + sin * slopes[k + self.orders.shape[0]]
            sizes.append(xp.where(present, 2 * size, 0.0))
            rows.append(xp.where(present, 2 * slope / xp.maximum(size, 1e-150), 0.0))
        return xp.stack(sizes) if sizes else xp.zeros(0), rows

    def named(self, response: Any, period: int) -> dict[str, tuple[float, Any]]:
        """Return the response of a closed orbit as a dict whose keys are names in the result file.

        `response` (r, 1 + d): one row each for mean, mean square and peak, then for the measures
        that follow the mean square in `values`. Column 0 holds the value, the other d columns its
        derivatives. `period`: period of the orbit (mesh periods). Each name maps to a pair: the
        value (N) and its derivatives (d,). A requested spectral line that the motion does not
        contain has amplitude 0.
        """
        rows = np.asarray(response, np.float64)
        mean, square, peak, *others = rows
        rms = np.sqrt(max(square[0], 0.0))
        forces = {
            "mean_force_N": (float(mean[0]), mean[1:]),
            "peak_force_N": (float(peak[0]), peak[1:]),
            "rms_force_N": (float(rms), square[1:] / (2 * max(rms, 1e-150))),
        }
        lines = self.amplitudes(rows[3:, 0], rows[3:, 1:], period, np)
        for order, size, slope in zip(np.asarray(self.orders), *lines, strict=True):
            forces[line_name(order)] = float(size), slope
        if self.norm is not None:
            norm = others[-1]
            forces[PEAK_NORM] = (float(norm[0]), norm[1:])
        return forces


PEAK_NORM = "peak_norm_force_N"
"""Name of the p-norm in result files."""


def line_name(order: float) -> str:
    """Return the name of a spectral line's amplitude in result files."""
    return f"line_{order:g}_force_N"
