"""Finds the steady motion near a known orbit, or the one to which a state leads.

The orbit is closed by collocation. If the orbit of a similar pair is known, the first attempt
begins there. Otherwise, and if that attempt fails, a transient leads to the orbit. All attempts are
iterations of one loop, so that each part is compiled only once.
"""

import dataclasses
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int

from rootsopt.dynamics.collocation.closing import USUAL, Closer, Loop, corrected
from rootsopt.dynamics.collocation.equation import CollocatedEquation
from rootsopt.dynamics.collocation.mesh import PIECES, KnownOrbit, from_pieces, room_for
from rootsopt.dynamics.collocation.newton import numbers
from rootsopt.dynamics.collocation.system import unchanged
from rootsopt.dynamics.flow import Pieces
from rootsopt.dynamics.integrator import Solver
from rootsopt.dynamics.orbit import Orbit, branch
from rootsopt.dynamics.pair import RotorPair
from rootsopt.dynamics.steady import (
    OPEN,
    Steady,
    Verdict,
    among,
    final,
    judged,
    transient_status,
    window_status,
)
from rootsopt.dynamics.window import (
    PERIODS,
    Transient,
    Window,
    lyapunov,
    no_pieces,
    settle,
    settled_within,
)
from rootsopt.status import Status

ACCURACY = 10.0
"""Requested relative error of the forces, in tolerances of the orbit's integrator."""
# Estimated error of the forces above which an orbit is rejected, in multiples of the requested one.
_UNREFINED = 10.0
# Scaled difference between the states at φ1 = 0 and after a fraction of the period, below which
# this fraction is the orbit's true period. The limit is the first number (tolerances), but at least
# the second.
_REPEATS = 1e3, 1e-5
# Number of instants per mesh period at which an orbit is compared with the transient.
_ALONG = 8


def greatest_error(tolerance: ArrayLike) -> Float[Array, ""]:
    """Return the estimated relative error of the forces above which an orbit is rejected.

    `tolerance`: that of the orbit's integrator. A tightened one must not reject what the usual one
    accepts: the mesh may lack room for refinement, or rounding of the gap may hide its effect."""
    return _UNREFINED * jnp.maximum(ACCURACY * jnp.asarray(tolerance), USUAL)


class Collocated(NamedTuple):
    """An orbit closed by collocation, with the results of its checks.

    `orbit`: as the last Newton step leaves it; `sound`: whether Newton's method has converged on a
    mesh that ends at the orbit's events; otherwise the orbit has no meaning. `shorter`: true period
    (mesh periods) if the orbit repeats after a fraction of its period, otherwise 0. `verified`:
    whether the orbit is sound and accurate, and does not repeat. `known`: the orbit in the form
    from which orbits of similar pairs can be closed.
    """

    orbit: Orbit
    sound: Bool[Array, ""]
    shorter: Int[Array, ""]
    verified: Bool[Array, ""]
    known: KnownOrbit


def closed_orbit(
    pair: RotorPair,
    tangents: Any,
    start: tuple[KnownOrbit, Float[Array, " m"]],
    settings: Solver,
) -> Collocated:
    """Close the orbit near a known motion.

    `tangents`: directions of the pair's parameters, stacked along a leading axis; `start`: the
    motion, and the `numbers` of its pair; `settings`: `orbit` (whose tolerance sets the accuracy),
    `measures`, `max_orbit`, `variation`."""
    known, neighbour = start
    integrator, measures = settings.orbit, settings.measures
    tolerance = integrator.tolerance
    equation = CollocatedEquation(pair, measures, settings.variation)
    frozen, accuracy = lax.stop_gradient(pair), ACCURACY * tolerance
    closed = Closer(equation, frozen, tangents, known, neighbour, accuracy).run()
    orbit, solution, sound = closed.orbit, closed.known, closed.known.sound & known.sound
    verified = sound & (solution.error <= greatest_error(tolerance))
    # The transient may have mistaken several periods of the orbit for one.
    shorter = _repeats(pair, closed, settings.max_orbit, tolerance) * sound
    verified &= shorter == 0
    orbit = orbit._replace(
        residual=jnp.where(sound, orbit.residual, jnp.inf),
        newton_steps=closed.steps,
        disagreement=solution.drift,
    )
    if not pair.contact.smooth:  # The force may jump where no element ends.
        unknown = jnp.nan * orbit.sensitivity, jnp.nan * orbit.moved
        orbit = orbit._replace(sensitivity=unknown[0], moved=unknown[1])
    return Collocated(orbit, sound, shorter, verified, solution._replace(sound=verified))


