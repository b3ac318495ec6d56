"""Integration of a rotor pair over whole mesh periods with diffrax."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from rootsopt.dynamics.landing import LandingControl
from rootsopt.dynamics.measures import Measures
from rootsopt.dynamics.pair import RotorPair
from rootsopt.dynamics.peak import BESIDE, BESIDE_UNIT, Steps, locate_peak, one_sided
from rootsopt.dynamics.saltation import MARKS, marks, saltation
from rootsopt.dynamics.tangent import Linear, linearized, one_step, propagated

METHODS: dict[str, Callable[..., diffrax.AbstractSolver]] = {
    "tsit5": diffrax.Tsit5,
    "dopri5": diffrax.Dopri5,
    "dopri8": diffrax.Dopri8,
    "kvaerno3": diffrax.Kvaerno3,
    "kvaerno5": diffrax.Kvaerno5,
}
IMPLICIT = ("kvaerno3", "kvaerno5")


_STAGES = 1e5
"""Roundings to which the stages of an implicit method are known: the gap is the difference of
lengths ten thousand times a penetration, and the force a power of it. Iterations that are asked for
less never end, and a repeated step cannot be made shorter. (Each is a whole step of Newton's
method, so that the last one gains more than was asked for.)"""
_FIRST_STEP = 1e-3, 0.05
"""First step: in mesh periods, and in units of the pair's quickest swing; the shorter counts. Too
large a one is rejected by the error control."""
_LONGEST = 1 / 32, 1 / 8, 4.0
"""Longest step: in mesh periods, and in units of a fall through the play; the shorter counts. In
free flight the error control would let a step pass over a short touch of the gear without a stage
inside it. But steps so long must not use up more than the last of these as a share (1 / x) of
those allowed: an implicit method takes far longer ones where the pair does not fly."""
_SHORTEST = 1e-9
"""Least time (mesh periods) between the beginning of a step and a peak inside it."""


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

    def tolerance(self, dtype: Any) -> Float[Array, ""]:
        """Tolerance for states of type `dtype`."""
        floor = 20 * float(jnp.finfo(dtype).eps)
        return jnp.maximum(self.rtol, floor).astype(dtype)

    def solver(self, dtype: Any, loops: str = "lax") -> diffrax.AbstractSolver:
        """The method for states of type `dtype`; `loops` over the stages of a step are
        "lax" (forward mode only) or "bounded" (either mode)."""
        method = METHODS[self.method]
        if self.method not in IMPLICIT:
            return method(scan_kind=loops)
        least = _STAGES * float(jnp.finfo(dtype).eps)
        rtol: Any = jnp.maximum(self.tolerance(dtype), least).astype(dtype)
        # With a Jacobian for every iteration: one kept from the step's begin does not converge
        # across a kink, and a repeated step cannot be made shorter.
        return method(scan_kind=loops, root_finder=optimistix.Newton(rtol=rtol, atol=rtol))

    def controller(
        self,
        dtype: Any,
        periods: Float[Array, ""] | float = 1.0,
        pair: RotorPair | None = None,
    ) -> "diffrax.PIDController | LandingControl":
        """Step size control of states of type `dtype` over an interval of `periods`, for `pair`
        if that is known."""
        rtol = self.tolerance(dtype)
        longest = _LONGEST[0]
        if pair is not None and pair.timescales is not None:
            fall = pair.timescales.fall / pair.mesh_period
            flying = jnp.maximum(_LONGEST[1] * fall, _LONGEST[2] / self.max_steps)
            longest = jnp.minimum(longest, flying).astype(dtype)
        base = diffrax.PIDController(rtol=rtol, atol=rtol, dtmax=longest / periods)
        if pair is None or pair.timescales is None:
            return base
        return LandingControl.of(base, pair, periods)


def first_step(pair: RotorPair, dtype: Any) -> Float[Array, ""]:
    """First step (mesh periods) to be tried."""
    longest, share = _FIRST_STEP
    if pair.timescales is None:
        return jnp.asarray(longest, dtype)
    swing = lax.stop_gradient(pair.timescales.swing / pair.mesh_period)
    return jnp.minimum(longest, share * swing).astype(dtype)


class Strobe(NamedTuple):
    """States at the end of successive mesh periods, and how the solver fared."""

    states: Float[Array, "periods n"]
    steps: Int[Array, ""]
    solved: Bool[Array, ""]


class Flow(NamedTuple):
    """One stretch of motion over `periods` mesh periods.

    `end`: final state; `mean`, `mean_square`, `peak` of the contact force (N, N², N);
    `peak_time` (mesh periods); `depth`: greatest penetration (m; negative: least gap)
    at the sampled times; `states` at uniform times, endpoint excluded; `grid`: ends
    of the steps taken (mesh periods), inf beyond the last, and `corners` the states there; `steps`:
    accepted and rejected solver steps; `solved`; `strain`: greatest error estimate of a repeated
    step, in tolerances (0 where the contact is not `RotorPair.smooth`); `others`: the values of
    `Measures` beside mean and mean square.
    `slope`: derivatives of (end, mean, mean_square, peak, others) in the initial state (n columns)
    and along the directions that were asked for (d more), or no columns at all.
    """

    end: Float[Array, " n"]
    mean: Float[Array, ""]
    mean_square: Float[Array, ""]
    peak: Float[Array, ""]
    peak_time: Float[Array, ""]
    depth: Float[Array, ""]
    states: Float[Array, "samples n"]
    grid: Float[Array, " steps"]
    corners: Float[Array, "steps n"]
    steps: Int[Array, ""]
    solved: Bool[Array, ""]
    strain: Float[Array, ""]
    others: Float[Array, " others"]
    slope: Float[Array, "rows columns"]

    @classmethod
    def empty(
        cls, count: int, directions: int, samples: int, steps: int, measures: Measures, dtype: Any
    ) -> "Flow":
        """A flow of `count` = n states that has not been integrated yet."""
        nothing = jnp.zeros((), dtype)
        return cls(
            end=jnp.zeros(count, dtype),
            mean=nothing,
            mean_square=nothing,
            peak=nothing,
            peak_time=nothing,
            depth=nothing,
            states=jnp.zeros((samples, count), dtype),
            grid=jnp.full(steps, jnp.inf, dtype),
            corners=jnp.zeros((steps, count), dtype),
            steps=jnp.zeros((), int),
            solved=jnp.zeros((), bool),
            strain=nothing,
            others=jnp.zeros(measures.count - 2, dtype),
            slope=jnp.zeros((count + 1 + measures.count, count + directions), dtype),
        )

    @property
    def response(self) -> Float[Array, " r"]:
        """(mean, mean square, peak, others) of the contact force."""
        return jnp.append(jnp.stack([self.mean, self.mean_square, self.peak]), self.others)


class StepGrid(diffrax.AbstractAdaptiveStepSizeController):
    """Adaptive steps, or a repetition of steps recorded before.

    On repeated steps the discrete flow is a smooth function of state and parameters, and
    Newton's method converges to rounding. `ends`: ends of the recorded steps (inf beyond
    the last), used where `repeat` is true.
    """

    pid: diffrax.PIDController | LandingControl
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
        strain = jnp.zeros((), self.ends.dtype)
        return jnp.where(self.repeat, self.ends[0], first), (state, jnp.asarray(1), strain)

    def adapt_step_size(self, t0, t1, y0, y1_candidate, args, y_error, error_order, state):  # pyright: ignore[reportIncompatibleMethodOverride]
        state, count, strain = state
        # The choice of steps is no part of what is differentiated.
        y0, y1_candidate, y_error = lax.stop_gradient((y0, y1_candidate, y_error))
        keep, start, stop, jump, state, result = self.pid.adapt_step_size(
            t0, t1, y0, y1_candidate, args, y_error, error_order, state
        )
        recorded = self.ends[jnp.minimum(count, self.ends.shape[0] - 1)]
        # Nothing is rejected where steps are repeated; whether it would have been is remembered.
        unit = self.pid.atol + self.pid.rtol * jnp.maximum(jnp.abs(y0), jnp.abs(y1_candidate))
        strain = jnp.maximum(strain, self.pid.norm(y_error / unit))
        return (
            keep | self.repeat,
            jnp.where(self.repeat, t1, start),
            jnp.where(self.repeat, recorded, stop),
            jump & ~self.repeat,
            (state, count + 1, strain),
            diffrax.RESULTS.where(self.repeat, diffrax.RESULTS.successful, result),
        )


def strobe(
    pair: RotorPair, state: Float[Array, " n"], periods: int, integrator: Integrator
) -> Strobe:
    """Integrate the bare states over `periods` mesh periods, from φ1 = 0.

    Steps land on the period ends: interpolated states would carry an error far above
    the tolerance and hide that the motion repeats.
    """
    number = state.dtype.type
    first, control = first_step(pair, state.dtype), integrator.controller(state.dtype, pair=pair)

    def one_period(state, _):
        solution = diffrax.diffeqsolve(
            diffrax.ODETerm(lambda tau, y, pair: pair.derivative(tau, y)[0]),
            integrator.solver(state.dtype),
            t0=number(0.0),
            t1=number(1.0),
            dt0=first,
            y0=state,
            args=pair,
            saveat=diffrax.SaveAt(t1=True),
            stepsize_controller=control,
            adjoint=diffrax.ForwardMode(),
            max_steps=integrator.max_steps,
            throw=False,
        )
        assert solution.ys is not None
        end = solution.ys[0]
        return end, (
            end,
            solution.stats["num_steps"],
            solution.result == diffrax.RESULTS.successful,
        )

    _, (states, steps, solved) = lax.scan(one_period, state, length=periods)
    return Strobe(states, jnp.sum(steps), jnp.all(solved))


def flow(
    pair: RotorPair,
    state: Float[Array, " n"],
    periods: Float[Array, ""],
    integrator: Integrator,
    samples: int,
    tangents: RotorPair | None = None,
    grid: Float[Array, " steps"] | None = None,
    repeat: Bool[Array, ""] | bool = True,
    adjoint: diffrax.AbstractAdjoint | None = None,
    measures: Measures | None = None,
    top: Float[Array, ""] | None = None,
) -> Flow:
    """Integrate over `periods` (traced) mesh periods with the force statistics.

    Mean, mean square and what else `measures` names are integrated along with the motion, under
    the same error control; `top` (N) is about the greatest force, for the p-norm. The peak is
    located between `samples` uniform ones. With `tangents` (directions of the pair's parameters,
    stacked along a leading axis; there may be none) every step is linearised, which gives `slope`.
    Where the contact may jump, that includes the moving instant of a jump, and an `adjoint` only
    says that the mode is reverse.
    With `grid` the steps recorded there are repeated (while `repeat`), else they are chosen anew.
    """
    count, dtype = state.shape[0], state.dtype
    measures = Measures() if measures is None else measures
    force_unit = lax.stop_gradient(pair.force_scale)
    top = jnp.ones_like(force_unit) if top is None else lax.stop_gradient(top) / force_unit
    dynamic, static = eqx.partition(pair, eqx.is_inexact_array)
    solver = integrator.solver(dtype, "lax" if adjoint is None else "bounded")
    # An adjoint of the solver knows nothing of jumps: then the steps are what is differentiated.
    jumps = pair.jumps
    retraced = jumps and adjoint is not None

    def derivative(tau, y, dynamic, marked=False):
        pair = eqx.combine(dynamic, static)
        slope, contact = pair.derivative(tau, y[:count])
        rates = measures.rates(tau, contact.total / force_unit, top)
        if pair.free:
            # Averages are over time, which passes unevenly.
            rates = pair.lapse(y[:count]) * jnp.append(rates, jnp.ones_like(force_unit))
        return jnp.concatenate([slope, rates, *([marks(contact)] if marked else [])])

    def whole(share, y, dynamic):
        return periods * derivative(share * periods, y, dynamic)

    # Over the unit interval: limits known when it is traced make a smaller program.
    ends = jnp.full(integrator.max_steps, jnp.inf, dtype) if grid is None else grid / periods
    repeated = jnp.asarray(False if grid is None else repeat)
    start = jnp.pad(state, (0, measures.count + pair.free))
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(whole),
        solver,
        t0=dtype.type(0.0),
        t1=dtype.type(1.0),
        dt0=first_step(pair, dtype) / periods,
        y0=lax.stop_gradient(start) if retraced else start,
        args=lax.stop_gradient(dynamic) if retraced else dynamic,
        saveat=diffrax.SaveAt(
            subs=[
                diffrax.SubSaveAt(
                    ts=(jnp.arange(samples) / samples).astype(dtype),
                    fn=lambda share, y, args: y[:count],
                ),
                diffrax.SubSaveAt(steps=True, fn=lambda share, y, args: (share, y)),
                diffrax.SubSaveAt(t1=True),
            ],
            controller_state=True,
        ),
        stepsize_controller=StepGrid(  # pyright: ignore[reportCallIssue]
            pid=integrator.controller(dtype, periods, lax.stop_gradient(pair)),
            ends=ends,
            repeat=repeated,
        ),
        adjoint=diffrax.ForwardMode() if adjoint is None or retraced else adjoint,
        max_steps=integrator.max_steps,
        throw=False,
    )
    assert solution.ys is not None
    states, (ends, after), (end,) = solution.ys
    assert solution.controller_state is not None
    strain = solution.controller_state[-1]
    states, ends = lax.stop_gradient((states, ends * periods))
    begins = jnp.concatenate([jnp.zeros_like(ends[:1]), ends[:-1]])
    before = jnp.concatenate([start[None], after[:-1]])
    last = jnp.maximum(solution.stats["num_accepted_steps"] - 1, 0)

    term = diffrax.ODETerm(functools.partial(derivative, marked=jumps))

    def one(begin, end, y, dynamic):
        """y after one step, and its slope there."""
        if not jumps:
            after, slopes = one_step(solver, term, begin, end, y, dynamic)
            return after, slopes[-1]
        after, slopes = one_step(solver, term, begin, end, jnp.pad(y, (0, MARKS)), dynamic)
        period = pair.mesh_period * (pair.lapse(y[:count]) if pair.free else 1.0)
        moved = saltation(end - begin, slopes, period, pair.contact.length_scale)
        return after[:-MARKS] + moved, slopes[-1, :-MARKS]

    if retraced:

        @jax.checkpoint
        def again(y, step):
            begin, end = step
            return one(begin, end, y, dynamic)[0]

        def advance(y, step):
            return lax.cond(step[1] < jnp.inf, again, lambda y, _: y, y, step), y

        end, before = lax.scan(advance, start, (begins, ends))
    # The step that holds the peak is taken once more, as far as the peak, and from there on short
    # steps to both sides.
    steps = lax.stop_gradient(Steps(begins, ends, before[:, :count], after[:, :count], last + 1))
    peak_time, depth = locate_peak(lax.stop_gradient(pair), states, periods, steps)
    holds = jnp.clip(jnp.sum(ends < peak_time), 0, last)
    peak_time = jnp.maximum(peak_time, begins[holds] + _SHORTEST)
    duration = end[-1] if pair.free else periods
    raw = end[count : count + measures.count] / duration
    averages, factors = measures.values(raw, force_unit, top)
    noise = lax.stop_gradient(pair.rounding(depth))
    sides = BESIDE_UNIT[dtype.itemsize] * jnp.asarray(BESIDE, dtype)

    def state_and_force(begin, end, y, dynamic):
        after, slope = one(begin, end, y, dynamic)
        return jnp.append(after, slope[count] / slope[-1] if pair.free else slope[count])

    if tangents is None:
        there = state_and_force(begins[holds], peak_time, before[holds], dynamic)[:-1]

        def force_beside(side):
            return state_and_force(peak_time, peak_time + side, there, dynamic)[-1]

        forces = jax.vmap(force_beside)(sides)
        frozen = lax.stop_gradient(forces)
        peak, weights = one_sided(frozen, noise)
        peak += jnp.dot(weights, forces - frozen)
        slope = jnp.zeros((count + 1 + measures.count, 0), dtype)
    else:
        moved = eqx.filter(tangents, eqx.is_inexact_array)

        def linear_step(k, there):
            step, beside = jnp.where(k < 0, holds, k), k < -1
            side = sides[jnp.clip(-2 - k, 0, len(BESIDE) - 1)]
            begin = jnp.where(beside, peak_time, begins[step])
            end = jnp.where(beside, peak_time + side, jnp.where(k < 0, peak_time, ends[step]))
            y = jnp.where(beside, there[: start.shape[0]], before[step])
            return linearized(
                lambda y, dynamic: state_and_force(begin, end, y, dynamic), y, dynamic, moved, count
            )

        columns = count + jax.tree.leaves(moved)[0].shape[0]
        unit = jnp.eye(start.shape[0], columns, dtype=dtype).at[count:].set(0.0)
        along, there, beside = propagated(linear_step, unit, last, holds, len(BESIDE))
        slopes = jax.vmap(Linear.after, (0, None))(beside, there)[:, -1]
        forces = beside.value[:, -1]
        peak, weights = one_sided(forces, noise)
        changes = along[count : count + measures.count]
        if pair.free:
            changes = changes - raw[:, None] * along[-1]
        changes = changes * (factors / duration)[:, None]
        by_peak = force_unit * (weights @ slopes)[None]
        slope = jnp.concatenate([along[:count], changes[:2], by_peak, changes[2:]])
    return Flow(
        end=end[:count],
        mean=averages[0],
        mean_square=averages[1],
        peak=peak * force_unit,
        peak_time=peak_time,
        depth=depth,
        states=states,
        grid=ends,
        corners=steps.after,
        steps=solution.stats["num_steps"],
        solved=solution.result == diffrax.RESULTS.successful,
        strain=jnp.where(repeated & pair.smooth, lax.stop_gradient(strain), 0.0),
        others=averages[2:],
        slope=slope,
    )
