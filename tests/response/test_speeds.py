"""One design at several speeds: evaluator, objective, optimiser, sweep."""

import json
from unittest import mock

import numpy as np
import pytest

from rootsopt.commands.console import main
from rootsopt.config import load, parse
from rootsopt.optimize.problem import Problem
from rootsopt.response import reducers
from rootsopt.response.attractors import Coexisting
from rootsopt.response.evaluation import Evaluator
from rootsopt.response.reducers import overall
from rootsopt.response.result import Part
from rootsopt.status import Status
from tests.standins import evaluation_of, programs, refusal

CIC = "configs/cic_drawn.yaml"
SPEEDS = "objective.speeds_rpm=[4000, 2000]"
WEIGHTS = "objective.speed_weights=[3, 1]"
WORST = "objective.over_speeds=worst"
TIGHT = "solver.rtol=1e-10"
POINT = np.array([0.2, 0.3, 0.4])


def config_of(*overrides, file=CIC):
    return load(file, overrides)


@pytest.fixture(scope="module")
def baseline():
    """Return an evaluator over two speeds, with 3000 rpm besides, its own evaluation, and the
    problem."""
    evaluator = Evaluator.of_objective(config_of(SPEEDS, WEIGHTS, TIGHT))
    found = evaluator(series=False)
    return evaluator, found, Problem.of(evaluator.config, evaluator.scene, found)


@pytest.fixture(scope="module")
def singles(baseline):
    """Return the baseline and another design at 2000 and 4000 rpm.

    Each is evaluated by an evaluator of one speed."""
    before, found = programs(), {}
    for speed in (2000.0, 4000.0):
        evaluator = Evaluator.of(config_of(TIGHT, f"scene.speed_rpm={speed}"))
        designs = None, baseline[2].design(POINT)
        found[speed] = [evaluator(design, series=False) for design in designs]
    # A speed is a number of the model: no other program, over several or at one.
    assert programs() == before
    return found


@pytest.fixture(scope="module")
def moved(baseline):
    evaluator, found, problem = baseline
    return evaluator(problem.design(POINT), start=found.start, series=False)


def relative(one, base):
    """Return the config's objective, computed by hand: half the mean force, half the peak."""
    keys = "mean_force_N", "peak_force_N"
    return sum(0.5 * one.response[key] / base.response[key] for key in keys)


def test_parts_are_the_evaluations_at_one_speed(baseline, singles):
    """Each speed, started from rest, equals the result of an evaluator of that speed.

    The scene's own speed comes first in the record, without a share."""
    evaluator, found, _ = baseline
    assert [(part.speed_rpm, part.share) for part in found.speeds] == [
        (2000, 0.25),
        (3000, 0),
        (4000, 0.75),
    ]
    alone = {speed: single for speed, (single, _) in singles.items()} | {3000: found}
    for part in found.speeds:
        single = alone[part.speed_rpm]
        assert part.evaluation.response == single.response
        assert part.evaluation.gradient == single.gradient != {}
    # The evaluator is left at the scene's speed.
    assert float(evaluator.scene.speed) == pytest.approx(100 * np.pi)
    rows = [
        [row["speed_rpm"], row["status"], row["peak_force_N"]] for row in found.record()["speeds"]
    ]
    assert rows == [
        [speed, "periodic", alone[speed].response["peak_force_N"]] for speed in (2000, 3000, 4000)
    ]


def test_objective_is_the_weighted_mean_or_the_worst(baseline, singles, moved):
    evaluator, base, problem = baseline
    values = [relative(*pair[::-1]) for pair in singles.values()]
    assert values[0] != pytest.approx(values[1], rel=1e-3)
    # Begun from the baseline's orbit, not at rest: the same to the tolerance of the orbit.
    assert problem.objective(moved) == pytest.approx(np.dot([0.25, 0.75], values), rel=1e-7)
    worst = Problem.of(config_of(SPEEDS, WORST), evaluator.scene, base)
    assert worst.objective(moved) == pytest.approx(max(values), rel=1e-7)
    assert [one.objective(base) for one in (problem, worst)] == pytest.approx([1, 1], abs=1e-14)
    rows = (row for row in problem.by_speed(moved) if row["share"])
    assert [row["objective"] for row in rows] == pytest.approx(values, rel=1e-7)


def test_slope_agrees_with_central_differences(baseline, moved):
    """Weighted mean and worst speed have the slopes of differences.

    They are taken along one direction of the unit box."""
    evaluator, base, problem = baseline
    # Differences of second order: 1e-4 leaves some 1e-6 of curvature and 1e-6 of tolerance.
    direction, step = np.array([0.6, -0.5, 0.4]), 1e-4
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


