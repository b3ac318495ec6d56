"""Ensembles: averages and standard errors, gradients estimated from neighbours, commands."""

import csv
import dataclasses
import itertools
import json

import jax.numpy as jnp
import numpy as np
import pytest

from rootsopt import Status, optimize
from rootsopt.config import EnsembleConfig, family_of
from rootsopt.response.ensemble import SIGNIFICANT, Ensemble, fitted_slope, independent, neighbours
from rootsopt.response.evaluation import Evaluator
from rootsopt.response.result import ERRORS, RESPONSES
from rootsopt.response.together import Members
from rootsopt.view import tables
from tests.response.test_speeds import config_of

PERIODIC = ("ensemble.members=4", "ensemble.settle_periods=48", "ensemble.periods=8")
CHAOTIC = (
    "scene.timing_gear={stiffness_N_m_per_rad: 2.0e4, damping_ratio: 0.1, backlash_mm: 0.4}",
    "scene.load.torque_N_m=1",
    "objective.motion=ensemble",
)
SMALL = ("ensemble.members=4", "ensemble.settle_periods=16", "ensemble.periods=16")
INSIDE = (30.0, 4.0, 3.0)


def averaged(*overrides, gradient=False, survey=True, design=None, start=None):
    """Evaluate an ensemble, without the Lyapunov exponent unless asked for."""
    evaluator = dataclasses.replace(
        Evaluator.of(config_of(*overrides)), motions=Ensemble(), differentiate=gradient
    )
    evaluator = evaluator.surveying() if survey else evaluator
    return evaluator(None if design is None else jnp.array(design), start, series=False)


def numbers(evaluation):
    """Return (responses, their standard errors)."""
    response, steady = evaluation.response, evaluation.steady_state
    return np.array([(response[name], steady[ERRORS[name]]) for name in RESPONSES]).T


def rows(gradient):
    return np.array([[gradient[name][key] for key in family_of("cic").keys] for name in RESPONSES])


# Where the motion is periodic


@pytest.fixture(scope="module")
def orbit():
    """Return the closed orbit of a design inside the box."""
    return Evaluator.of(config_of())(jnp.array(INSIDE), series=False)


def test_periodic_averages_are_those_of_the_orbit(orbit):
    """All members end on the one orbit: its mean, RMS and peak, with nearly no standard error."""
    evaluation = averaged(*PERIODIC, survey=False, design=INSIDE)
    steady = evaluation.steady_state
    assert evaluation.status is Status.AVERAGED
    assert (steady["kind"], steady["period"], evaluation.gradient) == ("periodic", 1, {})
    values, errors = numbers(evaluation)
    closed = np.array([orbit.response[name] for name in RESPONSES])
    np.testing.assert_allclose(values, closed, rtol=3e-5)
    assert np.all(errors < 3e-5 * closed)
    assert steady["greatest_force_N"] == pytest.approx(closed[1], rel=1e-4)
    assert abs(steady["mean_force_drift_N"]) < 1e-4 * closed[0]


def test_gradient_is_that_of_the_orbit(orbit):
    """The gradient estimated from close neighbours agrees with the implicit one.

    The difference is within the estimate's own standard error, which is small."""
    evaluation = averaged(
        *PERIODIC, "ensemble.spread=0.005", "ensemble.designs=16", gradient=True, design=INSIDE
    )
    found, truth = rows(evaluation.gradient), rows(orbit.gradient)
    errors = rows(evaluation.steady_state["gradient_standard_error"])
    size = np.max(np.abs(truth), axis=1, keepdims=True)
    assert np.all((errors > 0) & (errors < 0.05 * size))
    assert np.all(np.abs(found - truth) < 4 * errors + 1e-3 * size)


def test_neighbours_are_in_pairs_inside_the_box():
    """Neighbours lie opposite each other about a middle.

    The middle is the point itself, except within a spread of a bound."""
    settings = EnsembleConfig(designs=64, spread=0.1, seed=3)
    for point in np.array([[0.5, 0.4, 0.6], [0.0, 1.0, 0.5], [0.05, 0.5, 0.97]]):
        points, steps = neighbours(point, settings)
        assert points.shape == (64, 3)
        assert np.all((points >= 0) & (points <= 1))
        middle = (points[:32] + points[32:]) / 2
        np.testing.assert_allclose(middle, np.clip(point, 0.1, 0.9) + 0 * steps, atol=1e-12)
        np.testing.assert_allclose(points[:32] - middle, steps, atol=1e-12)
        assert np.linalg.matrix_rank(steps) == 3
    steps, others = (
        neighbours(np.full(3, 0.5), EnsembleConfig(designs=2048, spread=0.1, seed=seed))[1]
        for seed in (3, 4)
    )
    np.testing.assert_allclose(np.cov(steps.T), 0.01 * np.eye(3), atol=5e-4)
    assert not np.any(steps == others)


