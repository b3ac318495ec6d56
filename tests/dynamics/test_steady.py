"""Tests of the steady state: closed orbit, statistics, gradients, statuses without them, spectral
lines, the p-norm, and local maxima of the force."""

import functools
import json

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rootsopt.config import family_of, load
from rootsopt.dynamics.flow import strobe
from rootsopt.dynamics.integrator import Integrator
from rootsopt.dynamics.linear import spectral_radius
from rootsopt.dynamics.maxima import candidates, shoulders
from rootsopt.dynamics.steady import SAMPLES
from rootsopt.response.evaluation import Evaluator
from rootsopt.response.records import floquet, message_of
from rootsopt.response.result import RESPONSES
from rootsopt.response.terms import objective_weights
from rootsopt.status import Status

NAMES = {
    "damping": "timing_gear.damping_ratio",
    "backlash": "timing_gear.backlash_mm",
    "load": "load.torque_N_m",
    "speed": "speed_rpm",
}


def gear(**changes):
    return [f"scene.{NAMES[key]}={value}" for key, value in changes.items()]


# A scene like that of the shipped configs, for which the figures below were measured.
BASE = gear(speed=3000, load=4.775, damping=0.3, backlash=0.1)
BASE += ["scene.timing_gear.stiffness_N_m_per_rad=2.0e4"]
SCENES = {
    "sharp": (["solver.rtol=1e-12"], Status.PERIODIC),
    # A multiplier close to 1.
    "slow": (["solver.rtol=1e-12", *gear(damping=0.02, load=2.0)], Status.PERIODIC),
    "periodic": ([], Status.PERIODIC),
    "doubled": (gear(backlash=0.2, damping=0.2, load=4.775, speed=4100), Status.PERIODIC),
    "tripled": (gear(backlash=0.1, damping=0.05, load=2.0, speed=6000), Status.PERIODIC),
    "noisy": (gear(backlash=0.1, damping=0.05, load=4.775, speed=6000), Status.PERIODIC),
    # An exponent of 0.7 per mesh period. Where it is 0.1, half of all windows do not show it.
    "chaotic": (
        [*gear(backlash=0.4, damping=0.1, load=1.0), "solver.max_mesh_periods=64"],
        Status.CHAOTIC,
    ),
    "impatient": (
        [*gear(backlash=0.2, damping=0.05, load=2.0, speed=4000), "solver.max_mesh_periods=16"],
        Status.NOT_SETTLED,
    ),
    "weak gear": (
        [*gear(load=40.0), "scene.timing_gear.stiffness_N_m_per_rad=1.0"],
        Status.PASSED_THROUGH,
    ),
    "soft": (
        [*gear(backlash=2.0, load=300.0), "contact.stiffness_N_per_mm_e=200"],
        Status.TOO_DEEP,
    ),
}


def evaluator_of(name):
    return Evaluator.of(load("configs/cic_drawn.yaml", [*BASE, *SCENES[name][0]]))


def pair_of(name):
    return evaluator_of(name).pair(evaluator_of(name).config.design)


@functools.cache
def settled(name):
    return evaluator_of(name)()


@eqx.filter_jit
def _strobed(pair, states, how):
    return jax.lax.map(lambda y: strobe(pair, y, 30, how).states, states)


def strobed(name, states, rtol=1e-12):
    """Return the end states of 30 mesh periods from four starts (4, 30, 2)."""
    how = Integrator("dopri8", jnp.asarray(rtol), 20_000)
    return np.asarray(_strobed(pair_of(name), jnp.asarray(states), how))


