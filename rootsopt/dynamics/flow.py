"""Integration of a rotor pair over whole mesh periods with diffrax."""

from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from rootsopt.dynamics.pair import RotorPair

METHODS: dict[str, type[diffrax.AbstractSolver]] = {
    "tsit5": diffrax.Tsit5,
    "dopri5": diffrax.Dopri5,
    "dopri8": diffrax.Dopri8,
    "kvaerno3": diffrax.Kvaerno3,
    "kvaerno5": diffrax.Kvaerno5,
}


_FIRST_STEP = 1e-3
"""First step in mesh periods; too large a one is rejected by the error control."""


class Integrator(eqx.Module):
    """How the equation is integrated.

    `method`: a key of `METHODS` (tsit5, dopri5, dopri8 explicit; kvaerno3, kvaerno5
    implicit); `rtol`: relative tolerance, which is also the absolute one, the state
    being scaled; `max_steps` for one mesh period. The precision is that of the state, and
    the tolerance is never asked to be finer than some twenty roundings of it.
    """

    method: str = eqx.field(static=True)
    rtol: Float[Array, ""]
    max_steps: int = eqx.field(static=True)

    @property
    def solver(self) -> diffrax.AbstractSolver:
        return METHODS[self.method]()

    def controller(self, dtype: Any, **options: Any) -> diffrax.PIDController:
        """Step size control of states of type `dtype`."""
        floor = 20 * float(jnp.finfo(dtype).eps)
        rtol = jnp.maximum(self.rtol, floor).astype(dtype)
        return diffrax.PIDController(rtol=rtol, atol=rtol, **options)


class Strobe(NamedTuple):
    """States at the end of successive mesh periods, and how the solver fared."""

    states: Float[Array, "periods 2"]
    steps: Int[Array, ""]
    solved: Bool[Array, ""]


class Flow(NamedTuple):
    """One stretch of motion over `periods` mesh periods.

    `end`: final state; `mean`, `mean_square`, `peak` of the contact force (N, N², N);
    `peak_time` (mesh periods); `states` at uniform times, endpoint excluded; `grid`: ends
    of the steps taken (mesh periods), inf beyond the last; `steps`: accepted and rejected
    solver steps; `solved`. `slope`: derivatives of (end, mean, mean_square, peak) along
    the directions that were asked for.
    """

    end: Float[Array, "n"]
    mean: Float[Array, ""]
    mean_square: Float[Array, ""]
    peak: Float[Array, ""]
    peak_time: Float[Array, ""]
    states: Float[Array, "samples n"]
    grid: Float[Array, " steps"]
    steps: Int[Array, ""]
    solved: Bool[Array, ""]
    slope: Float[Array, "n+3 directions"]

    @property
    def response(self) -> Float[Array, "3"]:
        """(mean, mean square, peak) of the contact force."""
        return jnp.stack([self.mean, self.mean_square, self.peak])


class Directions(NamedTuple):
    """Directions to differentiate along, stacked: changes of the initial state (scaled)
    and of the pair's parameters (the pair's own structure)."""

    state: Float[Array, "directions n"]
    pair: RotorPair


