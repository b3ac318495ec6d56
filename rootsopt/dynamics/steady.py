"""The steady motion that a state leads to, with its status and derivatives, as a pure function.

The transient is simulated until the motion repeats (`settle`). The orbit near its end is closed and
differentiated (`close_orbit`), then checked (`verdict`). If a check fails, the next attempt uses
finer tolerances. All attempts are iterations of one loop, so that each part is compiled only once.
"""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from rootsopt.dynamics.collocation.known import Known
from rootsopt.dynamics.flow import Flow
from rootsopt.dynamics.integrator import Integrator
from rootsopt.dynamics.measures import Measures
from rootsopt.dynamics.orbit import SAMPLES, Orbit, Shots, choose, close_orbit
from rootsopt.dynamics.pair import RotorPair
from rootsopt.dynamics.settle import Transient, settle, settled_within
from rootsopt.dynamics.verdict import RESIDUAL, TOO_DEEP, UNRESOLVED, Verdict, verdict
from rootsopt.dynamics.window import Window
from rootsopt.status import Status

NEARLY = 0.05
"""Scaled difference below which states nearly repeat. Newton's method then decides whether there is
an orbit, possibly of a shorter period."""
_CLOSEST = 1e-12
"""Scaled difference between repeating states below which no finer attempt is made: the states
repeat to rounding."""
_TRUSTED = 1e-8
"""Finest tolerance to which an orbit is refined, unless the config requests a finer tolerance. An
orbit is refined if it does not close or its derivatives are uncertain."""


class Solver(eqx.Module):
    """Settings for finding a steady motion.

    `transient`, `orbit`: integrators of the transient and of the orbit; `measures`: averages of the
    force to compute; `max_periods`: maximum length of the transient (mesh periods); `examine`: 1 to
    integrate a window of a motion that does not settle (see `closed.examined`), 0 to skip it;
    `max_orbit`: longest period of an orbit to find (mesh periods), at most 8. `max_periods` and
    `examine` are floats, as are all leaves.

    The other settings have defaults. Coarse surveys of many designs use other values. `shots`:
    maximum number of integrations to close an orbit; `closed`: residual (tolerances) at which an
    orbit may count as closed; `samples`: number of uniform samples of an orbit; `check`: whether to
    compare the derivatives with those on halved steps; `attempts`: maximum number of attempts;
    `variation`: whether an orbit closed by collocation has its `Orbit.variation`.

    `closing`: how orbits are closed: by `shooting`, or, with `collocation` or `auto`, by
    collocation. Only shooting closes orbits of pairs that are not `smooth`.
    """

    transient: Integrator
    orbit: Integrator
    measures: Measures
    max_periods: Float[Array, ""]
    examine: Float[Array, ""]
    max_orbit: int = eqx.field(static=True)
    shots: int = eqx.field(static=True, default=24)
    closed: float = eqx.field(static=True, default=0.0)
    samples: int = eqx.field(static=True, default=SAMPLES)
    check: bool = eqx.field(static=True, default=True)
    attempts: int = eqx.field(static=True, default=16)
    variation: bool = eqx.field(static=True, default=False)
    closing: str = eqx.field(static=True, default="shooting")


class Steady(NamedTuple):
    """The steady motion that a state leads to.

    `status`: code of a `Status`; `orbit`: the orbit found, or the last one tried; `period` (mesh
    periods), `rtol` and `verdict`: length and tolerance of this orbit, and the results of its
    checks; `window` of a motion that did not settle, `None` if it was not examined; `settled`: end
    of the transient; `used`: mesh periods of all transients; `steps`: number of solver steps of
    transients and orbits; `known`: an orbit closed by collocation, from which those of similar
    pairs can be closed, `None` after shooting.
    """

    status: Int[Array, ""]
    orbit: Orbit
    period: Int[Array, ""]
    rtol: Float[Array, ""]
    verdict: Verdict
    window: Window | None
    settled: Transient
    used: Int[Array, ""]
    steps: Int[Array, ""]
    known: Known | None

    @property
    def forces(self) -> Float[Array, " r"]:
        """Mean (N), mean square (N²), peak (N) and the further measures of the contact force.

        For a closed orbit, all of them are known. For a complete window of a motion that does not
        settle, the further measures are NaN. Without contact, all of them are 0. Otherwise, they
        are NaN."""
        closed = self.orbit.response
        unknown = jnp.full_like(closed, jnp.nan)
        found = jnp.where(among(self.status, CLOSED), closed, unknown)
        if self.window is not None:
            whole = self.window.done == self.window.growth.shape[0]
            window = among(self.status, (Status.CHAOTIC, Status.NOT_SETTLED)) & whole
            found = jnp.where(window, unknown.at[:3].set(self.window.forces), found)
        return jnp.where(self.status == Status.IDLE.code, jnp.zeros_like(closed), found)

    @property
    def sensitivity(self) -> Float[Array, "r d"]:
        """Derivatives of `forces` along the requested directions; NaN unless periodic."""
        return jnp.where(self.status == Status.PERIODIC.code, self.orbit.sensitivity, jnp.nan)


