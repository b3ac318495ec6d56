"""Initial mesh and motion for closing an orbit by collocation.

Both come from the steps of an integration over the orbit's period: the end of a transient, or the
last shot of an orbit that was closed by shooting."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from rootsopt.dynamics.collocation.blocks import in_blocks, whole_blocks
from rootsopt.dynamics.collocation.closing import FIRST
from rootsopt.dynamics.collocation.elements import Elements, Mesh
from rootsopt.dynamics.collocation.gauss import GAUSS
from rootsopt.dynamics.collocation.known import Known
from rootsopt.dynamics.collocation.mesh import room_for
from rootsopt.dynamics.flow import Pieces
from rootsopt.dynamics.pair import RotorPair


def from_pieces(pair: RotorPair, pieces: Pieces, period: Int[Array, ""], longest: int) -> Known:
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
    return Known.unaligned(Elements(mesh, states, slopes, roots))


PIECES = FIRST, GAUSS.nodes
"""Argument `pieces` of the transient (`strobe`) for `from_pieces`."""


def from_steps(
    pair: RotorPair,
    state: Float[Array, " n"],
    taken: tuple[Float[Array, " steps"], Float[Array, "steps n"]],
    period: Int[Array, ""],
    longest: int,
) -> Known:
    """Return an orbit that was closed by shooting, as a start for closing it by collocation.

    `state`: scaled, at φ1 = 0; `taken`: `Flow.grid` and `Flow.corners` of the integration over the
    `period` (mesh periods); `longest`: longest period for which the arrays have room."""
    grid, corners = taken
    times = jnp.append(0.0, grid)
    states = jnp.concatenate([state[None], corners])
    steps = jnp.sum(jnp.isfinite(grid))
    slope = jax.vmap(lambda tau, y: pair.derivative(tau, y)[0])
    slopes = in_blocks(slope, steps + 1, *whole_blocks(times, states))[: times.shape[0]]
    every, length = (times, states, slopes), period.astype(state.dtype)
    room = room_for(pair, longest)
    return Known.unaligned(_on_steps(pair, every, steps, length, FIRST * period, room))


def _on_steps(
    pair: RotorPair,
    taken: tuple[Float[Array, " m"], Float[Array, "m n"], Float[Array, "m n"]],
    steps: Int[Array, ""],
    length: Float[Array, ""],
    used: Int[Array, ""],
    room: tuple[int, int],
) -> Elements:
    """Return the motion through the ends of solver steps, on elements without events.

    `taken`: times (mesh periods), scaled states and slopes at the start and at the ends of the
    steps; `steps`: number of them; `length`: period; `used`: number of elements; `room`: sizes of
    the arrays for elements and for times."""
    times, states, slopes = taken
    capacity, count = room
    dtype = states.dtype
    real = jnp.arange(times.shape[0]) <= steps
    times = jnp.where(real, times, length + jnp.arange(times.shape[0]))
    share = jnp.linspace(0.0, 1.0, capacity + 1) * capacity / used
    edges = jnp.interp(share * steps, jnp.arange(times.shape[0], dtype=dtype), times)
    edges = jnp.minimum(edges, length)
    number = jnp.arange(capacity)
    real = number < used
    anchors = jnp.full(count, length, dtype).at[0].set(0.0)
    mesh = Mesh(
        times=anchors,
        which=jnp.full(count, -1),
        interval=jnp.where(real, 0, count - 2),
        left=jnp.where(real, edges[:-1] / length, 1.0),
        right=jnp.where(real, jnp.where(number == used - 1, length, edges[1:]) / length, 1.0),
        used=used,
    )

    def motion(tau):
        """Return states and slopes at the times `tau` (mesh periods).

        They come from the cubic through both ends of a solver step."""
        k = jnp.clip(jnp.searchsorted(times, tau, side="right") - 1, 0, steps - 1)
        step = (times[k + 1] - times[k])[..., None]
        x = (tau - times[k])[..., None] / step
        rise, rate, last = states[k + 1] - states[k], step * slopes[k], step * slopes[k + 1]
        bend, twist = 3 * rise - 2 * rate - last, rate + last - 2 * rise
        swing = states[k] + x * (rate + x * (bend + x * twist))
        return swing, (rate + x * (2 * bend + 3 * x * twist)) / step

    begin = mesh.ends[0]
    inside = begin[:, None] + mesh.lengths[:, None] * GAUSS.nodes
    return Elements(
        mesh=mesh,
        state=motion(begin)[0],
        slopes=motion(inside)[1],
        roots=jnp.zeros((capacity, len(GAUSS.nodes) + 1, pair.flanks, 2), dtype),
    )
