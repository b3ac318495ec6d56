"""Search for designs whose objective is an average over an ensemble, and its verification.

A descent by Adam's rule projects the gradient onto the directions that active constraints allow,
and each new point onto the feasible set.

The lowest of many noisy objectives is low partly by chance. The decision therefore does not use the
objectives of the search. The best few designs are averaged again over a larger ensemble of other
motions. The best of these and the baseline are then averaged over a third ensemble. The design is
accepted if its objective is lower than the baseline's by more than `SIGNIFICANT` combined standard
errors."""

import dataclasses
import operator
from collections.abc import Callable, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from rootsopt.optimize.local import FEASIBLE
from rootsopt.optimize.outcome import Optimization, Trial, apart
from rootsopt.optimize.problem import Problem
from rootsopt.response.ensemble import SIGNIFICANT, independent
from rootsopt.response.evaluation import Evaluator
from rootsopt.response.result import ERRORS, Evaluation
from rootsopt.runtime.programs import CachedFunction

# Distance between trials in the unit box below which they count as the same candidate.
_NEAR = 0.1

# Maximum number of candidates that are averaged again.
_CANDIDATES = 3


# Norm of the projected gradient (objective per side of the unit box) below which a descent ends.
_STATIONARY = 1e-3

# First step of the rule (of the unit box).
_STEP = 0.05


def descended(
    problem: Problem,
    evaluate: Callable[[NDArray[np.float64], int, Any], Trial],
    point: NDArray[np.float64],
    iterations: int,
    asked: Callable[[], bool],
) -> list[Trial]:
    """Descend from `point` (d,) in the unit box, and return the trials.

    `evaluate`: takes a point, the number of the iteration, and where the motion begins;
    `iterations`: greatest number; `asked`: whether to end."""
    state = _init(iterations, point)
    trials: list[Trial] = []
    last: Trial | None = None
    for iteration in range(iterations + 1):
        if asked():
            break
        orbit = last.evaluation.start if last is not None and last is trials[-1] else None
        trial = evaluate(point, iteration, orbit)
        trials.append(trial)
        if np.isnan(trial.objective):
            # No usable steady state: go half way back to the last good design.
            if last is None:
                break
            point = problem.toward((point + last.point) / 2, last.point)
            continue
        last = trial
        if iteration == iterations:
            break
        slope = descent(problem, point, problem.slope(trial.evaluation, point))
        if np.linalg.norm(slope) < _STATIONARY:
            break
        update, state = _update(iterations, slope, state)
        point = problem.toward(point + np.asarray(update), point)
    return trials


def _rule(iterations: int):
    """Return the update rule, with steps that shrink over the iterations."""
    import optax

    return optax.adam(optax.cosine_decay_schedule(_STEP, iterations, 0.05))


@CachedFunction
def _init(iterations, point):
    """Return the initial state of the rule at `point` (d,)."""
    return _rule(iterations).init(point)


@CachedFunction
def _update(iterations, slope, state):
    """Return (step (d,), next state) of the rule, given the gradient `slope` (d,)."""
    return _rule(iterations).update(slope, state)


def standard_error(problem: Problem, evaluation: Evaluation) -> float:
    """Return the standard error of an evaluation's objective; NaN without a usable steady state.

    The result is the weighted sum of the measures' standard errors, without the baseline's own
    error. This sum is a close upper bound, since the mean and the peak force rise together."""
    steady = evaluation.steady_state
    errors = {name: steady.get(key, float("nan")) for name, key in ERRORS.items()}
    return problem.objective(dataclasses.replace(evaluation, response=errors))


def add_errors(rows: list[dict[str, Any]], trials: Sequence, problem: Problem) -> None:
    """Add the entry `objective_standard_error` to each of the `rows` of a history, in place.

    `trials`: trials of the search, one per row and in the same order; `problem`: that of the
    search."""
    for row, trial in zip(rows, trials, strict=True):
        row["objective_standard_error"] = standard_error(problem, trial.evaluation)


def verify(problem: Problem, evaluator: Evaluator, trials: Sequence) -> Optimization:
    """Choose the best design with a second ensemble; compare it with the baseline in a third.

    `problem`, `evaluator`, `trials`: those of the search. The second and third ensembles are larger
    than that of the search. Gradients come from ensembles of the search's size.

    Return the outcome, without history. Its `baseline` is evaluated over the third ensemble, which
    decides. Its `problem` is relative to this baseline. Its `optimized` design is evaluated over
    the same ensemble. If no candidate is usable, `problem` and `baseline` are those of the search.
    If only the new evaluation of the baseline is not usable, `problem` is that of the search."""
    chooser, judge = (independent(evaluator, k).without_gradient() for k in (1, 2))
    settings = judge.config.ensemble
    record: dict[str, Any] = {
        "holds_up": False,
        "members": settings.members,
        "seed": settings.seed,
        "required_standard_errors": SIGNIFICANT,
    }
    tried = [
        (problem.objective(chooser(problem.design(point), series=False)), searched, point)
        for searched, point in candidates(problem, trials)
    ]
    record["candidates"] = [
        {"searched_objective": searched, "chosen_by_objective": objective}
        for objective, searched, _ in tried
    ]
    tried = [one for one in tried if np.isfinite(one[0])]
    if not tried:
        return Optimization(problem, problem.baseline, None, [], record)
    _, searched, point = min(tried, key=lambda one: one[0])
    baseline = judge(jnp.asarray(list(problem.baseline.design.values())))
    if not baseline.usable:
        return Optimization(problem, baseline, None, [], record)
    baseline = _with_gradient(baseline, problem.baseline)
    renewed = dataclasses.replace(problem, baseline=baseline)
    evaluation = judge(problem.design(point))
    objective = renewed.objective(evaluation)
    errors = [standard_error(renewed, one) for one in (baseline, evaluation)]
    combined = float(np.linalg.norm(errors))
    holds = bool(1 - objective > SIGNIFICANT * combined)
    record |= {
        "searched_objective": searched,
        "verified_objective": objective,
        "combined_standard_error": combined,
        "status": evaluation.status.label,
        "holds_up": holds,
    }
    if not holds:
        return Optimization(renewed, baseline, None, [], record | {"design": evaluation.design})
    search = evaluator(problem.design(point), series=False)
    return Optimization(renewed, baseline, _with_gradient(evaluation, search), [], record)


