"""Limits of any quantity: as constraints of the design space, and as caps of the search."""

import dataclasses
import threading
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

from rootsopt.config.units import words
from rootsopt.dynamics.maxima import Maxima
from rootsopt.errors import InputError
from rootsopt.optimize.infeasible import Infeasible, explain
from rootsopt.optimize.limits import TermConstraint, constraint_rows, limited
from rootsopt.optimize.local import Certificate, Linearization
from rootsopt.optimize.problem import Problem
from rootsopt.optimize.search import Search
from rootsopt.profiles import geometry
from rootsopt.pump import flow
from rootsopt.response.records import geometry_record
from rootsopt.response.result import Part
from rootsopt.scene import Scene
from rootsopt.scene.space import RangeConstraint
from rootsopt.status import Status
from tests.optimize.test_optimize import baseline, config, problem_of
from tests.standins import registered

PEAK = "constraints.terms.peak_force_N.max="
LIMITED = (
    "constraints.terms.displaced_volume_cm3.min=400",
    "constraints.terms.width.max=452",
    "constraints.terms.ratio.max=3",
)


def drawn(*overrides):
    """Return a config with limits, its scene, the own design's volume (cm³) and evaluation."""
    settings = limited(config(*overrides))
    scene = Scene.from_config(settings)
    shape = geometry(scene.profile(jnp.asarray(settings.design)))
    volume = 1e6 * float(flow.displaced_volume(shape, scene.length))
    terms = {"area_efficiency": float(shape.area_efficiency), "displaced_volume_cm3": volume}
    one = dataclasses.replace(evaluation(), geometry=geometry_record(scene, shape))
    return settings, scene, volume, dataclasses.replace(one, response=one.response | terms)


def evaluation(mean=50.0, peak=200.0, maxima=None):
    """An evaluation with made-up forces and slopes, by which the limits are judged."""
    slope = {"pressure_angle_deg": 1.0, "involute_length_mm": 2.0, "tip_arc_angle_deg": -1.0}
    return dataclasses.replace(
        baseline(config()),
        response={"mean_force_N": mean, "peak_force_N": peak, "rms_force_N": 80.0},
        gradient=dict.fromkeys(("mean_force_N", "peak_force_N", "rms_force_N"), slope),
        steady_state={"period": 2},
        maxima=maxima,
    )


OUTSIDE = {
    "width": lambda profile, shape, forces: 1e4 * shape.outer_radius,
    "ratio": lambda profile, shape, forces: forces.peak / forces.mean,
}
"""Terms from outside: ten times the outer radius (mm), and peak over mean force. One program serves
all tests."""


@registered(**OUTSIDE)
def test_terms_without_forces_are_constraints_of_the_geometry():
    """Their slacks are those of the formulas, and projection moves designs onto them."""
    problem = problem_of(*LIMITED)
    assert [one.key for one in problem.limits] == ["ratio"]
    assert [
        (c.name, c.unit, c.ceiling)
        for c in problem.space.constraints
        if isinstance(c, TermConstraint)
    ] == [("displaced volume", "cm³", False), ("width", "", True)]
    point, scene = np.array([0.3, 0.6, 0.4]), problem.space.scene
    shape = geometry(scene.profile(problem.design(point)))
    volume = 1e6 * float(flow.displaced_volume(shape, scene.length))
    expected = [(volume - 400) / 400, (452 - 1e4 * float(shape.outer_radius)) / 452]
    np.testing.assert_allclose(problem.look(point)[2][-2:], expected, rtol=1e-9)
    beyond = np.array([0.1, 0.9, 0.2])
    assert [problem.feasible(one) for one in (beyond, problem.project(beyond))] == [False, True]


@registered(**OUTSIDE)
def test_prices_are_per_unit_of_the_limits():
    """A multiplier of a scaled slack, (V - 400) / 400 or 1 - F / 150, becomes a price per unit.

    A limit is relaxed by 1 % of it, to the nearest power of ten."""
    problem = problem_of(*LIMITED, "constraints.terms.mean_force_N.max=150")
    values = {"displaced_volume_cm3": 450.0, "width": 440.0, "ratio": 2.0}
    base, found = (
        dataclasses.replace(
            one, response=one.response | values,
            geometry=one.geometry | {"undercut_margin_mm": 5.0, "seal_width_mm": 5.0},
        )
        for one in (problem.baseline, evaluation(40.0, 160.0))
    )  # fmt: skip
    problem = dataclasses.replace(problem, baseline=base)
    caps = np.zeros(1), np.array([0.25, 0.5])
    proof = Certificate(
        0.0, 0.0, np.full(len(problem.space.constraints), 2.0), np.zeros(3), np.zeros(3), (), caps
    )
    rows = {row["name"]: row for row in constraint_rows(problem, found, proof)}
    # The objective, 0.8, rises with the least volume and falls with the greatest force.
    keys = "multiplier", "relaxed_by", "relaxed_objective_percent"
    for name, price, change in (
        ("displaced volume", 2 / 400, -10.0),
        ("mean force", -0.75 / 150, 1.0),
    ):
        assert [rows[name][key] for key in keys] == pytest.approx(
            [price, change, 100 * price * change / 0.8]
        )


