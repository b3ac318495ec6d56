"""A closed periodic orbit, and branches of a search that batches can share."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
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

        found = jax.vmap(choose)(taken, computed(0, taken), computed(1, ~taken))
        return found, jax.tree.map(lambda _: True, found)

    return chosen(taken, dynamic)