CLOSED = (Status.PERIODIC, Status.INACCURATE, Status.TOO_DEEP, Status.UNRESOLVED)
"""Statuses of a closed orbit with contact."""


def among(code: Int[Array, "*n"], statuses: tuple[Status, ...]) -> Bool[Array, "*n"]:
    """Return whether a status code belongs to one of the `statuses`."""
    return jnp.any(jnp.stack([code == status.code for status in statuses]), axis=0)


class _Search(NamedTuple):
    """State of the loop over attempts: the result so far, and what to do in the next iteration.

    `found`: result so far; `shorter`: period (mesh periods) of a shorter orbit to try next, 0 for
    none. Otherwise, the next iteration simulates a transient and closes its orbit. It starts from
    `state`, at the tolerances `coarse` (transient) and `fine` (orbit), and the states must repeat
    to within the scaled distance `within`. `tries`: number of refinements so far; `over`: whether
    the loop has ended.
    """

    found: Steady
    state: Float[Array, " n"]
    coarse: Float[Array, ""]
    fine: Float[Array, ""]
    within: Float[Array, ""]
    shorter: Int[Array, ""]
    tries: Int[Array, ""]
    over: Bool[Array, ""]


class _Attempts(eqx.Module):
    """The loop of `steady_motion`. Its fields hold the arguments of that function.

    `start` returns the initial state of the loop, `step` the result of its body, `final` the result
    of the search."""

    pair: RotorPair
    tangents: RotorPair
    solver: Solver
    radius: Float[Array, ""]

    def start(self, state: Float[Array, " n"]) -> _Search:
        """Return the initial state of the loop, for a motion that begins at the scaled `state`
        (n,)."""
        solver, dtype, count = self.solver, state.dtype, state.shape[0]
        directions = jax.tree.leaves(eqx.filter(self.tangents, eqx.is_inexact_array))[0].shape[0]
        steps = solver.orbit.max_steps
        flow = Flow.empty(count, directions, solver.samples, steps, solver.measures, dtype)
        infinite, no = jnp.full((), jnp.inf, dtype), jnp.zeros((), bool)
        one, zero = jnp.ones((), int), jnp.zeros((), int)
        unsound = ~self.pair.sound
        found = Steady(
            status=jnp.where(unsound, Status.UNSOUND.code, Status.NOT_SETTLED.code),
            orbit=Orbit.empty(state, directions, flow),
            period=one,
            rtol=solver.orbit.rtol,
            verdict=Verdict(no, no, jnp.zeros((), dtype), no, no),
            window=None,
            settled=Transient(state, zero, one, infinite, zero, no, ~no, zero),
            used=zero,
            steps=zero,
            known=None,
        )
        coarse, fine = solver.transient.rtol, solver.orbit.rtol
        within = settled_within(coarse).astype(dtype)
        return _Search(found, state, coarse, fine, within, zero, zero, unsound)

    def step(self, now: _Search) -> _Search:
        """Make one iteration and return the new state of the loop.

        An iteration computes a transient and its orbit, or an orbit of a shorter period."""
        solver, found = self.solver, now.found
        shorter = now.shorter > 0
        fresh = ~shorter
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
        # The transient has reached its limit, but the motion nearly repeats. The difference may be
        # noise of the coarse steps: let Newton's method decide.
        nearly = (failure == Status.NOT_SETTLED.code) & (settled.spread < NEARLY) & fresh
        within = jnp.where(nearly, settled.spread, now.within)
        settled = settled._replace(period=jnp.where(nearly, settled.nearest, settled.period))
        lost = fresh & (failure >= 0) & ~nearly
        period = jnp.maximum(jnp.where(shorter, now.shorter, settled.period), 1)
        start = jnp.where(shorter, found.orbit.state, settled.state)
        shots = Shots(
            integrator=dataclasses.replace(solver.orbit, rtol=now.fine),
            measures=solver.measures,
            count=jnp.where(lost, 0, solver.shots),
            closed=solver.closed * solver.orbit.rtol,
            samples=solver.samples,
            check=solver.check,
        )
        orbit = close_orbit(self.pair, self.tangents, start, period, shots)
        open_by = solver.closed * solver.orbit.rtol
        open_by = jnp.maximum(open_by, RESIDUAL)
        limits = now.fine, within, open_by
        checks, status = judged(self.pair, solver, self.radius, orbit, start, limits)
        # An orbit of a shorter period is the motion even if its derivatives are uncertain.
        holds = among(status, (Status.PERIODIC, Status.INACCURATE))
        taken = jnp.where(shorter, holds, ~lost)
        status = jnp.where(lost, failure, jnp.where(taken, status, found.status))
        new = Steady(
            status=status,
            orbit=choose(taken, orbit, found.orbit),
            period=jnp.where(taken, period, found.period),
            rtol=jnp.where(taken, now.fine, found.rtol),
            verdict=choose(taken, checks, found.verdict),
            window=None,
            settled=settled,
            used=used,
            steps=steps + orbit.flow.steps,
            known=found.known,
        )
        return self._next(now, new, within, lost, taken & shorter)

    def _next(self, now: _Search, new: Steady, within, lost, shortened) -> _Search:
        """Return the loop's state after an iteration with the result `new`.

        `within`: scaled distance to which the states repeated; `lost`: whether the transient
        failed; `shortened`: whether an orbit of a shorter period was accepted."""
        solver = self.solver
        candidate = self._shorter(new, now.shorter)
        looks = (new.status == Status.PERIODIC.code) & ~shortened & ~lost
        # Newton's method left the neighbourhood, or found an orbit that is unstable or has
        # uncertain derivatives. Either the motion was not steady yet, or the steps were too coarse:
        # continue the transient with finer tolerances.
        late = (new.used >= solver.max_periods) | (within < _CLOSEST)
        late |= now.tries + 1 >= solver.attempts
        weak = among(new.status, (Status.NOT_SETTLED, Status.INACCURATE))
        again = weak & ~late & ~lost
        least = jnp.minimum(solver.orbit.rtol, _TRUSTED)
        fine = jnp.where(again, jnp.maximum(now.fine / 100, least), now.fine)
        coarse = jnp.where(again, jnp.maximum(now.coarse / 10, fine), now.coarse)
        shorter = jnp.where(looks, candidate, 0)
        return _Search(
            found=new,
            state=new.settled.state,
            coarse=coarse,
            fine=fine,
            within=jnp.where(again, within / 10, within),
            shorter=shorter,
            tries=now.tries + again,
            over=~(again | (shorter > 0)),
        )

    def _shorter(self, found: Steady, beyond) -> Int[Array, ""]:
        """Return a shorter period after which the orbit nearly repeats, or 0.

        The result is the least such period above `beyond` that divides the orbit's period. In the
        transient, noise can hide this repetition."""
        periods = jnp.arange(1, max(self.solver.max_orbit // 2, 1) + 1)
        place = periods * self.solver.samples // found.period
        states = found.orbit.flow.states[jnp.minimum(place, self.solver.samples - 1)]
        near = jnp.max(jnp.abs(states - found.orbit.state), axis=1) < NEARLY
        divides = (found.period % periods == 0) & (periods < found.period)
        fits = near & divides & (periods > beyond)
        return jnp.where(jnp.any(fits), periods[jnp.argmax(fits)], 0)


def judged(
    pair: RotorPair,
    solver: Solver,
    radius: Float[Array, ""],
    orbit: Orbit,
    start: Float[Array, " n"],
    limits: tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""]],
) -> tuple[Verdict, Int[Array, ""]]:
    """Return the `Verdict` on an orbit of `pair`, and a status code.

    `radius`: pitch radius (m); `start`: scaled state near which the orbit has to be; `limits`:
    tolerance of the orbit, scaled distance to which the transient's states repeated, and residual
    (scaled) above which the orbit does not count as closed. The accuracy of the forces is checked
    later, by `final`."""
    dtype, (fine, within, open_by) = start.dtype, limits
    closing = dataclasses.replace(solver.orbit, rtol=fine)
    rtols = solver.transient.tolerance, closing.tolerance
    scales = pair.law.exponent, radius, pair.force_scale
    found = verdict(orbit, start, within, rtols, open_by.astype(dtype), scales)
    numbers = jnp.concatenate([orbit.response, orbit.state])
    # A pair that is not smooth never has derivatives. Their absence is not a failure.
    unknown = ~jnp.all(jnp.isfinite(orbit.sensitivity)) & pair.smooth
    status = _first(
        (~orbit.flow.solved, Status.SOLVER_FAILED),
        (found.idle, Status.IDLE),
        (~jnp.all(jnp.isfinite(numbers)), Status.NON_FINITE),
        # Checked before the derivatives, which are unknown if the orbit amplifies errors.
        (~found.steady, Status.NOT_SETTLED),
        (unknown, Status.NON_FINITE),
        (~found.certain, Status.INACCURATE),
        default=Status.PERIODIC.code,
    )
    return found, status