def test_slope_of_a_quadratic_is_exact():
    """Curvature cancels between opposite neighbours, and the stated error is zero."""
    rng = np.random.default_rng(0)
    slope, bend, steps = (rng.normal(size=shape) for shape in ((2, 3), (2, 3, 3), (8, 3)))
    both = np.concatenate([steps, -steps])
    values = 5 + both @ slope.T + np.einsum("ni,rij,nj->nr", both, bend, both)
    found, covariance = fitted_slope(values, steps)
    np.testing.assert_allclose(found, slope, atol=1e-12)
    np.testing.assert_allclose(covariance, 0, atol=1e-20)


def test_standard_error_of_the_slope_is_honest():
    """Over many noisy samples the slope is right on average, and scatters as stated."""
    rng = np.random.default_rng(1)
    slope = np.array([[1.0, -2.0, 0.5]])
    steps = 0.1 * rng.normal(size=(8, 3))
    both = np.concatenate([steps, -steps])
    samples = [
        fitted_slope(both @ slope.T + 0.05 * rng.normal(size=(16, 1)), steps) for _ in range(2000)
    ]
    found = np.array([one[0][0] for one in samples])
    stated = np.mean([np.diag(one[1][0]) for one in samples], axis=0)
    assert np.all(np.abs(np.mean(found, axis=0) - slope[0]) < 4 * np.sqrt(stated / 2000))
    np.testing.assert_allclose(np.var(found, axis=0), stated, rtol=0.15)


# Where it is chaotic


def test_chaos_is_averaged_and_named():
    evaluation = averaged(*CHAOTIC, *SMALL, survey=False)
    steady = evaluation.steady_state
    assert (evaluation.status, evaluation.usable) == (Status.AVERAGED, True)
    assert steady["kind"] == "chaotic"
    exponent = steady["lyapunov_exponent_per_mesh_period"]
    assert exponent > 3 * steady["lyapunov_standard_error"] > 0
    values, errors = numbers(evaluation)
    assert 0 < values[0] < values[2] < values[1] < steady["greatest_force_N"]
    assert np.all((errors > 1e-3 * values) & (errors < values))
    json.dumps(evaluation.record(), allow_nan=False)


@pytest.mark.long
def test_gradient_of_chaos_has_its_standard_error():
    """Estimates of two seeds differ by as much as their standard errors state."""
    both = [
        averaged(*CHAOTIC, *SMALL, "ensemble.spread=0.2", f"ensemble.seed={seed}", gradient=True)
        for seed in (0, 1)
    ]
    first, second = (rows(one.gradient) for one in both)
    errors = [rows(one.steady_state["gradient_standard_error"]) for one in both]
    assert not np.array_equal(first, second)
    # Five degrees of freedom each: 6 of these are as rare as 4 of normal ones.
    assert np.all(np.abs(first - second) < 6 * np.hypot(*errors))
    slopes = next(tables.gradient_tables(both[0].record()))
    assert all(" ± " in cell.text for row in slopes.groups[0][1] for cell in row[1:])
    json.dumps(both[0].record(), allow_nan=False)


def test_same_seed_same_numbers():
    size = "ensemble.members=4", "ensemble.settle_periods=2", "ensemble.periods=2"
    first, again, other = (averaged(*CHAOTIC, *size, f"ensemble.seed={seed}") for seed in (5, 5, 6))
    assert first.response == again.response
    np.testing.assert_array_equal(first.start, again.start)
    assert first.response != other.response
    # Members continue from the last states of a neighbour; other shapes are refused.
    on = averaged(*CHAOTIC, *size, "ensemble.seed=5", start=first.start)
    assert on.status is Status.AVERAGED
    assert on.response != first.response
    with pytest.raises(ValueError, match="start"):
        averaged(*CHAOTIC, *size, start=np.zeros(2))


YES, NO = np.ones(4, bool), np.zeros(4, bool)
ONE = np.array([True, False, False, False])


def sound(level=1.0):
    few = level * np.ones(4)
    means = np.column_stack([few, few**2, 2 * few + np.arange(4)])
    return Members(
        means, 0 * few, 9 * few, -1e-3 * few, np.ones((4, 2)), np.ones((4, 8), bool),
        NO, NO, YES,
    )  # fmt: skip


def test_one_member_that_fails_is_enough():
    failures = {
        Status.AVERAGED: {},
        Status.PASSED_THROUGH: {"lost": ONE},
        Status.STALLED: {"lost": ONE, "stalled": ONE},
        Status.NON_FINITE: {"means": np.full((4, 3), np.nan), "stalled": ONE},
        Status.SOLVER_FAILED: {"means": np.full((4, 3), np.nan), "solved": ~ONE},
    }
    assert [sound()._replace(**one).status for one in failures.values()] == [*failures]


