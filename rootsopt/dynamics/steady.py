"""The steady motion that a state leads to, with its status and derivatives, as a pure function.

A transient is let pass (`settle`), the cycle it ends on is closed and differentiated
(`close_orbit`) and judged (`verdict`). What does not hold is tried again more closely. Where there
is no orbit, a window of the motion tells chaos from a long transient. All attempts are turns of one
loop, so that a program holds one copy of every part.
"""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from rootsopt.dynamics.flow import Flow
from rootsopt.dynamics.integrator import Integrator
from rootsopt.dynamics.measures import Measures
from rootsopt.dynamics.orbit import SAMPLES, Orbit, Shots, choose, orbit_or_window
from rootsopt.dynamics.pair import RotorPair
from rootsopt.dynamics.settle import Transient, settle, settled_within
from rootsopt.dynamics.verdict import RESIDUAL, TOO_DEEP, UNRESOLVED, Verdict, verdict
from rootsopt.dynamics.window import PERIODS, Window
from rootsopt.status import Status

_NEARLY = 0.05
"""Scaled difference below which states are near enough to repeating for Newton's method to tell,
and an orbit may be one of a shorter period."""
_CLOSEST = 1e-12
"""Scaled difference below which states repeat exactly: a closer look would show no more."""
_TRUSTED = 1e-8
"""Tolerance down to which an orbit is integrated more finely than asked for, where it does not
close or its derivatives are not known."""


class Solver(eqx.Module):
    """How a steady motion is found.

    `transient` and `orbit`: how they are integrated; `measures` of the force beside mean and mean
    square; `max_periods`: mesh periods that the transient may take; `examine`: 1 to look at a
    window of a motion that does not settle, 0 to give it up (both floats, so that all leaves are);
    `max_orbit`: longest period looked for, at most 8; `precision`: float64 or float32.

    For coarse surveys of many designs: `shots` allowed for closing an orbit, which is closed to
    `closed` tolerances; `samples` of it; `check` of the derivatives on halved steps; number of
    `attempts`; `windows`: mesh periods of a window (a multiple of 16, or 0 for none at all).
    """

    transient: Integrator
    orbit: Integrator
    measures: Measures
    max_periods: Float[Array, ""]
    examine: Float[Array, ""]
    max_orbit: int = eqx.field(static=True)
    precision: str = eqx.field(static=True, default="float64")
    shots: int = eqx.field(static=True, default=24)
    closed: float = eqx.field(static=True, default=0.0)
    samples: int = eqx.field(static=True, default=SAMPLES)
    check: bool = eqx.field(static=True, default=True)
    attempts: int = eqx.field(static=True, default=16)
    windows: int = eqx.field(static=True, default=PERIODS)


class Steady(NamedTuple):
    """What a state leads to.

    `status`: code of a `Status`; `orbit` of `period` mesh periods, as it was closed last at the
    tolerance `rtol`, and the `verdict` on it; `window` of a motion that did not settle;
    `settled`: end of the transient; mesh periods `used` by transients and solver `steps` of all.
    """

    status: Int[Array, ""]
    orbit: Orbit
    period: Int[Array, ""]
    rtol: Float[Array, ""]
    verdict: Verdict
    window: Window
    settled: Transient
    used: Int[Array, ""]
    steps: Int[Array, ""]

    @property
    def forces(self) -> Float[Array, " r"]:
        """Mean (N), mean square (N²), peak (N) and the other measures: of the orbit, of the window
        where there is one (NaN for the others), 0 without contact, else NaN."""
        closed = self.orbit.response
        unknown = jnp.full_like(closed, jnp.nan)
        found = jnp.where(among(self.status, CLOSED), closed, unknown)
        if self.window.growth.shape[0]:
            whole = self.window.done == self.window.growth.shape[0]
            window = among(self.status, (Status.CHAOTIC, Status.NOT_SETTLED)) & whole
            found = jnp.where(window, unknown.at[:3].set(self.window.forces), found)
        return jnp.where(self.status == Status.IDLE.code, jnp.zeros_like(closed), found)

    @property
    def sensitivity(self) -> Float[Array, "r d"]:
        """Derivatives of `forces` along the directions asked for; NaN unless periodic."""
        return jnp.where(self.status == Status.PERIODIC.code, self.orbit.sensitivity, jnp.nan)


