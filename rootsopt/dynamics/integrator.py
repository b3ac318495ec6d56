"""Settings of the solver, and integration of the equation of motion: method, tolerance and steps.

In free flight the motion is a parabola, for which a high-order method estimates an error of zero.
Steps grow until one of them skips a whole contact between two stages, at any tolerance. Two
integrations whose steps differ only by rounding then differ by the impulse of that contact.

Therefore a step ends where the parabola through the last step reaches an edge of free flight: a
value of ε at which contact may begin. The next step starts short. A step that has passed an edge by
too much is repeated."""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import NDArray

from rootsopt.dynamics.flow import Pieces, strobe
from rootsopt.dynamics.orbit import Measures
from rootsopt.dynamics.pair import RotorPair

METHODS: dict[str, Callable[..., diffrax.AbstractERK]] = {
    "tsit5": diffrax.Tsit5,
    "dopri8": diffrax.Dopri8,
}
# Upper limits on the step length: an absolute length (mesh periods), and a multiple of
# `Timescales.fall`. The smaller limit applies. In free flight, the error control alone would let a
# step skip a short contact of the gear. The third number, divided by `max_steps`, is the least
# value (mesh periods) of the second limit. Steps of this length use at most a quarter of
# `max_steps` per mesh period.
_LONGEST = 1 / 32, 1 / 8, 4.0


class Integrator(eqx.Module):
    """Settings for integrating the equation of motion.

    `method`: a key of `METHODS`; `rtol`: relative tolerance, also used as absolute tolerance, since
    states are scaled; `max_steps`: maximum number of steps in one integration.
    """

    method: str = eqx.field(static=True)
    rtol: Float[Array, ""]
    max_steps: int = eqx.field(static=True)

    @property
    def tolerance(self) -> Float[Array, ""]:
        """`rtol` or, if greater, 20 rounding errors."""
        return jnp.maximum(self.rtol, 20 * float(jnp.finfo(float).eps))

    def solver(self) -> diffrax.AbstractERK:
        """Return the diffrax solver."""
        return METHODS[self.method](scan_kind="lax")

    def controller(self, pair: RotorPair) -> "diffrax.PIDController | LandingControl":
        """Return the step size control for `pair`, whose `timescales` limit the steps.

        The result is a `LandingControl` if they are known. Otherwise it is a plain
        `diffrax.PIDController`."""
        rtol, longest = self.tolerance, jnp.asarray(_LONGEST[0])
        if pair.timescales is not None:
            fall = pair.timescales.fall / pair.mesh_period
            flying = jnp.maximum(_LONGEST[1] * fall, _LONGEST[2] / self.max_steps)
            longest = jnp.minimum(longest, flying)
        base = diffrax.PIDController(rtol=rtol, atol=rtol, dtmax=longest)
        return base if pair.timescales is None else LandingControl.of(base, pair)


class Solver(eqx.Module):
    """Settings for finding a steady motion.

    `transient`, `orbit`: integrators of the transient, and of the check of an orbit, whose
    tolerance sets the accuracy of the orbit; `measures`: averages of the force to compute;
    `max_periods`: maximum length of the transient (mesh periods); `probe_chaos`: 1 to integrate a
    window of a motion that does not settle (see `closed.examined`), 0 to skip it; `max_orbit`:
    longest period of an orbit to find (mesh periods), at most 8; `variation`: whether an orbit has
    its `Orbit.variation`. `max_periods` and `probe_chaos` are floats, as are all leaves.
    """

    transient: Integrator
    orbit: Integrator
    measures: Measures
    max_periods: Float[Array, ""]
    probe_chaos: Float[Array, ""]
    max_orbit: int = eqx.field(static=True)
    variation: bool = eqx.field(static=True, default=False)


# Time (mesh periods) after reaching an edge at which a step should end. A contact shorter than this
# may be missed.
_BEYOND = 1e-4
# Time since passing an edge, in units of `_BEYOND`, above which a step is repeated with a shorter
# length.
_LATE = 10.0
# Maximum length of the first step after an edge, in units of `_BEYOND`.
_AFTER = 5.0
# Distance (scaled ε) between the vertex of the parabola and an edge below which the next step ends
# no later than at the vertex.
_CLOSE = 0.05
# Maximum step (mesh periods) where ε alone does not determine whether the flanks touch: beyond the
# clearance, or with displaced axes.
_INSIDE = 1 / 128
# Two lengths for the first step: an absolute length (mesh periods), and a multiple of
# `Timescales.swing`. The smaller one is used. The error control rejects a first step that is too
# long.
_FIRST = 1e-3, 0.05


