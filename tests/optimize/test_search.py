"""Tests of the search on made-up objectives, with and without noise, without simulations."""

import dataclasses
from collections.abc import Callable

import numpy as np
import optax
import pytest

from rootsopt.config import family_of, load
from rootsopt.optimize import noise
from rootsopt.optimize.local import Linearization
from rootsopt.optimize.outcome import Trial, apart, history_of, ranked
from rootsopt.optimize.problem import Problem
from rootsopt.optimize.robust_problem import Stage
from rootsopt.optimize.search import Search
from rootsopt.response.ensemble import SIGNIFICANT
from rootsopt.response.evaluation import Evaluator
from rootsopt.response.result import ERRORS
from rootsopt.scene.space import sobol
from rootsopt.status import Status
from rootsopt.view.comparison import rejected_table
from tests.standins import evaluation_of


def trial_of(point, objective, feasible=True) -> Trial:
    return Trial(
        np.asarray(point, float), 0, 0, evaluation_of(objective, design=point), objective, feasible
    )


@dataclasses.dataclass(frozen=True)
class Knowing(Evaluator):
    """An evaluator that knows the objective of each point, and at tighter tolerances a `tight`
    one. It notes where the motions begin that it is `asked` for."""

    truth: Callable = lambda point: 1.0
    tight: Callable = lambda point: 1.0
    asked: list = dataclasses.field(default_factory=list)

    def __call__(self, design=None, start=None, series=True):
        self.asked.append(start)
        found = self.truth(tuple(design))
        status = Status.PERIODIC if np.isfinite(found) else Status.INACCURATE
        return evaluation_of(found, status, design, start=np.asarray(design))

    def at_tolerance(self, rtol):
        return dataclasses.replace(self, truth=self.tight)


def searching(truth=lambda point: 1.0, tight=None, **settings) -> Search:
    """Return a search over points of the unit box whose verification finds the `truth`.

    `tight`: what it finds at a tighter tolerance, by default the same."""
    config = load("configs/cic_drawn.yaml")
    given = config.optimizer.model_copy(update={"screening": 0, "starts": 2} | settings)
    search = Search(config.model_copy(update={"optimizer": given}))
    search.noisy = True
    search.problem = object.__new__(Problem)
    vars(search.problem).update(
        design=lambda point: point,
        objective=lambda evaluation: evaluation.response.get("mean_force_N", float("nan")),
        project=lambda point: point,
        toward=lambda point, inside: point,
        feasible=lambda point: True,
        excess=lambda evaluation: 0.0,
    )
    search.exact = search.sharp = dataclasses.replace(
        Knowing.of(search.config), truth=truth, tight=tight or truth
    )
    return search


@pytest.mark.parametrize(
    ("promised", "true", "accepted"),
    [
        (0.8, 0.8, True),
        (0.8, 0.8079, True),
        (0.8, 0.7921, True),
        (0.8, 0.8081, False),  # more than 1 % from what was promised, if still better than 1
        (0.8, 0.7919, False),
        (0.8, float("nan"), False),
        (0.995, 1.001, False),  # within 1 %, but no improvement
        (1.0, 0.995, False),  # nothing was promised
    ],
)
def test_a_promise_must_hold_up(promised, true, accepted):
    search = searching(lambda point: true)
    found, record = search._verification().confirmed([trial_of([0.3, 0.4], promised)])
    assert (found is not None, record["holds_up"]) == (accepted, accepted)
    if accepted:
        assert (record["verified_objective"], record["searched_objective"]) == (true, promised)
        assert found.design == {"x0": 0.3, "x1": 0.4}


