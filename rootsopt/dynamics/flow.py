"""Integration of a rotor pair over whole mesh periods, with or without the contact force.

`diffrax.diffeqsolve` also serves events, dense output at given times and reverse mode. Each call
compiles some thousand operations for them. The loop here (`integrated`) has the same solvers and
step size controls, takes the same steps, and compiles quickly.
"""

from typing import Any, NamedTuple, cast

import diffrax
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import NDArray

from rootsopt.dynamics.integrator import Integrator
from rootsopt.dynamics.pair import RotorPair

# Distance from 1 (in multiples of eps) below which a step ends at 1. Otherwise the last step might
# be too short for its own rounding errors. diffrax has the same rule.
_NEARLY = 50.0


class Records(NamedTuple):
    """All accepted steps of an integration, padded with inf.

    `ends` (steps,): ends of the steps; `dense`: what `solver.interpolation_cls` needs in order to
    interpolate within each step.
    """

    ends: Float[Array, " steps"]
    dense: Any


class Integrated(NamedTuple):
    """State of an integration, and its result.

    The next step goes from `begin` to `stop`, and starts at `end` (m,), which is y at the end of
    the last one; `memory`: state of the solver; `control`: state of the step size control; `sound`:
    whether neither has failed; `steps`: number of accepted and rejected steps; `accepted`: number
    of accepted steps; `records`: the accepted steps, or None if they were not recorded.
    """

    begin: Float[Array, ""]
    stop: Float[Array, ""]
    end: Float[Array, " m"]
    memory: Any
    control: Any
    sound: Bool[Array, ""]
    steps: Int[Array, ""]
    accepted: Int[Array, ""]
    records: Records | None

    @property
    def solved(self) -> Bool[Array, ""]:
        """Whether the solver reached the end."""
        return self.sound & ~(self.begin < 1)


def interpolated(
    out: Integrated, solver: diffrax.AbstractSolver, share: Float[Array, ""]
) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
    """Return y and its derivative at `share` of the unit interval, inside the steps of `out`."""
    assert out.records is not None
    ends, dense = out.records
    k = jnp.minimum(jnp.searchsorted(ends, share), jnp.maximum(out.accepted - 1, 0))
    begin = jnp.where(k > 0, ends[jnp.maximum(k - 1, 0)], 0.0)
    within = jax.tree.map(lambda x: x[k], dense)
    step = solver.interpolation_cls(t0=begin, t1=ends[k], **within)
    return jax.jvp(step.evaluate, (share,), (jnp.ones_like(share),))


