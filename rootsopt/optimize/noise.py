"""What a search owes to the noise of its objective, where that is an average over an ensemble.

The best of many noisy objectives is best in part by luck. So what the search promises
counts for nothing in the verdict: baseline and winner are averaged again, over an ensemble of
other motions and several times as many, and the winner is accepted only if it is better
by more than `SIGNIFICANT` combined standard errors.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from rootsopt.ensemble import ERRORS, SIGNIFICANT, EnsembleEvaluator
from rootsopt.evaluate import Evaluation
from rootsopt.optimize.problem import Problem

_NEAR = 0.1
"""Distance in the unit box up to which trials count as one candidate."""
_CANDIDATES = 3


class Verdict(NamedTuple):
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


def verify(problem: Problem, evaluator: EnsembleEvaluator, trials: Sequence) -> Verdict:
    """Average the best candidates and the baseline again, over an independent ensemble, until
    one is significantly better. Gradients are from ensembles of the search's size."""
    judge = evaluator.independent()
    judge.differentiate = False
    baseline = judge(jnp.asarray(list(problem.baseline.design.values())))
    settings = judge.settings
    record: dict[str, Any] = {
        "holds_up": False,
        "members": settings.members,
        "seed": settings.seed,
        "required_standard_errors": SIGNIFICANT,
    }
    if not baseline.usable:
        return Verdict(problem, baseline, None, record | {"rejected": []})
    baseline = _with_gradient(baseline, problem.baseline)
    renewed = dataclasses.replace(problem, baseline=baseline)
    rejected: list[dict[str, Any]] = []
    for searched, trial in candidates(problem, trials):
        evaluation = judge(problem.design(trial.point))
        found = renewed.objective(evaluation)
        errors = [standard_error(renewed, one) for one in (baseline, evaluation)]
        combined = float(np.linalg.norm(errors))
        holds = bool(1 - found > SIGNIFICANT * combined)
        entry = {
            "searched_objective": searched,
            "verified_objective": found,
            "combined_standard_error": combined,
            "status": evaluation.status.label,
            "holds_up": holds,
        }
        if holds:
            search = evaluator(problem.design(trial.point), series=False)
            evaluation = _with_gradient(evaluation, search)
            return Verdict(renewed, baseline, evaluation, record | entry | {"rejected": rejected})
        rejected.append(entry | {"design": evaluation.design})
    return Verdict(renewed, baseline, None, record | {"rejected": rejected})


def _with_gradient(evaluation: Evaluation, other: Evaluation) -> Evaluation:
    """`evaluation` with the gradient of the `other` one, and its standard error."""
    key = "gradient_standard_error"
    errors = {key: other.steady_state[key]} if key in other.steady_state else {}
    steady = evaluation.steady_state | errors
    return dataclasses.replace(evaluation, gradient=other.gradient, steady_state=steady)


def candidates(problem: Problem, trials: Sequence) -> list[tuple[float, Any]]:
    """The most promising trials, apart from each other, with the objective that the trials near
    them give on average.

    Ranked by that average plus its standard error: one lucky trial among worse ones is no
    candidate.
    """
    usable = [trial for trial in trials if trial.candidate]
    ranked = []
    for trial in usable:
        near = [t for t in usable if np.linalg.norm(t.point - trial.point) < _NEAR]
        mean = float(np.mean([t.objective for t in near]))
        errors = [standard_error(problem, t.evaluation) for t in near]
        ranked.append((mean + float(np.linalg.norm(errors)) / len(near), mean, trial))
    ranked.sort(key=lambda entry: entry[0])
    chosen: list[tuple[float, Any]] = []
    for _, mean, trial in ranked:
        apart = all(np.linalg.norm(trial.point - t.point) > _NEAR for _, t in chosen)
        if apart and mean < 1 and len(chosen) < _CANDIDATES:
            chosen.append((mean, trial))
    return chosen


def message(record: dict[str, Any]) -> str:
    """What to tell of a verification over an ensemble that no design passed; nothing for
    another one."""
    if "required_standard_errors" not in record:
        return ""
    advice = (
        "Raise ensemble.members or ensemble.periods (the standard error falls with the square "
        "root of either), or optimizer.iterations."
    )
    known = [entry for entry in record["rejected"] if np.isfinite(entry["verified_objective"])]
    if not known:
        return f"No design promised to be better than the baseline beyond the noise. {advice}"
    best = min(known, key=lambda entry: entry["verified_objective"])
    found, error = best["verified_objective"], best["combined_standard_error"]
    return (
        f"The difference to the baseline is within the noise: averaged over an independent "
        f"ensemble, the best design has an objective of {found:.4g} against 1, with a combined "
        f"standard error of {error:.2g}, and {record['required_standard_errors']:g} are asked "
        f"for. {advice}"
    )
