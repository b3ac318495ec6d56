"""Tests of robust optima: objective over many scenes, its gradient, both stages of the search."""

import json

import numpy as np
import pandas
import pytest

from rootsopt.commands.console import main
from rootsopt.config import load
from rootsopt.optimize.design import search_of
from rootsopt.optimize.local import Group, Linearization, certify
from rootsopt.optimize.problem import Problem
from rootsopt.optimize.robust import COMPARED, Scattered, compare, without
from rootsopt.optimize.robust_problem import RobustProblem
from rootsopt.optimize.search import Search
from rootsopt.optimize.sqp import descend
from rootsopt.response.evaluation import Evaluator
from rootsopt.response.reducers import over_scenes
from rootsopt.response.result import Part
from rootsopt.response.scatter import draw, shifts
from rootsopt.scene.resemblance import Likeness
from tests.response.test_speeds import relative
from tests.standins import evaluation_of, refusal

CIC = "configs/cic_drawn.yaml"
PLAY = "contact.clearance_mm=0.01"
CLEARANCE = "tolerances.over.contact.clearance_mm.normal=0.002"
LOAD = "tolerances.over.scene.load.torque_N_m.relative_normal=0.05"
TIP = "tolerances.over.profile.tip_arc_angle_deg.normal=0.02"
POINT, DIRECTION = np.array([0.2, 0.3, 0.4]), np.array([0.6, -0.5, 0.4])
STEP = 1e-4
"""Differences are of second order: this leaves some 1e-6 of curvature and 1e-6 of tolerance."""
RULES = {
    "mean": (),
    "quantile": ("tolerances.combine=quantile",),
    "worst": ("tolerances.combine=worst",),
}


def config_of(*overrides):
    return load(CIC, (PLAY, CLEARANCE, *overrides))


def problem_of(evaluator, baseline, *overrides):
    return RobustProblem.of(config_of(LOAD, TIP, *overrides), evaluator.scene, baseline)


@pytest.fixture(scope="module")
def spread():
    """Return an evaluator over four scenes with all maxima, the baseline, and another design."""
    config = config_of(LOAD, TIP, "solver.rtol=1e-10", "tolerances.samples=4")
    evaluator = Evaluator.of(config).scattered().with_maxima()
    baseline = evaluator(series=False)
    design = problem_of(evaluator, baseline).design(POINT)
    return evaluator, baseline, evaluator(design, baseline.start, series=False)


@pytest.fixture(scope="module")
def ends(spread):
    """Return the evaluations of the designs a step of `STEP` ahead and behind."""
    evaluator, baseline, moved = spread
    problem = problem_of(evaluator, baseline)
    points = (POINT + sign * STEP * DIRECTION for sign in (1, -1))
    return [evaluator(problem.design(one), moved.start, series=False) for one in points]


def test_objective_combines_the_scenes(spread):
    """The objective agrees with combinations by hand, and is 1 for the baseline.

    Worst ≥ mean + 0 σ."""
    evaluator, baseline, moved = spread
    rows = [
        np.array([relative(part.evaluation, baseline.nominal) for part in one.samples])
        for one in (moved, baseline)
    ]
    expected = {
        (): [np.mean(row) + 2 * np.std(row) for row in rows],
        ("tolerances.k=0",): [np.mean(row) for row in rows],
        ("tolerances.combine=worst",): [np.max(row) for row in rows],
    }
    for overrides, (after, before) in expected.items():
        problem = problem_of(evaluator, baseline, *overrides)
        assert problem.objective(moved) == pytest.approx(after / before, rel=1e-12)
        assert problem.objective(baseline) == pytest.approx(1, abs=1e-14)
        assert problem.objective(moved.nominal) == pytest.approx(
            relative(moved.nominal, baseline.nominal), rel=1e-12
        )


def test_limits_hold_in_every_scene_or_for_a_combination(spread, ends):
    """Value and gradient of a limit's cap; mean plus k standard deviations by hand."""
    evaluator, baseline, moved = spread
    limit = "constraints.terms={mean_force_N: {max: 60}, rms_force_N: {min: 70}}"
    every = problem_of(evaluator, baseline, limit)
    assert every.worst(moved, every.limits[0]) == max(
        part.evaluation.response["mean_force_N"] for part in moved.scenes
    )
    combined = problem_of(evaluator, baseline, limit, "tolerances.limits=combined")
    means, squares = (
        np.array([part.evaluation.response[key] for part in moved.samples])
        for key in ("mean_force_N", "rms_force_N")
    )
    values = np.mean(means) + 2 * np.std(means), np.mean(squares) - 2 * np.std(squares)
    caps = combined.caps(moved, combined.look(POINT)[1])
    for bound, value, cap in zip(combined.limits, values, caps, strict=True):
        assert combined.worst(moved, bound) == pytest.approx(value, rel=1e-12)
        assert cap.values == pytest.approx([bound.excess(value)], abs=1e-12)
        upper, lower = (bound.excess(combined.worst(end, bound)) for end in ends)
        assert float(cap.slopes[0] @ DIRECTION) == pytest.approx(
            (upper - lower) / (2 * STEP), rel=1e-4
        )


