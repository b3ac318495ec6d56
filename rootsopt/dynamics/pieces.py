"""Pieces of an orbit in which a quantity is smooth, for integrals over the orbit."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from rootsopt.dynamics.collocation.elements import Elements
from rootsopt.dynamics.pair import RotorPair

LONGEST = 8
"""Maximum length of an orbit (mesh periods), rounded up by `RotorPair.whole`."""
# Minimum number of pieces into which one mesh period is divided.
_EVEN = 128
# Maximum number of instants at which flags change, and number of bisections that locate them.
_FLAGS, _HALVED = 64, 40
# Length (mesh periods) below which a piece counts as empty. Many corners coincide.
_EMPTY = 1e-13


def smooth_pieces(
    pair: RotorPair,
    elements: Elements,
    corners: Float[Array, " k"],
    flags: Callable[[Any], Any],
) -> tuple[Float[Array, " pieces"], Float[Array, " pieces"], Int[Array, ""]]:
    """Return starts and ends (mesh periods) of pieces of an orbit of `pair` in which a quantity is
    smooth, and the number of pieces in use. The others, which are empty, come last.

    `corners` (k,): times from 0 to 1 at which the quantity is not smooth, in each mesh period;
    `flags`: function that returns, at a time, flags (s,) that change where it is not smooth. Pieces
    end there, and at the ends of elements. They are shorter than elements, because a power of a
    quantity needs shorter pieces than the motion."""
    mesh = elements.mesh
    period = mesh.period
    turns = jnp.arange(pair.whole(LONGEST))[:, None]
    every = jnp.append(corners, jnp.arange(1, _EVEN + 1) / _EVEN)
    own = jnp.mod(mesh.ends[1], period)
    ends = jnp.append(own, jnp.minimum((every + turns).ravel(), period))
    ends = jnp.sort(jnp.minimum(lax.stop_gradient(ends), period))
    begins = jnp.append(0.0, ends[:-1])
    before = jax.vmap(flags)(begins)
    changes = jnp.any(before != jnp.append(before[1:], before[:1], axis=0), axis=1)
    # Unused places get the last piece, which is empty.
    piece = jnp.nonzero(changes, size=_FLAGS, fill_value=len(ends) - 1)[0]

    def halved(_, ends):
        low, high = ends
        middle = (low + high) / 2
        same = jnp.all(jax.vmap(flags)(middle) == jax.vmap(flags)(low), axis=1)
        return jnp.where(same, middle, low), jnp.where(same, high, middle)

    _, high = lax.fori_loop(0, _HALVED, halved, (begins[piece], ends[piece]))
    ends = jnp.sort(jnp.append(ends, high))
    begins = jnp.append(0.0, ends[:-1])
    empty = ends - begins < _EMPTY
    order = jnp.argsort(empty)
    return begins[order], ends[order], jnp.sum(~empty)


__all__ = ["LONGEST", "smooth_pieces"]