def told(monkeypatch, run, gradient=False):
    """Evaluate an ensemble whose members are made up by `run(index of the pair)`."""
    monkeypatch.setattr(
        "rootsopt.response.ensemble.run_members",
        lambda pairs, *rest: [run(k) for k in range(len(pairs))],
    )
    return averaged("ensemble.members=4", "ensemble.designs=12", gradient=gradient)


def test_responses_stand_where_they_belong(monkeypatch):
    """They are those of the members; members that never touch are idle, with gradients of zero."""
    evaluation = told(monkeypatch, lambda number: sound(3.0))
    assert evaluation.status is Status.AVERAGED
    assert evaluation.response == {"mean_force_N": 3, "peak_force_N": 7.5, "rms_force_N": 3}
    steady = [evaluation.steady_state[key] for key in (*ERRORS.values(), "greatest_force_N")]
    assert steady == pytest.approx([0, np.std(np.arange(4), ddof=1) / 2, 0, 27])
    evaluation = told(monkeypatch, lambda number: sound(0.0)._replace(means=np.zeros((4, 3))))
    assert evaluation.status is Status.IDLE
    assert set(evaluation.response.values()) == {0.0}
    assert {x for row in evaluation.gradient.values() for x in row.values()} == {0.0}


def test_too_deep_is_no_average(monkeypatch):
    depth = np.array([-1.0, 1.0, 1.0, 1.0]) * 0.0201 * 0.033
    evaluation = told(monkeypatch, lambda number: sound()._replace(depth=depth), gradient=True)
    assert evaluation.status is Status.TOO_DEEP
    assert evaluation.gradient == {}
    allowed = sound()._replace(depth=0.99 * depth)
    assert told(monkeypatch, lambda number: allowed).status is Status.AVERAGED


def test_a_neighbour_that_fails_leaves_no_gradient(monkeypatch):
    """A neighbour that fails leaves neither gradient nor averages.

    The averages are those of the whole neighbourhood."""
    evaluation = told(
        monkeypatch, lambda number: sound()._replace(lost=ONE & (number == 7)), gradient=True
    )
    assert evaluation.status is Status.PASSED_THROUGH
    assert (evaluation.response, evaluation.gradient, evaluation.start) == ({}, {}, None)
    whole = told(monkeypatch, lambda number: sound(), gradient=True)
    assert whole.status is Status.AVERAGED
    assert rows(whole.gradient) == pytest.approx(0)


def test_evaluator_of_a_motion():
    """`objective.motion` chooses the motions that count."""
    assert Evaluator.of_objective(config_of()).single
    evaluator = Evaluator.of_objective(config_of("objective.motion=ensemble")).surveying()
    assert (evaluator.motions, evaluator.single) == (Ensemble(), False)
    other = independent(evaluator, 2)
    assert (evaluator.survey, other.survey) == (True, False)
    assert other.config.ensemble.members == 4 * evaluator.config.ensemble.members


# Commands


@pytest.mark.long
def test_optimize_a_chaotic_scene(tmp_path, capsys):
    """A small run says whether its gain is significant; the history has standard errors."""
    size = "ensemble.members=4", "ensemble.designs=12", "ensemble.spread=0.1"
    window = "ensemble.settle_periods=8", "ensemble.periods=8"
    search = "optimizer.screening=0", "optimizer.starts=1", "optimizer.iterations=1"
    options = itertools.chain.from_iterable(
        ("--set", key) for key in (*CHAOTIC, *size, *window, *search)
    )
    code = optimize.main(["configs/cic_drawn.yaml", "-o", str(tmp_path), "--no-figures", *options])
    result = json.loads((tmp_path / "result.json").read_text())
    verification, text = result["verification"], capsys.readouterr().out
    assert result["baseline"]["status"] == "averaged"
    assert result["baseline"]["gradient"]
    with open(tmp_path / "history.csv", newline="") as file:
        history = list(csv.DictReader(file))
    assert len(history) >= 2
    assert all(0 < float(row["objective_standard_error"]) < 10 for row in history)
    assert code == (0 if verification["holds_up"] else 3)
    if code == 0:
        gain = 1 - verification["verified_objective"]
        assert gain > SIGNIFICANT * verification["combined_standard_error"]
        assert gain == pytest.approx(result["improvement"]["objective"])
    else:
        assert "noise" in text
        assert result["optimized"] is None


@pytest.mark.long
def test_standard_errors_are_honest():
    """Standard errors are neither too small nor far too large."""
    size = "ensemble.members=16", "ensemble.periods=32", "ensemble.settle_periods=24"
    found = [numbers(averaged(*CHAOTIC, *size, f"ensemble.seed={seed}")) for seed in range(5)]
    apart = [
        np.abs(first - second) / np.hypot(by_first, by_second)
        for (first, by_first), (second, by_second) in itertools.combinations(found, 2)
    ]
    assert 0.3 < np.max(apart) < 4
