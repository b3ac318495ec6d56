"""Tests of a search with noise: candidates, and verification by ensembles of other motions."""

import dataclasses

import numpy as np
import pytest

from rootsopt.config import family_of, load
from rootsopt.optimize import noise
from rootsopt.optimize.outcome import Trial
from rootsopt.optimize.problem import Problem
from rootsopt.response.ensemble import SIGNIFICANT
from rootsopt.response.evaluation import Evaluator
from rootsopt.response.result import ERRORS
from rootsopt.status import Status
from tests.standins import evaluation_of

INSIDE = (30.0, 4.0, 3.0)


def made_up(objective, error=0.02, design=INSIDE):
    """Return an evaluation with forces of `objective` times the baseline's, and a standard
    error."""
    return dataclasses.replace(
        evaluation_of(100.0 * objective, Status.AVERAGED),
        design=dict(zip(family_of("cic").keys, map(float, design), strict=True)),
        geometry={"area_efficiency": 0.43},
        steady_state={key: 100.0 * error for key in ERRORS.values()},
    )


def trial(point, objective, error=0.02):
    return Trial(np.asarray(point), 0, 0, made_up(objective, error), objective, True)


@pytest.fixture(scope="module")
def problem():
    settings = load("configs/cic_drawn.yaml", ["objective.motion=ensemble"])
    return Problem.of(settings, Evaluator.of(settings).scene, made_up(1.0))


def test_a_lucky_trial_is_no_candidate_on_its_own(problem):
    """A trial far below its neighbours ranks behind a place where all trials are good.

    Repeated trials count once, infeasible ones never."""
    good = [trial([0.2, 0.2, 0.2 + 0.01 * k], 0.7) for k in range(4)]
    lucky = [trial([0.8, 0.8, 0.8 + 0.01 * k], 0.9 if k else 0.5) for k in range(3)]
    worst = dataclasses.replace(trial([0.2, 0.8, 0.8], 0.3), feasible=False)
    (first, place), (second, _) = noise.candidates(
        problem, [worst, *lucky, lucky[0], lucky[0], *good]
    )[:2]
    assert (first, second) == pytest.approx((0.7, (0.5 + 0.9 + 0.9) / 3))
    assert place[:2] == pytest.approx([0.2, 0.2])
    assert noise.candidates(problem, [trial([0.5, 0.5, 0.5], 1.2)]) == []


def test_many_trials_are_surer_than_one(problem):
    """Four trials of 0.8 with an error of 0.08 each have a mean with an error of 0.04.

    With it, they rank before one trial of 0.79 with an error of 0.08."""
    many = [trial([0.2, 0.2, 0.2 + 0.01 * k], 0.8, 0.08) for k in range(4)]
    found = noise.candidates(problem, [trial([0.8, 0.8, 0.8], 0.79, 0.08), *many])
    assert [objective for objective, _ in found] == pytest.approx([0.8, 0.79])


@dataclasses.dataclass(frozen=True)
class Judge(Evaluator):
    """An evaluator that knows the true objective of every design; the baseline's is 1.

    Designs with a first angle above 35° have no average."""

    truth: float = 1.0
    asked: list[int] = dataclasses.field(default_factory=list)

    def __call__(self, design=None, start=None, series=True):
        self.asked.append(self.config.ensemble.seed)
        base = np.allclose(np.asarray(design), INSIDE)
        found = made_up(1.0 if base else self.truth, design=np.asarray(design))
        lost, steep = {"response": {}, "status": Status.PASSED_THROUGH}, design[0] > 35
        return dataclasses.replace(found, **lost) if steep else found


@pytest.mark.parametrize(("truth", "accepted"), [(0.9, True), (0.93, False), (1.1, False)])
def test_only_a_significant_difference_holds_up(problem, truth, accepted):
    """0.9 differs by more than three combined standard errors of 0.02·√(1 + 1); 0.93 does not.

    The objective in the search does not matter."""
    judge = Judge(problem.config, problem.space.scene, truth=truth)
    verdict = noise.verify(problem, judge, [trial([0.5, 0.5, 0.5], 0.4)])
    # One choice, then baseline and choice over another ensemble; then the search's own again.
    assert judge.asked == [1, 2, 2] + [0] * accepted
    record = verdict.verification
    assert (verdict.optimized is not None, record["holds_up"]) == (accepted, accepted)
    assert record["verified_objective"] == pytest.approx(truth)
    assert record["combined_standard_error"] == pytest.approx(0.02 * np.sqrt(2))
    for said in ("within the noise", "ensemble.members", f"{SIGNIFICANT:g}"):
        assert said in noise.message(record)
    assert noise.message({"holds_up": False, "rejected": []}) == ""


def test_a_candidate_without_an_average_is_passed_over(problem):
    """The next candidate is judged, although the first had a better objective.

    Without another candidate, none is accepted."""
    judge = Judge(problem.config, problem.space.scene, truth=0.8)
    lost, good = trial([0.9, 0.5, 0.5], 0.3), trial([0.1, 0.5, 0.5], 0.7)
    verdict = noise.verify(problem, judge, [lost, good])
    assert verdict.optimized is not None
    assert verdict.verification["searched_objective"] == 0.7
    assert len(verdict.verification["candidates"]) == 2
    alone = noise.verify(problem, judge, [lost])
    assert (alone.optimized, alone.verification["holds_up"]) == (None, False)
