"""One design in one scene by an ensemble of motions: what a chaotic scene leaves to optimise.

In a chaotic scene a single motion tells nothing of its neighbours: its average over any
finite window jumps between designs that hardly differ, and its derivative grows with the
window. What still means something is the average over many motions, known to a standard
error. An `EnsembleEvaluator` starts `ensemble.members` motions at different initial
states, lets each settle and averages the contact force over all. The gradient is that of
the average over a Gaussian neighbourhood of the design: the least-squares slope through
pairs of opposite neighbours, with a standard error of its own.
"""

import dataclasses
import functools
import os
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float
from numpy.typing import NDArray

from rootsopt.config import Config, EnsembleConfig
from rootsopt.dynamics.flow import Integrator, flow, strobe
from rootsopt.dynamics.pair import RotorPair
from rootsopt.evaluate import (
    CHAOS_WINDOW,
    RESPONSES,
    TOO_DEEP,
    Evaluation,
    Evaluator,
    geometry_record,
    lyapunov_program,
    unsettled,
)
from rootsopt.model import Model, design_vector
from rootsopt.optimize.problem import Space
from rootsopt.profiles import Geometry
from rootsopt.programs import Program
from rootsopt.status import Status

_RTOL = 1e-6
"""Finest tolerance worth its time: the standard errors of an ensemble are far coarser than
what the steps leave (docs/chaos.md)."""
_SAMPLES = 63
"""Samples of a mesh period among which its peak is looked for."""
_MEMBERS = 4
"""Members in one call of the compiled program."""
_MEMORY = 17
"""Stroboscopic states remembered, to tell a motion that repeats."""
_REPEATS = 1e-2
"""Scaled difference below which a motion repeats."""
_AGAIN = 4
"""Motions that begin where those of a neighbouring design ended settle in this part of
`ensemble.settle_periods`."""
VERIFYING = 4
"""Times as many members verify a search's winner."""
SIGNIFICANT = 3.0
"""Combined standard errors that a difference must exceed to count."""
ERRORS = {name: name.replace("_N", "_standard_error_N") for name in RESPONSES}
"""Keys of the standard errors in `steady_state`, by response."""


class Members(NamedTuple):
    """What m motions of one design came to.

    `means` (m, 3): mean, mean square (N²) and mean over the mesh periods of the greatest
    force in each; `drift`: mean force in the second half of the window less that in the
    first (N); `greatest` force (N), `reach` |ε| (rad) and penetration `depth` (m; least
    gap if negative) of all; `states`: last scaled state; `repeats` (m, 8): whether the last
    states repeat after 1 … 8 mesh periods; `lost`, `solved`.
    """

    means: Float[Array, "m 3"]
    drift: Float[Array, " m"]
    greatest: Float[Array, " m"]
    reach: Float[Array, " m"]
    depth: Float[Array, " m"]
    states: Float[Array, "m 2"]
    repeats: Bool[Array, "m 8"]
    lost: Bool[Array, " m"]
    solved: Bool[Array, " m"]

    @property
    def status(self) -> Status:
        """The first failure among the members, or AVERAGED."""
        if not np.all(self.solved):
            return Status.SOLVER_FAILED
        if not np.all(np.isfinite(self.means)):
            return Status.NON_FINITE
        return Status.PASSED_THROUGH if np.any(self.lost) else Status.AVERAGED

    @property
    def responses(self) -> NDArray[np.float64]:
        """(3, 2): mean, peak, RMS force (N) and their standard errors, by `RESPONSES`.

        The members being independent, the standard error is that of the mean of their
        means; of the RMS, to first order.
        """
        values, errors = _mean_and_error(np.asarray(self.means, np.float64))
        mean, square, peak = values
        rms = np.sqrt(square)
        by_rms = errors[1] / (2 * rms) if rms > 0 else 0.0
        return np.array([[mean, errors[0]], [peak, errors[2]], [rms, by_rms]])


