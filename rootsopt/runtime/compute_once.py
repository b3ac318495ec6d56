"""Values that XLA computes once, however many results use them.

On a CPU, XLA fuses an operation with every operation that uses its result, and repeats it there.
It even counts cosine and sine as cheap. In a program with many results and derivatives, most of the
time may be spent on repetitions. XLA drops optimisation barriers on CPUs, but it does not merge the
code before and after a branch whose condition it does not know.
"""

from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_batching import custom_vmap

T = TypeVar("T")

# Number of values below which they are not kept, because repeating them costs less.
_MANY = 32


def compute_once(tree: T) -> T:
    """Return `tree` unchanged, and have the values of its floating-point arrays computed once.

    The result cannot be differentiated. On a GPU, this function does nothing."""
    values, rest = eqx.partition(tree, eqx.is_inexact_array)
    leaves, shape = jax.tree.flatten(values)
    if not leaves or jax.default_backend() != "cpu":
        return tree
    return eqx.combine(jax.tree.unflatten(shape, _compute_once(leaves)), rest)


@jax.custom_jvp
def compute_once_along(tree: Any) -> Any:
    """Return `tree` unchanged, like `compute_once`, and have its derivatives along directions
    computed once, too.

    All leaves must be floating-point arrays. Reverse-mode differentiation is not possible."""
    return compute_once(tree)


@compute_once_along.defjvp
def _(primals, tangents):
    return compute_once(*primals), compute_once(*tangents)


@custom_vmap
def _compute_once(leaves):
    if sum(leaf.size for leaf in leaves) < _MANY:
        return leaves
    # The compiler cannot know that both branches return the same (for all but infinite values).
    endless = jnp.ravel(max(leaves, key=jnp.size))[0] == jnp.inf
    return lax.cond(endless, lambda x: [1.0 * leaf for leaf in x], lambda x: x, leaves)


@_compute_once.def_vmap
def _(size, batched, leaves):
    return _compute_once(leaves), batched[0]
