"""The verification of a search: its best design once more, from rest, with a certificate."""

import dataclasses
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rootsopt.optimize.local import FEASIBLE, RESIDUAL, Certificate, certify
from rootsopt.optimize.optimality import Optimality, StartOutcome, judged
from rootsopt.optimize.outcome import Trial, candidate, near, objective
from rootsopt.optimize.problem import Problem
from rootsopt.optimize.sqp import Found
from rootsopt.response.evaluation import Evaluation, Evaluator
from rootsopt.response.sensitivity import by_scene, quantities

# Relative difference between a design's objectives in search and verification above which the
# design is rejected.
_HOLDS_UP = 0.01

# Factor on the tolerance of orbits for a second evaluation, if the first-order conditions do not
# hold.
_SHARPER = 0.01

# Distances (unit box, per coordinate) from a design at which its verification is repeated.
_BESIDE = 1e-6, 1e-5, 3e-5, 1e-4

# Scaled excess over a force limit above which the verification rejects a design.
_MEETS = 1e-4


@dataclasses.dataclass(frozen=True)
class Verification:
    """How the results of a search are verified.

    `problem`: design problem; `exact`: evaluator from rest; `tolerance` of its orbits; `method` of
    the local searches; `bar`: objective that a design must be below; `asked`: whether the search
    should end; `found`: what each local search by sequential quadratic programming has found;
    `refuted`: points that did not hold up, to which more are added.
    """

    problem: Problem
    exact: Evaluator
    tolerance: float
    method: str
    bar: float
    asked: Callable[[], bool]
    found: Mapping[int, Found]
    refuted: list[NDArray[np.float64]]

    def confirmed(self, trials: list[Trial]) -> tuple[Evaluation | None, dict[str, Any]]:
        """Simulate the best designs again, from rest at a tight tolerance, until one is confirmed.

        Return (evaluation of this design, or `None`; record for the result file)."""
        ends = {found.point.tobytes() for found in self.found.values()}
        ranked = sorted(filter(candidate, trials), key=objective)
        # Try the results of the local searches first. Points next to them are hardly different.
        ranked.sort(key=lambda trial: trial.point.tobytes() not in ends)
        tried: list[np.ndarray] = []
        failures = []
        for trial in ranked:
            if trial.objective >= self.bar or len(tried) >= 5:
                break
            if near(trial.point, tried):
                continue
            tried.append(trial.point)
            evaluation, record = self._again(trial)
            if record["holds_up"] and record["verified_objective"] < self.bar:
                return evaluation, record | {"rejected": failures}
            failures.append(record | {"design": evaluation.design})
            self.refuted.append(trial.point)
        return None, {"holds_up": False, "rejected": failures}

    def _again(self, trial: Trial) -> tuple[Evaluation, dict[str, Any]]:
        """Simulate a candidate from rest, more tightly and beside it, until its objective holds up.

        Return (evaluation that holds up, or else the first one; record for the result file). The
        record has the statuses of all attempts."""
        attempts: list[tuple[Evaluation, dict[str, Any]]] = []
        for evaluator, point in self._attempts(trial.point):
            evaluation = evaluator(self.problem.design(point))
            value = self.problem.objective(evaluation)
            change = abs(value / trial.objective - 1)
            record = {
                "searched_objective": trial.objective,
                "verified_objective": None if np.isnan(value) else value,
                "status": evaluation.status.label,
                "holds_up": bool(change <= _HOLDS_UP and self.problem.excess(evaluation) <= _MEETS),
            }
            attempts.append((evaluation, record))
            if record["holds_up"] or self.asked():
                break
        found, record = attempts[-1 if attempts[-1][1]["holds_up"] else 0]
        return found, record | {"attempts": [one["status"] for _, one in attempts]}

    def _attempts(self, point: NDArray[np.float64]) -> Iterator[tuple[Evaluator, NDArray]]:
        """Yield (evaluator, point) of each attempt to confirm the design at a `point` (d,).

        An orbit can fail a check of accuracy at a design although all its neighbours pass."""
        yield self.exact, point
        yield self.exact.at_tolerance(_SHARPER * self.tolerance), point
        for beside in self.problem.nearby(point, _BESIDE):
            yield self.exact, beside

    def optimality(self, optimized: Evaluation, trials: list[Trial]) -> Optimality | None:
        """Return the first-order conditions at a verified design, and the outcomes of the starts.

        Return `None` if the design has no usable steady state."""
        point = self.problem.point(list(optimized.design.values()))
        local = self.problem.local(optimized, point)
        if local is None:
            return None
        certificate = certify(local, point)
        if not certificate.holds(RESIDUAL, FEASIBLE) and not self.asked():
            # The gradients may be less accurate than the residual requires.
            sharper = self.exact.at_tolerance(_SHARPER * self.tolerance)
            again = sharper(self.problem.design(point), start=optimized.start, series=False)
            found = self.problem.local(again, point)
            if found is not None and (other := certify(found, point)).residual < RESIDUAL:
                certificate, optimized = other, again
        ends = sorted(self.found.items())
        reason, promised = "verification" if ends else "descent", float("nan")
        beside = [found for _, found in ends if near(found.point, [point])]
        if beside:
            found = min(beside, key=lambda one: float(np.linalg.norm(one.point - point)))
            reason = judged(found.reason, certificate.holds(RESIDUAL, FEASIBLE))
            promised = found.promised
        held = self.problem.held_by(optimized, certificate)
        starts = [self._outcome(number, found) for number, found in ends]
        starts = starts or self._ends(trials)
        rows = self._sensitivities(optimized, certificate)
        return Optimality(self.method, certificate, reason, promised, held, starts, rows)

    def _sensitivities(self, optimized: Evaluation, certificate: Certificate) -> list[dict]:
        """Return one row per scene quantity, with its effect on forces and objective.

        Forces are those in the nominal scene; the effect on the objective is left out for a sample.
        Return an empty list for several speeds, for several motions, or after `stop`."""
        nominal = self.exact.nominal
        if not nominal.single or self.asked():
            return []
        moved = by_scene(nominal, optimized.nominal)
        if moved is None:
            return []
        slopes = {} if optimized.scenes else self.problem.along_scene(moved, certificate)
        level = self.problem.objective(optimized)
        rows = []
        for one in quantities(nominal.config):
            forces = {name: one.step * row[one.key] for name, row in moved.gradient.items()}
            row = {"quantity": one.name, "key": one.key, "unit": one.unit, "value": one.value}
            row |= {"step": one.step} | forces
            if slopes:
                row["objective_percent"] = one.step * (100 * slopes[one.key] / level)
            rows.append(row)
        return rows

    def _outcome(self, number: int, found: Found) -> StartOutcome:
        """Return the outcome of a local search by sequential quadratic programming.

        `number`: index of the search; `found`: what it found."""
        certificate, local = found.certificate, found.local
        reason = found.reason
        met = local is not None and local.violation <= FEASIBLE
        if local is not None and not met and reason != "interrupted":
            reason = "infeasible"
        return StartOutcome(
            start=number,
            objective=local.objective if local is not None and met else float("nan"),
            residual=float("nan") if certificate is None else certificate.residual,
            reason=reason,
            evaluations=found.evaluations,
            design=self._named(found.point),
            point=found.point,
        )

    def _ends(self, trials: list[Trial]) -> list[StartOutcome]:
        """Return the outcomes of all descents, each with the best trial of the descent."""
        starts: dict[int, list[Trial]] = {}
        for trial in trials:
            if trial.start >= 0:
                starts.setdefault(trial.start, []).append(trial)
        found = []
        for number, every in sorted(starts.items()):
            best = min(filter(candidate, every), key=objective, default=every[0])
            outcome = best.objective, best.residual, "descent", len(every)
            found.append(StartOutcome(number, *outcome, self._named(best.point), best.point))
        return found

    def _named(self, point) -> dict[str, float]:
        """Return the design at a `point` (d,), in config units by key."""
        values = self.problem.look(point)[0].tolist()
        return dict(zip(self.problem.config.design_keys, values, strict=True))
