"""Initial mesh and motion for closing an orbit by collocation.

Both come from the steps of an integration over the orbit's period: the end of a transient."""

import jax.numpy as jnp
from jaxtyping import Array, Int

from rootsopt.dynamics.collocation.closing import FIRST
from rootsopt.dynamics.collocation.elements import Elements, Mesh
from rootsopt.dynamics.collocation.gauss import GAUSS
from rootsopt.dynamics.collocation.known import KnownOrbit
from rootsopt.dynamics.collocation.mesh import room_for
from rootsopt.dynamics.flow import Pieces
from rootsopt.dynamics.pair import RotorPair


def from_pieces(
    pair: RotorPair, pieces: Pieces, period: Int[Array, ""], longest: int
) -> KnownOrbit:
    """Return the end of a transient as a start for closing its orbit by collocation.

    `pieces`: the last mesh periods of the transient, which ends at φ1 = 0, in `PIECES`; `period` of
    the orbit (mesh periods); `longest`: longest period for which the arrays have room."""
    capacity, count = room_for(pair, longest)
    dtype, per = pieces.states.dtype, pieces.ends.shape[1]
    number = jnp.arange(capacity)
    used, length = period * per, period.astype(dtype)
    real = number < used
    which = pieces.ends.shape[0] - period + number // per
    row, column = jnp.minimum(which, pieces.ends.shape[0] - 1), number % per
    begins = jnp.pad(pieces.ends[:, :-1], ((0, 0), (1, 0)))
    left, right = ((x[row, column] + number // per) / length for x in (begins, pieces.ends))
    mesh = Mesh(
        times=jnp.full(count, length, dtype).at[0].set(0.0),
        which=jnp.full(count, -1),
        interval=jnp.where(real, 0, count - 2),
        left=jnp.where(real, left, 1.0),
        right=jnp.where(real, right, 1.0),
        used=used,
    )
    roots = jnp.zeros((capacity, len(GAUSS.nodes) + 1, pair.flanks, 2), dtype)
    states, slopes = pieces.states[row, column], pieces.slopes[row, column]
    return KnownOrbit.unaligned(Elements(mesh, states, slopes, roots))


PIECES = FIRST, GAUSS.nodes
"""Argument `pieces` of the transient (`strobe`) for `from_pieces`."""
