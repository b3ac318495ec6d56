"""One design at several speeds: evaluator, objective, optimiser, sweep."""

import json

import numpy as np
import pytest

from rootsopt.commands.console import main
from rootsopt.config import load, parse
from rootsopt.errors import InputError
from rootsopt.optimize.problem import Problem
from rootsopt.response import reducers
from rootsopt.response.attractors import Coexisting
from rootsopt.response.evaluation import Evaluator
from rootsopt.response.reducers import overall
from rootsopt.response.result import Part
from rootsopt.status import Status
from tests.standins import evaluation_of, programs

CIC = "configs/cic_drawn.yaml"
SPEEDS = "objective.speeds_rpm=[4000, 2000]"
WEIGHTS = "objective.speed_weights=[3, 1]"
WORST = "objective.over_speeds=worst"
TIGHT = "solver.rtol=1e-10"
POINT = np.array([0.2, 0.3, 0.4])


def config_of(*overrides):
    return load(CIC, overrides)


@pytest.fixture(scope="module")
def baseline():
    """Return an evaluator over two speeds, with 3000 rpm besides, and its own evaluation."""
    evaluator = Evaluator.of_objective(config_of(SPEEDS, WEIGHTS, TIGHT))
    return evaluator, evaluator(series=False)


@pytest.fixture(scope="module")
def problem(baseline):
    evaluator, evaluation = baseline
    return Problem.of(evaluator.config, evaluator.scene, evaluation)


@pytest.fixture(scope="module")
def singles(baseline, problem):
    """Return the baseline and another design at 2000 and 4000 rpm.

    Each is evaluated by an evaluator of one speed."""
    before = programs()
    design = problem.design(POINT)
    found = {}
    for speed in (2000.0, 4000.0):
        evaluator = Evaluator.of(config_of(TIGHT, f"scene.speed_rpm={speed}"))
        found[speed] = evaluator(series=False), evaluator(design, series=False)
    # A speed is a number of the model: no other program, over several or at one.
    assert programs() == before
    return found


@pytest.fixture(scope="module")
def moved(baseline, problem):
    return baseline[0](problem.design(POINT), start=baseline[1].start, series=False)


def relative(one, base):
    """Return the config's objective, computed by hand: half the mean force, half the peak."""
    keys = "mean_force_N", "peak_force_N"
    return sum(0.5 * one.response[key] / base.response[key] for key in keys)


def test_parts_are_the_evaluations_at_one_speed(baseline, singles):
    """Each speed, started from rest, equals the result of an evaluator of that speed.

    The scene's own speed comes first in the record, without a share."""
    evaluator, found = baseline
    assert [part.speed_rpm for part in found.speeds] == [2000, 3000, 4000]
    assert [part.share for part in found.speeds] == [0.25, 0, 0.75]
    for part in (found.speeds[0], found.speeds[2]):
        single, _ = singles[part.speed_rpm]
        assert part.evaluation.response == single.response
        assert part.evaluation.gradient == single.gradient
    assert found.response == found.speeds[1].evaluation.response
    assert found.gradient == found.speeds[1].evaluation.gradient != {}
    # The evaluator is left at the scene's speed.
    assert float(evaluator.scene.speed) == pytest.approx(100 * np.pi)
    rows = found.record()["speeds"]
    assert [row["speed_rpm"] for row in rows] == [2000, 3000, 4000]
    assert {row["status"] for row in rows} == {"periodic"}
    assert rows[2]["peak_force_N"] == singles[4000.0][0].response["peak_force_N"]


def test_objective_is_the_weighted_mean_or_the_worst(baseline, problem, singles, moved):
    """The objective equals combinations of single-speed evaluations."""
    values = [relative(*pair[::-1]) for pair in singles.values()]
    assert values[0] != pytest.approx(values[1], rel=1e-3)
    # Begun from the baseline's orbit, not at rest: the same to the tolerance of the orbit.
    assert problem.objective(moved) == pytest.approx(np.dot([0.25, 0.75], values), rel=1e-7)
    worst = Problem.of(config_of(SPEEDS, WORST), baseline[0].scene, baseline[1])
    assert worst.objective(moved) == pytest.approx(max(values), rel=1e-7)
    for one in (problem, worst):
        assert one.objective(baseline[1]) == pytest.approx(1, abs=1e-14)
    found = [row["objective"] for row in problem.by_speed(moved) if row["share"]]
    assert found == pytest.approx(values, rel=1e-7)