def final(pair: RotorPair, found: Steady, radius: Float[Array, ""]) -> Steady:
    """Return `found`, with a different status if the forces of its orbit are not valid.

    The status is then UNSOUND (no such rotors), TOO_DEEP (the flanks penetrate too deep) or
    UNRESOLVED (the numerical errors of the forces are too large). `radius`: pitch radius (m)."""
    orbit, checks = found.orbit, found.verdict
    closed = among(found.status, (Status.PERIODIC, Status.INACCURATE))
    deep = orbit.flow.depth > TOO_DEEP * radius
    vague = (checks.rounding > UNRESOLVED) | ~checks.consistent
    status = jnp.where(closed & vague, Status.UNRESOLVED.code, found.status)
    status = jnp.where(closed & deep, Status.TOO_DEEP.code, status)
    return found._replace(status=jnp.where(pair.sound, status, Status.UNSOUND.code))


def transient_status(pair: RotorPair, settled: Transient) -> Int[Array, ""]:
    """Return the status code of a transient that has not settled, or -1 if it has settled."""
    return _first(
        (~pair.sound, Status.UNSOUND),
        (~settled.solved, Status.SOLVER_FAILED),
        (~jnp.all(jnp.isfinite(settled.state)), Status.NON_FINITE),
        (settled.lost & pair.stalled(settled.state), Status.STALLED),
        (settled.lost, Status.PASSED_THROUGH),
        (settled.period == 0, Status.NOT_SETTLED),
        default=-1,
    )


