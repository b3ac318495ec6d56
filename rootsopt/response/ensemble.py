"""Evaluates one design in a chaotic scene, averaged over an ensemble of motions.

In a chaotic scene, a single motion cannot guide an optimisation. Its average over a finite window
jumps between designs that hardly differ, and its derivative grows with the window. The average over
many motions is meaningful, and its standard error is known.

An `Ensemble` starts `ensemble.members` motions from different initial states, lets each
settle, and averages the contact force over all of them. The gradient is that of the average over a
Gaussian neighbourhood of the design. It is the least-squares slope through pairs of opposite
neighbours, and has its own standard error.
"""

import dataclasses
import functools
import os
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from rootsopt.config.study import EnsembleConfig
from rootsopt.dynamics.integrator import Integrator
from rootsopt.dynamics.pair import RotorPair
from rootsopt.dynamics.steady import TOO_DEEP
from rootsopt.dynamics.window import PERIODS
from rootsopt.response.evaluation import Evaluator, Motions, lyapunov_program, unsettled_status
from rootsopt.response.records import apart_message, geometry_record, message_of, unsettled
from rootsopt.response.result import ERRORS, RESPONSES, Evaluation
from rootsopt.response.together import (
    Members,
    initial_states,
    mean_and_error,
    prepare_members,
    run_members,
)
from rootsopt.runtime.programs import CachedFunction
from rootsopt.scene.build import Scene
from rootsopt.scene.space import Space, sobol
from rootsopt.status import Status

# Finest tolerance at which the motions of an ensemble are integrated. The standard errors of an
# ensemble are far larger than the error of such steps (docs/chaos.md).
_RTOL = 1e-6
# Divisor of `ensemble.settle_periods` for motions that start from the last states of a neighbouring
# design's motions.
_AGAIN = 4
VERIFYING = 4
"""Factor by which the number of members is increased to verify the best design of a search."""
SIGNIFICANT = 3.0
"""Difference between two averages (combined standard errors) above which it counts as significant.
"""


@dataclasses.dataclass(frozen=True)
class Ensemble(Motions):
    """An ensemble of motions, over which the force is averaged.

    The argument `start` (members, n) of an evaluation are scaled initial states, such as the
    `start` of a neighbouring design's evaluation. By default, the initial states are those of
    `members.initial_states`.

    An evaluation with the status AVERAGED holds:

    - `response`: averages over members and mesh periods. `peak_force_N` is the **mean of the peaks
      of all mesh periods**. The greatest force grows without limit as the window gets longer; it is
      `steady_state["greatest_force_N"]`.
    - `steady_state`: standard errors of the response (keys in `ERRORS`); `kind`: periodic if all
      members repeat, chaotic if a member has a positive Lyapunov exponent, else transient;
      `gradient_standard_error` (as `gradient`, per config unit); the size of the ensemble;
      `mean_force_drift_N` within the window, with its standard error. If this drift is far from
      zero, `ensemble.settle_periods` is too short, or members still move from one kind of
      coexisting motion to another.
    - `start` (members, n): last scaled states, for a neighbouring design.
    - `series` of one member.

    The orbit tolerance is not used, since averages need no closed orbit. The Lyapunov exponent is
    not computed in surveys.
    """

    def evaluated(self, evaluator: Evaluator, design: Any, start: Any, series: bool) -> Evaluation:
        """Evaluate a design. `start` (members, n): scaled initial states; `series`: of a member.

        Raises ValueError if `start` has the wrong shape."""
        began, built = time.perf_counter(), _pair(evaluator.scene, design)
        outcome = _run(evaluator, [built], *_beginning(evaluator, built[0], start))
        return _report(evaluator, design, built, outcome, began, series)

    def prepare(self, evaluator: Evaluator, design: Any, series: bool, maxima: bool) -> None:
        """Compile the programs in the background. `series` and `maxima` have no effect."""
        pair, _ = _pair.result_shape(evaluator.scene, design)
        prepare_members(pair, integrator(evaluator.scene))
        if not evaluator.survey:
            state = jax.ShapeDtypeStruct((pair.states,), pair.angle_scale.dtype)
            lyapunov_program.prepare(pair, state, PERIODS, evaluator.scene.solver.transient)
        _pair.prepare(evaluator.scene, design)


def integrator(scene: Scene) -> Integrator:
    """Return the integrator of the motions: that of the transient, at least at `_RTOL`."""
    transient = scene.solver.transient
    return dataclasses.replace(transient, rtol=jnp.maximum(transient.rtol, _RTOL))


def independent(evaluator: Evaluator, number: int) -> Evaluator:
    """Return another evaluator, for judging designs that were chosen with `evaluator`.

    Its seed is larger by `number`, and it has `VERIFYING` times as many members. Scene and
    compiled programs are shared."""
    settings = evaluator.config.ensemble
    larger = {"members": VERIFYING * settings.members, "seed": settings.seed + number}
    ensemble = settings.model_copy(update=larger)
    config = evaluator.config.model_copy(update={"ensemble": ensemble})
    return dataclasses.replace(evaluator, config=config, survey=False)