def _repeats(
    pair: RotorPair, closed: Loop, longest: int, tolerance: Float[Array, ""]
) -> Int[Array, ""]:
    """Return the true period (mesh periods) of an orbit `closed` over several, or 0.

    It is the least fraction of the period after which the orbit repeats. Fractions after which the
    equation of `pair` does not repeat are ignored. `longest`: longest period of an orbit (mesh
    periods); `tolerance`: that of the orbit's integrator."""
    motion, state = closed.known.elements, closed.orbit.state
    shorter, period = pair.orders(max(longest // 2, 1)), jnp.round(motion.mesh.period).astype(int)
    states = motion.motion(shorter.astype(state.dtype))
    limit = jnp.maximum(_REPEATS[0] * tolerance, _REPEATS[1])
    same = jnp.max(jnp.abs(states - state), axis=1) < limit
    same &= (shorter < period) & (period % shorter == 0)
    return jnp.where(jnp.any(same), shorter[jnp.argmax(same)], 0)


def apart(known: KnownOrbit, pieces: Pieces) -> Float[Array, ""]:
    """Return the greatest scaled difference between a closed orbit and the end of a transient.

    `pieces`: the last mesh periods of the transient, which ends at φ1 = 0."""
    motion = known.elements
    number, every = pieces.ends.shape[0], pieces.ends.shape[1] // _ALONG
    begins = jnp.pad(pieces.ends[:, :-1], ((0, 0), (1, 0)))[:, ::every]
    times = motion.mesh.period + (begins + jnp.arange(-number, 0)[:, None])
    miss = jnp.abs(motion.motion(times) - pieces.states[:, ::every])
    within = (times > -1e-9)[..., None]
    return jnp.max(jnp.where(within, miss, 0.0))


# Scaled difference below which states nearly repeat. Newton's method then decides whether there is
# an orbit, possibly of a shorter period.
_NEARLY = 0.05
# Tolerance of the first transient, unless that of the solver is coarser. The transient only has to
# reach the neighbourhood of the orbit. Each further attempt is ten times finer.
_COARSE = 1e-5
# Maximum number of attempts to close an orbit at the end of a transient, and maximum number of mesh
# periods by which the transient continues before each further attempt. The states of the transient
# must then repeat ten times more closely.
_ATTEMPTS, _LONGER = 3, 160.0


class Start(eqx.Module):
    """Where the search for an orbit begins.

    `state` (n,): at φ1 = 0, in SI units, where the transient begins if there is no known orbit or
    it does not lead to another one; `known`: a closed orbit; `pair`: the numbers of the orbit's
    pair, with `None` in place of all other leaves. The orbit is used if `known.sound`.
    """

    state: Any
    known: KnownOrbit
    pair: Any

    @classmethod
    def at(cls, pair: RotorPair, state: Float[Array, " n"], longest: int) -> "Start":
        """Return a start at the `state` (n,), in SI units, of `pair`, without a known orbit.

        `longest`: longest period of an orbit (mesh periods)."""
        return cls(state, unknown(pair, longest), eqx.filter(pair, eqx.is_inexact_array))

    def fits(self, other: "Start") -> bool:
        """Return whether both starts belong to the same kind of pair and solver."""
        one, two = (
            (jax.tree.structure(start), [jnp.shape(leaf) for leaf in jax.tree.leaves(start)])
            for start in (self, other)
        )
        return one == two


def unknown(pair: RotorPair, longest: int) -> KnownOrbit:
    """Return the placeholder for an orbit of `pair` of up to `longest` mesh periods."""
    return KnownOrbit.empty(room_for(pair, longest), pair.states, pair.flanks)


class _Loop(NamedTuple):
    """State of the loop over attempts.

    `motion`: that of the last attempt; `near`: whether the next attempt begins on the known orbit.
    Otherwise, it continues the transient from the scaled `state`, at the tolerance `coarse`, until
    the states repeat to within the scaled distance `within`. If `shorter` is not 0, the last orbit
    repeated after `shorter` mesh periods; the next attempt then closes an orbit of this period,
    without a further transient. `tries`: number of attempts from a transient; `over`: whether the
    loop has ended.
    """

    motion: Steady
    near: Bool[Array, ""]
    shorter: Int[Array, ""]
    state: Float[Array, " n"]
    coarse: Float[Array, ""]
    within: Float[Array, ""]
    tries: Int[Array, ""]
    over: Bool[Array, ""]


class _Attempts(eqx.Module):
    """The loop of `steady_motion`. Its fields hold the arguments of that function, and the
    `numbers` of the pair whose orbit is known."""

    pair: RotorPair
    tangents: RotorPair
    start: Start
    neighbour: Float[Array, " m"]
    radius: Float[Array, ""]
    solver: Solver

    def begin(self) -> _Loop:
        """Return the initial state of the loop."""
        solver, pair = self.solver, self.pair
        state = pair.scaled(self.start.state)
        dtype = state.dtype
        directions = jax.tree.leaves(eqx.filter(self.tangents, eqx.is_inexact_array))[0].shape[0]
        no, zero = jnp.zeros((), bool), jnp.zeros((), int)
        unsound = ~pair.sound
        pieces = no_pieces(pair, state, solver.max_orbit, PIECES)
        known = unknown(pair, solver.max_orbit)
        still = unchanged(known.elements, directions) if solver.variation else None
        orbit = Orbit.empty(state, directions, solver.measures.count + 1, still)
        motion = Steady(
            status=jnp.where(unsound, Status.UNSOUND.code, Status.NOT_SETTLED.code),
            orbit=orbit,
            period=jnp.ones((), int),
            verdict=Verdict(no, no, jnp.zeros((), dtype), no, no),
            window=None,
            settled=Transient(
                state, zero, zero + 1, jnp.full((), jnp.inf, dtype), zero, no, ~no, zero, pieces
            ),
            used=zero,
            steps=zero,
            known=known,
        )
        coarse = jnp.maximum(solver.transient.rtol, _COARSE)
        within = settled_within(coarse).astype(dtype)
        near = self.start.known.sound
        return _Loop(motion, near, zero, state, coarse, within, zero, unsound)

    def step(self, now: _Loop) -> _Loop:
        """Make one attempt, and return the new state of the loop.

        In a batch, motions that are over take the branches that cost least."""
        settled, failure = branch(
            now.near | (now.shorter > 0) | now.over,
            lambda: self.settled(now),
            lambda: self.transient(now),
        )
        return branch(
            (failure < 0) & ~now.over,
            lambda: self.attempt(now, settled),
            lambda: self.lost(now, settled, failure),
        )

    def settled(self, now: _Loop) -> tuple[Transient, Int[Array, ""]]:
        """Return an empty transient for an attempt that needs none, and the code -1."""
        nothing = jnp.zeros_like(now.shorter)
        known = jnp.round(self.start.known.elements.mesh.period).astype(int)
        period = jnp.where(now.near, known, now.shorter)
        settled = now.motion.settled._replace(period=period, periods=nothing, steps=nothing)
        return settled, nothing - 1

    def transient(self, now: _Loop) -> tuple[Transient, Int[Array, ""]]:
        """Return the transient of an attempt, and its status code, -1 if it has settled."""
        solver = self.solver
        room = solver.max_periods - now.motion.used
        room = jnp.where(now.tries > 0, jnp.minimum(room, _LONGER), room).astype(int)
        integrator = dataclasses.replace(solver.transient, rtol=now.coarse)
        end = settle(self.pair, now.state, integrator, now.within, room, solver.max_orbit, PIECES)
        failure = transient_status(self.pair, end)
        # The motion nearly repeats. The difference may be noise of the coarse steps: let Newton's
        # method decide.
        nearly = (failure == Status.NOT_SETTLED.code) & (end.spread < _NEARLY)
        period = jnp.where(nearly, end.nearest, end.period)
        return end._replace(period=period), jnp.where(nearly, -1, failure)

    def lost(self, now: _Loop, settled: Transient, failure: Int[Array, ""]) -> _Loop:
        """Return the loop's state after a transient that has not settled."""
        motion = self.counted(now.motion, settled)._replace(status=failure)
        return now._replace(motion=motion, state=settled.state, over=jnp.ones((), bool))

    def counted(self, motion: Steady, settled: Transient) -> Steady:
        """Return `motion` after a further transient: its end replaced, its effort added up."""
        used, steps = motion.used + settled.periods, motion.steps + settled.steps
        return motion._replace(settled=settled, used=used, steps=steps)

    def attempt(self, now: _Loop, settled: Transient) -> _Loop:
        """Close an orbit, and return the loop's state."""
        solver, pair = self.solver, self.pair
        period, pieces = jnp.maximum(settled.period, 1), settled.pieces
        assert pieces is not None
        known = self.start.known
        known = branch(
            now.near,
            lambda: known,
            lambda: from_pieces(pair, pieces, period, solver.max_orbit),
        )
        neighbour = jnp.where(now.near, self.neighbour, lax.stop_gradient(numbers(pair)))
        made = closed_orbit(pair, self.tangents, (known, neighbour), solver)
        within = now.within
        place = jnp.where(now.near, made.orbit.state, settled.state)
        # The orbit must be that of the transient everywhere, not only at φ1 = 0.
        reach = 10 * within / jnp.maximum(1 - made.orbit.multiplier, 1e-3)
        meets = now.near | (apart(made.known, pieces) <= reach)
        # The orbit is that of the transient, but a finer mesh does not make it accurate: it has an
        # event that the equation does not know. A further attempt would end the same way.
        vague = ~now.near & meets & made.sound & ~made.verified & (made.shorter == 0)
        made = made._replace(verified=made.verified & meets)
        motion = self.taken(self.counted(now.motion, settled), made, place, period, within)
        failed = motion.status == Status.NOT_SETTLED.code
        refused = now.near & (motion.status != Status.PERIODIC.code)
        shorter = jnp.where(now.near, 0, made.shorter)
        again = failed & ~now.near & ~vague & (now.tries + 1 < _ATTEMPTS)
        again &= (shorter > 0) | (motion.used < solver.max_periods)
        # Chaos does not repeat at two tolerances: no window is needed to exclude it.
        repeats = (now.tries > 0) & (settled.spread < within) & ~again
        missed = failed & ~now.near & (vague | repeats)
        status = jnp.where(missed, Status.NOT_CLOSED.code, motion.status)
        motion = motion._replace(status=status)
        finer = jnp.where(now.near | (shorter > 0), 1.0, 0.1)
        return _Loop(
            motion=motion,
            near=jnp.zeros((), bool),
            shorter=shorter,
            # A refused orbit does not change where the transient begins.
            state=jnp.where(now.near, now.state, settled.state),
            coarse=jnp.maximum(now.coarse * finer, jnp.minimum(solver.orbit.rtol, now.coarse)),
            within=now.within * finer,
            tries=now.tries + ~now.near,
            over=~(again | refused),
        )

    def taken(self, motion: Steady, made: Collocated, start, period, within) -> Steady:
        """Return `motion` with the closed orbit `made` and its status.

        `start`: scaled state near which the orbit must lie; `period` of the orbit (mesh periods);
        `within`: scaled distance to which the transient's states repeated."""
        limits = within, corrected(ACCURACY * self.solver.orbit.rtol)
        orbit = made.orbit
        verdict, status = judged(self.pair, self.solver, self.radius, orbit, start, limits)
        unsure = among(status, (Status.PERIODIC, Status.INACCURATE)) & ~made.verified
        if self.pair.repeats > 1:
            # The flanks stay apart, but the gear rattles over several revolutions.
            unsure |= (status == Status.IDLE.code) & (made.shorter > 0)
        status = jnp.where(unsure | ~made.sound, Status.NOT_SETTLED.code, status)
        motion = motion._replace(
            status=status,
            orbit=orbit,
            period=period,
            verdict=verdict,
            known=made.known,
        )
        return final(self.pair, motion, self.radius)


def steady_motion(
    pair: RotorPair,
    tangents: RotorPair,
    start: Start,
    radius: Float[Array, ""],
    solver: Solver,
) -> Steady:
    """Find the steady motion of `pair` near a known orbit, or the one to which a state leads.

    `tangents`: directions of the pair's parameters, stacked along a leading axis, along which to
    differentiate; `start`: see `Start`; `radius`: pitch radius (m), for judging penetrations;
    `solver`: settings.

    An orbit is rejected if it is not stable or not near the end of the transient. The transient
    then continues, followed by another attempt (`_ATTEMPTS`). If the last attempt fails although
    the transient has repeated at two tolerances, the status is NOT_CLOSED. If an orbit near the
    known one is not accepted, the search begins at `start.state`. A motion without an orbit is left
    to `examined`."""
    radius = jnp.asarray(radius, pair.angle_scale.dtype)
    start = lax.stop_gradient(start)
    attempts = _Attempts(pair, tangents, start, numbers(start.pair), radius, solver)
    loop = lax.while_loop(lambda now: ~now.over, lambda now: attempts.step(now), attempts.begin())
    return loop.motion._replace(settled=loop.motion.settled._replace(pieces=None))


def examined(pair: RotorPair, motion: Steady, solver: Solver) -> Steady:
    """Return the `motion` of `pair`; if it has no orbit, set its status by a window.

    The window begins at the end of the transient, and distinguishes chaos from a long transient."""
    state, integrator = motion.settled.state, solver.transient
    unsettled = among(motion.status, OPEN) & (solver.probe_chaos > 0)
    window = branch(
        unsettled,
        lambda: lyapunov(pair, state, PERIODS, integrator),
        lambda: Window.empty(state, PERIODS, integrator.tolerance),
    )
    return seen(pair, motion, window, unsettled)


def seen(
    pair: RotorPair, motion: Steady, window: Window | None, whole: Bool[Array, ""] | bool = True
) -> Steady:
    """Return a `motion` without an orbit, completed with a `window` of it.

    The window determines the status if it was integrated (`whole`). A motion that repeats is
    NOT_CLOSED if the window shows neither chaos nor a failure."""
    status, repeats = motion.status, motion.settled.period > 0
    if window is not None:
        judged = window_status(pair, window)
        # A motion that repeats at two tolerances is not chaotic.
        sure = ~among(judged, OPEN) | (status == Status.NOT_SETTLED.code)
        status = jnp.where(among(status, OPEN) & whole & sure, judged, status)
    missed = (status == Status.NOT_SETTLED.code) & repeats
    status = jnp.where(missed, Status.NOT_CLOSED.code, status)
    return motion._replace(window=window, status=status)