def test_forces_are_limited_at_every_speed_that_counts():
    """One branch per speed and local maximum, with scaled slopes; the worst one is the excess."""
    problem = problem_of(PEAK + "180", "constraints.terms.mean_force_N.min=40")
    peaks = Maxima(np.array([0.5, 1.5]), np.array([190.0, 200.0]), np.ones((2, 3)))
    slow, fast, unused = evaluation(60.0, 200.0, peaks), evaluation(30.0, 150.0), evaluation(1.0)
    shares = (2000.0, slow, 0.5), (3000.0, fast, 0.5), (4000.0, unused, 0.0)
    parts = tuple(Part({"speed_rpm": rpm}, one, share) for rpm, one, share in shares)
    whole = dataclasses.replace(slow, speeds=parts)
    high, low = problem.caps(whole, np.diag([1.0, 2.0, 3.0]))
    np.testing.assert_allclose(high.values, np.array([10, 20, -30]) / 180)
    np.testing.assert_allclose(high.tags, [[0, 0.25], [0, 0.75], [1, 0]])
    np.testing.assert_allclose(high.slopes[0], np.array([1.0, 2.0, 3.0]) / 180)
    np.testing.assert_allclose(low.values, np.array([-20, 10]) / 40)
    np.testing.assert_allclose(low.slopes[1], -np.array([1.0, 4.0, -3.0]) / 40)
    assert problem.excess(whole) == pytest.approx(0.25)
    assert [problem.worst(whole, one) for one in problem.limits] == [200.0, 30.0]
    assert problem.broken(whole) == ["peak force", "mean force"]
    assert problem.broken(evaluation(45.0, 170.0)) == []
    free = problem_of()
    assert (free.excess(whole), free.limits) == (0.0, ())
    assert not [one for one in free.space.constraints if isinstance(one, TermConstraint)]


@pytest.mark.parametrize(
    ("keys", "names"),
    [
        (
            [
                "area_efficiency_min=0.48", "undercut_margin_min_mm=30", "seal_width_min_mm=7",
                "outer_radius_max_mm=44", "terms.displaced_volume_cm3.min=900",
            ],
            {"area efficiency", "undercut margin", "seal width", "outer radius",
             "displaced volume"},
        ),
        (["terms.area_efficiency.min=0.48", "outer_radius_min_mm=47"],
         {"area efficiency", "outer radius"}),
    ],
)  # fmt: skip
def test_the_baseline_breaks_limits_of_any_key(keys, names):
    settings, scene, _, one = drawn(*(f"constraints.{key}" for key in keys))
    problem = Problem.of(settings, scene, one)
    assert sorted(problem.broken(one)) == sorted(names)
    assert {
        row["name"] for row in constraint_rows(problem, one) if row["baseline_satisfied"] is False
    } == names


def test_every_limit_can_be_the_baselines_own_value():
    """The baseline meets each of them exactly; the worst of several speeds counts."""
    limits = (
        "area_efficiency_min", "undercut_margin_min_mm", "seal_width_min_mm",
        "outer_radius_max_mm", "terms.peak_force_N.max", "terms.displaced_volume_cm3.min",
    )  # fmt: skip
    settings, scene, volume, one = drawn(*(f"constraints.{key}=baseline" for key in limits))
    slow, fast = (
        dataclasses.replace(one, response=one.response | {"peak_force_N": peak})
        for peak in (150.0, 180.0)
    )
    speeds = tuple(Part({"speed_rpm": rpm}, e, 0.5) for rpm, e in ((2e3, slow), (3e3, fast)))
    whole = dataclasses.replace(slow, speeds=speeds)
    problem = Problem.of(settings, scene, whole)
    assert problem.broken(whole) == []
    rows = {row["name"]: row for row in constraint_rows(problem, whole)}
    assert rows["peak force"]["limit"] == 180.0
    assert rows["displaced volume"]["limit"] == pytest.approx(volume, rel=1e-12)
    for key in ("area_efficiency", "undercut_margin_mm", "seal_width_mm", "outer_radius_mm"):
        row = rows[words(key)]
        assert row["limit"] == pytest.approx(one.geometry[key], rel=1e-12)
        assert row["active"]