def test_slope_agrees_with_central_differences(baseline, problem, moved):
    """Weighted mean and worst speed have the slopes of differences.

    They are taken along one direction of the unit box."""
    evaluator, base = baseline
    direction = np.array([0.6, -0.5, 0.4])
    # Differences of second order: 1e-4 leaves some 1e-6 of curvature and 1e-6 of tolerance.
    step = 1e-4
    ends = [
        evaluator(problem.design(POINT + sign * step * direction), moved.start, series=False)
        for sign in (1, -1)
    ]
    worst = Problem.of(config_of(SPEEDS, WORST), evaluator.scene, base)
    slopes = []
    for one in (problem, worst):
        upper, lower = map(one.objective, ends)
        slopes.append(float(one.slope(moved, POINT) @ direction))
        assert slopes[-1] == pytest.approx((upper - lower) / (2 * step), rel=1e-4)
    assert slopes[0] != pytest.approx(slopes[1], rel=1e-2)


def test_each_speed_begins_on_its_own_orbit(baseline, moved, monkeypatch):
    """The state of an evaluation starts each speed on that speed's own motion."""
    evaluator, found = baseline
    seen = []
    single = Evaluator.reached

    def spy(self, design, start, series):
        seen.append(start)
        return single(self, design, start, series)

    monkeypatch.setattr(Evaluator, "reached", spy)
    again = evaluator(start=found.start, series=False)
    for start, part in zip(seen, found.speeds, strict=True):
        assert start is part.evaluation.start
    for new, old in zip(again.speeds, found.speeds, strict=True):
        periods = [part.evaluation.statistics["transient_mesh_periods"] for part in (new, old)]
        assert periods[0] <= periods[1]


def test_motions_that_coexist_at_every_speed():
    """`objective.motion: worst` over speeds uses the attractors at each speed.

    Their forces are relative to the baseline's at that speed."""
    small = "attractors.relatives=1", "attractors.rates=1", "objective.motion=worst"
    evaluator = Evaluator.of_objective(config_of(SPEEDS, *small))
    assert evaluator.motions == Coexisting()
    assert not evaluator.single
    found = evaluator(series=False)
    assert found.status is Status.PERIODIC
    for part in found.speeds:
        assert len(part.evaluation.steady_state["attractors"]) == 1
    again = evaluator.relative_to(found)(start=found.start, series=False)
    assert again.response["peak_force_N"] == pytest.approx(found.response["peak_force_N"], rel=1e-7)


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["objective.speeds_rpm=[2000, 2000]"], ["objective.speeds_rpm", "different"]),
        ([f"objective.speeds_rpm={list(range(1, 34))}"], ["objective.speeds_rpm", "32"]),
        (["objective.speeds_rpm=[2000, 0]"], ["objective.speeds_rpm.1", "greater than 0"]),
        (["objective.speeds_rpm=2000"], ["objective.speeds_rpm", "list"]),
        ([SPEEDS, "objective.speed_weights=[1]"], ["objective.speed_weights", "2 numbers"]),
        ([SPEEDS, "objective.speed_weights=[1, 0]"], ["speed_weights.1", "greater than 0"]),
        ([WEIGHTS], ["objective.speed_weights", "objective.speeds_rpm"]),
        ([WORST], ["objective.over_speeds", "objective.speeds_rpm"]),
        ([SPEEDS, WEIGHTS, WORST], ["objective.speed_weights", "worst"]),
        ([SPEEDS, "objective.motion=ensemble"], ["objective.speeds_rpm", "ensemble"]),
        ([SPEEDS, "objective.over_speeds=best"], ["objective.over_speeds", "worst"]),
        (["sweep.speed_rpm={from: 1, to: 2, points: 3}"], ["sweep.speed_rpm", "--over"]),
    ],
)
def test_refusals_name_the_key(overrides, words):
    with pytest.raises(InputError) as caught:
        config_of(*overrides)
    message = str(caught.value)
    assert "\n" not in message
    for word in words:
        assert word in message