@pytest.mark.parametrize("name", ["sharp", "slow"])
def test_orbit_is_closed_and_disturbances_decay_as_its_multiplier_says(name):
    """States beside the orbit return as the monodromy matrix predicts, and stay on it."""
    evaluation, size = settled(name), 1e-4
    multiplier = evaluation.steady_state["floquet_multiplier"]
    assert evaluation.steady_state["period"] == 1
    assert evaluation.steady_state["residual"] < 1e-9
    ends = strobed(name, evaluation.state + size * np.kron(np.eye(2), [[1], [-1]]))
    spread = np.stack([ends[0] - ends[1], ends[2] - ends[3]], axis=-1) / (2 * size)
    # 1e-9 of noise over 1e-4, and the square of the perturbation.
    rate = np.max(np.abs(np.linalg.eigvals(spread[0])))
    assert rate == pytest.approx(multiplier, rel=1e-3, abs=1e-6)
    if multiplier > 0.1:
        later = np.max(np.abs(np.linalg.eigvals(spread[5]))) ** (1 / 6)
        assert later == pytest.approx(multiplier, rel=1e-3)
    # Solver noise of 1e-9 per period, multiplied by 1/(1 - 0.83) for the decay of the orbit.
    assert np.max(np.abs(np.mean(ends[:2, -1], axis=0) - evaluation.state)) < 1e-7