def _with_gradient(evaluation: Evaluation, other: Evaluation) -> Evaluation:
    """Return `evaluation` with the gradient of `other` and the standard error of this gradient."""
    key = "gradient_standard_error"
    errors = {key: other.steady_state[key]} if key in other.steady_state else {}
    steady = evaluation.steady_state | errors
    return dataclasses.replace(evaluation, gradient=other.gradient, steady_state=steady)


def candidates(problem: Problem, trials: Sequence) -> list[tuple[float, NDArray[np.float64]]]:
    """Return the most promising designs as (averaged objective, point (d,)), the best first.

    The objective is averaged over the trials near a point. Points are ranked by this average plus
    its standard error, so a lucky trial among worse trials ranks low. The points are at least
    `_NEAR` apart in the unit box. Their averages are below 1, the objective of the baseline."""
    # The first trial of a descent repeats a screening trial, with the same noise: count it once.
    usable = {tuple(trial.point): trial for trial in trials if trial.candidate}
    points = np.array(list(usable)).reshape(len(usable), -1)
    objectives = np.array([trial.objective for trial in usable.values()])
    errors = np.array([standard_error(problem, trial.evaluation) for trial in usable.values()])
    ranked = []
    for point in points:
        near = np.linalg.norm(points - point, axis=1) < _NEAR
        mean = float(np.mean(objectives[near]))
        error = float(np.linalg.norm(errors[near])) / np.sum(near)
        ranked.append((mean + error, mean, point))
    ranked.sort(key=lambda entry: entry[0])
    better = [(mean, point) for _, mean, point in ranked if mean < 1]
    return apart(better, _NEAR, _CANDIDATES, operator.itemgetter(1))


def most_promising(problem: Problem, trials: Sequence) -> Any:
    """Return the trial at the best of the `candidates`, or `None` without candidates."""
    designs = candidates(problem, trials)
    if not designs:
        return None
    _, point = designs[0]
    return next(t for t in trials if t.candidate and np.array_equal(t.point, point))


def message(record: dict[str, Any]) -> str:
    """Return a message for the user on why no design was confirmed over an ensemble.

    `record`: field `verification` of an `Optimization`. Return "" for that of a search without an
    ensemble."""
    if "required_standard_errors" not in record:
        return ""
    advice = (
        "Raise ensemble.members or ensemble.periods (the standard error falls with the square "
        "root of either), or optimizer.iterations."
    )
    objective, error = record.get("verified_objective"), record.get("combined_standard_error")
    if objective is None:
        return f"The search found no design better than the baseline beyond the noise. {advice}"
    if not np.isfinite(objective):
        return (
            f"Averaged over an independent ensemble, the best design has no usable response "
            f"({record['status']}). {advice}"
        )
    return (
        f"The difference from the baseline is within the noise: averaged over an independent "
        f"ensemble, the best design has an objective of {objective:.4g} against 1. The combined "
        f"standard error is {error:.2g}, and the difference must exceed "
        f"{record['required_standard_errors']:g} of these. {advice}"
    )


def descent(problem: Problem, point, slope: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the gradient `slope` (d,) projected so that its negative is a feasible direction.

    The negative of the result is the direction closest to -`slope` that violates no constraint
    or bound active at `point` (d,). It solves a non-negative least-squares problem. The result
    is zero exactly at a Karush-Kuhn-Tucker point."""
    _, _, slack, jacobian = problem.look(point)
    point = np.asarray(point)
    walls = [row for row, s in zip(jacobian, slack, strict=True) if s < 1e-4]
    sides = np.eye(len(point))
    walls += [side for side, x in zip(sides, point, strict=True) if x <= FEASIBLE]
    walls += [-side for side, x in zip(sides, point, strict=True) if x >= 1 - FEASIBLE]
    if not walls:
        return np.asarray(slope, dtype=np.float64)
    from scipy.optimize import nnls  # Slow import (0.3 s).

    normals = np.stack(walls)
    multipliers, _ = nnls(normals.T, slope)
    return np.asarray(slope - multipliers @ normals, dtype=np.float64)