CLOSED = (Status.PERIODIC, Status.INACCURATE, Status.TOO_DEEP, Status.UNRESOLVED)
"""Statuses of a closed orbit with contact."""


def among(code: Int[Array, "*n"], statuses: tuple[Status, ...]) -> Bool[Array, "*n"]:
    """Return whether a status code is that of one of the `statuses`."""
    return jnp.any(jnp.stack([code == status.code for status in statuses]), axis=0)


class _Search(NamedTuple):
    """Where the attempts stand: what is known (`found`), and what comes next.

    A `shorter` period to be tried (0: none), a window (`windowed`), or else a transient from
    `state` at tolerances `coarse`, until it repeats `within` some scaled distance, and an orbit at
    `fine`. `tries`: attempts made; `over`: nothing comes next.
    """

    found: Steady
    state: Float[Array, " n"]
    coarse: Float[Array, ""]
    fine: Float[Array, ""]
    within: Float[Array, ""]
    shorter: Int[Array, ""]
    windowed: Bool[Array, ""]
    tries: Int[Array, ""]
    over: Bool[Array, ""]


class _Attempts(eqx.Module):
    """What `steady_motion` was asked for; `start` and `step` are its loop."""

    pair: RotorPair
    tangents: RotorPair
    solver: Solver
    radius: Float[Array, ""]

    def start(self, state: Float[Array, " n"]) -> _Search:
        """Nothing known of the motion from the scaled `state`."""
        solver, dtype, count = self.solver, state.dtype, state.shape[0]
        directions = jax.tree.leaves(eqx.filter(self.tangents, eqx.is_inexact_array))[0].shape[0]
        steps = solver.orbit.max_steps
        flow = Flow.empty(count, directions, solver.samples, steps, solver.measures, dtype)
        infinite, no = jnp.full((), jnp.inf, dtype), jnp.zeros((), bool)
        one, zero = jnp.ones((), int), jnp.zeros((), int)
        found = Steady(
            status=jnp.asarray(Status.NOT_SETTLED.code),
            orbit=Orbit.empty(state, directions, flow),
            period=one,
            rtol=solver.orbit.rtol,
            verdict=Verdict(no, no, jnp.zeros((), dtype), no, no),
            window=Window.empty(state, solver.windows),
            settled=Transient(state, zero, one, infinite, zero, no, ~no, zero),
            used=zero,
            steps=zero,
        )
        coarse, fine = solver.transient.rtol, solver.orbit.rtol
        within = settled_within(coarse).astype(dtype)
        return _Search(found, state, coarse, fine, within, zero, no, zero, no)

    def step(self, now: _Search) -> _Search:
        """One turn: a transient and its orbit, an orbit of a shorter period, or a window."""
        solver, found = self.solver, now.found
        shorter = now.shorter > 0
        fresh = ~shorter & ~now.windowed
        settled = settle(
            self.pair,
            now.state,
            dataclasses.replace(solver.transient, rtol=now.coarse),
            now.within,
            jnp.where(fresh, solver.max_periods - found.used, 0).astype(int),
            solver.max_orbit,
        )
        used = found.used + jnp.where(fresh, settled.periods, 0)
        steps = found.steps + jnp.where(fresh, settled.steps, 0)
        settled = choose(fresh, settled, found.settled)
        failure = transient_status(self.pair, settled)
        # Time is out, but the motion nearly repeats: noise of the coarse transient may be all that
        # is left. Newton's method tells.
        nearly = (failure == Status.NOT_SETTLED.code) & (settled.spread < _NEARLY) & fresh
        within = jnp.where(nearly, settled.spread, now.within)
        settled = settled._replace(period=jnp.where(nearly, settled.nearest, settled.period))
        lost = fresh & (failure >= 0) & ~nearly
        period = jnp.maximum(jnp.where(shorter, now.shorter, settled.period), 1)
        start = jnp.where(shorter, found.orbit.state, settled.state)
        rtol = jnp.where(now.windowed, solver.transient.rtol, now.fine)
        shots = Shots(
            integrator=dataclasses.replace(solver.orbit, rtol=rtol),
            measures=solver.measures,
            count=jnp.where(lost, 0, solver.shots),
            closed=solver.closed * solver.orbit.rtol,
            samples=solver.samples,
            check=solver.check,
        )
        orbit, window = orbit_or_window(
            self.pair, self.tangents, start, period, shots, now.windowed, solver.windows
        )
        judged, status = self._judged(orbit, start, now.fine, within)
        # An orbit of a shorter period whose derivatives are not known is the motion all the same.
        holds = among(status, (Status.PERIODIC, Status.INACCURATE))
        taken = jnp.where(shorter, holds, ~lost) & ~now.windowed
        status = jnp.where(lost, failure, jnp.where(taken, status, found.status))
        new = Steady(
            status=jnp.where(now.windowed, self._unsettled(window), status),
            orbit=choose(taken, orbit, found.orbit),
            period=jnp.where(taken, period, found.period),
            rtol=jnp.where(taken, now.fine, found.rtol),
            verdict=choose(taken, judged, found.verdict),
            window=choose(now.windowed, window, found.window),
            settled=settled,
            used=used,
            steps=steps + jnp.where(now.windowed, 0, orbit.flow.steps),
        )
        return self._next(now, new, within, lost, taken & shorter)

    def _next(self, now: _Search, new: Steady, within, lost, shortened) -> _Search:
        """What comes after an attempt that has left `new`."""
        solver = self.solver
        candidate = self._shorter(new, now.shorter)
        looks = (new.status == Status.PERIODIC.code) & ~shortened & ~now.windowed & ~lost
        # Newton left the neighbourhood or found an unstable orbit, or one whose derivatives are
        # not known: it was not the steady state yet, or too coarse an image of it. Go on, and look
        # more closely.
        late = (new.used >= solver.max_periods) | (within < _CLOSEST)
        late |= now.tries + 1 >= solver.attempts
        weak = among(new.status, (Status.NOT_SETTLED, Status.INACCURATE)) & ~now.windowed
        again = weak & ~late & ~lost
        least = jnp.minimum(solver.orbit.rtol, _TRUSTED)
        fine = jnp.where(again, jnp.maximum(now.fine / 100, least), now.fine)
        coarse = jnp.where(again, jnp.maximum(now.coarse / 10, fine), now.coarse)
        unsettled = (new.status == Status.NOT_SETTLED.code) & ~again & ~now.windowed
        windowed = unsettled & (solver.windows > 0) & (solver.examine > 0)
        shorter = jnp.where(looks, candidate, 0)
        return _Search(
            found=new,
            state=new.settled.state,
            coarse=coarse,
            fine=fine,
            within=jnp.where(again, within / 10, within),
            shorter=shorter,
            windowed=windowed,
            tries=now.tries + again,
            over=~(again | windowed | (shorter > 0)),
        )

    def _judged(self, orbit: Orbit, start, fine, within) -> tuple[Verdict, Int[Array, ""]]:
        """The verdict on an orbit integrated at the tolerance `fine`, and its status as a motion;
        whether its forces are known is asked at the end."""
        pair, solver, dtype = self.pair, self.solver, start.dtype
        closing = dataclasses.replace(solver.orbit, rtol=fine)
        rtols = solver.transient.tolerance(dtype), closing.tolerance(dtype)
        open_by = jnp.maximum(solver.closed * solver.orbit.rtol, RESIDUAL[solver.precision])
        scales = pair.law.exponent, self.radius, pair.force_scale
        found = verdict(orbit, start, within, rtols, open_by.astype(dtype), scales)
        numbers = jnp.concatenate([orbit.response, orbit.state])
        status = _first(
            (~orbit.flow.solved, Status.SOLVER_FAILED),
            (found.idle, Status.IDLE),
            (~jnp.all(jnp.isfinite(numbers)), Status.NON_FINITE),
            # Of what multiplies errors no derivative is known either.
            (~found.steady, Status.NOT_SETTLED),
            (~jnp.all(jnp.isfinite(orbit.sensitivity)), Status.NON_FINITE),
            (~found.certain, Status.INACCURATE),
            default=Status.PERIODIC.code,
        )
        return found, status

    def _shorter(self, found: Steady, beyond) -> Int[Array, ""]:
        """Least period above `beyond` that divides that of the orbit and after which the orbit
        nearly repeats, or 0: noise of the transient can hide that a motion repeats sooner."""
        periods = jnp.arange(1, max(self.solver.max_orbit // 2, 1) + 1)
        place = periods * self.solver.samples // found.period
        states = found.orbit.flow.states[jnp.minimum(place, self.solver.samples - 1)]
        near = jnp.max(jnp.abs(states - found.orbit.state), axis=1) < _NEARLY
        divides = (found.period % periods == 0) & (periods < found.period)
        fits = near & divides & (periods > beyond)
        return jnp.where(jnp.any(fits), periods[jnp.argmax(fits)], 0)

    def _unsettled(self, window: Window) -> Int[Array, ""]:
        """Code of the status of a motion that has not settled, from a window of it."""
        if not self.solver.windows:
            return jnp.asarray(Status.NOT_SETTLED.code)
        return window_status(self.pair, window)

    def final(self, found: Steady) -> Steady:
        """`found`, with the forces of its orbit looked at."""
        orbit, judged = found.orbit, found.verdict
        closed = among(found.status, (Status.PERIODIC, Status.INACCURATE))
        deep = orbit.flow.depth > TOO_DEEP * self.radius
        vague = (judged.rounding > UNRESOLVED) | ~judged.consistent
        status = jnp.where(closed & vague, Status.UNRESOLVED.code, found.status)
        return found._replace(status=jnp.where(closed & deep, Status.TOO_DEEP.code, status))


def transient_status(pair: RotorPair, settled: Transient) -> Int[Array, ""]:
    """Code of the status of a transient that leads to no orbit, or -1."""
    return _first(
        (~settled.solved, Status.SOLVER_FAILED),
        (~jnp.all(jnp.isfinite(settled.state)), Status.NON_FINITE),
        (settled.lost & pair.stalled(settled.state), Status.STALLED),
        (settled.lost, Status.PASSED_THROUGH),
        (settled.period == 0, Status.NOT_SETTLED),
        default=-1,
    )


def window_status(pair: RotorPair, window: Window) -> Int[Array, ""]:
    """Code of the status of a motion that has not settled, from a `window` of it."""
    finite = jnp.all(jnp.isfinite(window.response)) & jnp.isfinite(window.exponent)
    lost = pair.lost(window.end)
    least = float(jnp.finfo(window.end.dtype).eps) * pair.force_scale
    return _first(
        (lost & pair.stalled(window.end), Status.STALLED),
        (lost, Status.PASSED_THROUGH),
        (~finite, Status.NON_FINITE),
        (~window.solved, Status.SOLVER_FAILED),
        (jnp.max(window.response[:, 2]) <= least, Status.IDLE),
        (jnp.asarray(window.exponent > 3 * window.error), Status.CHAOTIC),
        default=Status.NOT_SETTLED.code,
    )


def _first(*cases: tuple[Bool[Array, ""], Status], default: int) -> Int[Array, ""]:
    """Code of the status of the first case that holds."""
    conditions, statuses = zip(*cases, strict=True)
    return jnp.select(conditions, [jnp.asarray(s.code) for s in statuses], jnp.asarray(default))


def steady_motion(
    pair: RotorPair,
    tangents: RotorPair,
    state: Float[Array, " n"],
    radius: Float[Array, ""],
    solver: Solver,
) -> Steady:
    """Find the steady motion of `pair` from the scaled `state` at φ1 = 0, with derivatives along
    the directions `tangents` of its parameters (stacked along a leading axis).

    `radius`: pitch radius (m), beside which penetrations are judged.
    """
    radius = jnp.asarray(radius, pair.angle_scale.dtype)
    attempts = _Attempts(pair, tangents, solver, radius)
    search = lax.while_loop(
        lambda now: ~now.over, lambda now: attempts.step(now), attempts.start(state)
    )
    return attempts.final(search.found)
