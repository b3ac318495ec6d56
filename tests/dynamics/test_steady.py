"""Tests of the steady state: closed orbit, statistics, gradients, and statuses without them."""

import functools
import json

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rootsopt.config import DESIGN_KEYS, load
from rootsopt.dynamics.flow import strobe
from rootsopt.dynamics.integrator import Integrator
from rootsopt.response.evaluation import Evaluator
from rootsopt.response.records import message_of
from rootsopt.response.result import RESPONSES
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


def config_of(name):
    return load("configs/cic_drawn.yaml", [*BASE, *SCENES[name][0]])


@functools.cache
def settled(name):
    return Evaluator.of(config_of(name))()


@eqx.filter_jit
def _strobed(scene, design, states, how):
    pair = scene.pair(design)
    return jax.lax.map(lambda y: strobe(pair, y, 30, how).states, states)


def strobed(name, states, rtol=1e-12):
    """Return the end states of 30 mesh periods from four starts (4, 30, 2)."""
    config, how = config_of(name), Integrator("dopri8", jnp.asarray(rtol), 20_000)
    at = Evaluator.of(config).scene, jnp.asarray(config.design), jnp.asarray(states)
    return np.asarray(_strobed(*at, how))


@pytest.mark.parametrize("name", ["sharp", "slow"])
def test_orbit_is_closed_and_disturbances_decay_as_its_multiplier_says(name):
    """States beside the orbit return as the monodromy matrix predicts, and stay on it."""
    evaluation, size = settled(name), 1e-4
    multiplier = evaluation.steady_state["floquet_multiplier"]
    assert evaluation.steady_state["period"] == 1
    assert evaluation.steady_state["residual"] < 1e-9
    ends = strobed(name, evaluation.state + size * np.array([[1, 0], [-1, 0], [0, 1], [0, -1]]))
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
    found = evaluation.status, evaluation.message, evaluation.usable
    assert found == (status, message_of(config_of(name), status), status is Status.PERIODIC)
    described = status is not Status.PASSED_THROUGH
    assert bool(evaluation.response) == (evaluation.series is not None) == described
    assert evaluation.gradient.keys() == (
        evaluation.response.keys() if evaluation.usable else set()
    )
    assert all(set(row) == set(DESIGN_KEYS) for row in evaluation.gradient.values())
    kinds = {Status.PERIODIC: "periodic", Status.TOO_DEEP: "periodic", Status.CHAOTIC: "chaotic"}
    assert evaluation.steady_state["kind"] == kinds.get(status, "transient")
    # Strict JSON knows no NaN and no infinity.
    record = json.loads(json.dumps(evaluation.record(), allow_nan=False))
    assert record["status"] == status.label
    if described:
        mean, peak, rms = (evaluation.response[name] for name in RESPONSES)
        assert 0 < mean <= rms <= peak


def test_chaos_has_a_positive_exponent():
    """The exponent exceeds its own error; two motions 1e-9 apart diverge at about that rate."""
    evaluation = settled("chaotic")
    steady, series = evaluation.steady_state, evaluation.series
    assert steady["lyapunov_exponent_per_mesh_period"] > 3 * steady["lyapunov_standard_error"] > 0
    pair = Evaluator.of(config_of("chaotic")).pair(np.array([*evaluation.design.values()]))
    start = pair.scaled(jnp.array([series.relative[0], series.rate[0]]))
    ends = strobed("chaotic", start + 1e-9 * np.eye(4, 2), 1e-10)
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
