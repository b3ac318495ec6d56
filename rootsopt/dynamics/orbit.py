"""Close a periodic orbit by shooting, and differentiate it.

Newton's method on the k-fold stroboscopic map closes an orbit of k mesh periods. The monodromy
matrix shows whether the orbit is stable, and the implicit function theorem gives its derivatives.

The solver steps of an orbit are recorded as a *grid*, and repeated once Newton's method is close. A
*kink* is an instant at which the equation of motion is not smooth; grid steps end there.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_batching import custom_vmap
from jaxtyping import Array, Bool, Float, Int

from rootsopt.dynamics.collocation.system import Step
from rootsopt.dynamics.flow import Flow, flow
from rootsopt.dynamics.integrator import Integrator
from rootsopt.dynamics.linear import solved, spectral_radius
from rootsopt.dynamics.measures import Measures
from rootsopt.dynamics.pair import RotorPair
from rootsopt.dynamics.switches import halved, has_room, with_switches

SAMPLES = 2520
"""Number of uniform samples of an orbit. It is divisible by every period up to ten, so that a
sample falls on the end of each mesh period."""
_NEWTON_STEPS = 24
"""Default maximum number of integrations to close one orbit."""
_CLOSED = 4000, 1e-3, 1e-10
"""Residual (scaled) below which Newton's method stops. It is the second number times the tolerance,
but at most the third number. In any case it is at least the first number times the rounding error
(about 1e-12 in float64)."""
_KEPT = 4
"""Number of integrations after which the solver steps are kept, whatever the size of the Newton
step. If a third of `Shots.count` is less, that number is used instead."""
_LOOKS = 6
"""Maximum number of searches for kinks while one orbit is closed."""
_DRIFT = 30.0, 1e-9, 1e-6
"""Change of the orbit's start (scaled) above which the search for kinks is repeated. The limit is
the first number (tolerances), at least the second and at most the third (scaled). After a smaller
change, kinks may lie slightly outside their short steps, which causes a first-order error."""
_STRAIN = 10.0
"""Estimated error of a repeated step (tolerances) above which the solver steps are chosen anew."""
_AFTER = 3
"""Number of remaining integrations below which an orbit that is already closed keeps its steps. A
new search for kinks, or a new choice of steps, could then leave the orbit open."""
_AGREE = 10.0, 1e-3, 3e-2
"""Relative difference between the derivatives on a grid and on halved steps above which no
derivatives are reported. The limit is the first number times the square root of the tolerance, at
least the second number and at most the third."""
_INEXACT = 1e-11
"""Least tolerance to which kinks count as known before the orbit is closed. Otherwise, at tight
tolerances, the check would have as long steps around kinks as the orbit."""
_SAME = 1e-3
"""Time (mesh periods) between the peaks on two grids above which they are two maxima of almost
equal height. The derivative of each is right, so they are not compared."""
_SMALL = 1e-9, 1e-3
"""Least and greatest value (scaled) of the Newton step below which the solver steps are kept. In
between, this limit is a thousand tolerances."""


class Orbit(NamedTuple):
    """A closed orbit of k mesh periods, with its first derivatives.

    `state`: scaled state z at φ1 = 0; `flow` over the orbit; `residual`: |Φ(z) - z|, scaled;
    `monodromy`: dΦ/dz, whose eigenvalues are the Floquet multipliers; `multiplier`: greatest
    modulus of the Floquet multipliers; `response`: mean (N), mean square (N²), peak (N) and the
    further measures; `sensitivity` (r, d): derivatives of `response` with respect to the design,
    along the family of orbits; `moved` (n, d): likewise, derivatives of `state`; `newton_steps`:
    number of integrations for Newton's method; `drift`: change of `state` since the last search for
    kinks (scaled); `defect`: residual (scaled) on a grid with halved steps, on which the
    derivatives are computed; `disagreement`: relative difference between the derivatives on both
    grids, plus that from the distance between their orbits. `defect` and `disagreement` are 0 if
    there was no check. `variation`: changes of the whole motion along the directions of the design,
    `None` unless the orbit was closed by collocation and they were requested.
    """

    state: Float[Array, " n"]
    flow: Flow
    residual: Float[Array, ""]
    monodromy: Float[Array, "n n"]
    multiplier: Float[Array, ""]
    response: Float[Array, " r"]
    sensitivity: Float[Array, "r d"]
    moved: Float[Array, "n d"]
    newton_steps: Int[Array, ""]
    drift: Float[Array, ""]
    defect: Float[Array, ""]
    disagreement: Float[Array, ""]
    variation: Step | None = None

    @classmethod
    def empty(cls, state: Float[Array, " n"], directions: int, flow: Flow) -> "Orbit":
        """Return a placeholder for an orbit from the scaled `state` (n,), before any integration.

        `directions`: number d of design directions; `flow`: result of `Flow.empty`."""
        count, dtype = state.shape[0], state.dtype
        infinite = jnp.asarray(jnp.inf, dtype)
        return cls(
            state=state,
            flow=flow,
            residual=infinite,
            monodromy=jnp.zeros((count, count), dtype),
            multiplier=infinite,
            response=flow.response,
            sensitivity=jnp.zeros((flow.response.shape[0], directions), dtype),
            moved=jnp.zeros((count, directions), dtype),
            newton_steps=jnp.zeros((), int),
            drift=jnp.zeros((), dtype),
            defect=jnp.zeros((), dtype),
            disagreement=jnp.zeros((), dtype),
        )


class _Closing(NamedTuple):
    """State of the loop that closes an orbit.

    `orbit`: result so far; `state`, `grid`: initial state and step ends for the next
    integration; `repeat`: whether the next integration repeats the steps of `grid`; `held`: whether
    the last integration repeated steps that remain in use; `improving`: whether the last
    integration at least halved the residual, or the grid is new; `base`: the grid without the step
    ends added for kinks; `best`: least residual on this grid; `looks`: number of searches for kinks
    so far; `looked`: initial state at the last search; `refined`: number of times that the steps
    were halved because derivatives disagreed; `checked`: whether the derivatives have been compared
    with those on halved steps.
    """

    orbit: Orbit
    state: Float[Array, " n"]
    repeat: Bool[Array, ""]
    held: Bool[Array, ""]
    improving: Bool[Array, ""]
    base: Float[Array, " steps"]
    grid: Float[Array, " steps"]
    best: Float[Array, ""]
    looks: Int[Array, ""]
    looked: Float[Array, " n"]
    refined: Int[Array, ""]
    checked: Bool[Array, ""]


class _Shooting(eqx.Module):
    """The loop of `close_orbit`, with the settings of one call.

    `start` returns the initial state of the loop, `go_on` whether the loop continues, and `step`
    its next state. `shots`: maximum number of integrations; `closed`: residual (scaled) at which
    Newton's method stops; `tolerance`: relative tolerance of the integrator; `check`: whether to
    compare derivatives with those on halved steps. The other fields are arguments of
    `close_orbit` or fields of `Shots`."""

    pair: RotorPair
    tangents: RotorPair
    period: Int[Array, ""]
    integrator: Integrator
    measures: Measures
    shots: Int[Array, ""]
    closed: Float[Array, ""]
    tolerance: Float[Array, ""]
    samples: int = eqx.field(static=True)
    check: bool = eqx.field(static=True)

    def start(self, state: Float[Array, " n"]) -> _Closing:
        """Return the initial state of the loop, for a motion that begins at the scaled `state`
        (n,)."""
        count, dtype = state.shape[0], state.dtype
        directions = jax.tree.leaves(eqx.filter(self.tangents, eqx.is_inexact_array))[0].shape[0]
        steps = self.integrator.max_steps
        none = Flow.empty(count, directions, self.samples, steps, self.measures, dtype)
        no, zero = jnp.zeros((), bool), jnp.zeros((), int)
        return _Closing(
            orbit=Orbit.empty(state, directions, none),
            state=state,
            repeat=no,
            held=no,
            improving=no,
            base=none.grid,
            grid=none.grid,
            best=jnp.asarray(jnp.inf, dtype),
            looks=zero,
            looked=state,
            refined=zero,
            checked=no,
        )

    def is_open(self, now: _Closing) -> Bool[Array, ""]:
        """Return whether Newton's method continues."""
        done = now.orbit.newton_steps
        left = (now.orbit.residual > self.closed) & ((done < 3) | now.improving)
        # Adaptive steps depend on the state, so the residual cannot fall below their noise.
        return (left | ~now.held) & (done < self.shots + now.refined * self.shots // 2)

    def go_on(self, now: _Closing) -> Bool[Array, ""]:
        """Return whether the loop continues: something is left to integrate."""
        sound = now.held & now.orbit.flow.solved & jnp.isfinite(now.orbit.residual)
        return self.is_open(now) | (sound & ~now.checked & self.check)

    def step(self, now: _Closing) -> _Closing:
        """Integrate once and return the new state of the loop.

        The integration serves a Newton step, or the check of the orbit on halved steps."""
        checking = ~self.is_open(now)
        start = jnp.where(checking, now.orbit.state, now.state)
        grid = lax.cond(checking, lambda: halved(now.grid), lambda: now.grid)
        frozen = lax.stop_gradient(self.pair)
        peak = now.orbit.flow.peak
        out = flow(
            self.pair,
            start,
            self.period.astype(start.dtype),
            self.integrator,
            self.samples,
            self.tangents,
            grid,
            now.repeat | checking,
            measures=self.measures,
            top=jnp.where(peak > 0, peak, frozen.force_scale),
        )
        return self._newton(now, start, checking, out)

    def _newton(self, now: _Closing, start, checking, out: Flow) -> _Closing:
        """Return the loop's state after the flow `out` from the scaled state `start`.

        If `checking`, compare the orbit with `out`, which has halved steps. Otherwise, take the
        Newton step. In both cases, choose the grid of the next integration."""
        count, dtype = start.shape[0], start.dtype
        monodromy = out.slope[:count, :count]
        miss = out.end - start
        residual = jnp.max(jnp.abs(miss))
        correction = solved(jnp.eye(count, dtype=dtype) - monodromy, miss[:, None])[:, 0]
        # A pair that floats (held by neither flanks nor gear) can rest anywhere: keep the state
        # the transient led to.
        floats = jnp.all(jnp.isfinite(miss)) & ~jnp.all(jnp.isfinite(correction))
        correction = jnp.where(floats, 0.0, correction)
        size = jnp.max(jnp.abs(correction))
        # Limit the Newton steps, to stay near the state the transient led to.
        new = start + correction * jnp.minimum(1.0, 0.5 / jnp.maximum(size, 1e-30))
        done = now.orbit.newton_steps + 1
        improving = residual < 0.5 * now.best
        following, look, again = self._kept(now, start, out, size, residual, improving)
        found = now.orbit._replace(
            state=start,
            flow=out,
            residual=residual,
            monodromy=monodromy,
            newton_steps=done,
            drift=jnp.max(jnp.abs(start - now.looked)),
        )
        compared, apart = _compared(now, out, residual, count)
        finer = checking & (apart > agreement(self.tolerance)) & (apart < jnp.inf)
        finer &= now.refined < 1
        renewed = jnp.where(checking, finer, look)
        # Residuals are comparable only on the same steps.
        best = jnp.where(renewed | ~now.repeat, jnp.inf, jnp.minimum(now.best, residual))
        after = _Closing(
            orbit=choose(checking, compared, found),
            state=new,
            repeat=following | checking,
            held=jnp.where(checking, ~finer, now.repeat & ~again),
            improving=improving | renewed,
            base=now.base,
            grid=now.grid,
            best=best,
            looks=now.looks + renewed,
            looked=jnp.where(renewed, start, now.looked),
            refined=now.refined + finer,
            checked=checking & ~finer,
        )
        # On a closed orbit, kinks are located exactly: the check has the shortest steps around
        # them. Otherwise, both grids would have the same error, and the check would not notice it.
        closed = ~self.is_open(after) & ~checking & self.check
        base, grid = self._steps(now, out, renewed | closed, finer, closed)
        return after._replace(base=base, grid=grid)

    def _kept(self, now: _Closing, start, out: Flow, size, residual, improving):
        """Return three decisions about the solver steps after the flow `out`.

        They are: whether to keep the steps of `out`; whether to search for kinks along `out`;
        whether to discard the steps kept so far. `start`: scaled initial state of `out`; `size`:
        greatest entry of the Newton step (scaled); `residual`: residual (scaled) of `out`;
        `improving`: whether it is below half the least residual so far on the same grid."""
        done, smooth = now.orbit.newton_steps + 1, self.pair.smooth
        known = size < jnp.clip(1000 * self.tolerance, *_SMALL)
        following = now.repeat | known | (done >= jnp.minimum(self.shots // 3, _KEPT))
        # The first search interpolates within long steps, and leaves some kinks up to 1e-5 mesh
        # periods outside their short steps, at any tolerance. The second one encloses them.
        rough = now.repeat & (now.looks == 1) & (residual > self.closed) & smooth
        # Search again where the motion has moved kinks out of their steps.
        few = now.looks < _LOOKS
        stalled = now.repeat & ~improving & (residual > self.closed) & few
        again = now.repeat & (residual <= self.closed) & few & (done + _AFTER <= self.shots)
        # If the pair is not smooth, kinks are not searched for again because the orbit has moved.
        far = jnp.clip(_DRIFT[0] * self.tolerance, *_DRIFT[1:])
        strayed = again & (jnp.max(jnp.abs(start - now.looked)) > far) & smooth
        strained = again & ~(out.strain <= _STRAIN)
        # Do not repeat the steps of a solver that failed.
        following &= ~strained & (out.solved | now.repeat | ~jnp.all(jnp.isfinite(start)))
        look = following & (~now.repeat | rough | stalled | strayed)
        return following, look, strayed | strained

    def _steps(self, now: _Closing, out: Flow, renewed, finer, closed):
        """Return the grid without step ends for kinks, and the grid of the next integration.

        `renewed`: whether to search for kinks along `out`; `finer`: whether to halve the steps;
        `closed`: whether `out` is the orbit, so that its kinks are known exactly."""
        base = jnp.where(now.repeat, now.base, out.grid)
        base = lax.cond(finer, lambda: halved(base), lambda: base)
        length = self.period.astype(out.end.dtype)
        frozen = lax.stop_gradient(self.pair)
        tolerance = jnp.where(closed, 0.0, jnp.maximum(self.tolerance, _INEXACT))
        grid = lax.cond(
            renewed,
            lambda: with_switches(frozen, out, length, tolerance, base),
            lambda: jnp.where(now.repeat, now.grid, out.grid),
        )
        return base, grid


class Shots(eqx.Module):
    """Settings for closing an orbit.

    `integrator` of the motion; `measures`: averages of the force; `count`: maximum number of
    integrations; `closed`: residual (scaled) at which Newton's method may stop; `samples`: number
    of uniform samples of an orbit, a multiple of its period; `check`: whether to compare the orbit
    and its derivatives with those on a grid with halved steps, if the pair is `smooth`. If the
    derivatives disagree, the orbit is closed once more, on the finer grid.
    """

    integrator: Integrator
    measures: Measures = eqx.field(default_factory=Measures)
    count: Int[Array, ""] | int = _NEWTON_STEPS
    closed: Float[Array, ""] | float = 0.0
    samples: int = eqx.field(static=True, default=SAMPLES)
    check: bool = eqx.field(static=True, default=True)


def close_orbit(
    pair: RotorPair,
    tangents: RotorPair,
    state: Float[Array, " n"],
    period: Int[Array, ""],
    shots: Shots,
) -> Orbit:
    """Find the periodic orbit of `period` mesh periods near the scaled `state` (n,), by shooting.

    The orbit is the solution of Φ(z) = z, where Φ is the flow over `period` mesh periods. Newton
    shooting finds it, and the implicit function theorem gives its derivatives. `tangents`: d pair /
    d design, stacked along a leading axis; `shots`: integrator, measures of the force and limits of
    Newton's method.

    Newton's method stops if the residual is at most `shots.closed` or, if greater, the limit from
    `_CLOSED`. It also stops if the residual no longer halves, or after `shots.count` integrations
    (half as many more if the steps were halved). If the orbit is still open then, nothing is
    raised: the result is that of the last integration. `Orbit.residual` and `Orbit.flow.solved`
    show whether it has failed.

    If the pair is not `smooth`, the linearised steps miss how its jumps move, so that derivatives
    with respect to the design are NaN.

    Once the Newton step is small, the solver steps are kept, with step ends added at kinks. Φ is
    then smooth and closes to rounding, and its derivative is as accurate as the motion.
    """
    count, dtype = state.shape[0], state.dtype
    tolerance = shots.integrator.tolerance
    roundings, tolerances, most = _CLOSED
    enough = jnp.minimum(tolerances * tolerance, most)
    enough = jnp.maximum(roundings * float(jnp.finfo(dtype).eps), enough)
    closer = _Shooting(
        pair=pair,
        tangents=tangents,
        period=period,
        integrator=shots.integrator,
        measures=shots.measures,
        shots=jnp.asarray(shots.count),
        closed=jnp.maximum(shots.closed, enough).astype(dtype),
        tolerance=tolerance,
        samples=shots.samples,
        # No check for a pair that is not smooth: its derivatives are those of the steps, not of
        # the motion.
        check=shots.check and pair.smooth,
    )
    # The integration occurs only once, inside the loop, so that it is compiled once.
    found = lax.while_loop(
        lambda now: closer.go_on(now), lambda now: closer.step(now), closer.start(state)
    )
    orbit = found.orbit
    slope = orbit.flow.slope
    moved = solved(jnp.eye(count, dtype=dtype) - orbit.monodromy, slope[:count, count:])
    if not pair.smooth:
        moved = jnp.full_like(moved, jnp.nan)  # Parameter derivatives become NaN.
    return orbit._replace(
        multiplier=spectral_radius(orbit.monodromy),
        response=orbit.flow.response,
        sensitivity=slope[count:, count:] + slope[count:, :count] @ moved,
        moved=moved,
    )


def choose(condition: Bool[Array, ""], new: Any, old: Any) -> Any:
    """Return the tree `new` if the `condition` holds, else the tree `old`."""
    return jax.tree.map(lambda x, y: jnp.where(condition, x, y), new, old)


def branch(taken: Bool[Array, ""], then: Callable[[], Any], otherwise: Callable[[], Any]) -> Any:
    """Return `then()` if `taken` holds, else `otherwise()`, like `lax.cond`.

    On a GPU, the motions of a batch are computed together, and `lax.cond` would compute both
    branches for all of them. Here, a branch that no motion takes is left out. A motion that does
    not take a branch repeats one that does, so that the loops of the branch do not last longer.
    There, the result cannot be differentiated."""
    if jax.default_backend() == "cpu":
        return lax.cond(taken, then, otherwise)
    both = eqx.filter_closure_convert(then), eqx.filter_closure_convert(otherwise)
    dynamic, static = eqx.partition(both, eqx.is_array)

    @custom_vmap
    def chosen(taken, dynamic):
        one, other = eqx.combine(dynamic, static)
        return lax.cond(taken, lambda: one(), lambda: other())

    @chosen.def_vmap
    def _(size, batched, taken, dynamic):
        taken = jnp.broadcast_to(taken, size)
        axes = jax.tree.map(lambda is_batched: 0 if is_batched else None, batched[1])

        def computed(number, takes):
            """Return the results (size, …) of a branch, zeros if no motion `takes` it."""
            row = jnp.where(takes, jnp.arange(size), jnp.argmax(takes))

            def every():
                own = jax.tree.map(
                    lambda x, is_batched: x[row] if is_batched else x,
                    dynamic[number],
                    batched[1][number],
                )
                call = jax.vmap(
                    lambda x: eqx.combine(x, static[number])(), (axes[number],), axis_size=size
                )
                return call(own)

            nothing = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(every))
            return lax.cond(jnp.any(takes), every, lambda: nothing)

        found = jax.vmap(choose)(taken, computed(0, taken), computed(1, ~taken))
        return found, jax.tree.map(lambda _: True, found)

    return chosen(taken, dynamic)


def _compared(now: _Closing, out: Flow, residual: Float[Array, ""], count: int):
    """Return the orbit of `now` with the derivatives of the flow `out`, and their disagreement.

    `out`: flow from the start of the orbit on the grid of the check, whose derivatives are the more
    accurate ones; `residual`: its residual (scaled); `count`: number of states. The orbit gets its
    steps, too: further derivatives are computed on them. Its forces and states remain."""
    flow = now.orbit.flow
    # The derivatives belong to the peak that is reported.
    same = jnp.abs(flow.peak_time - out.peak_time) < _SAME
    row = count + 2
    slope = out.slope.at[row].set(jnp.where(same, out.slope[row], flow.slope[row]))
    # Both flows begin at the same state. The orbit on the finer grid is displaced by (I - M)⁻¹
    # times the residual (scaled), and its derivatives differ by about as much.
    unit = jnp.eye(count, dtype=slope.dtype)
    gain = jnp.max(jnp.sum(jnp.abs(solved(unit - slope[:count, :count], unit)), axis=1))
    apart = disagreement(flow.slope, slope, count) + gain * residual
    # The comparison needs room to halve all steps.
    apart = jnp.where(has_room(now.grid), apart, jnp.inf)
    finer = flow._replace(slope=slope, grid=out.grid, corners=out.corners)
    kept = choose(jnp.all(jnp.isfinite(slope)), finer, flow)
    monodromy = kept.slope[:count, :count]
    orbit = now.orbit._replace(flow=kept, monodromy=monodromy, defect=residual)
    return orbit._replace(disagreement=apart), apart


def agreement(tolerance: Float[Array, ""]) -> Float[Array, ""]:
    """Return the `disagreement` above which an orbit's derivatives are not reported.

    `tolerance`: relative tolerance of the orbit's integration."""
    scale, least, most = _AGREE
    return jnp.clip(scale * jnp.sqrt(tolerance), least, most)


def disagreement(
    first: Float[Array, "rows columns"], second: Float[Array, "rows columns"], count: int
) -> Float[Array, ""]:
    """Return the largest relative difference between two estimates of an orbit's derivatives.

    `first` and `second`: `Flow.slope` on two grids; `count`: number of states. Two kinds of
    derivative are compared: (I - M)⁻¹, where M is the monodromy matrix; and the derivatives of
    state, mean force, mean square force and peak force with respect to the design. Differences are
    relative to the greatest entry of the same quantity in `first`.
    """

    def derivatives(slope):
        unit = jnp.eye(count, dtype=slope.dtype)
        right = jnp.concatenate([unit, slope[:count, count:]], axis=1)
        moved = solved(unit - slope[:count, :count], right)
        forces = slope[count : count + 3]
        along = forces[:, count:] + forces[:, :count] @ moved[:, count:]
        return [moved[:, :count], moved[:, count:], *along]

    def apart(one, other):
        size = jnp.max(jnp.abs(one), initial=0.0)
        return jnp.max(jnp.abs(one - other), initial=0.0) / jnp.where(size > 0, size, 1.0)

    pairs = zip(derivatives(first), derivatives(second), strict=True)
    return jnp.max(jnp.stack([apart(one, other) for one, other in pairs]))