def integrated(  # 88 lines: the functions of its loop share the settings of one call.
    term: diffrax.AbstractTerm,
    solver: diffrax.AbstractSolver,
    control: diffrax.AbstractAdaptiveStepSizeController,
    start: Float[Array, " m"],
    args: Any,
    max_steps: int,
    recorded: bool,
) -> Integrated:
    """Integrate y from `start` (m,) at 0 to 1.

    `term`: the equation, whose vector field takes the arguments (time, y, `args`); `solver`,
    `control`: method and step size control; `max_steps`: maximum number of steps, accepted or
    rejected; `recorded`: whether to return all accepted steps.
    """
    dtype = start.dtype
    zero, one = jnp.zeros((), dtype), jnp.ones((), dtype)
    nearly = dtype.type(1 - _NEARLY * float(jnp.finfo(dtype).eps))
    order: Any = solver.error_order(term)
    successful = diffrax.RESULTS.successful
    # Without the term, a plain PID control begins with a step of 0.01, as it does in `diffeqsolve`.
    # With it, diffrax would compile two more evaluations of the equation.
    first, control_start = control.init(None, zero, one, start, None, args, solver.func, order)
    first = jnp.minimum(first, one)
    memory = solver.init(term, zero, first, start, args)

    def go_on(now: Integrated):
        return (now.begin < one) & now.sound

    def advance(now: Integrated) -> Integrated:
        y, error, dense, memory, result = solver.step(
            term, now.begin, now.stop, now.end, args, now.memory, made_jump=False
        )
        # Not a number means that the step was too long.
        error = cast(Array, error)
        error = jnp.where(jnp.isnan(error), jnp.inf, error)
        keep: Any
        keep, begin, stop, _, control_state, control_result = control.adapt_step_size(
            now.begin, now.stop, now.end, y, args, error, order, now.control
        )
        begin = jnp.minimum(begin, one)
        last = jnp.where(keep, one, begin + 0.5 * (one - begin))
        records = now.records
        if records is not None:
            records = jax.tree.map(
                lambda x, kept: eqxi.buffer_at_set(kept, now.accepted, x, pred=keep),
                Records(begin, dense),
                records,
            )
        return Integrated(
            begin=begin,
            stop=jnp.where(stop > nearly, last, stop),
            end=jnp.where(keep, y, now.end),
            memory=jax.tree.map(lambda x, old: jnp.where(keep, x, old), memory, now.memory),
            control=control_state,
            sound=now.sound & (~keep | (result == successful)) & (control_result == successful),
            steps=now.steps + 1,
            accepted=now.accepted + keep,
            records=records,
        )

    records = None
    if recorded:
        shapes = jax.eval_shape(
            lambda: solver.step(term, zero, first, start, args, memory, made_jump=False)[2]
        )
        room = jax.tree.map(lambda x: jnp.full((max_steps, *x.shape), jnp.inf, x.dtype), shapes)
        records = Records(jnp.full(max_steps, jnp.inf, dtype), room)
    nothing = jnp.zeros((), int)
    state = Integrated(
        begin=zero,
        stop=first,
        end=start,
        memory=memory,
        control=control_start,
        sound=jnp.ones((), bool),
        steps=nothing,
        accepted=nothing,
        records=records,
    )
    # equinox keeps `vmap` from copying all records in every step.
    return eqxi.while_loop(
        go_on,
        advance,
        state,
        max_steps=max_steps,
        buffers=lambda now: now.records,
        kind="lax",
    )


SAMPLES, _BESIDE = 630, 64
"""Number of uniform samples per mesh period, and of further ones around the greatest force."""


class Strobe(NamedTuple):
    """Scaled states at the ends of successive mesh periods.

    `states` (periods, n); `steps`: total number of solver steps; `solved`: whether the solver
    succeeded in every mesh period; `pieces`: the motion, if it was requested.
    """

    states: Float[Array, "periods n"]
    steps: Int[Array, ""]
    solved: Bool[Array, ""]
    pieces: "Pieces | None" = None


class Pieces(NamedTuple):
    """A motion over p mesh periods, each divided into e pieces with the same number of steps.

    `ends` (p, e): ends of the pieces, as fractions of the mesh period; `states` (p, e, n): scaled
    states at their starts; `slopes` (p, e, s, n): derivatives of the states with respect to time
    (mesh periods) at s instants inside each piece.
    """

    ends: Float[Array, "p e"]
    states: Float[Array, "p e n"]
    slopes: Float[Array, "p e s n"]


def strobe(
    pair: RotorPair,
    state: Float[Array, " n"],
    periods: int,
    integrator: Integrator,
    pieces: tuple[int, NDArray[np.float64]] | None = None,
) -> Strobe:
    """Integrate the scaled `state` (n,) over `periods` mesh periods from φ1 = 0, or from where the
    pair `begins`.

    `pieces`: number of pieces of each mesh period and instants inside a piece (fractions of its
    length) for `Strobe.pieces`; `None`: no pieces.

    A step ends exactly at the end of each mesh period. Interpolated states would have an error far
    above the tolerance, which could hide that the motion repeats.
    """
    solver = integrator.solver()
    term = diffrax.ODETerm(lambda tau, y, pair: pair.derivative(tau, y)[0])
    numbers = None if pair.repeats == 1 else jnp.arange(periods)
    control = integrator.controller(pair)

    def one_period(state, number):
        own, how, recorded = pair, control, pieces is not None
        if number is not None:
            own = pair.later(number)
            how = integrator.controller(own)
        out = integrated(term, solver, how, state, own, integrator.max_steps, recorded)
        made = None if pieces is None else _divided(out, solver, *pieces)
        return out.end, (out.end, out.steps, out.solved, made)

    _, (states, steps, solved, made) = lax.scan(one_period, state, numbers, length=periods)
    return Strobe(states, jnp.sum(steps), jnp.all(solved), made)


