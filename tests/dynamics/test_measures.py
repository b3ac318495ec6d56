"""Tests of spectral lines and of the p-norm."""

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rootsopt.config import load
from rootsopt.dynamics.linear import spectral_radius
from rootsopt.errors import InputError
from rootsopt.optimize.problem import Problem
from rootsopt.response.evaluation import Evaluator
from rootsopt.response.records import floquet
from rootsopt.response.terms import objective_weights

LIVELY = (
    "scene.speed_rpm=4000",
    "scene.timing_gear.damping_ratio=0.2",
    "scene.timing_gear.backlash_mm=0.2",
)


ALL = "response.lines=[1, 2, 7, 0.5, 0.3]", "objective.peak_norm=8"
"""Measures of every evaluation here, so that all share one program."""


def evaluated(*overrides):
    return Evaluator.of(load("configs/cic_drawn.yaml", [*ALL, *overrides]))()


@pytest.mark.parametrize("scene", [(), LIVELY])
def test_lines_are_those_of_the_sampled_force(scene):
    """Amplitudes from integrated coefficients agree with those from the transform of 2520
    samples."""
    evaluation = evaluated(*scene)
    period = evaluation.steady_state["period"]
    assert period == (2 if scene else 1)
    force = evaluation.series.force
    amplitudes = 2 * np.abs(np.fft.rfft(force)) / len(force)
    mesh_periods = len(force) // 2520 * period
    for order in (1, 2, 7, 0.5):
        found = evaluation.response[f"line_{order:g}_force_N"]
        line = order * mesh_periods
        present = abs(order * period - round(order * period)) < 1e-9
        expected = amplitudes[round(line)] if present else 0.0
        # Impacts are narrow: the samples leave 1e-3 of the greatest line.
        assert found == pytest.approx(expected, abs=1e-3 * evaluation.response["line_1_force_N"])
    # No motion of up to eight mesh periods has this line.
    assert evaluation.response["line_0.3_force_N"] == 0
    assert set(evaluation.gradient["line_0.3_force_N"].values()) == {0.0}


def test_p_norm_tends_to_the_peak_as_stated():
    """The p-norm rises to the peak with p, at the rate of Laplace's method for a smooth peak."""
    found = {p: evaluated(f"objective.peak_norm={p}") for p in (8, 16, 32, 64)}
    norms = [one.response["peak_norm_force_N"] for one in found.values()]
    peaks = [one.response["peak_force_N"] for one in found.values()]
    assert np.all(np.diff(norms) > 0)
    assert np.ptp(peaks) < 1e-6 * peaks[0]
    assert norms[-1] < peaks[0]
    # (mean of F^p)^(1/p) of the samples, which know nothing of the quadrature.
    for p, norm in zip(found, norms, strict=True):
        force = found[p].series.force
        assert norm == pytest.approx(np.mean(force**p) ** (1 / p), rel=2e-4)
    # The bias falls about as ln(p)/p: a factor of 8 in p leaves less than a quarter of it.
    bias = 1 - np.array(norms) / peaks
    assert bias[-1] < 0.3 * bias[0]


def test_objective_takes_the_lines_and_the_norm_as_weighted():
    config = load(
        "configs/cic_drawn.yaml",
        [*ALL, "objective.line_weights={1: 1, 2: 2}", "objective.rms_weight=1"],
    )
    weights = objective_weights(config)
    assert sum(weights.values()) == pytest.approx(1)
    assert weights["line_2_force_N"] == pytest.approx(2 / 5)
    assert weights["peak_norm_force_N"] == pytest.approx(0.5 / 5)
    assert "peak_force_N" not in weights
    evaluator = Evaluator.of(config)
    baseline = evaluator(series=False)
    problem = Problem.of(config, evaluator.scene, baseline)
    assert problem.objective(baseline) == pytest.approx(1)
    point = problem.point(list(baseline.design.values())) * 0.99
    here = evaluator(problem.design(point), series=False)
    slope = problem.slope(here, point)
    unit = np.array([1.0, -0.5, 0.5])
    up, down = (
        problem.objective(evaluator(problem.design(point + h * unit), series=False))
        for h in (1e-4, -1e-4)
    )
    assert slope @ unit == pytest.approx((up - down) / 2e-4, rel=1e-3)


def test_a_line_the_baseline_has_not_got_is_refused():
    config = load("configs/cic_drawn.yaml", ["objective.line_weights={0.5: 1, 1: 1}"])
    evaluator = Evaluator.of(load("configs/cic_drawn.yaml", ALL))
    with pytest.raises(InputError, match=r"line_weights.*0\.5.*repeats every 1 mesh periods"):
        Problem.of(config, evaluator.scene, evaluator(series=False))


@given(st.integers(1, 5), st.integers(0, 2**32 - 1))
def test_spectral_radius(count, seed):
    """The result agrees with NumPy's eigenvalues, for any number of states."""
    matrix = np.random.default_rng(seed).normal(size=(count, count))
    expected = np.max(np.abs(np.linalg.eigvals(matrix)))
    assert float(spectral_radius(jnp.asarray(matrix))) == pytest.approx(expected, rel=1e-8)
    first = floquet(matrix)[0]
    assert np.hypot(*first) == pytest.approx(expected, rel=1e-9)
    assert float(spectral_radius(jnp.asarray(np.triu(matrix, 1)))) == 0
