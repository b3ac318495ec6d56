"""Evaluation of the elements of a mesh in blocks.

The arrays of a mesh have room for more elements than the mesh uses. Blocks of unused elements are
not evaluated."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_batching import custom_vmap
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Int

BLOCK = 48
"""Number of elements evaluated together. The arrays of a mesh have room for a multiple of this
number."""


@custom_vmap
def greatest(count: Int[Array, ""]) -> Int[Array, ""]:
    """Return `count` or, in a batch, the greatest of the batch.

    A loop with one number of iterations for all motions of a batch only writes what is new. With a
    number for each motion, every iteration would copy all arrays, to keep those of motions that are
    done."""
    return count


@greatest.def_vmap
def _(size, batched, count):
    return jnp.max(count), False


def whole_blocks(*arrays: Array) -> list[Array]:
    """Return `arrays`, padded with zeros to a whole number of blocks."""
    spare = -arrays[0].shape[0] % BLOCK
    return [jnp.pad(x, ((0, spare), *((0, 0),) * (x.ndim - 1))) for x in arrays]


def in_blocks(function: Any, used: Int[Array, ""], *arrays: Any) -> Any:
    """Return `function(*arrays)`, evaluated block by block along the leading axis of elements.

    `function` maps arrays (e, …) of e elements to arrays (e, …); `used`: number of elements in use.
    Blocks without such elements are not evaluated, except in a batch, where another motion uses
    them; their results have no meaning."""
    count = jax.tree.leaves(arrays)[0].shape[0]
    size = min(BLOCK, count)

    def sliced(begin):
        return jax.tree.map(lambda x: lax.dynamic_slice_in_dim(x, begin, size), arrays)

    function = eqx.filter_closure_convert(function, *sliced(0))  # traced once
    shapes = jax.eval_shape(function, *sliced(0))
    nothing = jax.tree.map(lambda x: jnp.zeros((count, *x.shape[1:]), x.dtype), shapes)
    # The numbers of a pair enter the loop as one vector. XLA would copy each of them.
    numbers, rest = eqx.partition(function, eqx.is_inexact_array)
    vector, back = ravel_pytree(numbers)

    def block(number, found):
        begin = number * size
        new = eqx.combine(back(vector), rest)(*sliced(begin))
        return jax.tree.map(
            lambda old, x: lax.dynamic_update_slice_in_dim(old, x, begin, 0), found, new
        )

    return lax.fori_loop(0, greatest((used + size - 1) // size), block, nothing)
