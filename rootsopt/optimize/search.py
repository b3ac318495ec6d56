"""The search: screening, optax descent with projection, verification.

Screening places the starts on a Sobol sample of feasible designs. From each start an
optax update rule walks in the unit box: the gradient is stripped of what active
constraints forbid, the step is projected back onto the feasible set. The last orbit is
the first guess for the next. Best-so-far is kept; the winner is simulated again from rest
at a tighter tolerance before it is reported.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
import optax

from rootsopt.config import Config
from rootsopt.errors import InputError
from rootsopt.evaluate import Evaluation, Evaluator
from rootsopt.model import design_vector
from rootsopt.optimize.problem import Problem, Space, sobol

RULES: dict[str, Callable[..., optax.GradientTransformation]] = {
    "adam": optax.adam,
    "rmsprop": optax.rmsprop,
    "sgd": optax.sgd,
}
_PATIENCE = 4
_GAIN = 1e-4
_STATIONARY = 1e-3
_HOLDS_UP = 0.01
"""Relative change of the objective in the verification that still counts as holding up."""

Progress = Callable[[int, int, float], None]
"""Called with (evaluations done, evaluations expected, best objective)."""


@dataclasses.dataclass
class Candidate:
    """A feasible design found by the search."""

    point: np.ndarray
    objective: float
    evaluation: Evaluation


@dataclasses.dataclass(frozen=True)
class Optimization:
    """Outcome of a search.

    `optimized` is None when no design better than the baseline held up. `verification`
    says what the search promised and what the tight simulation from rest gave.
    """

    problem: Problem
    baseline: Evaluation
    optimized: Evaluation | None
    history: list[dict[str, Any]]
    verification: dict[str, Any]

    @property
    def improvement(self) -> dict[str, float]:
        """Reductions relative to the baseline, as fractions."""
        if self.optimized is None:
            return {}
        gains = {"objective": 1 - self.problem.objective(self.optimized)}
        for key in ("mean_force_N", "peak_force_N", "rms_force_N"):
            before, after = self.baseline.response[key], self.optimized.response[key]
            gains[key] = 1 - after / before if before > 0 else 0.0
        return gains


class Search:
    """One optimisation run of a config."""

    def __init__(self, config: Config, progress: Progress | None = None):
        if config.profile.family != "cic":
            raise InputError(
                f"`profile.family` must be cic to be optimised, but is {config.profile.family}: "
                "it has no design parameter; use `simulate` for it"
            )
        self.config = config
        self.settings = config.optimizer
        self.progress = progress or (lambda done, expected, best: None)
        self.history: list[dict[str, Any]] = []
        self.candidates: list[Candidate] = []
        self.expected = self.settings.screening + self.settings.starts * (
            self.settings.iterations + 1
        )
        # The search needs a gradient and an order of designs, not the last digits.
        self.fast = Evaluator(config, rtol=max(1e-6, config.solver.rtol), survey=True)
        self.exact = Evaluator(config)

    def run(self) -> Optimization:
        """Baseline, screening, descents, verification."""
        self.exact.prepare(design_vector(self.config))
        Space.of(self.config, self.exact.model, 0.0).prepare()
        baseline = self.exact()
        if not baseline.usable:
            return Optimization(None, baseline, None, [], {})  # type: ignore[arg-type]
        self.fast.model, self.fast.fitted = self.exact.model, True
        self.problem = Problem.of(self.config, self.exact.model, baseline)
        start = np.asarray(self.problem.space.point(jnp.asarray(list(baseline.design.values()))))
        for number, point in enumerate(self._starts(start)):
            self._descend(number, point)
        optimized, verification = self._verify()
        return Optimization(self.problem, baseline, optimized, self.history, verification)

    def _starts(self, baseline_point) -> list[np.ndarray]:
        """The baseline's neighbourhood and the best screened designs, apart from each other."""
        sample = [baseline_point, *sobol(self.settings.screening, self.settings.seed)]
        points = [self.problem.project(point) for point in sample]
        points = [point for point in points if self.problem.feasible(point)]
        if not points:
            raise InputError(
                "`constraints` and `optimizer.bounds` leave no feasible design; lower "
                "`constraints.area_efficiency_min` or widen `optimizer.bounds`"
            )
        if self.settings.screening:
            for point in points:
                self._evaluate(point, start=-1, iteration=0)
        ranked = sorted(self.candidates, key=lambda c: c.objective)
        chosen: list[np.ndarray] = []
        for candidate in ranked:
            apart = all(np.linalg.norm(candidate.point - p) > 0.15 for p in chosen)
            if apart and len(chosen) < self.settings.starts:
                chosen.append(candidate.point)
        return chosen or [points[0]]

    def _descend(self, number: int, point: np.ndarray) -> None:
        """Local descent from `point`."""
        settings = self.settings
        schedule = optax.cosine_decay_schedule(settings.learning_rate, settings.iterations, 0.05)
        rule = RULES[settings.method](schedule)
        state = rule.init(jnp.asarray(point))
        best, since = np.inf, 0
        last: Candidate | None = None
        orbit = None
        for iteration in range(settings.iterations + 1):
            evaluation, objective = self._evaluate(point, number, iteration, orbit)
            if np.isnan(objective):
                # No steady state there: go half way back to the last good design.
                if last is None:
                    return
                point = self.problem.project((point + last.point) / 2)
                orbit = None
                continue
            last = Candidate(point, objective, evaluation)
            orbit = evaluation.state
            since = 0 if objective < best * (1 - _GAIN) else since + 1
            best = min(best, objective)
            if since > _PATIENCE or iteration == settings.iterations:
                return
            slope = self.problem.descent(point, self.problem.slope(evaluation, jnp.asarray(point)))
            if np.linalg.norm(slope) < _STATIONARY:
                return
            update, state = rule.update(jnp.asarray(slope), state)
            point = self.problem.project(point + np.asarray(update))

    def _evaluate(self, point, start, iteration, orbit=None):
        evaluation = self.fast(self.problem.design(point), start=orbit, series=False)
        objective = self.problem.objective(evaluation)
        feasible = self.problem.feasible(point)
        if not np.isnan(objective) and feasible:
            self.candidates.append(Candidate(np.asarray(point), objective, evaluation))
        best = min((c.objective for c in self.candidates), default=float("nan"))
        self.history.append(
            {
                "evaluation": len(self.history) + 1,
                "start": start,
                "iteration": iteration,
                "objective": objective,
                "best_objective": best,
                "mean_force_N": evaluation.response.get("mean_force_N", float("nan")),
                "peak_force_N": evaluation.response.get("peak_force_N", float("nan")),
                **evaluation.design,
                "area_efficiency": evaluation.geometry["area_efficiency"],
                "feasible": feasible,
                "status": evaluation.status.label,
            }
        )
        self.progress(len(self.history), self.expected, best)
        return evaluation, objective

    def _verify(self) -> tuple[Evaluation | None, dict[str, Any]]:
        """Simulate the best designs again, from rest and tightly, until one holds up."""
        ranked = sorted(self.candidates, key=lambda c: c.objective)
        tried: list[np.ndarray] = []
        failures = []
        for candidate in ranked:
            if candidate.objective >= 1 or len(tried) >= 5:
                break
            if any(np.linalg.norm(candidate.point - p) < 0.02 for p in tried):
                continue
            tried.append(candidate.point)
            evaluation = self.exact(self.problem.design(candidate.point))
            objective = self.problem.objective(evaluation)
            change = abs(objective / candidate.objective - 1)
            record = {
                "searched_objective": candidate.objective,
                "verified_objective": None if np.isnan(objective) else objective,
                "status": evaluation.status.label,
                "holds_up": bool(change <= _HOLDS_UP),
            }
            if change <= _HOLDS_UP and objective < 1:
                return evaluation, record | {"rejected": failures}
            failures.append(record | {"design": evaluation.design})
        return None, {"holds_up": False, "rejected": failures}
