"""Evaluation of as many elements as a mesh has, in arrays with room for more."""

from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Int

BLOCK = 16
"""Number of elements evaluated together. The room of a mesh is a multiple of it."""


def in_blocks(function: Any, used: Int[Array, ""], *arrays: Any) -> Any:
    """Return `function` of arrays (e, …), evaluated in blocks of elements; 0 beyond `used`."""
    shapes = jax.eval_shape(function, *arrays)
    count = jax.tree.leaves(arrays)[0].shape[0]
    size = min(BLOCK, count)
    nothing = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)

    def block(number, found):
        begin = number * size
        part = jax.tree.map(lambda x: lax.dynamic_slice_in_dim(x, begin, size), arrays)
        new = function(*part)
        return jax.tree.map(
            lambda old, x: lax.dynamic_update_slice_in_dim(old, x, begin, 0), found, new
        )

    return lax.fori_loop(0, (used + size - 1) // size, block, nothing)