def _beginning(evaluator: Evaluator, pair: RotorPair, start) -> tuple[NDArray[np.float64], int]:
    """Return the initial states (members, n), and the number of mesh periods to settle."""
    settings = evaluator.config.ensemble
    if start is None:
        states = initial_states(pair, settings.members, settings.seed)
        return states, settings.settle_periods
    states = np.asarray(start)
    if states.shape != (settings.members, pair.states):
        raise ValueError(
            f"Argument `start` must be the states (members, n) of an ensemble, but has shape "
            f"{states.shape}; pass None to start from new states"
        )
    return states, -(-settings.settle_periods // _AGAIN)


def _run(
    evaluator: Evaluator, built: Sequence, states, settle: int
) -> tuple[Status, list[Members]]:
    """Simulate the ensembles of several designs; `built`: pair and geometry of each.

    Return the status of the first design that has failed, or AVERAGED, and the `Members` of every
    design."""
    pairs, _ = zip(*built, strict=True)
    periods, how = evaluator.config.ensemble.periods, integrator(evaluator.scene)
    runs = run_members(pairs, states, settle, periods, how)
    if not bool(pairs[0].sound):
        return Status.UNSOUND, runs
    failed = (run.status for run in runs if run.status is not Status.AVERAGED)
    return next(failed, Status.AVERAGED), runs


def _report(
    evaluator: Evaluator, design, built, outcome, began: float, with_series: bool
) -> Evaluation:
    """Return the evaluation; `built`: pair and geometry; `outcome`: result of `_run`."""
    (pair, shape), (status, (members,)) = built, outcome
    settings = evaluator.config.ensemble
    size = {"members": settings.members, "window_mesh_periods": settings.periods}
    steady: dict[str, Any] = {"kind": "transient"}
    response: dict[str, float] = {}
    gradient: dict[str, dict[str, float]] = {}
    series, last, said = None, None, ""
    if status is Status.AVERAGED:
        values = members.responses
        least = float(np.finfo(members.greatest.dtype).eps) * float(pair.force_scale)
        if np.max(members.greatest) <= least:
            status, said = (
                Status.IDLE,
                apart_message(evaluator.config, float(np.max(members.depth))),
            )
            gradient = {name: dict.fromkeys(evaluator.keys, 0.0) for name in RESPONSES}
        response = dict(zip(RESPONSES, map(float, values[:, 0]), strict=True))
        errors = dict(zip(ERRORS.values(), map(float, values[:, 1]), strict=True))
        kind, series = _kind(evaluator, pair, members, with_series)
        if status is Status.IDLE:
            kind["kind"] = "idle"
        drift, by_drift = mean_and_error(np.asarray(members.drift, np.float64))
        steady = kind | size | errors | {
            "mean_force_drift_N": float(drift),
            "mean_force_drift_standard_error_N": float(by_drift),
            "greatest_force_N": float(np.max(members.greatest)),
        }  # fmt: skip
        last = np.asarray(members.states, np.float64)
        if float(np.max(members.depth)) > TOO_DEEP * float(evaluator.scene.pitch_radius):
            status = Status.TOO_DEEP
    if status is Status.AVERAGED and evaluator.keys and evaluator.differentiate:
        status, slopes = _slopes(evaluator, design, members)
        if slopes is not None:
            gradient, steady["gradient_standard_error"] = (
                {
                    name: dict(zip(evaluator.keys, map(float, row), strict=True))
                    for name, row in zip(RESPONSES, rows, strict=True)
                }
                for rows in slopes
            )
        else:
            # A neighbour has failed: the results do not represent a neighbourhood.
            response, steady, series, last = {}, {"kind": "transient"}, None, None
    return Evaluation(
        design=dict(zip(evaluator.keys, map(float, design), strict=True)),
        geometry=geometry_record(evaluator.scene, shape),
        response=response,
        gradient=gradient,
        steady_state=steady,
        status=status,
        message=said if status is Status.IDLE else message_of(evaluator.config, status),
        statistics={
            "settle_mesh_periods": settings.settle_periods,
            "neighbours": settings.designs // 2 * 2 if gradient else 0,
            "seconds": time.perf_counter() - began,
        },
        series=series,
        start=last,
    )


def _kind(evaluator: Evaluator, pair, members: Members, with_series):
    """Return the entries of `steady_state` for the kind of motion, and the series of a member.

    The Lyapunov exponent is computed for a member whose motion does not repeat, if there is
    one.
    """
    every = np.all(members.repeats, axis=0)
    period = {"period": (int(np.argmax(every)) + 1) * pair.repeats}
    kind: dict[str, Any] = {"kind": "periodic"} | period if every.any() else {"kind": "transient"}
    if evaluator.survey or (every.any() and not with_series):
        return kind, None
    typical = int(np.argmin(np.any(members.repeats, axis=1)))
    state = jnp.asarray(members.states[typical])
    window = lyapunov_program(pair, state, PERIODS, evaluator.scene.solver.transient)
    status = Status.of(int(unsettled_status(pair, window)))
    steady, _, series = unsettled(pair, status, jax.device_get(window), with_series)
    del steady["window_mesh_periods"]
    return steady | (kind if every.any() else {}), series


def _slopes(
    evaluator: Evaluator, design, members: Members
) -> tuple[Status, NDArray[np.float64] | None]:
    """Return a status, and gradients of the responses with their standard errors (2, 3, d).

    Gradients and errors are in N per config unit. They are None unless the status is AVERAGED.
    All neighbours start from the last states of the design's own members.
    """
    space, settings = _space(evaluator, design), evaluator.config.ensemble
    points, steps = neighbours(np.asarray(_point(space, design)), settings)
    designs, jacobian = _around(space, design, points)
    settle = -(-settings.settle_periods // _AGAIN)
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        built = list(pool.map(functools.partial(_pair, evaluator.scene), designs))
    status, runs = _run(evaluator, built, members.states, settle)
    if status is not Status.AVERAGED:
        return status, None
    values = np.stack([run.responses[:, 0] for run in runs])
    slopes = per_config_unit(*fitted_slope(values, steps), np.asarray(jacobian))
    return Status.AVERAGED, np.stack(slopes)


def _space(evaluator: Evaluator, design) -> Space:
    space = Space.of(evaluator.config, evaluator.scene)
    lower, upper = np.minimum(space.lower, design), np.maximum(space.upper, design)
    bounds = jnp.asarray(lower), jnp.asarray(upper)
    return eqx.tree_at(lambda s: (s.lower, s.upper), space, bounds)


def neighbours(
    point: NDArray[np.float64], settings: EnsembleConfig
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return random points (2n, d) of the unit box around `point` (d,), and their steps (n, d).

    The first n points are a centre plus the steps, the last n the centre minus the steps. The steps
    are normally distributed with standard deviation `settings.spread`, and shortened where a point
    would leave the box. The centre is `point`, moved inside the box if it is less than one standard
    deviation from a bound. (A point at a bound has no opposite neighbours.)
    """
    from scipy.stats import norm

    pairs, spread = settings.designs // 2, settings.spread
    share = sobol(pairs, settings.seed, len(point))
    steps = spread * norm.ppf(np.clip(share, 1e-6, 1 - 1e-6))
    middle = np.clip(point, spread, 1 - spread)
    room = np.minimum(middle, 1 - middle)
    steps *= np.minimum(1.0, np.min(room / np.maximum(np.abs(steps), 1e-12), axis=1))[:, None]
    points = np.concatenate([middle + steps, middle - steps])
    return np.clip(points, 0.0, 1.0), steps  # Only rounding is clipped.


def fitted_slope(
    values: NDArray[np.float64], steps: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the slopes (r, d) of r responses and their covariances (r, d, d).

    `values` (2n, r): responses at n opposite pairs of points, the first n at plus `steps` (n, d),
    the last n at minus `steps`. The slopes are a least-squares fit to the differences of the pairs,
    exact for responses up to quadratic. As the number of pairs grows, the slope tends to the
    gradient of the average over the neighbourhood (Stein's identity: E[δδᵀ]⁻¹ E[δ f] = ∇E[f] for
    normal δ). The covariance comes from the residuals of the pairs. It therefore includes the noise
    of the values and their nonlinearity.
    """
    count = len(steps)
    differences = (values[:count] - values[count:]) / 2
    slope, *_ = np.linalg.lstsq(steps, differences, rcond=None)
    residuals = differences - steps @ slope
    variance = np.sum(residuals**2, axis=0) / (count - steps.shape[1])
    covariance = variance[:, None, None] * np.linalg.inv(steps.T @ steps)
    return np.asarray(slope.T, np.float64), np.asarray(covariance, np.float64)


def per_config_unit(
    slope: NDArray[np.float64], covariance: NDArray[np.float64], jacobian: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Convert slopes from the unit box to config units. Return slopes and standard errors (r, d).

    `slope` (r, d) and `covariance` (r, d, d): slopes in the unit box and their covariances;
    `jacobian` (d, d): derivatives of the design with respect to the point of the box."""
    inverse = np.linalg.inv(jacobian)
    spread = np.einsum("ik,rij,jl->rkl", inverse, covariance, inverse)
    return slope @ inverse, np.sqrt(np.diagonal(spread, axis1=1, axis2=2))


_pair = CachedFunction(Scene.pair_and_shape)
_point = CachedFunction(Space.point)


@CachedFunction
def _around(space: Space, design, points):
    """Return the designs at `points` of the unit box, and the Jacobian of the design with respect
    to the point."""
    return jax.vmap(space.design)(points), jax.jacfwd(space.design)(space.point(design))
