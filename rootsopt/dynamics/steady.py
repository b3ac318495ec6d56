"""Steady state: let the transient pass, check that it has, close the orbit.

The pair is forced with the mesh period. After a transient the states at the end of each
mesh period (the stroboscopic map) settle on a cycle of k points; Newton's method on the
k-fold map closes it, and the monodromy matrix tells whether it is stable. Where it does
not settle, the largest Lyapunov exponent tells chaos from a long transient.
"""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from rootsopt.dynamics.flow import Flow, Integrator, flow, strobe
from rootsopt.dynamics.measures import Measures
from rootsopt.dynamics.pair import RotorPair
from rootsopt.dynamics.switches import halved, has_room, with_switches

BLOCK = 4
"""Mesh periods integrated between two looks at the transient."""
_MEMORY = 20
"""Stroboscopic states remembered; more than twice the longest period looked for."""
SAMPLES = 2520
"""Uniform samples of an orbit; divisible by every period up to ten, so that a sample
falls on the end of each mesh period."""
_NEWTON_STEPS = 24
_CLOSED = 4000, 1e-3, 1e-10
"""Residual (scaled) at which Newton stops: in roundings (1e-12 in double precision), or in
tolerances of the motion up to a limit."""
_PATIENCE = 32, 1e-5
"""Mesh periods after which a transient that has not settled goes on with steps at this tolerance
at most: their noise hides that the motion repeats."""
NOISE = 100.0
"""Noise that adaptive steps give the stroboscopic states, in tolerances and relative to them."""
_KEPT = 4
"""Integrations after which the steps are kept in any case."""
_LOOKS = 6
"""Times that kinks are looked for while an orbit is closed, at most."""
_DRIFT = 30.0, 1e-9, 1e-6
"""Distance (scaled) that an orbit may have moved from where its kinks were looked for, in
tolerances, but within these limits. The kinks lie that far outside their steps, which costs
accuracy in first order."""
_STRAIN = 10.0
"""Error of a repeated step, in tolerances, with which the steps are chosen anew."""
_AFTER = 3
"""Integrations that must be left for looking at kinks again, or choosing steps anew: an orbit that
is closed is not given away."""
_AGREE = 10.0, 1e-3, 3e-2
"""Disagreement of the derivatives on a grid and on one with its steps halved that is accepted: in
square roots of the tolerance, but within these limits."""
_SMALL = 1e-9, 1e-3
"""Newton step (scaled) from which on the solver's steps are kept: a thousand times its
tolerance, but within these."""


class Transient(NamedTuple):
    """End of a transient.

    `state`: last stroboscopic state; `period`: its cycle length k in mesh periods, 0 if
    it has not settled; `nearest`: the k with which the last states repeat best, and
    `spread` the scaled difference that leaves; `periods`: mesh periods simulated; `lost`:
    `RotorPair.lost`; `solved`: whether the solver got through; `steps`:
    solver steps.
    """

    state: Float[Array, " n"]
    period: Int[Array, ""]
    nearest: Int[Array, ""]
    spread: Float[Array, ""]
    periods: Int[Array, ""]
    lost: Bool[Array, ""]
    solved: Bool[Array, ""]
    steps: Int[Array, ""]


class Orbit(NamedTuple):
    """A closed orbit of k mesh periods with first derivatives.

    `state` at φ1 = 0; `flow` over the orbit; `residual` |Φ(z) - z| in scaled units;
    `monodromy` dΦ/dz and `multiplier`, the greatest modulus of its eigenvalues; `response`:
    (mean, mean square, peak, other measures); `sensitivity` (r, d): their derivatives along the
    orbit family with respect to the design; `newton_steps`. `drift`: distance (scaled) from where
    the kinks were looked for. `defect`: residual on a grid with every step halved, and
    `disagreement` of the derivatives on both, relative to the greatest; 0 where there was no check.
    """

    state: Float[Array, " n"]
    flow: Flow
    residual: Float[Array, ""]
    monodromy: Float[Array, "n n"]
    multiplier: Float[Array, ""]
    response: Float[Array, " r"]
    sensitivity: Float[Array, "r d"]
    newton_steps: Int[Array, ""]
    drift: Float[Array, ""]
    defect: Float[Array, ""]
    disagreement: Float[Array, ""]

    @classmethod
    def empty(cls, state: Float[Array, " n"], directions: int, flow: Flow) -> "Orbit":
        """An orbit from `state` that has not been integrated yet, with derivatives along d
        `directions` of the design; `flow` is `Flow.empty`."""
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
            newton_steps=jnp.zeros((), int),
            drift=jnp.zeros((), dtype),
            defect=jnp.zeros((), dtype),
            disagreement=jnp.zeros((), dtype),
        )