class StepGrid(diffrax.AbstractAdaptiveStepSizeController):
    """Adaptive steps, or a repetition of steps recorded before.

    On repeated steps the discrete flow is a smooth function of state and parameters:
    Newton's method converges to rounding, and its derivative is exactly that of the
    variational equation on the same steps. `ends`: ends of the recorded steps (inf beyond
    the last), used where `repeat` is true. The error is controlled on the first part of
    the state alone, so that a derivative carried along does not change the motion.
    """

    pid: diffrax.PIDController
    ends: Float[Array, " steps"]
    repeat: Bool[Array, ""]

    @property
    def rtol(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.pid.rtol

    @property
    def atol(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.pid.atol

    @property
    def norm(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.pid.norm

    def wrap(self, direction):
        return eqx.tree_at(lambda self: self.pid, self, self.pid.wrap(direction))

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):
        first, state = self.pid.init(terms, t0, t1, y0, dt0, args, func, error_order)
        return jnp.where(self.repeat, self.ends[0], first), (state, jnp.asarray(1))

    def adapt_step_size(self, t0, t1, y0, y1_candidate, args, y_error, error_order, state):  # pyright: ignore[reportIncompatibleMethodOverride]
        state, count = state
        # The choice of steps is no part of what is differentiated.
        y0, y1_candidate, y_error = lax.stop_gradient((y0, y1_candidate, y_error))
        keep, start, stop, jump, state, result = self.pid.adapt_step_size(
            t0, t1, y0, y1_candidate, args, y_error, error_order, state
        )
        recorded = self.ends[jnp.minimum(count, self.ends.shape[0] - 1)]
        return (
            keep | self.repeat,
            jnp.where(self.repeat, t1, start),
            jnp.where(self.repeat, recorded, stop),
            jump & ~self.repeat,
            (state, count + 1),
            diffrax.RESULTS.where(self.repeat, diffrax.RESULTS.successful, result),
        )


def strobe(pair: RotorPair, state: Float[Array, "2"], periods: int, how: Integrator) -> Strobe:
    """Integrate the bare two states over `periods` mesh periods, from φ1 = 0.

    Steps land on the period ends: interpolated states would carry an error far above
    the tolerance and hide that the motion repeats.
    """
    ends = jnp.arange(1, periods + 1, dtype=state.dtype)
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(lambda tau, y, pair: pair.derivative(tau, y)[0]),
        how.solver,
        t0=jnp.zeros_like(ends[0]),
        t1=ends[-1],
        dt0=_FIRST_STEP * ends[0],
        y0=state,
        args=pair,
        saveat=diffrax.SaveAt(ts=ends),
        stepsize_controller=diffrax.ClipStepSizeController(
            how.controller(state.dtype), step_ts=ends
        ),
        adjoint=diffrax.ForwardMode(),
        max_steps=how.max_steps * periods,
        throw=False,
    )
    assert solution.ys is not None
    return Strobe(
        solution.ys, solution.stats["num_steps"], solution.result == diffrax.RESULTS.successful
    )


def flow(
    pair: RotorPair,
    state: Float[Array, "n"],
    periods: Float[Array, ""],
    how: Integrator,
    samples: int,
    directions: Directions | None = None,
    grid: Float[Array, " steps"] | None = None,
    repeat: Bool[Array, ""] | bool = True,
    adjoint: diffrax.AbstractAdjoint | None = None,
) -> Flow:
    """Integrate over `periods` (traced) mesh periods with the force statistics.

    Mean and mean square are integrated along with the motion, under the same error
    control. The peak is located between `samples` uniform ones. With `directions` the
    variational equation is integrated on the same steps, which gives `slope`. With `grid`
    the steps recorded there are repeated (while `repeat`), else they are chosen anew.
    Memory grows with `samples` × (1 + directions).
    """
    count = state.shape[0]
    force_unit = lax.stop_gradient(pair.force_scale)
    dynamic, static = eqx.partition(pair, eqx.is_inexact_array)

    def derivative(tau, y, dynamic):
        slope, contact = eqx.combine(dynamic, static).derivative(tau, y[:count])
        force = contact.total / force_unit
        return jnp.concatenate([slope, jnp.stack([force, force**2])])

    def with_tangents(tau, y, args):
        base, tangents = y
        dynamic, moved = args

        def push(tangent, dynamic_tangent):
            return jax.jvp(
                lambda y, dynamic: derivative(tau, y, dynamic),
                (base, dynamic),
                (tangent, dynamic_tangent),
            )

        return jax.vmap(push, out_axes=(None, 0))(tangents, moved)

    start = jnp.pad(state, (0, 2))
    if directions is None:
        # A tangent bundle of no dimensions: the same program serves both.
        moved = jax.tree.map(lambda x: jnp.zeros((0, *x.shape), x.dtype), dynamic)
        tangents = jnp.zeros((0, count + 2), state.dtype)
        term = diffrax.ODETerm(
            lambda tau, y, args: (derivative(tau, y[0], args[0]), jnp.zeros_like(y[1]))
        )
    else:
        moved = eqx.filter(directions.pair, eqx.is_inexact_array)
        tangents = jnp.pad(directions.state, ((0, 0), (0, 2)))
        term = diffrax.ODETerm(with_tangents)
    controller = StepGrid(  # pyright: ignore[reportCallIssue]
        pid=how.controller(state.dtype, norm=lambda y: optimistix.rms_norm(y[0])),
        ends=jnp.full(how.max_steps, jnp.inf, state.dtype) if grid is None else grid,
        repeat=jnp.asarray(False if grid is None else repeat),
    )
    times = periods * (jnp.arange(samples + 1) / samples).astype(state.dtype)
    solution = diffrax.diffeqsolve(
        term,
        how.solver,
        t0=times[0],
        t1=times[-1],
        dt0=_FIRST_STEP * jnp.ones_like(times[0]),
        y0=(start, tangents),
        args=(dynamic, moved),
        saveat=diffrax.SaveAt(
            subs=[
                diffrax.SubSaveAt(ts=times),
                diffrax.SubSaveAt(steps=True, fn=lambda tau, y, args: tau),
            ]
        ),
        stepsize_controller=controller,
        adjoint=diffrax.ForwardMode() if adjoint is None else adjoint,
        max_steps=how.max_steps,
        throw=False,
    )
    assert solution.ys is not None
    (bases, along), ends = solution.ys
    end, states = bases[-1], bases[:-1, :count]

    frozen, frozen_states = lax.stop_gradient((pair, states))
    forces = jax.vmap(lambda t, y: frozen.contact_at(t, y).total)(times[:-1], frozen_states)
    best = jnp.argmax(forces)
    # The motion is not closed in general: stay inside the window.
    middle = jnp.clip(best, 2, samples - 3)
    near, near_along = (lax.dynamic_slice_in_dim(x, middle - 2, 5) for x in (states, along))
    window = times[middle], times[1] - times[0], best - middle
    place = _locate_peak(*lax.stop_gradient((pair, near)), *window)

    def peak_at(near, dynamic):
        return _force_between(eqx.combine(dynamic, static), near, *window[:2], place)

    def push_peak(near_tangent, dynamic_tangent):
        return jax.jvp(peak_at, (near, dynamic), (near_tangent, dynamic_tangent))

    if directions is None:
        peak, slope = peak_at(near, dynamic), jnp.zeros((count + 3, 0), state.dtype)
    else:
        near_moved = jnp.moveaxis(near_along[..., :count], 1, 0)
        peak, peak_slope = jax.vmap(push_peak, out_axes=(None, 0))(near_moved, moved)
        final = along[-1]
        unit = jnp.stack([force_unit, force_unit**2]) / periods
        slope = jnp.concatenate(
            [final[:, :count], final[:, count:] * unit, peak_slope[:, None]], axis=1
        ).T
    return Flow(
        end=end[:count],
        mean=end[count] / periods * force_unit,
        mean_square=end[count + 1] / periods * force_unit**2,
        peak=peak,
        peak_time=window[0] + place * window[1],
        states=frozen_states,
        grid=lax.stop_gradient(ends),
        steps=solution.stats["num_steps"],
        solved=solution.result == diffrax.RESULTS.successful,
        slope=slope,
    )


def _force_between(pair, values, time, step, place):
    """Contact force at `place`, counted in samples from the middle of five: between
    samples the motion is the quartic through them."""
    x = place - jnp.arange(-2, 3, dtype=place.dtype)
    others = jnp.where(jnp.eye(5, dtype=bool), 1.0, x)
    weights = jnp.prod(others, axis=1) / jnp.asarray([24.0, -6.0, 4.0, -6.0, 24.0], x.dtype)
    return pair.contact_at(time + place * step, weights @ values).total


def _locate_peak(pair, values, time, step, best):
    """Place of the greatest force around the sample `best` (both counted from `time`).

    An impact's peak can be narrower than the sampling, with a corner where the damping
    saturates. The peak is enclosed by repeated subdivision. At the fixed instant the force
    is differentiated in the motion and the design (envelope theorem).
    """

    def zoom(_, window):
        center, width = window
        grid = jnp.clip(center + width * jnp.linspace(-1, 1, 17, dtype=step.dtype), -2.0, 2.0)
        forces = jax.vmap(lambda place: _force_between(pair, values, time, step, place))(grid)
        return grid[jnp.argmax(forces)], width / 8

    start = (jnp.asarray(best, step.dtype), jnp.ones_like(step))
    return lax.stop_gradient(lax.fori_loop(0, 5, zoom, start)[0])