def test_gradient_agrees_with_central_differences(spread, ends):
    """The gradient is right along one direction of the unit box, for every rule.

    The local model has the same value, gradient and constraints."""
    evaluator, baseline, moved = spread
    slopes = []
    problems = [problem_of(evaluator, baseline, *overrides) for overrides in RULES.values()]
    # Over assumptions, each scene is relative to its own baseline, and moved by an offset.
    apart = 0.0, -0.3, 0.1, -0.1
    problems.append(RobustProblem.of(problems[-1].config, evaluator.scene, baseline, apart))
    for problem in problems:
        upper, lower = map(problem.objective, ends)
        rows = [one.slope(scene, POINT) for one, scene, _ in problem._each(moved)]
        slope = problem.combined(moved).weights @ np.array(rows) / problem.reference
        slopes.append(float(slope @ DIRECTION))
        assert slopes[-1] == pytest.approx((upper - lower) / (2 * STEP), rel=1e-4)
        local = problem.local(moved, POINT)
        # Two programs compute the peaks, from the orbit's elements and from steps along it.
        assert local.objective == pytest.approx(problem.objective(moved), rel=1e-8)
        tops = tuple(np.eye(len(g.values))[np.argmax(g.values)] for g in local.groups)
        # The slope of the highest maximum is computed apart from that of the peak.
        assert local.combined(tops) @ DIRECTION == pytest.approx(slopes[-1], rel=1e-5)
        np.testing.assert_array_equal(local.slack, problem.look(POINT)[2])
    assert len(set(np.round(slopes, 4))) == 4


def toy(monkeypatch, branches, *overrides):
    """Return a robust problem in one variable x.

    Its scenes have the objectives max over `branches` of (level + slope * (x - place)²): one list
    of (level, slope, place) per scene."""

    def local_of(number, x):
        rows = branches[number]
        values = np.array([level + slope * (x - place) ** 2 for level, slope, place in rows])
        slopes = np.array([[2 * slope * (x - place)] for _, slope, place in rows])
        tags = np.array([[0.0, k / len(rows)] for k in range(len(rows))])
        return Linearization(0.0, np.zeros(1), (Group(tags, values, slopes),), np.zeros(0),
                     np.zeros((0, 1)))  # fmt: skip

    def local(self, evaluation, point=None):
        return local_of(int(evaluation.response["mean_force_N"]), evaluation.design["x0"])

    monkeypatch.setattr(Problem, "local", local)
    monkeypatch.setattr(Problem, "objective", lambda self, one: local(self, one).objective)
    monkeypatch.setattr(Problem, "point", lambda self, design: np.asarray(design))
    problem = object.__new__(RobustProblem)
    vars(problem).update(config=config_of(*overrides), baseline=evaluation_of(), reference=1.0)

    def evaluate(x):
        return over_scenes(
            [Part({}, evaluation_of(float(k), design=[x])) for k in [0, *range(len(branches))]]
        )

    return problem, evaluate


@pytest.mark.parametrize("name", RULES)
def test_local_search_finds_the_minimum_over_scenes_with_corners(name, monkeypatch):
    """The minimum agrees with a fine grid, and the certificate there holds.

    Each scene is a maximum of two parabolas."""
    draws = np.random.default_rng(5)
    branches = [
        [(draws.uniform(0.8, 1), draws.uniform(0.5, 2), draws.uniform(0.1, 0.9)) for _ in range(2)]
        for _ in range(6)
    ]
    problem, evaluate = toy(monkeypatch, branches, *RULES[name])
    grid = np.linspace(0, 1, 801)
    values = [problem.objective(evaluate(x)) for x in grid]
    shares = np.maximum(problem.combined(evaluate(0.2)).weights, 0.0)
    found = descend(lambda x: problem.local(evaluate(float(x[0])), x, shares), np.array([0.2]))
    assert found.local.objective <= min(values) + 1e-7
    assert found.point[0] == pytest.approx(grid[np.argmin(values)], abs=2e-3)
    if name != "quantile":  # Its corners, where scenes change places, are no maxima.
        own = problem.local(evaluate(float(found.point[0])), found.point)
        assert certify(own, found.point).residual < 1e-4


def test_the_worst_scenes_hold_the_optimum(monkeypatch):
    """Of two parabolas that cross at 0.5 and one far below, the first two are active at the
    optimum."""
    problem, evaluate = toy(
        monkeypatch, [[(1, 1, 0.25)], [(1, 1, 0.75)], [(0.1, 1, 0.5)]], "tolerances.combine=worst"
    )
    found = descend(lambda x: problem.local(evaluate(float(x[0])), x), np.array([0.1]))
    assert found.reason == "converged"
    assert found.point[0] == pytest.approx(0.5, abs=1e-6)
    held = problem.held_by(evaluate(0.5), found.certificate)
    assert [one.record()["scene"] for one in held] == [0, 1]
    assert [one.share for one in held] == pytest.approx([0.5, 0.5], abs=1e-3)


