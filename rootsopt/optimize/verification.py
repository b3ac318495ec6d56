"""Verifies a search: simulates its best design again, from rest, with a certificate.

`surviving` computes how much of the gain is left if the rotors are not exactly as drawn. Baseline
and optimised design are evaluated again with the same errors of manufacture. All flanks are too
full or too lean, or the axes too near or too far."""

import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rootsopt.config.reading import Config
from rootsopt.optimize.local import FEASIBLE, RESIDUAL, Certificate, certify
from rootsopt.optimize.optimality import Optimality, StartOutcome, judged
from rootsopt.optimize.outcome import Optimization, Trial, candidate, near, objective
from rootsopt.optimize.problem import Problem
from rootsopt.optimize.sqp import Descent
from rootsopt.response.evaluation import Evaluator
from rootsopt.response.reducers import Point, evaluate_many
from rootsopt.response.result import Evaluation
from rootsopt.response.sensitivity import by_scene, quantities
from rootsopt.response.still import needed_motion
from rootsopt.status import Status

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
    """Verifies the results of a search.

    `problem`: design problem; `exact`: evaluator from rest; `bar`: objective that a design must be
    below; `asked`: whether the search should end; `descents`: what each local search by sequential
    quadratic programming has found; `refuted`: points that did not hold up, extended by the
    verification.
    """

    problem: Problem
    exact: Evaluator
    bar: float
    asked: Callable[[], bool]
    descents: Mapping[int, Descent]
    refuted: list[NDArray[np.float64]]

    def confirmed(self, trials: list[Trial]) -> tuple[Evaluation | None, dict[str, Any]]:
        """Simulate the best designs again, from rest at a tight tolerance, until one is confirmed.

        Return (evaluation of this design, or `None`; record for the result file)."""
        ends = {end.point.tobytes() for end in self.descents.values()}
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
        chosen, record = attempts[-1 if attempts[-1][1]["holds_up"] else 0]
        return chosen, record | {"attempts": [one["status"] for _, one in attempts]}

    def _attempts(self, point: NDArray[np.float64]) -> Iterator[tuple[Evaluator, NDArray]]:
        """Yield (evaluator, point) of each attempt to confirm the design at a `point` (d,).

        An orbit can fail a check of accuracy at a design although all its neighbours pass."""
        yield self.exact, point
        yield self.exact.at_tolerance(_SHARPER * self.exact.config.solver.orbit_tolerance), point
        for beside in self.problem.nearby(point, _BESIDE):
            yield self.exact, beside

    def optimality(self, optimized: Evaluation) -> Optimality | None:
        """Return the first-order conditions at a verified design, and the outcomes of the starts.

        Return `None` if the design has no usable steady state."""
        point = self.problem.point(list(optimized.design.values()))
        local = self.problem.local(optimized, point)
        if local is None:
            return None
        certificate = certify(local, point)
        if not certificate.holds(RESIDUAL, FEASIBLE) and not self.asked():
            # The gradients may be less accurate than the residual requires.
            sharper = self.exact.at_tolerance(_SHARPER * self.exact.config.solver.orbit_tolerance)
            again = sharper(self.problem.design(point), start=optimized.start, series=False)
            end = self.problem.local(again, point)
            if end is not None and (other := certify(end, point)).residual < RESIDUAL:
                certificate, optimized = other, again
        ends = sorted(self.descents.items())
        reason, promised = "verification" if ends else "interrupted", float("nan")
        beside = [end for _, end in ends if near(end.point, [point])]
        if beside:
            end = min(beside, key=lambda one: float(np.linalg.norm(one.point - point)))
            reason = judged(end.reason, certificate.holds(RESIDUAL, FEASIBLE))
            promised = end.promised
        held = self.problem.held_by(optimized, certificate)
        starts = [self._outcome(number, end) for number, end in ends]
        rows = self._sensitivities(optimized, certificate)
        return Optimality(certificate, reason, promised, held, starts, rows)

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
            row = {"quantity": one.name, "key": one.key, "unit": one.unit, "value": one.value,
                   "step": one.step} | forces  # fmt: skip
            if slopes:
                row["objective_percent"] = one.step * (100 * slopes[one.key] / level)
            rows.append(row)
        return rows

    def _outcome(self, number: int, end: Descent) -> StartOutcome:
        """Return the outcome of a local search by sequential quadratic programming.

        `number`: index of the search; `end`: what it found at its end."""
        certificate, local, reason = end.certificate, end.local, end.reason
        met = local is not None and local.violation <= FEASIBLE
        if local is not None and not met and reason != "interrupted":
            reason = "infeasible"
        return StartOutcome(
            start=number,
            objective=local.objective if local is not None and met else float("nan"),
            residual=float("nan") if certificate is None else certificate.residual,
            reason=reason,
            evaluations=end.evaluations,
            design=self.problem.named(end.point),
            point=end.point,
        )


