"""What a search owes to the noise of its objective, where that is an average over an ensemble.

The best of many noisy objectives is best in part by luck. So what the search promises
counts for nothing in the verdict: a few candidates are averaged again, over an ensemble of
other motions and several times as many; the best of them and the baseline once more, over
yet another; and it is accepted only if it is better by more than `SIGNIFICANT` combined
standard errors.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from rootsopt.optimize.problem import Problem
from rootsopt.response.ensemble import ERRORS, SIGNIFICANT, EnsembleEvaluator
from rootsopt.response.evaluation import Evaluation

_NEAR = 0.1
"""Distance in the unit box up to which trials count as one candidate."""
_CANDIDATES = 3


class Verification(NamedTuple):
    """Outcome of a verification: `problem` relative to the `baseline` as averaged anew,
    `optimized` if a design held up, and the `record` for the result file."""

    problem: Problem
    baseline: Evaluation
    optimized: Evaluation | None
    record: dict[str, Any]


def standard_error(problem: Problem, evaluation: Evaluation) -> float:
    """Standard error of the objective of an evaluation, that of the baseline aside; NaN for
    one that is not usable.

    The weighted sum of those of the responses: an upper bound, and close to it, since mean
    and peak rise together.
    """
    steady = evaluation.steady_state
    errors = {name: steady.get(key, float("nan")) for name, key in ERRORS.items()}
    return problem.objective(dataclasses.replace(evaluation, response=errors))


def add_errors(rows: list[dict[str, Any]], trials: Sequence, problem: Problem) -> None:
    """Give the rows of a history, one a trial, the standard error of their objective."""
    for row, trial in zip(rows, trials, strict=True):
        row["objective_standard_error"] = standard_error(problem, trial.evaluation)


def verify(problem: Problem, evaluator: EnsembleEvaluator, trials: Sequence) -> Verification:
    """Choose among the best candidates by one larger ensemble, and compare the one chosen with
    the baseline by another. Gradients are from ensembles of the search's size."""
    chooser, judge = (evaluator.independent(k).without_gradient() for k in (1, 2))
    settings = judge.settings
    record: dict[str, Any] = {
        "holds_up": False,
        "members": settings.members,
        "seed": settings.seed,
        "required_standard_errors": SIGNIFICANT,
    }
    tried = []
    for searched, point in candidates(problem, trials):
        evaluation = chooser(problem.design(point), series=False)
        tried.append((problem.objective(evaluation), searched, point))
    record["candidates"] = [
        {"searched_objective": searched, "chosen_by_objective": found}
        for found, searched, _ in tried
    ]
    tried = [one for one in tried if np.isfinite(one[0])]
    if not tried:
        return Verification(problem, problem.baseline, None, record)
    _, searched, point = min(tried, key=lambda one: one[0])
    baseline = judge(jnp.asarray(list(problem.baseline.design.values())))
    if not baseline.usable:
        return Verification(problem, baseline, None, record)
    baseline = _with_gradient(baseline, problem.baseline)
    renewed = dataclasses.replace(problem, baseline=baseline)
    evaluation = judge(problem.design(point))
    found = renewed.objective(evaluation)
    errors = [standard_error(renewed, one) for one in (baseline, evaluation)]
    combined = float(np.linalg.norm(errors))
    holds = bool(1 - found > SIGNIFICANT * combined)
    record |= {
        "searched_objective": searched,
        "verified_objective": found,
        "combined_standard_error": combined,
        "status": evaluation.status.label,
        "holds_up": holds,
    }
    if not holds:
        return Verification(renewed, baseline, None, record | {"design": evaluation.design})
    search = evaluator(problem.design(point), series=False)
    return Verification(renewed, baseline, _with_gradient(evaluation, search), record)


def _with_gradient(evaluation: Evaluation, other: Evaluation) -> Evaluation:
    """`evaluation` with the gradient of the `other` one, and its standard error."""
    key = "gradient_standard_error"
    errors = {key: other.steady_state[key]} if key in other.steady_state else {}
    steady = evaluation.steady_state | errors
    return dataclasses.replace(evaluation, gradient=other.gradient, steady_state=steady)


def candidates(problem: Problem, trials: Sequence) -> list[tuple[float, NDArray[np.float64]]]:
    """The most promising points of the unit box, apart from each other, each with the
    objective that the trials near it give on average.

    Ranked by that average plus its standard error: one lucky trial among worse ones is no
    candidate.
    """
    # A start repeats the screening's trial, noise and all.
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
    chosen: list[tuple[float, NDArray[np.float64]]] = []
    for _, mean, point in ranked:
        apart = all(np.linalg.norm(point - other) > _NEAR for _, other in chosen)
        if apart and mean < 1 and len(chosen) < _CANDIDATES:
            chosen.append((mean, point))
    return chosen


def most_promising(problem: Problem, trials: Sequence) -> Any:
    """The trial at the best of the `candidates`, or None."""
    found = candidates(problem, trials)
    if not found:
        return None
    _, point = found[0]
    return next(t for t in trials if t.candidate and np.array_equal(t.point, point))


def message(record: dict[str, Any]) -> str:
    """What to tell of a verification over an ensemble that no design passed; nothing for
    another one."""
    if "required_standard_errors" not in record:
        return ""
    advice = (
        "Raise ensemble.members or ensemble.periods (the standard error falls with the square "
        "root of either), or optimizer.iterations."
    )
    found, error = record.get("verified_objective"), record.get("combined_standard_error")
    if found is None or not np.isfinite(found):
        return f"No design promised to be better than the baseline beyond the noise. {advice}"
    return (
        f"The difference to the baseline is within the noise: averaged over an independent "
        f"ensemble, the best design has an objective of {found:.4g} against 1, with a combined "
        f"standard error of {error:.2g}, and {record['required_standard_errors']:g} of these are "
        f"asked for. {advice}"
    )