class EnsembleEvaluator(Evaluator):
    """Evaluates designs of one config by an ensemble; called like an `Evaluator`.

    An evaluation that is AVERAGED has as `response` averages over members and mesh
    periods: `mean_force_N`, `rms_force_N`, and as `peak_force_N` the **mean of the peak of
    every mesh period**. (The greatest force of all grows with the window and has no limit
    to average to; it is `steady_state["greatest_force_N"]`.) `steady_state` holds their
    standard errors (`ERRORS`), `kind` (chaotic if a member has a positive Lyapunov exponent,
    periodic if all repeat, else transient), `gradient_standard_error` (as `gradient`, per
    config unit), the size of the ensemble, and `mean_force_drift_N` within the window with its
    standard error: far from zero, `ensemble.settle_periods` is too short, or motions of
    several kinds coexist and members still pass from one to another. `state` (members, 2):
    their last scaled states, the `start` of a neighbouring design. `series` is that of one
    member.

    `rtol` is not used: averages need no closed orbit. With `survey` the Lyapunov exponent is
    not looked for. Without `differentiate` there is no gradient, which takes most of the time.
    """

    def __init__(self, config: Config, rtol: float | None = None, survey: bool = False):
        super().__init__(config, rtol, survey)
        self.differentiate = True
        self.how = dataclasses.replace(self.transient, rtol=jnp.maximum(self.transient.rtol, _RTOL))

    @property
    def settings(self) -> EnsembleConfig:
        """Size and seed of the ensemble."""
        return self.config.ensemble

    def independent(self, number: int) -> "EnsembleEvaluator":
        """The `number`-th of those with another seed and `VERIFYING` times as many members, to
        judge what was chosen by this one; it shares the model, and the compiled programs."""
        settings = self.settings
        larger = {"members": VERIFYING * settings.members, "seed": settings.seed + number}
        ensemble = settings.model_copy(update=larger)
        other = EnsembleEvaluator(self.config.model_copy(update={"ensemble": ensemble}))
        other.model, other.fitted, other.prepared = self.model, self.fitted, self.prepared
        other.sized, other.map_error = self.sized, self.map_error
        return other

    def __call__(
        self,
        design: Float[Array, " d"] | None = None,
        start: NDArray[np.float64] | None = None,
        series: bool = True,
    ) -> Evaluation:
        """Evaluate `design` (config units; default: the config's own).

        `start` (members, 2): scaled states to begin from, such as the `state` of a
        neighbouring design's evaluation; by default they are spread over the play.
        """
        design = design_vector(self.config) if design is None else jnp.asarray(design)
        began = time.perf_counter()
        if self.prepared:
            self._size(design)
        else:
            self.prepare(design, series)
        for _ in range(5):
            outcome = self._simulate(design, start)
            covered = float(self.model.deepest)
            if not self._refit(outcome):  # pyright: ignore[reportArgumentType]
                break
            if float(self.model.deepest) < covered:
                self._size(design)
        return self._describe(design, outcome, began, series)

    def prepare(self, design: Float[Array, " d"], series: bool = True) -> None:
        """Compile, in the background, what evaluating `design` (config units) takes."""
        self.prepared = True
        self._size(design)
        pair, _ = _pair.outline(self.model, design)
        dtype = pair.angle_scale.dtype
        state, count = jax.ShapeDtypeStruct((2,), dtype), jax.ShapeDtypeStruct((), int)
        states = jax.ShapeDtypeStruct((_MEMBERS, 2), dtype)
        _in_turn.prepare(pair, states, count, count, self.how)
        if not self.survey:
            lyapunov_program.prepare(pair, state, CHAOS_WINDOW, self.transient)
        _pair.prepare(self.model, design)

    def _simulate(self, design, start) -> "_Outcome":
        """The ensemble of one design."""
        pair, shape = _pair(self.model, design)
        settle = self.settings.settle_periods
        if start is None:
            states = initial_states(pair, self.settings.members, self.settings.seed)
        else:
            states, settle = np.asarray(start), -(-settle // _AGAIN)
            if states.shape != (self.settings.members, 2):
                raise ValueError(
                    f"Argument `start` must be the states (members, 2) of an ensemble, but has "
                    f"shape {states.shape}; pass None to begin anew"
                )
        (members,) = run_members([pair], states, settle, self.settings.periods, self.how)
        return _Outcome(pair, shape, members)

    def _describe(self, design, outcome: "_Outcome", began, with_series) -> Evaluation:
        pair, members, status = outcome.pair, outcome.members, outcome.status
        settings = self.settings
        size = {"members": settings.members, "window_mesh_periods": settings.periods}
        steady: dict[str, Any] = {"kind": "transient"}
        response: dict[str, float] = {}
        gradient: dict[str, dict[str, float]] = {}
        series, state = None, None
        if status is Status.AVERAGED:
            values = members.responses
            response = dict(zip(RESPONSES, map(float, values[:, 0]), strict=True))
            errors = dict(zip(ERRORS.values(), map(float, values[:, 1]), strict=True))
            greatest = float(np.max(members.greatest))
            found, series = self._kind(pair, members, with_series)
            drift, by_drift = _mean_and_error(np.asarray(members.drift, np.float64))
            steady = found | size | errors
            steady |= {
                "mean_force_drift_N": float(drift),
                "mean_force_drift_standard_error_N": float(by_drift),
                "greatest_force_N": greatest,
            }
            state = np.asarray(members.states, np.float64)
            if float(np.max(members.depth)) > TOO_DEEP * float(self.model.pitch_radius):
                status = Status.TOO_DEEP
        if status is Status.AVERAGED and self.keys and self.differentiate:
            status, slopes = self._slopes(design, members)
            if slopes is not None:
                gradient, steady["gradient_standard_error"] = (
                    {
                        name: dict(zip(self.keys, map(float, row), strict=True))
                        for name, row in zip(RESPONSES, rows, strict=True)
                    }
                    for rows in slopes
                )
            else:
                # A neighbour fails: what is left stands for no neighbourhood.
                response, steady, series, state = {}, {"kind": "transient"}, None, None
        return Evaluation(
            design=dict(zip(self.keys, map(float, design), strict=True)),
            geometry=geometry_record(self.model, outcome.shape),
            response=response,
            gradient=gradient,
            steady_state=steady,
            status=status,
            message=status.value,
            statistics={
                "settle_mesh_periods": settings.settle_periods,
                "neighbours": settings.designs // 2 * 2 if gradient else 0,
                "seconds": time.perf_counter() - began,
            },
            series=series,
            state=state,
        )

    def _kind(self, pair, members: Members, with_series):
        """What kind of motion it is, and the series of one member.

        A member that does not repeat is asked for its Lyapunov exponent, if there is one.
        """
        every = np.all(members.repeats, axis=0)
        kind: dict[str, Any] = {"kind": "transient"}
        if every.any():
            kind = {"kind": "periodic", "period": int(np.argmax(every)) + 1}
        if self.survey or (every.any() and not with_series):
            return kind, None
        typical = int(np.argmin(np.any(members.repeats, axis=1)))
        state = jnp.asarray(members.states[typical])
        window = lyapunov_program(pair, state, CHAOS_WINDOW, self.transient)
        _, steady, _, series = unsettled(pair, window, with_series)
        del steady["window_mesh_periods"]
        return steady | (kind if every.any() else {}), series

    def _slopes(self, design, members: Members) -> tuple[Status, NDArray[np.float64] | None]:
        """A status, and (2, 3, d): gradient of each response per config unit and its standard
        error.

        The neighbours begin where the members of the design ended, all at the same states.
        """
        space = self._space(design)
        points, steps = neighbours(np.asarray(_point(space, design)), self.settings)
        designs, jacobian = _around(space, design, points)
        settle = -(-self.settings.settle_periods // _AGAIN)
        for _ in range(5):
            with ThreadPoolExecutor(os.cpu_count()) as pool:
                built = list(pool.map(functools.partial(_pair, self.model), designs))
            pairs, shapes = zip(*built, strict=True)
            runs = run_members(pairs, members.states, settle, self.settings.periods, self.how)
            farthest = max(runs, key=lambda run: np.max(run.reach))
            if not self._refit(_Outcome(pairs[0], shapes[0], farthest)):  # pyright: ignore[reportArgumentType]
                break
        for run in runs:
            if run.status is not Status.AVERAGED:
                return run.status, None
        values = np.stack([run.responses[:, 0] for run in runs])
        slope, covariance = fitted_slope(values, steps)
        # From the unit box to config units.
        inverse = np.linalg.inv(np.asarray(jacobian))
        spread = np.einsum("ik,rij,jl->rkl", inverse, covariance, inverse)
        errors = np.sqrt(np.diagonal(spread, axis1=1, axis2=2))
        return Status.AVERAGED, np.stack([slope @ inverse, errors])

    def _space(self, design) -> Space:
        """The unit box of the search, made larger where the design lies outside."""
        space = Space.of(self.config, self.model, 0.0)
        lower, upper = np.minimum(space.lower, design), np.maximum(space.upper, design)
        bounds = jnp.asarray(lower), jnp.asarray(upper)
        return eqx.tree_at(lambda s: (s.lower, s.upper), space, bounds)


@dataclasses.dataclass(frozen=True)
class _Outcome:
    pair: RotorPair
    shape: Geometry
    members: Members

    @property
    def status(self) -> Status:
        return self.members.status

    @property
    def reached(self) -> float:
        """Largest |ε| (rad)."""
        return float(np.max(self.members.reach))


def _mean_and_error(values: NDArray[np.float64]):
    """Mean over the first axis of independent values, and its standard error."""
    spread = np.std(values, axis=0, ddof=1)
    return np.mean(values, axis=0), spread / np.sqrt(len(values))


def initial_states(pair: RotorPair, members: int, seed: int) -> NDArray[np.float64]:
    """Scaled states (members, 2), a scrambled Sobol sequence over the play of the pair and
    the speeds at which the load crosses it.

    |ε| ≤ `angle_scale`, play and static penetration; |dε/dt| up to that of a fall under the
    load through the whole of it.
    """
    from scipy.stats import qmc

    acceleration = float(pair.load.torque / pair.inertia * pair.mesh_period**2 / pair.angle_scale)
    fastest = max(2 * np.sqrt(acceleration), 1.0)
    sampler = qmc.Sobol(2, rng=np.random.default_rng(seed))
    power = int(np.ceil(np.log2(members)))
    return (2 * sampler.random_base2(power)[:members] - 1) * np.array([1.0, fastest])


def neighbours(
    point: NDArray[np.float64], settings: EnsembleConfig
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Points (2n, d) of the unit box in opposite pairs, n first and their n opposites, and the
    n steps (n, d) from the middle.

    Steps are normal with standard deviation `spread`, and shortened where a pair would leave
    the box. The middle is `point`, but at least one standard deviation inside the box: right
    at a bound there are no opposite neighbours.
    """
    from scipy.stats import norm, qmc

    pairs, spread = settings.designs // 2, settings.spread
    sampler = qmc.Sobol(len(point), rng=np.random.default_rng(settings.seed))
    share = sampler.random_base2(int(np.ceil(np.log2(pairs))))[:pairs]
    steps = spread * norm.ppf(np.clip(share, 1e-6, 1 - 1e-6))
    middle = np.clip(point, spread, 1 - spread)
    room = np.minimum(middle, 1 - middle)
    steps *= np.minimum(1.0, np.min(room / np.maximum(np.abs(steps), 1e-12), axis=1))[:, None]
    points = np.concatenate([middle + steps, middle - steps])
    return np.clip(points, 0.0, 1.0), steps  # Nothing but rounding is clipped.


def fitted_slope(
    values: NDArray[np.float64], steps: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Slopes (r, d) of r responses and their covariances (r, d, d) from the `values` (2n, r)
    at n opposite pairs at ± `steps` (n, d).

    Least squares through the differences of the pairs: exact for responses up to quadratic,
    and for any response it tends to the gradient of its average over the neighbourhood as
    pairs are added (Stein's identity: E[δδᵀ]⁻¹ E[δ f] = ∇E[f] for normal δ). The covariance
    is that of the residuals between pairs, so that it contains the noise of the values and
    what is not linear.
    """
    count = len(steps)
    differences = (values[:count] - values[count:]) / 2
    slope, *_ = np.linalg.lstsq(steps, differences, rcond=None)
    residuals = differences - steps @ slope
    variance = np.sum(residuals**2, axis=0) / (count - steps.shape[1])
    covariance = variance[:, None, None] * np.linalg.inv(steps.T @ steps)
    return np.asarray(slope.T, np.float64), np.asarray(covariance, np.float64)


def run_members(
    pairs: Sequence[RotorPair],
    states: NDArray[np.float64] | Float[Array, "m 2"],
    settle: int,
    periods: int,
    how: Integrator,
) -> list[Members]:
    """The `Members` of each of `pairs`, all from the same scaled `states` (m, 2), over
    `periods` mesh periods after `settle` others.

    On CPUs a thread for each core takes a few members at a time: stepping many together, each
    would wait for the slowest at every turn. On other devices all are stepped together.
    """
    states = np.asarray(states, pairs[0].angle_scale.dtype)
    counts = np.asarray(settle), np.asarray(periods)
    if jax.default_backend() != "cpu":
        stacked = jax.tree.map(lambda *x: jnp.stack(x), *pairs)
        together = jax.device_get(_together(stacked, states, *counts, how))
        return [jax.tree.map(lambda x, i=i: x[i], together) for i in range(len(pairs))]
    # Parts of one size share a compiled program; the last member fills the last part up.
    count = len(states)
    parts = -(-count // _MEMBERS)
    rows = np.minimum(np.arange(parts * _MEMBERS), count - 1).reshape(parts, _MEMBERS)

    def part(task):
        pair, rows = task
        return jax.device_get(_in_turn(pair, states[rows], *counts, how))

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        done = list(pool.map(part, [(pair, row) for pair in pairs for row in rows]))
    return [
        jax.tree.map(lambda *x: np.concatenate(x)[:count], *done[k : k + parts])
        for k in range(0, len(done), parts)
    ]


def member(
    pair: RotorPair, state: Float[Array, "2"], settle: Any, periods: Any, how: Integrator
) -> Members:
    """One motion from the scaled `state`, as a pure function; leaves without the axis m."""
    dtype = state.dtype
    one, none, low = jnp.ones((), dtype), jnp.zeros((), dtype), jnp.full((), -jnp.inf, dtype)

    def pass_by(_, carry):
        state, solved = carry
        out = strobe(pair, state, 1, how)
        return out.states[-1], solved & out.solved

    half = periods // 2

    def count(index, carry):
        state, solved, means, drift, greatest, reach, depth, memory = carry
        out = flow(pair, state, one, how, _SAMPLES)
        reach = jnp.maximum(reach, jnp.max(jnp.abs(out.states[:, 0])))
        return (
            out.end,
            solved & out.solved,
            means + jnp.stack([out.mean, out.mean_square, out.peak]),
            drift + jnp.sign(2 * index - (periods - 1)) * out.mean,
            jnp.maximum(greatest, out.peak),
            reach,
            jnp.maximum(depth, out.depth),
            jnp.concatenate([memory[1:], out.end[None]]),
        )

    settled = lax.fori_loop(0, settle, pass_by, (state, jnp.ones((), bool)))
    memory = jnp.full((_MEMORY, 2), jnp.inf, dtype)
    start = *settled, jnp.zeros(3, dtype), none, none, none, low, memory
    end, solved, means, drift, greatest, reach, depth, memory = lax.fori_loop(
        0, periods, count, start
    )
    apart = jnp.stack(
        [jnp.max(jnp.abs(memory[k:] - memory[:-k])[-k - 1 :]) for k in range(1, _MEMORY // 2 + 1)]
    )
    return Members(
        means=means / periods,
        drift=drift / jnp.maximum(half, 1),
        greatest=greatest,
        reach=pair.angle_scale * reach,
        depth=depth,
        states=end,
        repeats=apart < _REPEATS,
        lost=pair.angle_scale * jnp.abs(end[0]) >= pair.angle_limit,
        solved=solved,
    )


_pair = Program(Model.pair_and_shape)


@Program
def _in_turn(pair, states, settle, periods, how) -> Members:
    return lax.map(lambda state: member(pair, state, settle, periods, how), states)


@Program
def _together(pairs, states, settle, periods, how) -> Members:
    run = functools.partial(member, settle=settle, periods=periods, how=how)
    return jax.vmap(lambda pair: jax.vmap(lambda state: run(pair, state))(states))(pairs)


@Program
def _point(space: Space, design):
    """Point of the unit box nearest to a design."""
    return space.point(design)


@Program
def _around(space: Space, design, points):
    """Designs at `points` of the unit box, and the Jacobian of the design in the box."""
    return jax.vmap(space.design)(points), jax.jacfwd(space.design)(space.point(design))


__all__ = [
    "ERRORS",
    "SIGNIFICANT",
    "VERIFYING",
    "EnsembleEvaluator",
    "Members",
    "fitted_slope",
    "initial_states",
    "neighbours",
    "run_members",
]