def test_the_best_feasible_trial_that_holds_up_is_taken():
    """An infeasible, unusable or unconfirmed trial is not taken, even if it is better.

    Neighbours of a failed trial are not tried."""
    truth = {(0.9, 0.9): 0.3, (0.1, 0.1): 0.95, (0.11, 0.1): 0.5, (0.5, 0.5): 0.602,
             (0.7, 0.2): 0.65}  # fmt: skip
    search = searching(lambda point: truth[tuple(np.round(point, 3))])
    trials = [
        trial_of([0.7, 0.2], 0.65),
        trial_of([0.9, 0.9], 0.3, feasible=False),
        trial_of([0.2, 0.9], float("nan")),
        trial_of([0.5, 0.5], 0.6),
        trial_of([0.11, 0.1], 0.51),
        trial_of([0.1, 0.1], 0.5),
    ]
    found, record = search._verification().confirmed(trials)
    assert found.design == {"x0": 0.5, "x1": 0.5}
    (rejected,) = record["rejected"]
    assert (rejected["verified_objective"], rejected["holds_up"]) == (0.95, False)
    np.testing.assert_array_equal(
        [row["best_objective"] for row in history_of(trials)], [0.65, 0.65, 0.65, 0.6, 0.51, 0.5]
    )
    np.testing.assert_array_equal(
        apart(ranked(trials), Stage.apart, 9), [[0.1, 0.1], [0.5, 0.5], [0.7, 0.2]]
    )
    infeasible = trials[1:2]
    assert search._verification().confirmed(infeasible)[0] is None
    assert np.isnan(history_of(infeasible)[0]["best_objective"])
    assert ranked(infeasible) == []


SPECK = (0.3, 0.7)
"""A design whose orbit fails a check of accuracy, in the tests below."""


@pytest.mark.parametrize(
    ("truth", "tight", "attempts"),
    [
        (lambda point: 0.8, None, 1),
        (lambda point: 0.8 if point != SPECK else np.nan, lambda point: 0.8, 2),
        (lambda point: 0.8 if point != SPECK else np.nan, None, 3),
        (lambda point: 0.8 if point != SPECK else 0.9, None, 3),
        (lambda point: 0.8 if abs(point[0] - 0.3) > 5e-5 else np.nan, None, 6),
        (lambda point: 0.95 if point[0] > 0.5 else np.nan, None, 0),
    ],
)
def test_a_verification_is_repeated_more_tightly_and_beside_the_design(truth, tight, attempts):
    """A single design that cannot be judged does not cost the best start; a region does.

    0 attempts: none succeeds, and the record of the rejected design says so."""
    trials = [trial_of(SPECK, 0.8), trial_of([0.8, 0.2], 0.95)]
    found, record = searching(truth, tight)._verification().confirmed(trials)
    if attempts:
        assert (len(record["attempts"]), record["rejected"]) == (attempts, [])
        np.testing.assert_allclose([*found.design.values()], SPECK, atol=2e-4)
    else:
        (rejected,) = record["rejected"]
        assert (rejected["status"], rejected["verified_objective"]) == ("inaccurate", None)
        assert (len(rejected["attempts"]), record["searched_objective"]) == (6, 0.95)
        shown = rejected_table({"verification": record})
        assert shown.groups[0][1][0][-1].text == "inaccurate (6 attempts)"


@pytest.mark.parametrize("size", [1.0, 0.1])
def test_starts_lie_apart_in_the_part_of_the_bounds_that_limits_leave(size):
    points = [size * np.array(point) for point in ((0, 0), (0.1, 0), (0.5, 0.5), (1, 0))]
    trials = [trial_of(point, 0.9 + place / 100) for place, point in enumerate(points)]
    for screening, known, places in (
        (4, trials, [0, 2, 3]),
        (0, [], [0, 2, 3] if size == 1 else [0]),
    ):
        np.testing.assert_array_equal(
            searching(screening=screening, starts=3)._starts(points, known),
            np.array(points)[places],
        )


@pytest.mark.parametrize("hole", [0.0, 1e-6, 5e-4, 1.0])
def test_a_local_search_begins_beside_a_start_without_a_usable_motion(hole):
    """The objective is |x - 0.6| in each coordinate, except within a distance of the start."""
    start = np.array([0.2, 0.3])

    def local(number, evaluation, point):
        if np.max(np.abs(point - start)) < hole:
            return None
        slopes, none = np.sign(point - 0.6), np.zeros((0, 2))
        return Linearization(float(np.sum(np.abs(point - 0.6))), slopes, (), none[:, 0], none)

    search = searching()
    search.noisy = False
    search.stage.local = lambda _, *given: local(*given)
    vars(search.problem).update(toward=lambda point, inside: np.clip(point, 0, 1), limits_at=None)
    tried = sum(trial.local is None for trial in search._solve(0, start))
    assert tried == {0.0: 0, 1e-6: 1, 5e-4: 3, 1.0: 5}[hole]
    assert (search._descents[0].local is None) == (hole == 1)


