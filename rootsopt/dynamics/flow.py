"""Integration of a rotor pair over whole mesh periods with diffrax."""

from typing import NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
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
    being scaled; `max_steps` for one mesh period.
    """

    method: str = eqx.field(static=True)
    rtol: Float[Array, ""]
    max_steps: int = eqx.field(static=True)

    @property
    def solver(self) -> diffrax.AbstractSolver:
        return METHODS[self.method]()

    @property
    def controller(self) -> diffrax.PIDController:
        return diffrax.PIDController(rtol=self.rtol, atol=self.rtol)


class Strobe(NamedTuple):
    """States at the end of successive mesh periods, and how the solver fared."""

    states: Float[Array, "periods 2"]
    steps: Int[Array, ""]
    solved: Bool[Array, ""]


class Flow(NamedTuple):
    """One stretch of motion over `periods` mesh periods.

    `end`: final state; `mean`, `mean_square`, `peak` of the contact force (N, N², N);
    `peak_time` (mesh periods); `states` at uniform times, endpoint excluded;
    `steps`: accepted and rejected solver steps; `solved`.
    """

    end: Float[Array, "2"]
    mean: Float[Array, ""]
    mean_square: Float[Array, ""]
    peak: Float[Array, ""]
    peak_time: Float[Array, ""]
    states: Float[Array, "samples 2"]
    steps: Int[Array, ""]
    solved: Bool[Array, ""]


def strobe(pair: RotorPair, state: Float[Array, "2"], periods: int, how: Integrator) -> Strobe:
    """Integrate the bare two states over `periods` mesh periods, from φ1 = 0.

    Steps land on the period ends: interpolated states would carry an error far above
    the tolerance and hide that the motion repeats.
    """
    ends = jnp.arange(1.0, periods + 1)
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(lambda tau, y, pair: pair.derivative(tau, y)[0]),
        how.solver,
        t0=0.0,
        t1=float(periods),
        dt0=_FIRST_STEP,
        y0=state,
        args=pair,
        saveat=diffrax.SaveAt(ts=ends),
        stepsize_controller=diffrax.ClipStepSizeController(how.controller, step_ts=ends),
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
    state: Float[Array, "2"],
    periods: Float[Array, ""],
    how: Integrator,
    samples: int,
    adjoint: diffrax.AbstractAdjoint,
) -> Flow:
    """Integrate over `periods` (traced) mesh periods with the force statistics.

    Mean and mean square are integrated along with the motion, under the same error
    control. The peak is located between `samples` uniform ones.
    """
    force_unit = lax.stop_gradient(pair.force_scale)

    def derivative(tau, y, pair):
        slope, contact = pair.derivative(tau, y[:2])
        force = contact.total / force_unit
        return jnp.concatenate([slope, jnp.stack([force, force**2])])

    start = jnp.concatenate([state, jnp.zeros(2)])
    times = periods * jnp.arange(samples + 1) / samples
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(derivative),
        how.solver,
        t0=times[0],
        t1=times[-1],
        dt0=_FIRST_STEP,
        y0=start,
        args=pair,
        saveat=diffrax.SaveAt(ts=times),
        stepsize_controller=how.controller,
        adjoint=adjoint,
        max_steps=how.max_steps,
        throw=False,
    )
    assert solution.ys is not None
    end, states = solution.ys[-1], solution.ys[:-1, :2]

    def force(tau, state):
        return pair.contact_force(*pair.physical(tau, state)).total

    frozen, frozen_states = lax.stop_gradient((pair, states))
    forces = jax.vmap(lambda t, y: frozen.contact_at(t, y).total)(times[:-1], frozen_states)
    peak_time, peak = _refine_peak(pair, times, states, jnp.argmax(forces))
    return Flow(
        end=end[:2],
        mean=end[2] / periods * force_unit,
        mean_square=end[3] / periods * force_unit**2,
        peak=peak,
        peak_time=peak_time,
        states=lax.stop_gradient(states),
        steps=solution.stats["num_steps"],
        solved=solution.result == diffrax.RESULTS.successful,
    )


def _refine_peak(pair, times, states, best):
    """Instant and size of the greatest force around the sample `best`.

    An impact's peak can be narrower than the sampling, with a corner where the damping
    saturates. Between samples the motion is the quartic through five of them; the peak is
    enclosed on it by repeated subdivision. At the fixed instant the force is
    differentiated in the motion and the design (envelope theorem).
    """
    # The motion is not closed in general: stay inside the window.
    middle = jnp.clip(best, 2, states.shape[0] - 3)
    values = lax.dynamic_slice(states, (middle - 2, 0), (5, states.shape[1]))
    step = times[1] - times[0]

    def force(pair, values, place):
        """Force at `place`, counted in samples from the middle one."""
        x = place - jnp.arange(-2.0, 3.0)
        others = jnp.where(jnp.eye(5, dtype=bool), 1.0, x)
        weights = jnp.prod(others, axis=1) / jnp.asarray([24.0, -6.0, 4.0, -6.0, 24.0])
        return pair.contact_at(times[middle] + place * step, weights @ values).total

    frozen = lax.stop_gradient((pair, values))

    def zoom(_, window):
        center, width = window
        grid = jnp.clip(center + width * jnp.linspace(-1, 1, 17), -2.0, 2.0)
        forces = jax.vmap(lambda place: force(*frozen, place))(grid)
        return grid[jnp.argmax(forces)], width / 8

    start = (jnp.asarray(best - middle, times.dtype), jnp.ones_like(step))
    place = lax.stop_gradient(lax.fori_loop(0, 5, zoom, start)[0])
    return times[middle] + place * step, force(pair, values, place)