def test_statistics_of_fresh_scenes():
    values = dict.fromkeys(COMPARED, np.array([1.0, 2.0, np.nan, 3.0, 4.0]))
    record = Scattered(values, {"periodic": 4, "chaotic": 1}, 2.5).record()
    assert (record["failed_share"], record["statuses"]["chaotic"]) == (0.2, 1)
    assert record["peak_force_N"] == pytest.approx(
        {
            "mean": 2.5, "worst": 4.0, "sigma": np.sqrt(1.25), "quantile_95": 3.85,
            "standard_error": np.sqrt(1.25 / 4),
        }
    )  # fmt: skip
    empty = Scattered(dict.fromkeys(COMPARED, np.full(3, np.nan)), {"chaotic": 3}, np.nan)
    assert np.isnan(empty.statistics("objective")["mean"])


def test_fresh_scenes_from_the_neighbouring_orbit(spread):
    """Forces in fresh scenes equal those found from rest; equal designs are simulated once.

    The baseline has an evaluator of its own."""
    evaluator, baseline, moved = spread
    problem = problem_of(evaluator, baseline)
    config = problem.config
    drawn = draw(config, 3, fresh=True)
    designs = dict.fromkeys(("nominal", "robust"), (evaluator, moved.nominal))
    damped = config.replaced({"scene.timing_gear.damping_ratio": 0.7})
    own = Evaluator.of(damped).scattered().with_maxima()
    found = compare(problem, {"baseline": (own, own(series=False).nominal)} | designs, drawn)
    assert found["robust"] is found["nominal"]
    assert (found["baseline"].combined, found["nominal"].statuses) == (1, {"periodic": 3})
    for shift, peak in zip(
        shifts(config, drawn), found["nominal"].values["peak_force_N"], strict=True
    ):
        alone = Evaluator.of(config.moved(shift.values))
        one = alone(problem.design(POINT) + shift.design, series=False)
        assert peak == pytest.approx(one.response["peak_force_N"], rel=1e-6)
    alone = Evaluator.of(damped.moved(shifts(damped, drawn)[0].values))(series=False)
    peak = found["baseline"].values["peak_force_N"][0]
    assert peak == pytest.approx(alone.response["peak_force_N"], rel=1e-6)


def test_a_parameter_that_the_family_of_the_search_lacks_cannot_scatter(monkeypatch):
    design = {"pressure_angle_deg": 36.0, "involute_length_mm": 6.0}
    near = Likeness("arc_involute", design, 0.0, 0.0)
    monkeypatch.setattr("rootsopt.optimize.infeasible.likeness", lambda given, family: near)
    key, found = "profile.tip_arc_angle_deg", {"optimizer.family": "arc_involute"}
    config = config_of().replaced(found | {"tolerances.over": {key: {"normal": 1e-3}}})
    assert f"must not name `{key}`" in refusal(search_of, config)


def test_without_tolerances_and_assumptions_the_search_is_the_plain_one():
    config = without(config_of("assumptions.scenes=0"))
    assert type(search_of(config)) is Search
    assert "tolerances" not in config.to_yaml()


def test_optimize_command(tmp_path, capsys, monkeypatch):
    overrides = (
        PLAY,
        "tolerances.over={contact.clearance_mm: {normal: 0.002}}",
        "tolerances.samples=2",
        "tolerances.check_samples=2",
        "assumptions.scenes=0",
        "optimizer.screening=0",
        "optimizer.starts=1",
        "optimizer.iterations=2",
        "optimizer.prove=false",
        "solver.rtol=1e-7",
    )
    asked = []
    monkeypatch.setattr("rootsopt.commands.work.optimize.touching", asked.append)
    monkeypatch.setattr("rootsopt.view.figures.runs.optimization_figures", lambda *_: None)
    assert main(["optimize", CIC, "-o", str(tmp_path), *(f"--set={one}" for one in overrides)]) == 0
    assert "Designs in 2 fresh scenes" in capsys.readouterr().out
    result = json.loads((tmp_path / "result.json").read_text())
    record = result["robustness"]
    assert set(record["fresh"]) == {"baseline", "nominal", "robust"}
    for one in (record["nominal"], result):
        assert one["optimality"]["residual"] >= 0
    assert len(result["optimized"]["samples"]) == 2
    assert [*asked[0].design] == pytest.approx([*result["optimized"]["design"].values()])
    (row,) = (r for r in result["optimality"]["sensitivities"] if "clearance" in r["quantity"])
    assert row["peak_force_N"] != 0
    assert "objective_percent" not in row
    # Simulated again from rest, the robust optimum is no worse than the nominal one.
    assert 1 - result["improvement"]["objective"] <= record["nominal"]["robust_objective"] + 1e-6
    peaks = pandas.read_csv(tmp_path / "tolerances.csv").robust_peak_force_N
    found = [record["fresh"]["robust"]["peak_force_N"][name] for name in ("mean", "worst")]
    assert found == pytest.approx([peaks.mean(), peaks.max()], rel=1e-8)
    assert (tmp_path / "figures" / "tolerances.png").read_bytes()[:4] == b"\x89PNG"
    for name in ("nominal", "optimized"):
        assert load(tmp_path / f"{name}.yaml").tolerances is not None
