"""Simulate the transient until the motion repeats.

The pair is forced with the mesh period. After a transient, the states at the end of each mesh
period (the stroboscopic states) settle on a cycle of k points.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import NDArray

from rootsopt.dynamics.flow import Pieces, strobe
from rootsopt.dynamics.integrator import Integrator
from rootsopt.dynamics.pair import RotorPair

BLOCK = 4
"""Least number of mesh periods integrated between two checks of whether the motion repeats."""
# Least number of stroboscopic states stored, and least excess over twice the longest cycle.
_MEMORY, _MORE = 20, 4
# Numbers of mesh periods after which a transient continues with a finer tolerance, each with the
# greatest value of that tolerance. The noise of coarser steps can hide that the motion repeats.
_PATIENCE = (32, 1e-5), (128, 1e-7)
NOISE = 100.0
"""Relative noise (tolerances) that adaptive steps cause in the stroboscopic states."""


class Transient(NamedTuple):
    """End of a transient.

    `state`: last stroboscopic state (scaled); `period`: length k of the cycle (mesh periods), 0 if
    not settled; `nearest`: the period with which the last states repeat most closely; `spread`:
    greatest scaled difference between states that are `nearest` periods apart; `periods`: mesh
    periods simulated; `lost`: see `RotorPair.lost`; `solved`: whether the solver succeeded;
    `steps`: number of solver steps; `pieces`: the motion over the last mesh periods, at least as
    many as the longest orbit has, if it was requested.
    """

    state: Float[Array, " n"]
    period: Int[Array, ""]
    nearest: Int[Array, ""]
    spread: Float[Array, ""]
    periods: Int[Array, ""]
    lost: Bool[Array, ""]
    solved: Bool[Array, ""]
    steps: Int[Array, ""]
    pieces: Pieces | None = None


def settled_within(rtol: Float[Array, ""]) -> Float[Array, ""]:
    """Return the scaled difference below which states count as repeating, at the tolerance `rtol`.

    The noise of adaptive steps is about a hundred times the tolerance."""
    return jnp.clip(1000 * rtol, 3e-3, 3e-2)


def settle(  # 85 lines: its inner functions share the arguments.
    pair: RotorPair,
    state: Float[Array, " n"],
    integrator: Integrator,
    tolerance: Float[Array, ""],
    max_periods: Int[Array, ""],
    max_orbit: int,
    pieces: tuple[int, NDArray[np.float64]] | None = None,
) -> Transient:
    """Integrate from the scaled `state` (n,) until the stroboscopic states repeat with a period k.

    `integrator`: method and steps, with the tolerance at the start. The motion has settled if the
    last k + 1 states differ from the states k periods earlier by less than `tolerance` (scaled).
    For large states, the noise of the steps replaces `tolerance` if it is greater. k is the
    smallest such period that the equation allows (`RotorPair.orders`), at most `max_orbit` ≤ 8,
    rounded up where the equation repeats after several mesh periods. Steps become finer after
    `_PATIENCE`. The transient ends unsettled after `max_periods` mesh periods. `pieces`: as for
    `strobe`."""
    orders, block = pair.orders(max_orbit), pair.whole(BLOCK)
    stored = max(_MEMORY, 2 * pair.whole(max_orbit) + _MORE)
    age = jnp.arange(stored)[::-1]

    def cycle(states, rtol):
        # In large states, the noise of adaptive steps is proportional to the state.
        noise = jnp.maximum(1.0, NOISE * rtol * jnp.abs(states) / tolerance)
        noise = jnp.where(jnp.isfinite(noise), noise, 1.0)

        def spread(k):
            change = jnp.max(jnp.abs(states - jnp.roll(states, k, axis=0)) / noise, axis=1)
            # Before the start the memory holds inf; inf - inf would be NaN.
            change = jnp.where(jnp.isnan(change), jnp.inf, change)
            return jnp.max(jnp.where(age <= k, change, 0.0))

        spreads = jax.vmap(spread)(orders)
        settled = spreads < tolerance
        period = jnp.where(jnp.any(settled), orders[jnp.argmax(settled)], 0)
        nearest = jnp.argmin(spreads)
        return period, orders[nearest], spreads[nearest]

    def go_on(loop):
        carry, *_ = loop
        alive = ~carry.lost & carry.solved & jnp.all(jnp.isfinite(carry.state))
        return (carry.period == 0) & alive & (carry.periods < max_periods)

    def advance(loop):
        carry, memory = loop
        rtol = integrator.rtol
        for longest, fine in _PATIENCE:
            rtol = jnp.where(carry.periods < longest, rtol, jnp.minimum(rtol, fine))
        how = dataclasses.replace(integrator, rtol=rtol)
        part = strobe(pair, carry.state, block, how, pieces)
        memory = jnp.concatenate([memory[block:], part.states])
        end = part.states[-1]
        lost = pair.lost(end)
        sound = part.solved & ~lost & jnp.all(jnp.isfinite(end))
        period, nearest, spread = cycle(memory, rtol.astype(memory.dtype))
        new = Transient(
            state=end,
            period=jnp.where(sound, period, 0),
            nearest=nearest,
            spread=spread,
            periods=carry.periods + block,
            lost=lost,
            solved=part.solved,
            steps=carry.steps + part.steps,
            pieces=jax.tree.map(
                lambda old, x: jnp.concatenate([old[block:], x]), carry.pieces, part.pieces
            ),
        )
        return new, memory

    start = Transient(
        state=state,
        period=jnp.zeros((), int),
        nearest=jnp.ones((), int),
        spread=jnp.full_like(state[0], jnp.inf),
        periods=jnp.zeros((), int),
        lost=jnp.zeros((), bool),
        solved=jnp.ones((), bool),
        steps=jnp.zeros((), int),
        pieces=None if pieces is None else no_pieces(pair, state, max_orbit, pieces),
    )
    memory = jnp.full((stored, *state.shape), jnp.inf, state.dtype)
    return lax.while_loop(go_on, advance, (start, memory))[0]


def no_pieces(
    pair: RotorPair,
    state: Float[Array, " n"],
    longest: int,
    pieces: tuple[int, NDArray[np.float64]],
) -> Pieces:
    """Return the placeholder for `Transient.pieces` of `pair`, with states like `state` (n,).

    `longest`: longest period of an orbit (mesh periods); `pieces`: as for `strobe`."""
    count, inside = pieces
    block = pair.whole(BLOCK)
    shape = -(-pair.whole(longest) // block) * block, count
    nothing = jnp.zeros(shape, state.dtype)
    states = jnp.zeros((*shape, *state.shape), state.dtype)
    return Pieces(nothing, states, jnp.zeros((*shape, len(inside), *state.shape), state.dtype))