def test_speeds_of_a_config():
    """A config says which speeds are simulated and which count; so does the resolved config."""
    config = config_of(SPEEDS, WEIGHTS)
    assert reducers.shares(config) == {2000: 0.25, 3000: 0, 4000: 0.75}
    assert reducers.shares(reducers.alone(config)) == {3000: 1}
    assert reducers.shares(config_of("objective.speeds_rpm=[3000]")) == {3000: 1}
    assert parse(config.to_yaml()) == config


def run(command, folder, *overrides, options=()):
    arguments = [f"--set={key}" for key in overrides]
    return main([command, CIC, "-o", str(folder), *arguments, *options])


def test_optimize_over_speeds(tmp_path, capsys):
    """A short run improves over the speeds.

    Table, records and picture have each speed."""
    short = ["optimizer.screening=0", "optimizer.starts=1", "optimizer.iterations=2"]
    short += ["assumptions.scenes=0"]
    assert run("optimize", tmp_path, SPEEDS, WEIGHTS, *short) == 0
    assert "Contact force over speed" in capsys.readouterr().out
    result = json.loads((tmp_path / "result.json").read_text())
    tables = {name: result[name]["speeds"] for name in ("baseline", "optimized")}
    by_hand = 0.0
    for before, after in zip(*tables.values(), strict=True):
        shares = [0.5 * after[k] / before[k] for k in ("mean_force_N", "peak_force_N")]
        by_hand += before["share"] * sum(shares)
    assert by_hand < 1
    assert result["improvement"]["objective"] == pytest.approx(1 - by_hand, rel=1e-9)
    assert result["optimized"]["response"]["mean_force_N"] == tables["optimized"][1]["mean_force_N"]
    assert [row["speed_rpm"] for row in result["objective_by_speed"]] == [2000, 3000, 4000]
    assert (tmp_path / "figures" / "speeds.png").exists()


def test_simulate_stays_at_the_scene(tmp_path, baseline):
    """`simulate` uses the scene's own speed, whatever the objective."""
    assert run("simulate", tmp_path, SPEEDS, TIGHT, options=["--no-figures"]) == 0
    record = json.loads((tmp_path / "result.json").read_text())
    assert "speeds" not in record
    assert record["response"]["mean_force_N"] == baseline[1].response["mean_force_N"]


@pytest.mark.parametrize("failing", [2000.0, 3000.0, 4000.0])
def test_every_speed_simulated_counts_in_the_status(monkeypatch, failing):
    """A failure at the scene's own 3000 rpm fails the result.

    That speed has no share in the objective."""
    config = load("configs/cic_drawn.yaml", ["objective.speeds_rpm=[4000, 2000]"])
    evaluator = Evaluator.of_objective(config)

    def single(self, design, start, series):
        here = float(self.scene.speed) * 60 / (2 * np.pi)
        lost = abs(here - failing) < 1e-6
        return evaluation_of(here, Status.PASSED_THROUGH if lost else Status.PERIODIC)

    monkeypatch.setattr(Evaluator, "reached", single)
    found = evaluator()
    assert [part.share for part in found.speeds] == [0.5, 0.0, 0.5]
    assert found.status is Status.PASSED_THROUGH
    assert not found.usable
    assert found.start is None
    assert found.message.startswith(f"At {failing:g} rpm: ")
    assert found.statistics["seconds"] == 3
    parts = [part._replace(evaluation=evaluation_of()) for part in found.speeds]
    assert overall(parts)[0] is Status.PERIODIC
    wrong = [Part({"speed_rpm": 1.0}, evaluation_of(status=Status.CHAOTIC)), *parts]
    assert overall(wrong)[0] is Status.CHAOTIC