class LandingControl(diffrax.AbstractAdaptiveStepSizeController):
    """The step size control `base`, extended so that steps end where free flight may end.

    `edges`: scaled ε at which a flank or the gear may begin to touch; `inside`: scaled |ε| above
    which a flank may touch at any time; `first`: length of the first step (mesh periods);
    `moving`: pair whose parts have `edges`, which then are 0, relative to those of the parts; None:
    the edges do not move.
    """

    base: "diffrax.PIDController | LandingControl"
    edges: Float[Array, " edges"]
    inside: Float[Array, ""]
    first: Float[Array, ""]
    moving: RotorPair | None = None

    @classmethod
    def of(cls, base: diffrax.PIDController, pair: RotorPair) -> "LandingControl":
        """Return the control based on `base` for a `pair` whose `timescales` are known."""
        assert pair.timescales is not None
        scale = pair.angle_scale
        play = pair.timescales.free / scale
        edges, own = [play, -play], [edge for part in pair.all_parts for edge in part.edges]
        if pair.repeats == 1:
            edges += [edge / scale for edge in own]
        inside = jnp.where(play > 0, play, jnp.inf)
        if pair.two_sided:
            inside = jnp.zeros_like(play)
        dtype = scale.dtype
        swing = _FIRST[1] * pair.timescales.swing / pair.mesh_period
        swing = jnp.minimum(_FIRST[0], swing)
        numbers = lax.stop_gradient((jnp.stack(edges), inside, swing))
        found = cls(base, *(x.astype(dtype) for x in numbers))  # pyright: ignore
        if pair.repeats == 1 or not own:
            return found
        zeros, frozen = jnp.zeros(len(own), dtype), lax.stop_gradient(pair)
        return cls(found, zeros, jnp.full_like(play, jnp.inf), found.first, frozen)  # pyright: ignore

    @property
    def rtol(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.base.rtol

    @property
    def atol(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.base.atol

    @property
    def norm(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.base.norm

    def wrap(self, direction):
        return self

    # diffrax prescribes the parameters of `init` and `adapt_step_size`.
    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):
        # Without `dt0`, diffrax adds no check of it. The check would be a callback to Python, and
        # programs with callbacks cannot be cached.
        first = self.first if dt0 is None else dt0
        return self.base.init(terms, t0, t1, y0, first, args, func, error_order)

    def adapt_step_size(self, t0, t1, y0, y1_candidate, args, y_error, error_order, state):
        keep, start, stop, jump, new, result = self.base.adapt_step_size(
            t0, t1, y0, y1_candidate, args, y_error, error_order, state
        )
        step = t1 - t0
        before, after = y0[:2], y1_candidate[:2]
        if self.moving is not None:
            before, after = self._relative(t0, before), self._relative(t1, after)
        away, late = self._passed(before, after, step)
        again = keep & (late > _LATE * _BEYOND)
        # Step to the edge, estimated by the secant, and a little beyond.
        shorter = jnp.maximum(step - late, 0.0) + _BEYOND
        ahead = self._ahead(before, after, step)
        ahead = ahead if self.moving is None else jnp.min(ahead)
        most = jnp.where(away, _AFTER * _BEYOND, ahead)
        following = jnp.minimum(stop - start, most)
        following = jnp.where(again, shorter, jnp.where(keep, following, stop - start))
        keep &= ~again
        start = jnp.where(again, t0, start)
        new = tuple(jnp.where(again, old, x) for old, x in zip(state, new, strict=True))
        return keep, start, start + following, jump, new, result

    def _relative(self, tau, state):
        """Return ε and dε/dτ (2, edges) of a scaled `state` relative to each moving edge at `tau`
        (mesh periods)."""
        pair = self.moving
        assert pair is not None

        def edges(tau):
            phi = pair.angle(tau)
            own = [edge for part in pair.all_parts for edge in part.edges_at(phi)]
            return jnp.stack(own) / pair.angle_scale

        return state[:, None] - jnp.stack(jax.jvp(edges, (tau,), (jnp.ones_like(tau),)))

    def _passed(self, before, after, step):
        """Return whether a step has passed an edge, and the time since then (mesh periods).

        `before`, `after`: scaled ε and dε/dτ at both ends of the step; `step`: its length (mesh
        periods). The time is 0 if no edge was passed."""
        passed = (before[0] - self.edges) * (after[0] - self.edges) < 0
        rate = jnp.maximum(jnp.abs(after[1]), jnp.abs(after[0] - before[0]) / step)
        ago = jnp.abs(after[0] - self.edges) / rate
        return jnp.any(passed), jnp.max(jnp.where(passed, ago, 0.0))

    def _ahead(self, before, after, step):
        """Return the maximum length (mesh periods) of the next step.

        A step of this length ends where ε next reaches an edge. `before`, `after`: scaled ε and
        dε/dτ at both ends of the last step; `step`: its length (mesh periods)."""
        place, rate = after
        bend = (rate - before[1]) / step
        away = place - self.edges
        square = rate**2 - 2 * bend * away
        half = -(rate + jnp.where(rate < 0, -1, 1) * jnp.sqrt(jnp.maximum(square, 0.0)))
        roots = jnp.stack([half / _known(bend), 2 * away / _known(half)])
        meets = (roots > 0) & (square >= 0)
        times = jnp.where(meets, roots + _BEYOND, jnp.inf)
        # With its vertex this close to an edge, the parabola is not known well enough to tell
        # whether the motion reaches the edge.
        turn = -rate / _known(bend)
        beside = jnp.min(jnp.abs(away + turn * (rate + bend * turn / 2))) < _CLOSE
        turning = beside & (turn > 2 * _BEYOND)
        longest = jnp.minimum(jnp.min(times), jnp.where(turning, turn, jnp.inf))
        return jnp.where(jnp.abs(place) > self.inside, jnp.minimum(longest, _INSIDE), longest)


def _known(x):
    """Return x with zeros replaced by infinity, for use as a divisor."""
    return jnp.where(x == 0, jnp.inf, x)


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
