"""Tests of spectral lines, of the p-norm, and of local maxima of the force, with derivatives."""

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rootsopt.config import load
from rootsopt.dynamics.linear import spectral_radius
from rootsopt.dynamics.maxima import candidates, shoulders
from rootsopt.dynamics.steady import SAMPLES
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
    period, force = evaluation.steady_state["period"], evaluation.series.force
    assert period == (2 if scene else 1)
    amplitudes = 2 * np.abs(np.fft.rfft(force)) / len(force)
    for order in (1, 2, 7, 0.5):
        found = evaluation.response[f"line_{order:g}_force_N"]
        present = abs(order * period - round(order * period)) < 1e-9
        line = round(order * (len(force) // 2520) * period)
        expected = amplitudes[line] if present else 0.0
        # Impacts are narrow: the samples leave 1e-3 of the greatest line.
        assert found == pytest.approx(expected, abs=1e-3 * evaluation.response["line_1_force_N"])
    # No motion of up to eight mesh periods has this line.
    assert evaluation.response["line_0.3_force_N"] == 0
    assert set(evaluation.gradient["line_0.3_force_N"].values()) == {0.0}


def test_p_norm_tends_to_the_peak_as_stated():
    """The p-norm rises to the peak with p, at the rate of Laplace's method for a smooth peak."""
    found = {p: evaluated(f"objective.peak_norm={p}") for p in (8, 16, 32, 64)}
    norms, peaks = (
        [one.response[f"{name}_force_N"] for one in found.values()]
        for name in ("peak_norm", "peak")
    )
    assert np.all(np.diff(norms) > 0)
    assert np.ptp(peaks) < 1e-6 * peaks[0]
    assert norms[-1] < peaks[0]
    # (mean of F^p)^(1/p) of the samples, which know nothing of the quadrature.
    for p, norm in zip(found, norms, strict=True):
        assert norm == pytest.approx(np.mean(found[p].series.force ** p) ** (1 / p), rel=2e-4)
    # The bias falls about as ln(p)/p: a factor of 8 in p leaves less than a quarter of it.
    assert 1 - norms[-1] / peaks[-1] < 0.3 * (1 - norms[0] / peaks[0])


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
    unit = np.array([1.0, -0.5, 0.5])
    down, here, up = (
        evaluator(problem.design(point + h * unit), series=False) for h in (-1e-4, 0.0, 1e-4)
    )
    difference = (problem.objective(up) - problem.objective(down)) / 2e-4
    assert problem.slope(here, point) @ unit == pytest.approx(difference, rel=1e-3)


def test_a_line_the_baseline_has_not_got_is_refused():
    config = load("configs/cic_drawn.yaml", ["objective.line_weights={0.5: 1, 1: 1}"])
    evaluator = Evaluator.of(load("configs/cic_drawn.yaml", ALL))
    with pytest.raises(InputError, match=r"line_weights.*0\.5.*repeats every 1 mesh periods"):
        Problem.of(config, evaluator.scene, evaluator(series=False))


@given(st.integers(1, 5), st.integers(0, 2**32 - 1))
def test_spectral_radius(count, seed):
    matrix = np.random.default_rng(seed).normal(size=(count, count))
    expected = np.max(np.abs(np.linalg.eigvals(matrix)))
    assert float(spectral_radius(jnp.asarray(matrix))) == pytest.approx(expected, rel=1e-8)
    first = floquet(matrix)[0]
    assert np.hypot(*first) == pytest.approx(expected, rel=1e-9)
    assert float(spectral_radius(jnp.asarray(np.triu(matrix, 1)))) == 0


# Local maxima

_STEP = 2e-4
"""Step of the differences, in config units."""


@pytest.fixture(scope="module")
def evaluator():
    """Return an evaluator of the smallest scene with a timing gear, at a tight tolerance."""
    config = load("configs/cic_drawn.yaml", ["profile.involute_length_mm=8.0"])
    return Evaluator.of(config).at_tolerance(1e-11).with_maxima()


@pytest.fixture(scope="module")
def found(evaluator):
    return evaluator()


def test_maxima_are_those_of_the_series(found):
    """Every maximum of the uniform samples of the force is listed, and no lower one."""
    cycle, maxima, period = found.series.force[:SAMPLES], found.maxima, found.steady_state["period"]
    higher = (cycle > np.roll(cycle, 1)) & (cycle >= np.roll(cycle, -1))
    assert found.response["peak_force_N"] == pytest.approx(maxima.forces[0], rel=1e-9)
    for top in np.flatnonzero(higher & (cycle > 1e-3 * cycle.max())):
        near = np.abs(maxima.times - period * top / SAMPLES) < 2 * period / SAMPLES
        assert near.any()
        assert cycle[top] <= maxima.forces[near].max() * (1 + 1e-9)
    # Each is the force at its instant, so no maximum exceeds the peak.
    there = np.interp(maxima.times, period * np.arange(SAMPLES) / SAMPLES, cycle, period=period)
    np.testing.assert_allclose(maxima.forces, there, atol=1e-2 * maxima.forces[0])


def test_gradients_are_those_of_differences(evaluator, found):
    """Gradients of every maximum agree with differences; the first one equals that of the peak."""
    design, maxima = np.array(list(found.design.values())), found.maxima
    peak = np.array(list(found.gradient["peak_force_N"].values()))
    np.testing.assert_allclose(maxima.slopes[0], peak, rtol=1e-4)
    for k, step in enumerate(_STEP * np.eye(len(design))):
        sides = [evaluator(design + s * step, found.start, series=False).maxima for s in (1, -1)]
        for time, slope in zip(maxima.times, maxima.slopes, strict=True):
            above, below = (one.forces[np.argmin(np.abs(one.times - time))] for one in sides)
            scale = np.abs(maxima.slopes).max()
            assert slope[k] == pytest.approx((above - below) / (2 * _STEP), abs=1e-4 * scale)


def test_candidates_are_told_apart():
    """Three maxima, one of them at the seam, are distinguished from ripple on a plateau."""
    places = np.linspace(0, 1, 201)
    ripple = 1e-9 * np.random.default_rng(0).normal(size=201)
    ripple[-1] = ripple[0]
    forces = 2 + np.cos(2 * np.pi * places) + np.cos(6 * np.pi * places)
    for force in (forces, forces + ripple):
        at, sides = candidates(places, force)
        assert len(at) == 3
        assert at[0] in (0, 200) or at[-1] in (0, 200)
        assert np.all(sides[0] <= places[at])
        assert np.all(sides[1] >= places[at])
    assert candidates(places, np.zeros(201))[0].size == 0


def test_shoulder_is_found_before_it_is_a_maximum():
    """A bump on a slope is a shoulder while the force rises there, and a maximum later."""
    x = np.arange(400) / 400
    for height, expected in ((0.02, 1), (0.03, 2)):
        force = 10 + np.cos(2 * np.pi * x) * 0.08 + height * np.exp(-(((x - 0.8) / 0.04) ** 2))
        places, closed = np.append(x, 1.0), np.append(force, force[0])
        assert len(candidates(places, closed)[0]) == expected
        assert len(shoulders(places, closed)) == (1 if expected == 1 else 0)