class _Closing(NamedTuple):
    """An orbit that is being closed.

    `state` and `grid` of the next integration, whose steps are kept if `repeat`; `held`: whether
    those of the last one were; `improving`: whether it came closer; `base`: the steps without those
    made for kinks; `best` residual on this grid; kinks were looked for `looks` times, last along
    the orbit from `looked`; `refined`: times the steps were halved because derivatives disagreed;
    `checked`: whether the derivatives were compared.
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


def settled_within(rtol: Float[Array, ""]) -> Float[Array, ""]:
    """Scaled difference below which states count as repeating, for a transient integrated
    at `rtol`: the noise of adaptive steps is some hundred times the tolerance."""
    return jnp.clip(1000 * rtol, 3e-3, 3e-2)


def settle(
    pair: RotorPair,
    state: Float[Array, " n"],
    how: Integrator,
    tolerance: Float[Array, ""],
    max_periods: Int[Array, ""],
    max_orbit: int,
) -> Transient:
    """Integrate block by block until the last states repeat with some period k.

    What has not settled after `_PATIENCE` goes on in finer steps. Settled means: the last k + 1
    states differ from those k periods earlier by less than `tolerance` (scaled units; or the noise
    of steps in states far from 0), for the smallest such k ≤ `max_orbit` ≤ 8.
    """
    orders = jnp.arange(1, max_orbit + 1)
    age = jnp.arange(_MEMORY)[::-1]

    def cycle(states, rtol):
        # Of states far from 0 the noise of adaptive steps is in proportion to them.
        noise = jnp.maximum(1.0, NOISE * rtol * jnp.abs(states) / tolerance)
        noise = jnp.where(jnp.isfinite(noise), noise, 1.0)

        def spread(k):
            change = jnp.max(jnp.abs(states - jnp.roll(states, k, axis=0)) / noise, axis=1)
            # Before the start the memory holds inf, and inf - inf is no difference.
            change = jnp.where(jnp.isnan(change), jnp.inf, change)
            return jnp.max(jnp.where(age <= k, change, 0.0))

        spreads = jax.vmap(spread)(orders)
        settled = spreads < tolerance
        period = jnp.where(jnp.any(settled), orders[jnp.argmax(settled)], 0)
        nearest = jnp.argmin(spreads)
        return period, orders[nearest], spreads[nearest]

    def go_on(loop):
        carry, _ = loop
        alive = ~carry.lost & carry.solved & jnp.all(jnp.isfinite(carry.state))
        return (carry.period == 0) & alive & (carry.periods < max_periods)

    def advance(loop):
        carry, memory = loop
        longest, fine = _PATIENCE
        rtol = jnp.where(carry.periods < longest, how.rtol, jnp.minimum(how.rtol, fine))
        part = strobe(pair, carry.state, BLOCK, dataclasses.replace(how, rtol=rtol))
        memory = jnp.concatenate([memory[BLOCK:], part.states])
        end = part.states[-1]
        lost = pair.lost(end)
        sound = part.solved & ~lost & jnp.all(jnp.isfinite(end))
        period, nearest, spread = cycle(memory, rtol.astype(memory.dtype))
        new = Transient(
            state=end,
            period=jnp.where(sound, period, 0),
            nearest=nearest,
            spread=spread,
            periods=carry.periods + BLOCK,
            lost=lost,
            solved=part.solved,
            steps=carry.steps + part.steps,
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
    )
    memory = jnp.full((_MEMORY, *state.shape), jnp.inf, state.dtype)
    return lax.while_loop(go_on, advance, (start, memory))[0]


def close_orbit(
    pair: RotorPair,
    tangents: RotorPair,
    state: Float[Array, " n"],
    period: Int[Array, ""],
    how: Integrator,
    measures: Measures | None = None,
    samples: int = SAMPLES,
    shots: Int[Array, ""] | int = _NEWTON_STEPS,
    closed: Float[Array, ""] | float = 0.0,
    check: bool = True,
) -> Orbit:
    """Newton shooting on Φ(z) = z, then the implicit function theorem for gradients.

    `tangents` holds d pair / d design, stacked along a leading axis. `samples` must be
    divisible by the period. Newton stops after `shots` integrations, or at the residual
    `closed` (at least some thousand roundings and a thousandth of the tolerance). Once its steps
    are small those of the solver are kept, with ends added where the equation is not smooth: so
    the map it solves is smooth and closes to rounding, and its derivative is as accurate as the
    motion. With `check`, orbit and derivatives are compared with those on a grid with every step
    halved; where they disagree the orbit is closed once more, on that one.
    """
    count, dtype = state.shape[0], state.dtype
    tolerance = how.tolerance(dtype)
    roundings, tolerances, most = _CLOSED
    enough = jnp.minimum(tolerances * tolerance, most)
    enough = jnp.maximum(roundings * float(jnp.finfo(dtype).eps), enough)
    closed = jnp.maximum(closed, enough).astype(dtype)
    far = jnp.clip(_DRIFT[0] * tolerance, *_DRIFT[1:])
    length = period.astype(dtype)
    measures = Measures() if measures is None else measures
    frozen = lax.stop_gradient(pair)
    # A contact that may jump anywhere has derivatives of the steps, not of the motion.
    check = check and pair.smooth

    def shoot(state, grid, repeat, peak):
        top = jnp.where(peak > 0, peak, frozen.force_scale)
        return flow(
            pair, state, length, how, samples, tangents, grid, repeat, measures=measures, top=top
        )

    def is_open(now):
        done = now.orbit.newton_steps
        left = (now.orbit.residual > closed) & ((done < 3) | now.improving)
        # Chosen anew, the steps depend on the state, and that leaves a floor.
        return (left | ~now.held) & (done < shots + now.refined * shots // 2)

    def go_on(now):
        sound = now.held & now.orbit.flow.solved & jnp.isfinite(now.orbit.residual)
        return is_open(now) | (sound & ~now.checked & check)

    def step(now):
        checking = ~is_open(now)
        start = jnp.where(checking, now.orbit.state, now.state)
        grid = lax.cond(checking, lambda: halved(now.orbit.flow.grid), lambda: now.grid)
        out = shoot(start, grid, now.repeat | checking, now.orbit.flow.peak)
        monodromy = out.slope[:count, :count]
        miss = out.end - start
        residual = jnp.max(jnp.abs(miss))
        correction = solved(jnp.eye(count, dtype=dtype) - monodromy, miss[:, None])[:, 0]
        # A pair that floats stays where the transient led to: any place is as good.
        floats = jnp.all(jnp.isfinite(miss)) & ~jnp.all(jnp.isfinite(correction))
        correction = jnp.where(floats, 0.0, correction)
        size = jnp.max(jnp.abs(correction))
        # Keep the first steps inside the neighbourhood the transient pointed to.
        new = start + correction * jnp.minimum(1.0, 0.5 / jnp.maximum(size, 1e-30))
        done = now.orbit.newton_steps + 1
        known = size < jnp.clip(1000 * tolerance, *_SMALL)
        following = now.repeat | known | (done >= jnp.minimum(shots // 3, _KEPT))
        improving = residual < 0.5 * now.best
        # Kinks are looked for again where the motion has moved them out of their steps.
        few = now.looks < _LOOKS
        stalled = now.repeat & ~improving & (residual > closed) & few
        drift = jnp.max(jnp.abs(start - now.looked))
        again = now.repeat & (residual <= closed) & few & (done + _AFTER <= shots)
        # A jump that no switch tells stays where the steps have it.
        strayed = again & (drift > far) & pair.smooth
        strained = again & ~(out.strain <= _STRAIN)
        # Steps of a solver that did not get through are none to be repeated.
        following &= ~strained & (out.solved | now.repeat | ~jnp.all(jnp.isfinite(start)))
        look = following & (~now.repeat | stalled | strayed)

        found = now.orbit._replace(
            state=start,
            flow=out,
            residual=residual,
            monodromy=monodromy,
            newton_steps=done,
            drift=drift,
        )
        apart = disagreement(now.orbit.flow.slope, out.slope, count)
        # Where not all steps can be divided nothing is compared.
        apart = jnp.where(has_room(now.orbit.flow.grid), apart, jnp.inf)
        compared = now.orbit._replace(defect=residual, disagreement=apart)
        orbit = _choose(checking, compared, found)
        finer = checking & (apart > agreement(tolerance)) & (apart < jnp.inf) & (now.refined < 1)
        base = jnp.where(now.repeat, now.base, out.grid)
        base = lax.cond(finer, lambda: halved(base), lambda: base)
        grid = lax.cond(
            jnp.where(checking, finer, look),
            lambda: with_switches(frozen, out, length, tolerance, base),
            lambda: jnp.where(now.repeat, now.grid, out.grid),
        )
        renewed = jnp.where(checking, finer, look)
        # Residuals compare on the same steps only.
        best = jnp.where(renewed | ~now.repeat, jnp.inf, jnp.minimum(now.best, residual))
        return _Closing(
            orbit=orbit,
            state=new,
            repeat=following | checking,
            held=jnp.where(checking, ~finer, now.repeat & ~strayed & ~strained),
            improving=improving | renewed,
            base=base,
            grid=grid,
            best=best,
            looks=now.looks + renewed,
            looked=jnp.where(renewed, start, now.looked),
            refined=now.refined + finer,
            checked=checking & ~finer,
        )

    # The loop holds the only copy of the integration: one shot is compiled, not two.
    designs = jax.tree.leaves(eqx.filter(tangents, eqx.is_inexact_array))[0].shape[0]
    none = Flow.empty(count, designs, samples, how.max_steps, measures, dtype)
    no, zero = jnp.zeros((), bool), jnp.zeros((), int)
    start = _Closing(
        orbit=Orbit.empty(state, designs, none),
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
    orbit = lax.while_loop(go_on, step, start).orbit
    slope = orbit.flow.slope
    moved = solved(jnp.eye(count, dtype=dtype) - orbit.monodromy, slope[:count, count:])
    sensitivity = slope[count:, count:] + slope[count:, :count] @ moved
    return orbit._replace(
        multiplier=spectral_radius(orbit.monodromy),
        response=orbit.flow.response,
        sensitivity=sensitivity,
    )


def _choose(condition, new, old):
    return jax.tree.map(lambda x, y: jnp.where(condition, x, y), new, old)


def agreement(tolerance: Float[Array, ""]) -> Float[Array, ""]:
    """Largest `disagreement` with which derivatives of an orbit at a relative `tolerance` are
    reported."""
    scale, least, most = _AGREE
    return jnp.clip(scale * jnp.sqrt(tolerance), least, most)


def disagreement(
    first: Float[Array, "rows columns"], second: Float[Array, "rows columns"], count: int
) -> Float[Array, ""]:
    """Largest difference of two estimates of an orbit's derivatives, each kind relative to its
    greatest: (I - M)⁻¹, and those of the state and of mean and mean square force with respect to
    the design. `first` and `second`: `Flow.slope` of `count` states on two grids.
    """

    def derivatives(slope):
        unit = jnp.eye(count, dtype=slope.dtype)
        right = jnp.concatenate([unit, slope[:count, count:]], axis=1)
        moved = solved(unit - slope[:count, :count], right)
        forces = slope[count : count + 2]
        along = forces[:, count:] + forces[:, :count] @ moved[:, count:]
        return [moved[:, :count], moved[:, count:], *along]

    def apart(one, other):
        size = jnp.max(jnp.abs(one), initial=0.0)
        return jnp.max(jnp.abs(one - other), initial=0.0) / jnp.where(size > 0, size, 1.0)

    pairs = zip(derivatives(first), derivatives(second), strict=True)
    return jnp.max(jnp.stack([apart(one, other) for one, other in pairs]))


def reverse_sensitivity(
    build: Callable[[Float[Array, " d"]], RotorPair],
    design: Float[Array, " d"],
    state: Float[Array, " n"],
    period: Int[Array, ""],
    how: Integrator,
    grid: Float[Array, " steps"],
    measures: Measures | None = None,
    top: Float[Array, ""] | None = None,
) -> Float[Array, "r d"]:
    """The same sensitivity by reverse mode, through diffrax's checkpointed adjoint (where the
    contact may jump, which that knows nothing of, through the steps themselves).

    On the steps `grid` of the closed orbit, whose peak is `top` (N). With cotangents v of a
    response and w of the end state, the implicit function theorem asks for
    (I - M)ᵀ w = R_zᵀ v and gives dR/dp = R_pᵀ v + Φ_pᵀ w.
    """
    count = state.shape[0]
    length = period.astype(state.dtype)
    adjoint = diffrax.RecursiveCheckpointAdjoint()

    def run(state, design):
        kept = {"grid": grid, "adjoint": adjoint, "measures": measures, "top": top}
        out = flow(build(design), state, length, how, SAMPLES, **kept)
        return jnp.concatenate([out.end, out.response])

    end, pull = jax.vjp(run, state, design)
    by_state, by_design = jax.vmap(pull)(jnp.eye(end.shape[0], dtype=state.dtype))
    monodromy, response = by_state[:count], by_state[count:]
    weight = solved((jnp.eye(count, dtype=state.dtype) - monodromy).T, response.T)
    return by_design[count:] + weight.T @ by_design[:count]


def no_tangents(pair: RotorPair) -> RotorPair:
    """No directions of the parameters of `pair`, stacked: derivatives in the state only."""
    return jax.tree.map(
        lambda x: jnp.zeros((0, *x.shape), x.dtype), eqx.filter(pair, eqx.is_inexact_array)
    )


class Lyapunov(NamedTuple):
    """Largest Lyapunov exponent per mesh period, its standard error, and statistics of
    the force over the window it was measured on."""

    exponent: Float[Array, ""]
    error: Float[Array, ""]
    flows: Flow
    state: Float[Array, " n"]


def lyapunov(pair: RotorPair, state: Float[Array, " n"], periods: int, how: Integrator) -> Lyapunov:
    """Growth of a tangent vector over `periods` mesh periods, renormalised each period.

    The standard error comes from 16 batch means.
    """
    one = jnp.ones_like(state[0])
    still = no_tangents(pair)

    def step(carry, _):
        state, tangent = carry
        out = flow(pair, state, one, how, SAMPLES // 4, still)
        moved = out.slope[: state.shape[0]] @ tangent
        size = jnp.linalg.norm(moved)
        safe = jnp.where(size > 0, size, 1.0)
        return (out.end, moved / safe), (jnp.log(safe), out)

    direction = jnp.zeros_like(state).at[0].set(1.0)
    (end, _), (growth, flows) = lax.scan(step, (state, direction), length=periods)
    batches = jnp.mean(growth.reshape(16, -1), axis=1)
    error = jnp.std(batches, ddof=1) / 4
    return Lyapunov(jnp.mean(growth), error, flows, end)


def solved(matrix: Float[Array, "n n"], right: Float[Array, "n m"]) -> Float[Array, "n m"]:
    """Solution of a few linear equations, by elimination with row pivoting.

    In plain arithmetic: a call into LAPACK costs more than the solution of two equations, and
    a program that holds one cannot be kept between processes.
    """
    rows = jnp.concatenate([matrix, right], axis=1)
    count = matrix.shape[0]
    place = jnp.arange(count)
    for k in range(count):
        size = jnp.where(place >= k, jnp.abs(rows[:, k]), -1.0)
        pivot = jnp.argmax(size)
        order = jnp.where(place == k, pivot, jnp.where(place == pivot, k, place))
        rows = rows[order]
        row = rows[k] / rows[k, k]
        rows = jnp.where((place == k)[:, None], row, rows - rows[:, k : k + 1] * row)
    return rows[:, count:]


_SQUARINGS = 40


def spectral_radius(matrix: Float[Array, "n n"]) -> Float[Array, ""]:
    """Greatest modulus of the eigenvalues, in real arithmetic.

    Of two, from trace and determinant; of more, as the growth of the powers of the matrix, which
    repeated squaring takes so far that nothing is left of the choice of norm.
    """
    if matrix.shape[0] == 2:
        half = jnp.trace(matrix) / 2
        determinant = jnp.linalg.det(matrix)
        square = half**2 - determinant
        root = jnp.sqrt(jnp.abs(square))
        return jnp.where(square >= 0, jnp.abs(half) + root, jnp.sqrt(jnp.abs(determinant)))

    def double(_, carry):
        power, growth, share = carry
        size = jnp.max(jnp.abs(power))
        scaled = power / jnp.where(size > 0, size, 1.0)
        growth = growth + share * jnp.log(size)
        # Written as a sum: a matrix product this small costs more in its call.
        return jnp.sum(scaled[:, :, None] * scaled[None], axis=1), growth, share / 2

    start = matrix, jnp.zeros((), matrix.dtype), jnp.ones((), matrix.dtype)
    return jnp.exp(lax.fori_loop(0, _SQUARINGS, double, start)[1])
