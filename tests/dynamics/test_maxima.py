"""Tests of local maxima of the contact force along an orbit, with their derivatives."""

import numpy as np
import pytest

from rootsopt import load_config
from rootsopt.dynamics.maxima import candidates, shoulders
from rootsopt.dynamics.steady import SAMPLES
from rootsopt.response.evaluation import Evaluator

_STEP = 2e-4
"""Step of the differences, in config units."""


@pytest.fixture(scope="module")
def evaluator():
    """Return an evaluator of the smallest scene with a timing gear, at a tight tolerance."""
    config = load_config("configs/cic_drawn.yaml", ["profile.involute_length_mm=8.0"])
    return Evaluator.of(config).at_tolerance(1e-11).with_maxima()


@pytest.fixture(scope="module")
def found(evaluator):
    return evaluator()


def test_maxima_are_those_of_the_series(found):
    """Every maximum of the uniform samples of the force is listed, and no lower one."""
    cycle, maxima, samples = found.series.force[:SAMPLES], found.maxima, SAMPLES
    period = found.steady_state["period"]
    higher = (cycle > np.roll(cycle, 1)) & (cycle >= np.roll(cycle, -1))
    tops = np.flatnonzero(higher & (cycle > 1e-3 * cycle.max()))
    assert found.response["peak_force_N"] == pytest.approx(maxima.forces[0], rel=1e-9)
    for top in tops:
        near = np.abs(maxima.times - period * top / samples) < 2 * period / samples
        assert near.any()
        assert cycle[top] <= maxima.forces[near].max() * (1 + 1e-9)
    # Each is the force at its instant, so no maximum exceeds the peak.
    places = period * np.arange(samples + 1) / samples
    there = np.interp(maxima.times, places, np.append(cycle, cycle[0]))
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
    forces = 2 + np.cos(2 * np.pi * places) + np.cos(6 * np.pi * places)
    at, sides = candidates(places, forces)
    assert len(at) == 3
    assert at[0] in (0, 200) or at[-1] in (0, 200)
    assert np.all(sides[0] <= places[at])
    assert np.all(sides[1] >= places[at])
    ripple = forces + 1e-9 * np.random.default_rng(0).normal(size=201)
    ripple[-1] = ripple[0]
    assert len(candidates(places, ripple)[0]) == 3
    assert candidates(places, np.zeros(201))[0].size == 0


def test_shoulder_is_found_before_it_is_a_maximum():
    """A bump on a slope is a shoulder while the force rises there, and a maximum later."""
    x = np.arange(400) / 400
    for height, expected in ((0.02, 1), (0.03, 2)):
        force = 10 + np.cos(2 * np.pi * x) * 0.08 + height * np.exp(-(((x - 0.8) / 0.04) ** 2))
        places, closed = np.append(x, 1.0), np.append(force, force[0])
        assert len(candidates(places, closed)[0]) == expected
        assert len(shoulders(places, closed)) == (1 if expected == 1 else 0)
