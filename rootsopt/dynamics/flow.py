"""Integration of a rotor pair over whole mesh periods."""

import functools
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import NDArray

from rootsopt.dynamics.flanks import FlankForce
from rootsopt.dynamics.integrator import Integrator, StepGrid
from rootsopt.dynamics.measures import Measures
from rootsopt.dynamics.pair import RotorPair
from rootsopt.dynamics.peak import BESIDE, BESIDE_UNIT, Steps, locate_peak, one_sided
from rootsopt.dynamics.saltation import MARKS, marks, saltation
from rootsopt.dynamics.stepping import Integrated, integrated, interpolated
from rootsopt.dynamics.tangent import Linear, linearized, one_step, propagated

_SHORTEST = 1e-9
"""Minimum time (mesh periods) from the start of a step to a peak inside it. An earlier peak is
moved to this time."""


class Strobe(NamedTuple):
    """Scaled states at the ends of successive mesh periods.

    `states` (periods, n); `steps`: total number of solver steps; `solved`: whether the solver
    succeeded in every mesh period; `pieces`: the motion, if it was requested.
    """

    states: Float[Array, "periods n"]
    steps: Int[Array, ""]
    solved: Bool[Array, ""]
    pieces: "Pieces | None" = None


class Flow(NamedTuple):
    """Result of integrating a motion over whole mesh periods. All states are scaled.

    `end`: final state; `mean` (N), `mean_square` (N²) and `peak` (N) of the contact force;
    `peak_time`: time of the peak (mesh periods); `depth`: greatest penetration found (m; if
    negative, the least gap); `states` (samples, n): states at uniform times, excluding the end;
    `grid` (steps,): ends of the accepted steps (mesh periods), padded with inf; `corners` (steps,
    n): states at the ends of steps; `steps`: number of accepted and rejected solver steps;
    `solved`: whether the solver succeeded; `strain`: greatest error estimate of a repeated step, in
    tolerances (0 if no steps were repeated or the pair is not `smooth`); `others`: the further
    measures (see `Measures.values`).

    `slope`: derivatives of the rows (`end`, `mean`, `mean_square`, `peak`, `others`). Its n + d
    columns are the n entries of the initial state, then d parameter directions. It has no columns
    if no derivatives were requested.
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
        """Return a placeholder for a flow that has not been integrated yet.

        `count`: number n of states; `directions`: number d of parameter directions; `samples`:
        number of uniform samples; `steps`: maximum number of solver steps; `measures`: averages of
        the force; `dtype`: type of the arrays."""
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
        """Mean (N), mean square (N²), peak (N) and the further measures of the contact force."""
        return jnp.append(jnp.stack([self.mean, self.mean_square, self.peak]), self.others)


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
    """Integrate the scaled `state` (n,) over `periods` mesh periods from φ1 = 0.

    `pieces`: number of pieces of each mesh period and instants inside a piece (fractions of its
    length) for `Strobe.pieces`; `None`: no pieces. Unlike `flow`, this function computes no
    statistics of the contact force.

    A step ends exactly at the end of each mesh period. Interpolated states would have an error far
    above the tolerance, which could hide that the motion repeats.
    """
    control = integrator.controller(pair=pair)
    solver = integrator.solver()
    term = diffrax.ODETerm(lambda tau, y, pair: pair.derivative(tau, y)[0])

    def one_period(state, _):
        recorded = pieces is not None
        out = integrated(term, solver, control, state, pair, integrator.max_steps, recorded)
        made = None if pieces is None else _divided(out, solver, *pieces)
        return out.end, (out.end, out.steps, out.solved, made)

    _, (states, steps, solved, made) = lax.scan(one_period, state, length=periods)
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


class Equation(eqx.Module):
    """The equation of motion together with the integrals of the measures, in the solver's units.

    The unknown y holds the state (n,), then the integrals, then the time if rotor 1 is free.
    Methods take the floating-point arrays of the pair as the argument `dynamic`, so that JAX can
    differentiate with respect to them.

    `static`: the rest of the pair; `measures`: averages to integrate; `force_unit` (N); `top`:
    roughly the greatest force, in `force_unit`; `states`: number n of states; `solver`: the method
    of integration.
    """

    static: Any = eqx.field(static=True)
    measures: Measures
    force_unit: Float[Array, ""]
    top: Float[Array, ""]
    states: int = eqx.field(static=True)
    solver: diffrax.AbstractERK

    def pair(self, dynamic) -> RotorPair:
        """Return the pair whose floating-point arrays are `dynamic`."""
        return eqx.combine(dynamic, self.static)

    def rates(self, tau, state, contact: FlankForce, dynamic) -> Float[Array, " q"]:
        """Return the integrands at the time `tau` (mesh periods), per mesh period.

        `state`: scaled; `contact`: the flanks there."""
        del state, dynamic
        return self.measures.rates(tau, contact.total / self.force_unit, self.top)

    def start(self, state: Float[Array, " n"], free: bool) -> Float[Array, " m"]:
        """Return y at the start: the scaled `state`, then zeros for the integrals and, if `free`,
        the time."""
        return jnp.pad(state, (0, self.measures.count + free))

    def derivative(self, tau, y, dynamic, marked: bool = False) -> Float[Array, " m"]:
        """Return dy/dτ at the time `tau` (mesh periods), followed by the `marks` of the contact if
        `marked`."""
        pair = self.pair(dynamic)
        slope, contact = pair.derivative(tau, y[: self.states])
        rates = self.rates(tau, y[: self.states], contact, dynamic)
        if pair.free:
            # Averages are over time, which is not proportional to rotation here.
            rates = pair.lapse(y[: self.states]) * jnp.append(rates, jnp.ones_like(self.force_unit))
        return jnp.concatenate([slope, rates, *([marks(contact)] if marked else [])])

    def advanced(self, begin, end, y, dynamic) -> tuple[Float[Array, " m"], Float[Array, " rows"]]:
        """Return y, and its derivative dy/dτ, after one step from `begin` to `end` (mesh periods).

        The derivative is followed by the `marks` if the contact may jump. The derivatives of y with
        respect to state and parameters account for the moving instants of jumps."""
        pair = self.pair(dynamic)
        term = diffrax.ODETerm(functools.partial(self.derivative, marked=pair.jumps))
        if not pair.jumps:
            after, slopes = one_step(self.solver, term, begin, end, y, dynamic)
            return after, slopes[-1]
        marked = jnp.pad(y, (0, MARKS))
        after, slopes = one_step(self.solver, term, begin, end, marked, dynamic)
        period = pair.mesh_period * (pair.lapse(y[: self.states]) if pair.free else 1.0)
        moved = saltation(end - begin, slopes, period, pair.contact.lever_scale)
        return after[:-MARKS] + moved, slopes[-1]

    def with_force(self, begin, end, y, dynamic) -> Float[Array, " rows"]:
        """Return y after one step from `begin` to `end` (mesh periods), and the contact force.

        The force is in `force_unit`, and is the last entry. If the contact may jump, the first of
        the `marks` precedes it."""
        after, slope = self.advanced(begin, end, y, dynamic)
        pair = self.pair(dynamic)
        force = slope[self.states]
        last = y.shape[0]
        force = force / slope[last - 1] if pair.free else force
        return jnp.concatenate([after, slope[last : last + pair.jumps], force[None]])

    def with_rate(
        self, tau: Float[Array, ""], found: Float[Array, " values"], dynamic: Any
    ) -> Float[Array, " sided"]:
        """Return the entries of `found` after the state, followed by the rate of the force.

        `found`: the state at the time `tau` (mesh periods), the first of the `marks` if the contact
        may jump, and the contact force in `force_unit`. The rate is per mesh period, along the
        motion, exact to rounding."""
        pair, state = self.pair(dynamic), found[: self.states]
        slope = pair.derivative(tau, state)[0]
        along = jnp.ones_like(tau), slope
        _, rate = jax.jvp(lambda *at: pair.contact_at(*at).total, (tau, state), along)
        return jnp.append(found[self.states :], rate / self.force_unit)

    def peak(
        self, times: Float[Array, " 7"], found: Float[Array, "7 values"], noise, dynamic: Any
    ) -> tuple[Float[Array, ""], Float[Array, "7 weighted"]]:
        """Return the peak force (in `force_unit`), and weights of its derivative (`one_sided`).

        `times` around the peak (mesh periods); `found`: as in `with_rate`, at these times; `noise`:
        relative rounding error of the force."""
        values = jax.vmap(self.with_rate, (0, 0, None))(times, found, dynamic)
        return one_sided(values, noise)


class _Recorded(NamedTuple):
    """The steps that a solver has taken.

    `before`, `after`: y at the start and end of each step; `end`: y at the end of the motion;
    `last`: index of the last step; `grid`, `states`, `strain`, `steps`, `solved`: as in `Flow`.
    """

    grid: Float[Array, " steps"]
    before: Float[Array, "steps m"]
    after: Float[Array, "steps m"]
    end: Float[Array, " m"]
    last: Int[Array, ""]
    states: Float[Array, "samples n"]
    strain: Float[Array, ""]
    steps: Int[Array, ""]
    solved: Bool[Array, ""]

    @property
    def begins(self) -> Float[Array, " steps"]:
        """Start of each step (mesh periods)."""
        return jnp.concatenate([jnp.zeros_like(self.grid[:1]), self.grid[:-1]])


class _Peak(NamedTuple):
    """The instant of the peak force, and the times around it at which the force is evaluated.

    `holds`: index of the step that contains the peak; `time` of the peak (mesh periods); `beside`:
    evaluation times relative to `time` (mesh periods); `noise`: relative rounding error of the
    force.
    """

    holds: Int[Array, ""]
    time: Float[Array, ""]
    beside: Float[Array, " sides"]
    noise: Float[Array, ""]


def flow(  # Ten parameters: adaptive steps and repeated steps need different ones.
    pair: RotorPair,
    state: Float[Array, " n"],
    periods: Float[Array, ""],
    integrator: Integrator,
    samples: int,
    tangents: RotorPair | None = None,
    grid: Float[Array, " steps"] | None = None,
    repeat: Bool[Array, ""] | bool = True,
    measures: Measures | None = None,
    top: Float[Array, ""] | None = None,
) -> Flow:
    """Integrate over `periods` mesh periods, and compute statistics of the contact force.

    `state` (n,): scaled state at φ1 = 0; `periods`: a whole number, which JAX may trace;
    `measures`: averages of the force to compute, integrated under the same error control as the
    motion; `top` (N): roughly the greatest force, for the p-norm; `samples`: number of uniform
    samples of the state. The peak is also located between the samples.

    `tangents`: d directions of the pair's parameters, stacked along a leading axis; d may be 0. If
    given, every step is linearised, and the result has `slope`. The derivatives account for the
    moving instants of contact jumps.

    `grid`: ends of steps (mesh periods) to repeat if `repeat` is true. Otherwise, or without a
    `grid`, the steps are chosen adaptively.
    """
    count, dtype = state.shape[0], state.dtype
    measures = Measures() if measures is None else measures
    force_unit = lax.stop_gradient(pair.force_scale)
    top = jnp.ones_like(force_unit) if top is None else lax.stop_gradient(top) / force_unit
    dynamic, static = eqx.partition(pair, eqx.is_inexact_array)
    solver = integrator.solver()
    equation = Equation(static, measures, force_unit, top, count, solver)
    start = equation.start(state, pair.free)
    ends = jnp.full(integrator.max_steps, jnp.inf, dtype) if grid is None else grid / periods
    control = StepGrid(  # pyright: ignore[reportCallIssue]
        pid=integrator.controller(periods, lax.stop_gradient(pair)),
        ends=ends,
        repeat=jnp.asarray(False if grid is None else repeat),
    )
    taken = _solved(equation, dynamic, start, periods, control, integrator.max_steps, samples)
    steps, peak, depth = _located(pair, taken, periods, count)
    duration = taken.end[-1] if pair.free else periods
    raw = taken.end[count : count + measures.count] / duration
    averages, factors = measures.values(raw, force_unit, top)
    if tangents is None:
        force = _peak_force(equation, taken, peak, dynamic)
        slope = jnp.zeros((count + 1 + measures.count, 0), dtype)
    else:
        moved = eqx.filter(tangents, eqx.is_inexact_array)
        along, force, by_peak = _linearized(equation, taken, peak, dynamic, moved)
        changes = along[count : count + measures.count]
        if pair.free:
            changes = changes - raw[:, None] * along[-1]
        changes = changes * (factors / duration)[:, None]
        by_peak = force_unit * by_peak[None]
        slope = jnp.concatenate([along[:count], changes[:2], by_peak, changes[2:]])
    return Flow(
        end=taken.end[:count],
        mean=averages[0],
        mean_square=averages[1],
        peak=force * force_unit,
        peak_time=peak.time,
        depth=depth,
        states=taken.states,
        grid=taken.grid,
        corners=steps.after,
        steps=taken.steps,
        solved=taken.solved,
        strain=jnp.where(control.repeat & pair.smooth, taken.strain, 0.0),
        others=averages[2:],
        slope=slope,
    )


def _located(
    pair: RotorPair, taken: _Recorded, periods: Float[Array, ""], count: int
) -> tuple[Steps, _Peak, Float[Array, ""]]:
    """Return the steps `taken`, the instant of the peak force, and the greatest penetration (m).

    The step that contains the peak is repeated up to the peak. Short steps from there give the
    force on both sides. `count`: number of states."""
    steps = lax.stop_gradient(
        Steps(
            taken.begins,
            taken.grid,
            taken.before[:, :count],
            taken.after[:, :count],
            taken.last + 1,
        )
    )
    peak_time, depth = locate_peak(lax.stop_gradient(pair), taken.states, periods, steps)
    holds = jnp.clip(jnp.sum(taken.grid < peak_time), 0, taken.last)
    dtype = taken.before.dtype
    peak = _Peak(
        holds=holds,
        time=jnp.maximum(peak_time, taken.begins[holds] + _SHORTEST),
        beside=BESIDE_UNIT * jnp.asarray(BESIDE, dtype),
        noise=lax.stop_gradient(pair.rounding(depth)),
    )
    return steps, peak, depth


def _solved(
    equation: Equation,
    dynamic: Any,
    start: Float[Array, " m"],
    periods: Float[Array, ""],
    control: StepGrid,
    max_steps: int,
    samples: int,
) -> _Recorded:
    """Integrate from y = `start` over `periods` mesh periods, and return all accepted steps."""
    dtype, solver = start.dtype, equation.solver
    out = integrated(
        _over_unit(equation, periods), solver, control, start, dynamic, max_steps, recorded=True
    )
    assert out.records is not None
    ends, after, _ = out.records
    last = jnp.maximum(out.accepted - 1, 0)
    shares = (jnp.arange(samples) / samples).astype(dtype)
    states = jax.vmap(lambda share: interpolated(out, solver, share)[0])(shares)
    states, grid, strain = lax.stop_gradient((states, ends * periods, out.control[-1]))
    return _Recorded(
        grid=grid,
        before=jnp.concatenate([start[None], after[:-1]]),
        after=after,
        end=out.end,
        last=last,
        states=states[:, : equation.states],
        strain=strain,
        steps=out.steps,
        solved=out.solved,
    )


def _over_unit(equation: Equation, periods: Float[Array, ""]) -> diffrax.ODETerm:
    """Return the equation with time in units of `periods` mesh periods, so that it ends at 1."""

    def whole(share, y, dynamic):
        return periods * equation.derivative(share * periods, y, dynamic)

    return diffrax.ODETerm(whole)


def _peak_force(
    equation: Equation, taken: _Recorded, peak: _Peak, dynamic: Any
) -> Float[Array, ""]:
    """Return the peak force (in `force_unit`)."""
    begin, y = taken.begins[peak.holds], taken.before[peak.holds]
    size = y.shape[0]
    there = equation.with_force(begin, peak.time, y, dynamic)[:size]

    def beside(side):
        return equation.with_force(peak.time, peak.time + side, there, dynamic)

    return _weighted(equation, jax.vmap(beside)(peak.beside), size, peak, dynamic)[0]


def _weighted(
    equation: Equation, beside: Float[Array, "sides rows"], size: int, peak: _Peak, dynamic: Any
) -> tuple[Float[Array, ""], Float[Array, "sides weighted"]]:
    """Return the peak force (in `force_unit`), and the weights of its derivative.

    `beside`: results of `Equation.with_force` beside the peak; `size`: number of entries of y."""
    rows = np.append(np.arange(equation.states), np.arange(size, beside.shape[1]))
    return equation.peak(peak.time + peak.beside, beside[:, rows], peak.noise, dynamic)


def _linearized(
    equation: Equation, taken: _Recorded, peak: _Peak, dynamic: Any, moved: Any
) -> tuple[Float[Array, "m columns"], Float[Array, ""], Float[Array, " columns"]]:
    """Return the derivatives of y at the end, the peak force, and its derivatives.

    Forces are in `force_unit`. The columns of derivatives are the n entries of the initial state,
    then the directions `moved` of the parameters.
    """
    count, size, sides = equation.states, taken.end.shape[0], peak.beside.shape[0]

    def linear_step(k, there):
        step, beside = jnp.where(k < 0, peak.holds, k), k < -1
        side = peak.beside[jnp.clip(-2 - k, 0, sides - 1)]
        begin = jnp.where(beside, peak.time, taken.begins[step])
        end = jnp.where(k < 0, peak.time, taken.grid[step])
        end = jnp.where(beside, peak.time + side, end)
        y = jnp.where(beside, there[:size], taken.before[step])
        return linearized(
            lambda y, dynamic: equation.with_force(begin, end, y, dynamic),
            y, dynamic, moved, count,
        )  # fmt: skip

    columns = count + jax.tree.leaves(moved)[0].shape[0]
    unit = jnp.eye(size, columns, dtype=taken.end.dtype).at[count:].set(0.0)
    along, there, beside = propagated(linear_step, unit, taken.last, peak.holds, sides)
    slopes = jax.vmap(Linear.after, (0, None))(beside, there)[:, size:]
    value, weights = _weighted(equation, beside.value, size, peak, dynamic)
    return along, value, jnp.tensordot(weights, slopes)