def test_a_descent_goes_half_way_back_from_where_there_is_no_steady_state(monkeypatch):
    """Other steps are those of the update rule, each from the orbit of the previous trial. On the
    bowl about 0.6, the second motion that is asked for is lost."""
    rates = optax.cosine_decay_schedule(0.2, 6, 0.05)
    monkeypatch.setattr(noise, "_rule", lambda iterations: optax.sgd(rates))
    search = searching(lambda point: np.nan if len(starts) == 2 else 1.0, iterations=6)
    monkeypatch.setattr(noise, "descent", lambda problem, point, slope: slope)
    vars(search.problem)["slope"] = lambda evaluation, point: 2 * (point - 0.6)
    search.fast = search.exact
    first, starts = np.array([0.2, 0.3]), search.exact.asked
    trials = search._descend(4, first)
    points = np.array([trial.point for trial in trials])
    # Steps of gradient descent at a rate that falls along a cosine to a twentieth: each multiplies
    # the distance from the optimum.
    rates = 0.2 * (0.05 + 0.95 * (1 + np.cos(np.pi * np.arange(6) / 6)) / 2)
    half = 1 - rates[0]
    shares = np.array([1, 1 - 2 * rates[0], half, *half * np.cumprod(1 - 2 * rates[1:5])])
    np.testing.assert_allclose(points, 0.6 + shares[:, None] * (first - 0.6), rtol=1e-6)
    assert [k for k, start in enumerate(starts) if start is None] == [0, 2]
    np.testing.assert_array_equal([starts[k] for k in (1, 3, 4, 5, 6)], points[[0, 2, 3, 4, 5]])
    assert [(trial.iteration, trial.start) for trial in trials] == [(k, 4) for k in range(7)]


def test_a_slope_is_stripped_only_of_what_is_forbidden():
    """Steepest descent in a box with the constraint x + y ≥ 1 is projected correctly.

    Inside, it is the gradient itself; on a face or on the constraint, the gradient without its
    normal part; in a corner, zero."""
    problem = object.__new__(Problem)
    normal = np.array([1.0, 1.0])
    vars(problem)["look"] = lambda point: (
        point, np.eye(2), np.array([normal @ point - 1]), normal[None]
    )  # fmt: skip
    for point, slope, expected in [
        ([0.7, 0.8], [1.0, -2.0], [1.0, -2.0]),
        ([0.7, 1.0], [1.0, -2.0], [1.0, 0.0]),
        ([0.7, 1.0], [1.0, 2.0], [1.0, 2.0]),
        ([1.0, 1.0], [-1.0, -2.0], [0.0, 0.0]),
        ([0.6, 0.4], [1.0, 1.0], [0.0, 0.0]),
        ([0.6, 0.4], [3.0, 1.0], [1.0, -1.0]),
        ([0.6, 0.4], [-3.0, 1.0], [-3.0, 1.0]),
        ([1.0, 0.0], [1.0, 3.0], [0.0, 0.0]),
    ]:
        found = noise.descent(problem, np.array(point), np.array(slope))
        np.testing.assert_allclose(found, expected, atol=1e-12, err_msg=str(point))


def test_the_seed_of_a_search_chooses_its_screening():
    own, samples = np.array([0.5, 0.5, 0.5]), []
    for seed in (0, 1):
        search = searching(screening=6, seed=seed)
        points = search.stage.sample(search.problem, own, search.settings)
        np.testing.assert_array_equal(points, [own, *sobol(6, seed, 3)])
        samples.append(points[1:])
    assert not np.any(np.equal(*samples))


# A search with noise: candidates, and verification by ensembles of other motions


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