def test_each_speed_begins_on_its_own_orbit(baseline, moved):
    evaluator, found, _ = baseline
    with mock.patch.object(
        Evaluator, "reached", autospec=True, side_effect=Evaluator.reached
    ) as spy:
        again = evaluator(start=found.start, series=False)
    asked = [call.args[2] for call in spy.call_args_list]
    for start, new, old in zip(asked, again.speeds, found.speeds, strict=True):
        assert start is old.evaluation.start
        periods = [part.evaluation.statistics["transient_mesh_periods"] for part in (new, old)]
        assert periods[0] <= periods[1]


def test_motions_that_coexist_at_every_speed():
    """`objective.motion: worst` over speeds uses the attractors at each speed.

    Their forces are relative to the baseline's at that speed."""
    small = "attractors.relatives=1", "attractors.rates=1", "objective.motion=worst"
    evaluator = Evaluator.of_objective(config_of(SPEEDS, *small))
    assert (evaluator.motions, evaluator.single) == (Coexisting(), False)
    found = evaluator(series=False)
    assert found.status is Status.PERIODIC
    assert [len(p.evaluation.steady_state["attractors"]) for p in found.speeds] == [1, 1, 1]
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
    message = refusal(config_of, *overrides)
    assert [word for word in words if word not in message] == []


def test_speeds_of_a_config():
    """A config says which speeds are simulated and which count; so does the resolved config.

    Those of several speeds are checked with their evaluations."""
    config = config_of(SPEEDS, WEIGHTS)
    assert reducers.shares(reducers.alone(config)) == {3000: 1}
    assert reducers.shares(config_of("objective.speeds_rpm=[3000]")) == {3000: 1}
    assert parse(config.to_yaml()) == config


def run(command, folder, *overrides, options=()):
    sets = (f"--set={key}" for key in overrides)
    return main([command, CIC, "-o", str(folder), *sets, *options])


def test_optimize_over_speeds(tmp_path, capsys):
    short = ["optimizer.screening=0", "optimizer.starts=1", "optimizer.iterations=2",
             "assumptions.scenes=0"]  # fmt: skip
    assert run("optimize", tmp_path, SPEEDS, WEIGHTS, *short) == 0
    assert "Contact force over speed" in capsys.readouterr().out
    result = json.loads((tmp_path / "result.json").read_text())
    tables = {name: result[name]["speeds"] for name in ("baseline", "optimized")}
    by_hand = 0.0
    for before, after in zip(*tables.values(), strict=True):
        ratios = [after[k] / before[k] for k in ("mean_force_N", "peak_force_N")]
        by_hand += before["share"] * np.mean(ratios)
    assert by_hand < 1
    assert result["improvement"]["objective"] == pytest.approx(1 - by_hand, rel=1e-9)
    assert result["optimized"]["response"]["mean_force_N"] == tables["optimized"][1]["mean_force_N"]
    assert [row["speed_rpm"] for row in result["objective_by_speed"]] == [2000, 3000, 4000]
    assert (tmp_path / "figures" / "speeds.png").exists()


def test_simulate_stays_at_the_scene(tmp_path, baseline):
    assert run("simulate", tmp_path, SPEEDS, TIGHT, options=["--no-figures"]) == 0
    record = json.loads((tmp_path / "result.json").read_text())
    assert "speeds" not in record
    assert record["response"]["mean_force_N"] == baseline[1].response["mean_force_N"]


@pytest.mark.parametrize("failing", [2000.0, 3000.0, 4000.0])
def test_every_speed_simulated_counts_in_the_status(monkeypatch, failing):
    """A failure at the scene's own 3000 rpm fails the result.

    That speed has no share in the objective."""

    def single(self, design, start, series):
        here = float(self.scene.speed) * 60 / (2 * np.pi)
        lost = abs(here - failing) < 1e-6
        return evaluation_of(here, Status.PASSED_THROUGH if lost else Status.PERIODIC)

    monkeypatch.setattr(Evaluator, "reached", single)
    found = Evaluator.of_objective(config_of(SPEEDS))()
    assert [part.share for part in found.speeds] == [0.5, 0.0, 0.5]
    assert (found.status, found.usable, found.start) == (Status.PASSED_THROUGH, False, None)
    assert found.message.startswith(f"At {failing:g} rpm: ")
    assert found.statistics["seconds"] == 3
    parts = [part._replace(evaluation=evaluation_of()) for part in found.speeds]
    chaotic = Part({"speed_rpm": 1.0}, evaluation_of(status=Status.CHAOTIC))
    statuses = overall(parts)[0], overall([chaotic, *parts])[0]
    assert statuses == (Status.PERIODIC, Status.CHAOTIC)