def window_status(pair: RotorPair, window: Window) -> Int[Array, ""]:
    """Return the status code of a motion that has not settled, judged by a `window` of it."""
    finite = jnp.all(jnp.isfinite(window.response)) & jnp.isfinite(window.exponent)
    lost = pair.lost(window.end)
    least = float(jnp.finfo(window.end.dtype).eps) * pair.force_scale
    return _first(
        (lost & pair.stalled(window.end), Status.STALLED),
        (lost, Status.PASSED_THROUGH),
        (~finite, Status.NON_FINITE),
        (~window.solved, Status.SOLVER_FAILED),
        (jnp.max(window.response[:, 2]) <= least, Status.IDLE),
        (jnp.asarray(window.chaotic), Status.CHAOTIC),
        default=Status.NOT_SETTLED.code,
    )


def _first(*cases: tuple[Bool[Array, ""], Status], default: int) -> Int[Array, ""]:
    """Return the status code of the first of `cases` whose condition is true, or `default`."""
    conditions, statuses = zip(*cases, strict=True)
    return jnp.select(conditions, [jnp.asarray(s.code) for s in statuses], jnp.asarray(default))


def steady_motion(
    pair: RotorPair,
    tangents: RotorPair,
    state: Float[Array, " n"],
    radius: Float[Array, ""],
    solver: Solver,
) -> Steady:
    """Find the steady motion of `pair` that the scaled `state` (n,) at φ1 = 0 leads to.

    `tangents`: directions of the pair's parameters, stacked along a leading axis, along which to
    differentiate; `radius`: pitch radius (m), for judging penetrations; `solver`: settings.
    """
    radius = jnp.asarray(radius, pair.angle_scale.dtype)
    attempts = _Attempts(pair, tangents, solver, radius)
    search = lax.while_loop(
        lambda now: ~now.over, lambda now: attempts.step(now), attempts.start(state)
    )
    return final(pair, search.found, radius)


def continues(pair: RotorPair, solver: Solver) -> bool:
    """Return whether orbits of `pair` are closed by collocation.

    The equation of motion must be smooth between the changes of its flags."""
    return solver.closing != "shooting" and pair.smooth