def _divided(
    out: Integrated, solver: diffrax.AbstractSolver, count: int, inside: NDArray[np.float64]
) -> Pieces:
    """Return the mesh period `out` in `count` pieces with the same number of steps.

    `inside`: instants inside a piece, as fractions of its length."""
    assert out.records is not None
    last = jnp.maximum(out.accepted - 1, 0)
    edges = jnp.append(jnp.zeros_like(out.end[:1]), out.records.ends)
    number = jnp.arange(count + 1) * (last + 1) / count
    whole = jnp.minimum(number.astype(int), last)
    part = number - whole
    share = edges[whole] + part * (edges[whole + 1] - edges[whole])

    begin, length = share[:-1, None], jnp.diff(share)[:, None]
    each = jax.vmap(jax.vmap(lambda share: interpolated(out, solver, share)))
    states, slopes = each(begin + length * np.append(0.0, inside))
    return Pieces(share[1:], states[:, 0], slopes[:, 1:])


class Period(NamedTuple):
    """A motion over one mesh period, with statistics of the contact force.

    The peak in `response` (3,) is that of `SAMPLES` uniform samples; `duration`: in usual mesh
    periods, from which it differs if rotor 1 is free."""

    end: Float[Array, " n"]
    response: Float[Array, " 3"]
    states: Float[Array, "samples n"]
    depth: Float[Array, ""]
    solved: Bool[Array, ""]
    duration: Float[Array, ""]


def one_period(pair: RotorPair, start: Float[Array, " n"], integrator: Integrator) -> Period:
    """Integrate the scaled state `start` (n,) over one mesh period from φ1 = 0, or from where the
    pair `begins`.

    Mean and mean square of the force are integrated under the same error control as the motion."""
    count, dtype = start.shape[0], start.dtype
    control, solver = integrator.controller(pair), integrator.solver()

    def slope(tau, y, pair):
        moved, contact = pair.derivative(tau, y[:count])
        force = contact.total / pair.force_scale
        rates = jnp.stack([force, force**2])
        if pair.free:
            rates = pair.lapse(y[:count]) * jnp.append(rates, jnp.ones_like(force))
        return jnp.append(moved, rates)

    begun = jnp.append(start, jnp.zeros(2 + pair.free, dtype))
    most, term = integrator.max_steps, diffrax.ODETerm(slope)
    out = integrated(term, solver, control, begun, pair, most, recorded=True)

    def sample(top, number):
        """Return the sample with this `number`, and time and force of the greatest uniform one.

        Samples after the uniform ones lie around the greatest uniform sample."""
        place, height = top
        share, beside = number / SAMPLES, 2 * (number - SAMPLES) / _BESIDE - 1
        share = jnp.where(share < 1, share, jnp.clip(place + beside / SAMPLES, 0.0, 1.0))
        swing = interpolated(out, solver, share)[0][:count]
        contact = pair.contact_at(share, swing)
        higher = (contact.total > height) & (number < SAMPLES)
        top = jnp.where(higher, share, place), jnp.where(higher, contact.total, height)
        return top, (swing, contact.total, contact.depth)

    nothing = jnp.zeros((), dtype)
    numbers = jnp.arange(SAMPLES + _BESIDE, dtype=dtype)
    states, force, depth = lax.scan(sample, (nothing, nothing), numbers)[1]
    duration = out.end[-1] if pair.free else jnp.ones((), dtype)
    mean, square = out.end[count : count + 2] / duration
    unit = pair.force_scale
    response = jnp.stack([unit * mean, unit**2 * square, jnp.max(force)])
    return Period(out.end[:count], response, states[:SAMPLES], jnp.max(depth), out.solved, duration)