def test_a_baseline_of_another_family_breaks_no_limit_of_parameters_that_it_lacks():
    settings, scene, _, own = drawn("optimizer.bounds.involute_length_mm=[1, 8]")
    one = dataclasses.replace(own, design={"arc_center_mm": 29.0})
    problem = Problem.of(settings, scene, one)
    assert any(isinstance(row, RangeConstraint) for row in problem.space.constraints)
    assert problem.broken(one) == []


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["constraints.terms.peak_force.max=1"], r"constraints\.terms.*peak_force"),
        (["constraints.terms.mean_force_N={}"], "min.*max"),
        (["constraints.terms.mean_force_N={min: 3, max: 2}"], "greater than"),
        (["constraints.terms.mean_force_N={min: baseline, max: baseline}"], "both baseline"),
        (
            [
                "constraints.outer_radius_min_mm=baseline",
                "constraints.outer_radius_max_mm=baseline",
            ],
            "both be baseline",
        ),
        (
            ["constraints.outer_radius_min_mm=44.5", "constraints.outer_radius_max_mm=44.2"],
            "outer_radius_max_mm` must be greater",
        ),
        (["constraints.terms.line_02_force_N.max=1"], "line_ORDER"),
        ([PEAK + "1", "objective.motion=ensemble"], "ensemble"),
        (["constraints.terms.mean_force_N.most=3"], "most"),
        (["constraints.terms.mean_force_N.max=.nan"], "constraints"),
        # A term to be maximised belongs in a limit or in a front.
        (["objective.terms.area_efficiency=1"], "area_efficiency.*constraints.*pareto"),
    ],
)
def test_refused_limits(overrides, words):
    with pytest.raises(InputError, match=words):
        problem_of(*overrides)


def test_limits_of_forces_in_conflict_are_explained():
    """A mean force 200 - 100 x that must be at most 130 N, and a peak 100 + 100 x of at most 150 N.
    By hand, the least violation lies where both are exceeded by the same share."""
    problem = problem_of(PEAK + "150", "constraints.terms.mean_force_N.max=130")

    def look(point):
        share = point[0]
        found = evaluation(100 * (2 - share), 100 * (1 + share))
        caps = (
            cap._replace(slopes=np.array([[row, 0.0, 0.0]]) / limit.scale)
            for cap, limit, row in zip(problem.caps(found, np.eye(3)), problem.limits,
                                        (100.0, -100.0), strict=True)
        )  # fmt: skip
        return Linearization(0.0, np.zeros(3), (), *problem.look(point)[2:], tuple(caps))

    found = explain(problem, [problem.project(np.full(3, 0.5))], look)
    # 130 (1 + v) + 150 (1 + v) = 300, whatever the share.
    assert found.violation == pytest.approx(300 / 280 - 1, rel=1e-5)
    assert found.design["pressure_angle_deg"] > 0
    exceeded = 1 + found.violation
    assert {one.name: [one.together, one.alone] for one in found.conflicts} == {
        "peak force": [pytest.approx(150 * exceeded, rel=1e-6), pytest.approx(170, rel=1e-5)],
        "mean force": [pytest.approx(130 * exceeded, rel=1e-6), pytest.approx(150, rel=1e-5)],
    }
    assert "peak force <= 150 N (possible with the others: 170 N)" in found.message


@pytest.mark.parametrize(("violation", "searches"), [(0.0, [7]), (0.1, [])])
def test_a_design_that_meets_all_limits_after_all_is_searched_from(
    violation, searches, monkeypatch
):
    problem, begins = problem_of(PEAK + "150"), np.array([0.25, 0.5, 0.75])
    reason = Infeasible(violation, (), problem.named(begins), True)
    monkeypatch.setattr("rootsopt.optimize.search.explain", lambda *_: reason)
    asked = []
    search = SimpleNamespace(
        stop=threading.Event(), problem=problem, sharp=print, _descents={}, _solve=None,
        _side_by_side=lambda work, tasks: asked.extend(tasks) or [],
    )  # fmt: skip
    assert Search._unmet(search, [], 7) == ([], reason)
    assert [number for number, _ in asked] == searches
    assert all(point == pytest.approx(begins, abs=1e-9) for _, point in asked)


@pytest.mark.long
def test_prices_of_limits_by_solving_again():
    """The mean force under a ceiling of the peak: met, certified, and its multiplier is the slope
    of the optimum between two limits (trapezoidal rule)."""
    few = "optimizer.screening=4", "optimizer.starts=1", "objective.peak_weight=0"
    free = Search(config(*few)).run()
    top = free.optimized.response["peak_force_N"]

    def at(ceiling):
        found = Search(config(*few, f"{PEAK}{ceiling}")).run()
        assert found.status is Status.PERIODIC
        (row,) = [row for row in found.constraints if row["name"] == "peak force"]
        assert (row["optimized"], row["unit"]) == (pytest.approx(ceiling, rel=1e-5), "N")
        return found.problem.objective(found.optimized), row["multiplier"]

    (low, first), (high, second) = at(0.97 * top), at(0.972 * top)
    assert free.problem.objective(free.optimized) < high < low
    assert (high - low) / (0.002 * top) == pytest.approx((first + second) / 2, rel=0.02)