ERROR = 0.01
"""Error (mm) of the profile along its normal, and of the centre distance."""

# Errors (mm) of profile and centre distance by the name of the case.
_CASES = {
    "as drawn": (0.0, 0.0),
    f"flanks {1e3 * ERROR:g} µm fuller": (ERROR, 0.0),
    f"flanks {1e3 * ERROR:g} µm leaner": (-ERROR, 0.0),
    f"axes {1e3 * ERROR:g} µm nearer": (0.0, -ERROR),
    f"axes {1e3 * ERROR:g} µm farther": (0.0, ERROR),
}


def surviving(result: Optimization, given: Config) -> list[dict[str, Any]]:
    """Return one row per case: the drawing first, then each error alone.

    `given`: config of the baseline, whose family may be another than that of the search.

    A row holds the name of the `case`, and the objectives `baseline` and `optimized` (relative to
    the baseline as drawn) with their `statuses`. It also holds the relative `gain` between them,
    and its `share` of the gain as drawn. Numbers are NaN if one of the two has no steady state.
    Return [] without an optimised design."""
    problem = result.problem
    if problem is None or result.optimized is None:
        return []
    # With an error of 0 as well, so that one program serves all cases.
    own = given.scene.center_distance_error_mm or 0.0
    known = {"scene.center_distance_error_mm": own}
    pairs = (given, result.baseline), (problem.config, result.optimized)
    configs = [config.moved(known) for config, _ in pairs]
    evaluators = [needed_motion(config).without_gradient() for config in configs]
    designs = [np.array([*one.design.values()]) for _, one in pairs]

    def moved(config: Config, evaluator: Evaluator, full: float, away: float) -> Evaluator:
        # Both flanks of a gap move. The scene takes a negative clearance, which no config may have.
        tip = config.value("pump.tip_clearance_mm")
        values = {"contact.clearance_mm": config.contact.clearance_mm - 2 * full,
                  "scene.center_distance_error_mm": own + away}  # fmt: skip
        values |= {} if tip is None else {"pump.tip_clearance_mm": max(0.0, tip - full)}
        return dataclasses.replace(evaluator, scene=evaluator.scene.renewed(config.moved(values)))

    both = [*zip(configs, evaluators, designs, strict=True)]
    evaluations = evaluate_many(
        Point(moved(config, evaluator, *errors), design)
        for errors in _CASES.values()
        for config, evaluator, design in both
    )
    # Where an orbit does not close, as between jammed flanks, the window still has its forces.
    closed = {Status.NOT_CLOSED: Status.PERIODIC}
    numbers = [
        problem.objective(dataclasses.replace(one, status=closed.get(one.status, one.status)))
        for one in evaluations
    ]
    pairs = [*zip(numbers[::2], numbers[1::2], strict=True)]
    gains = [1 - after / before for before, after in pairs]
    states = [one.status.label for one in evaluations]
    return [
        {"case": name, "baseline": pair[0], "optimized": pair[1], "gain": gain,
         "share": gain / gains[0], "statuses": states[2 * k : 2 * k + 2]}
        for k, (name, pair, gain) in enumerate(zip(_CASES, pairs, gains, strict=True))
    ]  # fmt: skip


def survives(rows: list[dict[str, Any]]) -> str:
    """Return a sentence on the share of the gain that is left in the worst case; "" without rows.

    `rows`: result of `surviving`."""
    lost = [one["case"] for one in rows if not math.isfinite(one["share"])]
    if not rows or lost:
        return f"Unknown with {lost[0]}: a rotor has no steady state there." if lost else ""
    worst = min(rows, key=lambda one: one["share"])
    return (
        f"With errors of ±{1e3 * ERROR:g} µm, at least {100 * worst['share']:.3g} % of the gain "
        f"is left (worst: {worst['case']})."
    )