def test_series_is_the_motion_over_one_revolution():
    """Uniform times cover a revolution and repeat with the mesh; forces act where flanks
    overlap. Mean, peak and RMS are those of the samples."""
    evaluation = settled("sharp")
    series, force = evaluation.series, evaluation.series.force
    count = len(series.time)
    np.testing.assert_allclose(series.time, 0.02 * np.arange(count) / count, rtol=1e-12)
    np.testing.assert_allclose(series.rotation, 2 * np.pi * np.arange(count) / count, rtol=1e-12)
    for part in (series.relative, series.rate):
        np.testing.assert_array_equal(part[: count // 3], part[count // 3 : 2 * (count // 3)])
    # The rate is the slope of the angle: central differences over 2.6 µs.
    slope = np.gradient(series.relative, series.time)[1:-1]
    assert np.max(np.abs(slope - series.rate[1:-1])) < 1e-2 * np.ptp(series.rate)
    assert not np.any(force[series.depth <= 0])
    assert np.all(series.drive_force * series.coast_force == 0)
    mean, peak, rms = (evaluation.response[name] for name in RESPONSES)
    # The force has corners: its 2520 samples average to second order only.
    assert [np.mean(force), np.sqrt(np.mean(force**2))] == pytest.approx([mean, rms], rel=2e-5)
    assert peak * (1 - 1e-3) < np.max(force) <= peak * (1 + 1e-9)


@pytest.mark.parametrize("name", SCENES)
def test_no_number_without_its_status(name):
    """Each scene ends with the correct status. Responses, gradient and series exist exactly where
    the status allows them."""
    evaluation, status = settled(name), SCENES[name][1]
    assert (evaluation.status, evaluation.usable) == (status, status is Status.PERIODIC)
    assert evaluation.message == message_of(evaluator_of(name).config, status)
    described = status is not Status.PASSED_THROUGH
    assert bool(evaluation.response) == (evaluation.series is not None) == described
    assert evaluation.gradient.keys() == (
        evaluation.response.keys() if evaluation.usable else set()
    )
    assert all(set(row) == set(family_of("cic").keys) for row in evaluation.gradient.values())
    kinds = {Status.PERIODIC: "periodic", Status.TOO_DEEP: "periodic", Status.CHAOTIC: "chaotic"}
    assert evaluation.steady_state["kind"] == kinds.get(status, "transient")
    # Strict JSON knows no NaN and no infinity.
    assert json.loads(json.dumps(evaluation.record(), allow_nan=False))["status"] == status.label
    if described:
        mean, peak, rms = (evaluation.response[name] for name in RESPONSES)
        assert 0 < mean <= rms <= peak


def test_chaos_has_a_positive_exponent():
    """The exponent exceeds its own error; two motions 1e-7 apart diverge at about that rate."""
    evaluation = settled("chaotic")
    steady, series = evaluation.steady_state, evaluation.series
    assert steady["lyapunov_exponent_per_mesh_period"] > 3 * steady["lyapunov_standard_error"] > 0
    start = pair_of("chaotic").scaled(jnp.array([series.relative[0], series.rate[0]]))
    ends = strobed("chaotic", start + 1e-7 * np.eye(4, 2), 1e-8)
    assert np.max(np.linalg.norm(ends[0] - ends[3], axis=1)) > 1e-2


@pytest.mark.parametrize(
    ("name", "period"), [("periodic", 1), ("doubled", 2), ("tripled", 3), ("noisy", 1)]
)
def test_the_least_period_is_named(name, period):
    """With period k, neighbouring mesh periods differ and the motion repeats after k of them.

    In the noisy scene the transient, at its coarser tolerance, never repeats to the settling
    threshold, and first seems to repeat after four periods."""
    evaluation = settled(name)
    series = evaluation.series
    assert evaluation.steady_state["period"] == period
    # A gap of some 1e-5 m is the difference of lengths of 0.1 m: forces round at 1e-12.
    assert evaluation.steady_state["residual"] < 1e-11
    # Each mesh begins with the peak of the one before; from anywhere else, it takes 7 steps.
    assert name != "periodic" or evaluation.statistics["newton_steps"] <= 5
    force = series.force.reshape(-1, len(series.force) // (-(-3 // period) * period))
    changes = np.max(np.abs(force[1:] - force[0]), axis=1) / evaluation.response["peak_force_N"]
    for k, change in enumerate(changes, start=1):
        assert (change < 1e-6) if k % period == 0 else (change > 1e-2)


# Lines and p-norm


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
        within = 1e-3 * present * evaluation.response["line_1_force_N"]
        assert found == pytest.approx(expected, abs=within)
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
    changes = *ALL, "objective.line_weights={1: 1, 2: 2}", "objective.rms_weight=1"
    rest = {"mean_force_N": 0.1, "peak_norm_force_N": 0.1, "rms_force_N": 0.2}
    expected = rest | {"line_1_force_N": 0.2, "line_2_force_N": 0.4}
    assert objective_weights(load("configs/cic_drawn.yaml", changes)) == pytest.approx(expected)


@pytest.mark.parametrize("count", range(1, 6))
def test_spectral_radius(count):
    matrices = np.random.default_rng(count).normal(size=(20, count, count))
    radius = jax.jit(jax.vmap(spectral_radius))
    expected = np.max(np.abs(np.linalg.eigvals(matrices)), axis=1)
    np.testing.assert_allclose(radius(matrices), expected, rtol=1e-8)
    np.testing.assert_allclose([np.hypot(*floquet(x)[0]) for x in matrices], expected, rtol=1e-9)
    np.testing.assert_array_equal(radius(np.triu(matrices, 1)), 0)


# Local maxima

_STEP = 2e-4
"""Step of the differences, in config units."""


def test_maxima_are_those_of_the_series_and_move_as_differences():
    """Every maximum of the uniform samples of the force is listed, and no lower one.

    Gradients of every maximum agree with differences; the first one equals that of the peak."""
    config = load("configs/cic_drawn.yaml", ["profile.involute_length_mm=8.0"])
    evaluator = Evaluator.of(config).at_tolerance(1e-11).with_maxima()
    found = evaluator()
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
    peak = [*found.gradient["peak_force_N"].values()]
    np.testing.assert_allclose(maxima.slopes[0], peak, rtol=1e-4)
    for k, step in enumerate(_STEP * np.eye(3)):
        ends = [config.design + s * step for s in (1, -1)]
        sides = [evaluator(end, found.start, series=False).maxima for end in ends]
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
        at, (before, after) = candidates(places, force)
        assert len(at) == 3
        assert {at[0], at[-1]} & {0, 200}
        assert np.all((before <= places[at]) & (places[at] <= after))
    assert candidates(places, np.zeros(201))[0].size == 0


def test_shoulder_is_found_before_it_is_a_maximum():
    """A bump on a slope is a shoulder while the force rises there, and a maximum later."""
    x = np.arange(400) / 400
    for height, expected in ((0.02, (1, 1)), (0.03, (2, 0))):
        force = 10 + np.cos(2 * np.pi * x) * 0.08 + height * np.exp(-(((x - 0.8) / 0.04) ** 2))
        at = np.append(x, 1.0), np.append(force, force[0])
        assert (len(candidates(*at)[0]), len(shoulders(*at))) == expected
