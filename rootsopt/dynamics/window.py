"""A window of a motion that has not settled: its forces, and its largest Lyapunov exponent.

The exponent distinguishes chaos from a long transient. It is the mean logarithmic growth rate of
the distance to a second motion. This motion is put back to a fixed distance every mesh period
(Benettin et al., Meccanica 15 (1980) 9-20).

A tangent vector instead of a second motion was tried. On coarse steps, products of linearised
impacts grow although the motion repeats: at 1e-6, by a factor of 8 per mesh period beside an orbit
with the multiplier 0.1. Two motions at a finite distance show what the motion does, provided that
the distance exceeds the noise of steps and rounding. Every second batch therefore uses a distance
eight times smaller: noise then makes the growth factor eight times greater, chaos does not.

Also simulates the transient, until the motion repeats. The pair is forced with the mesh period. The
states at the end of each mesh period (the stroboscopic states) therefore settle on a cycle of k
points."""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import NDArray

from rootsopt.dynamics.flow import Period, Pieces, one_period, strobe
from rootsopt.dynamics.integrator import Integrator
from rootsopt.dynamics.pair import RotorPair

PERIODS = 128
"""Length of a window (mesh periods)."""
# Number of batches into which a window is divided to estimate the standard error of the Lyapunov
# exponent.
_BATCHES = 16
# Scaled distance between the two motions: the first number times the tolerance, at least the second
# and at most the third number.
_APART = 1e4, 1e-2, 0.2
# Divisor of this distance in every second batch.
_NEARER = 8.0
# Rounding errors that replace the tolerance, if they exceed it, when the distance is chosen.
_ROUNDINGS = 200.0
# Difference between the growth rates at both distances above which they show noise or the finite
# distance rather than the motion.
_ALIKE = float(np.log(3.0))
# Number of states stored per mesh period.
_KEPT = 105
# Force, in units of the pair's `force_scale`, below which differences are relative to this force.
# The integration does not resolve the small forces of flanks that barely touch.
_FAINT = 1e-3
# Array type of a window: JAX arrays, or NumPy arrays after a copy from the device.
_Arrays = Array | np.ndarray


