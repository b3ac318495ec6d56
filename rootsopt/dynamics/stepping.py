"""Integration with a diffrax solver over the unit interval, in a program that compiles quickly.

`diffrax.diffeqsolve` also serves events, dense output at given times and reverse mode. Each call
compiles some thousand operations for them. This loop has the same solvers and step size controls,
and takes the same steps.
"""

from typing import Any, NamedTuple, cast

import diffrax
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

# Distance from 1 (in multiples of eps) below which a step ends at 1. Otherwise the last step might
# be too short for its own rounding errors. diffrax has the same rule.
_NEARLY = 50.0


class Records(NamedTuple):
    """All accepted steps of an integration, padded with inf.

    `ends` (steps,): ends of the steps; `after` (steps, m): y at the ends; `dense`: what
    `solver.interpolation_cls` needs in order to interpolate within each step.
    """

    ends: Float[Array, " steps"]
    after: Float[Array, "steps m"]
    dense: Any


class Integrated(NamedTuple):
    """Result of an integration.

    `end` (m,): y at the end; `steps`: number of accepted and rejected steps; `accepted`: number of
    accepted steps; `solved`: whether the solver reached the end; `control`: final state of the step
    size control; `records`: the accepted steps, or None if they were not recorded.
    """

    end: Float[Array, " m"]
    steps: Int[Array, ""]
    accepted: Int[Array, ""]
    solved: Bool[Array, ""]
    control: Any
    records: Records | None


def interpolated(
    out: Integrated, solver: diffrax.AbstractSolver, share: Float[Array, ""]
) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
    """Return y and its derivative at `share` of the unit interval, inside the steps of `out`."""
    assert out.records is not None
    ends, _, dense = out.records
    k = jnp.minimum(jnp.searchsorted(ends, share), jnp.maximum(out.accepted - 1, 0))
    begin = jnp.where(k > 0, ends[jnp.maximum(k - 1, 0)], 0.0)
    within = jax.tree.map(lambda x: x[k], dense)
    step = solver.interpolation_cls(t0=begin, t1=ends[k], **within)
    return jax.jvp(step.evaluate, (share,), (jnp.ones_like(share),))


class _State(NamedTuple):
    """State of the loop over steps.

    The next step goes from `begin` to `stop`, and starts at `y`. `memory`: state of the solver;
    `sound`: whether neither the solver nor the control has failed. The other fields are those of
    `Integrated`."""

    begin: Float[Array, ""]
    stop: Float[Array, ""]
    y: Float[Array, " m"]
    memory: Any
    control: Any
    sound: Bool[Array, ""]
    steps: Int[Array, ""]
    accepted: Int[Array, ""]
    records: Records | None


def integrated(  # 97 lines: the functions of its loop share the settings of one call.
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

    def go_on(now: _State):
        return (now.begin < one) & now.sound

    def advance(now: _State) -> _State:
        y, error, dense, memory, result = solver.step(
            term, now.begin, now.stop, now.y, args, now.memory, made_jump=False
        )
        # Not a number means that the step was too long.
        error = cast(Array, error)
        error = jnp.where(jnp.isnan(error), jnp.inf, error)
        keep: Any
        keep, begin, stop, _, control_state, control_result = control.adapt_step_size(
            now.begin, now.stop, now.y, y, args, error, order, now.control
        )
        begin = jnp.minimum(begin, one)
        last = jnp.where(keep, one, begin + 0.5 * (one - begin))
        records = now.records
        if records is not None:
            records = jax.tree.map(
                lambda x, kept: eqxi.buffer_at_set(kept, now.accepted, x, pred=keep),
                Records(begin, y, dense),
                records,
            )
        return _State(
            begin=begin,
            stop=jnp.where(stop > nearly, last, stop),
            y=jnp.where(keep, y, now.y),
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
            lambda: solver.step(term, zero, first, start, args, memory, made_jump=False)[:3:2]
        )
        room = jax.tree.map(lambda x: jnp.full((max_steps, *x.shape), jnp.inf, x.dtype), shapes)
        records = Records(jnp.full(max_steps, jnp.inf, dtype), *room)
    nothing = jnp.zeros((), int)
    state = _State(
        begin=zero,
        stop=first,
        y=start,
        memory=memory,
        control=control_start,
        sound=jnp.ones((), bool),
        steps=nothing,
        accepted=nothing,
        records=records,
    )
    # equinox keeps `vmap` from copying all records in every step.
    state = eqxi.while_loop(
        go_on,
        advance,
        state,
        max_steps=max_steps,
        buffers=lambda now: now.records,
        kind="lax",
    )
    return Integrated(
        end=state.y,
        steps=state.steps,
        accepted=state.accepted,
        solved=state.sound & ~(state.begin < one),
        control=state.control,
        records=state.records,
    )