class Window(NamedTuple):
    """A motion over p mesh periods, of which the first `done` have been integrated.

    `growth` (p,): logarithm of the factor by which the distance between both motions grew in each
    mesh period; `response` (p, 3): mean (N), mean square (N²) and peak (N) of the contact force in
    each mesh period; `states` (p, s, n): uniform samples, scaled; `depth`: greatest penetration (m;
    negative: least gap); `solved`: whether the solver succeeded; `end` (n,): last scaled state;
    `beside` (n,): scaled state of the second motion; `second`: whether the second motion is
    integrated next; `apart`: distance of both motions at the start of a mesh period, in batches
    with an even number.
    """

    growth: Float[Array, " p"]
    response: Float[Array, "p 3"]
    states: Float[Array, "p s n"]
    depth: Float[Array, ""]
    solved: Bool[Array, ""]
    end: Float[Array, " n"]
    beside: Float[Array, " n"]
    second: Bool[Array, ""]
    apart: Float[Array, ""]
    done: Int[Array, ""]

    @classmethod
    def empty(
        cls, state: Float[Array, " n"], periods: int, tolerance: Float[Array, ""]
    ) -> "Window":
        """Return a window of `periods` mesh periods from the scaled `state` (n,), before any
        integration.

        `tolerance`: relative tolerance of the integrator."""
        count, dtype = state.shape[0], state.dtype
        times, least, most = _APART
        rounding = _ROUNDINGS * float(jnp.finfo(dtype).eps)
        apart = jnp.clip(times * jnp.maximum(tolerance, rounding), least, most).astype(dtype)
        return cls(
            growth=jnp.zeros(periods, dtype),
            response=jnp.zeros((periods, 3), dtype),
            states=jnp.zeros((periods, _KEPT, count), dtype),
            depth=jnp.full((), -jnp.inf, dtype),
            solved=jnp.ones((), bool),
            end=state,
            beside=state.at[0].add(apart),
            second=jnp.zeros((), bool),
            apart=apart,
            done=jnp.zeros((), int),
        )

    @property
    def start(self) -> Float[Array, " n"]:
        """Scaled state from which the next mesh period is integrated."""
        return jnp.where(self.second, self.beside, self.end)

    def after(self, out: Period) -> "Window":
        """Return the window after one more integration over a mesh period; `out`: its flow.

        The two motions take turns; the second one is then put back to its fixed distance."""
        row, every = self.done, out.states.shape[0] // _KEPT

        def first(new, old):
            return jnp.where(self.second, old, new)

        size = jnp.linalg.norm(out.end - self.end)
        least = float(jnp.finfo(size.dtype).eps) * self.apart
        ahead = jnp.zeros_like(self.end).at[0].set(1.0)
        direction = jnp.where(size > least, (out.end - self.end) / size, ahead)
        growth = jnp.log(jnp.maximum(size, least) / self._distance(row))
        beside = self.end + self._distance(row + 1) * direction
        kept = first(out.response[:3], self.response[row])
        states = first(out.states[::every][:_KEPT], self.states[row])
        return self._replace(
            growth=self.growth.at[row].set(growth),
            response=self.response.at[row].set(kept),
            states=self.states.at[row].set(states),
            depth=first(jnp.maximum(self.depth, out.depth), self.depth),
            solved=self.solved & out.solved,
            end=first(out.end, self.end),
            beside=first(self.beside, beside),
            second=~self.second,
            done=row + self.second,
        )

    def _distance(self, period: Int[Array, ""]) -> Float[Array, ""]:
        """Return the scaled distance of both motions at the start of the mesh period `period`."""
        batch = period * _BATCHES // max(self.growth.shape[0], 1)
        return jnp.where(batch % 2 == 0, self.apart, self.apart / _NEARER)

    @property
    def _rates(self) -> Float[_Arrays, "2 b"]:
        """Mean `growth` in each batch: row 0 at the far distance, row 1 at the near one."""
        return self.growth.reshape(_BATCHES // 2, 2, -1).mean(axis=2).T

    @property
    def exponent(self) -> Float[_Arrays, ""]:
        """Largest Lyapunov exponent per mesh period."""
        xp = _numpy_of(self.growth)
        return xp.asarray(xp.mean(self.growth))

    @property
    def error(self) -> Float[_Arrays, ""]:
        """Standard error of `exponent`, from the means of batches with the same distance."""
        xp = _numpy_of(self.growth)
        return xp.asarray(xp.sqrt(xp.mean(xp.var(self._rates, axis=1, ddof=1)) / _BATCHES))

    @property
    def chaotic(self) -> Bool[Array, ""]:
        """Whether motions diverge at both distances alike.

        The exponent must exceed three standard errors. The rate at each distance must exceed two
        standard errors of this rate, which are √2 times greater."""
        far, near = jnp.mean(self._rates, axis=1)
        alike = jnp.abs(near - far) < _ALIKE
        sure = self.exponent > 3 * self.error
        each = jnp.minimum(far, near) > 2 * 2**0.5 * self.error
        return jnp.asarray(sure & each & alike)

    @property
    def forces(self) -> Float[_Arrays, " 3"]:
        """Mean (N), mean square (N²) and peak (N) of the contact force over the window."""
        xp = _numpy_of(self.response)
        mean, square, peak = self.response.T
        return xp.stack([xp.mean(mean), xp.mean(square), xp.max(peak)])


def _numpy_of(array: Any) -> Any:
    """Return the module NumPy if `array` is a NumPy array, else jax.numpy.

    NumPy operations need no compilation."""
    return np if isinstance(array, np.ndarray) else jnp


def lyapunov(
    pair: RotorPair, state: Float[Array, " n"], periods: int, integrator: Integrator
) -> Window:
    """Return a window of `periods` mesh periods (a multiple of 16), integrated from the scaled
    `state`."""

    def step(window: Window) -> Window:
        return window.after(one_period(pair.later(window.done), window.start, integrator))

    def goes_on(window: Window) -> Bool[Array, ""]:
        alive = window.solved & jnp.all(jnp.isfinite(window.start))
        return (window.done < periods) & alive

    begun = Window.empty(state, periods, integrator.tolerance)
    return lax.while_loop(goes_on, step, begun)


def integrated_difference(
    pair: RotorPair,
    orbit: tuple[Float[Array, " n"], Float[Array, " r"]],
    period: Int[Array, ""],
    integrator: Integrator,
) -> Float[Array, ""]:
    """Return the difference between a closed orbit and an integration over its period.

    `orbit`: its scaled state (n,) at φ1 = 0, and its forces (r,): mean (N), mean square (N²), and
    others, which are ignored; `period` (mesh periods). The result is the greatest of the relative
    differences in mean and RMS force, and the scaled distance between start and end. It is inf if
    the solver fails."""
    state, forces = orbit

    def step(number: Any, carry):
        here, total, solved = carry
        made = one_period(pair.later(number), here, integrator)
        rates = jnp.append(made.response[:2], jnp.ones_like(made.duration))
        return made.end, total + made.duration * rates, solved & made.solved

    begun = state, jnp.zeros(3, state.dtype), jnp.ones((), bool)
    end, total, solved = lax.fori_loop(0, period, step, begun)
    sizes = jnp.stack([total[:2] / total[2], forces[:2]])
    integrated, given = sizes.at[:, 1].set(jnp.sqrt(sizes[:, 1]))
    apart = jnp.abs(integrated - given) / jnp.maximum(given, _FAINT * pair.force_scale)
    largest = jnp.maximum(jnp.max(apart), jnp.max(jnp.abs(end - state)))
    return jnp.where(solved & jnp.isfinite(largest), largest, jnp.inf)


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
    smallest such period that the equation allows (`RotorPair.orders`). It is at most `max_orbit` ≤
    8, rounded up where the equation repeats after several mesh periods. Steps become finer after
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
