"""Tests of the steady state: closed orbit, statistics, gradients, and statuses without them."""

import json

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rootsopt.config import DESIGN_KEYS, load
from rootsopt.dynamics.flow import strobe
from rootsopt.dynamics.integrator import Integrator
from rootsopt.dynamics.linear import spectral_radius
from rootsopt.response.evaluation import Evaluator, evaluate
from rootsopt.response.records import message_of
from rootsopt.response.result import RESPONSES
from rootsopt.status import Status

# A scene like that of the shipped configs, for which the figures below were measured.
SCENE = (
    "scene.speed_rpm=3000",
    "scene.load.torque_N_m=4.775",
    "scene.timing_gear={stiffness_N_m_per_rad: 2.0e4, damping_ratio: 0.3, backlash_mm: 0.1}",
)
SHARP = ("solver.rtol=1e-12",)
DESIGNS = {"paper": (36.43, 9.0, 4.0), "shorter involute": (36.43, 8.0, 4.0)}


def config_of(*overrides):
    return load("configs/cic_drawn.yaml", [*SCENE, *overrides])


def gear(**changes):
    """Return overrides for a scene with another gear, load or speed."""
    names = {"damping": "timing_gear.damping_ratio", "backlash": "timing_gear.backlash_mm"}
    names |= {"load": "load.torque_N_m", "speed": "speed_rpm"}
    return [f"scene.{names[key]}={value}" for key, value in changes.items()]


def numbers(evaluation):
    return np.array([evaluation.response[name] for name in RESPONSES])


def integrator(rtol):
    return Integrator("dopri8", jnp.asarray(rtol), 20_000)


@eqx.filter_jit
def run_strobe(pair, states, periods, how):
    """Return the end states of every period from several starts (starts, periods, 2)."""
    return jax.lax.map(lambda y: strobe(pair, y, periods, how).states, states)


@eqx.filter_jit
def force_at(pair, start, times, how):
    """Return the force at ascending `times` (mesh periods), each the end of a solver step."""
    states = diffrax.diffeqsolve(
        diffrax.ODETerm(lambda tau, y, _: pair.derivative(tau, y)[0]),
        how.solver(),
        t0=0.0,
        t1=times[-1],
        dt0=1e-4,
        y0=start,
        saveat=diffrax.SaveAt(ts=times),
        stepsize_controller=diffrax.ClipStepSizeController(
            diffrax.PIDController(how.rtol, how.rtol), step_ts=times
        ),
        max_steps=200_000,
    ).ys
    return jax.vmap(lambda t, y: pair.contact_at(t, y).total)(times, states)


@eqx.filter_jit
def pair_of(evaluator, design):
    return evaluator.pair(design)


# The orbit


@pytest.fixture(scope="module")
def sharp():
    """Return an evaluator at the reference settings; its program serves every test that needs
    it."""
    return Evaluator.of(config_of(*SHARP))


@pytest.fixture(scope="module")
def orbits(sharp):
    """Return sharp evaluations of both designs, and of a scene with a multiplier close to 1."""
    found = {name: (sharp, sharp(jnp.array(design))) for name, design in DESIGNS.items()}
    slow = Evaluator.of(config_of(*SHARP, *gear(damping=0.02, load=2.0)))
    return found | {"slow": (slow, slow())}


every_orbit = pytest.mark.parametrize("name", [*DESIGNS, "slow"])


def pair_and_state(orbits, name):
    evaluator, evaluation = orbits[name]
    design = jnp.array(list(evaluation.design.values()))
    return pair_of(evaluator.scene, design), jnp.asarray(evaluation.state)


@every_orbit
def test_orbit_is_closed_and_stays_closed(orbits, name):
    """The orbit is PERIODIC with a tiny residual, and 50 further periods stay on it."""
    _, evaluation = orbits[name]
    assert evaluation.status is Status.PERIODIC
    assert evaluation.usable
    assert evaluation.steady_state["kind"] == "periodic"
    assert evaluation.steady_state["period"] == 1
    assert evaluation.steady_state["residual"] < 1e-9
    pair, state = pair_and_state(orbits, name)
    states = run_strobe(pair, state[None], 50, integrator(1e-11))[0]
    # Solver noise of 1e-9 per period, multiplied by 1/(1 - 0.83) for the decay of the orbit.
    assert np.max(np.abs(states - state)) < 1e-7


@every_orbit
def test_floquet_multiplier_is_the_decay_of_a_perturbation(orbits, name):
    """States beside the orbit return as the monodromy matrix predicts."""
    pair, state = pair_and_state(orbits, name)
    _, evaluation = orbits[name]
    size = 1e-4
    starts = state + size * jnp.array([[1, 0], [-1, 0], [0, 1], [0, -1]])
    ends = np.asarray(run_strobe(pair, starts, 6, integrator(1e-12)))
    spread = np.stack([ends[0] - ends[1], ends[2] - ends[3]], axis=-1) / (2 * size)
    after_one, after_six = spread[0], spread[5]
    multiplier = evaluation.steady_state["floquet_multiplier"]
    # 1e-9 of noise over 1e-4, and the square of the perturbation.
    rate = np.max(np.abs(np.linalg.eigvals(after_one)))
    assert rate == pytest.approx(multiplier, rel=1e-3, abs=1e-6)
    assert float(spectral_radius(jnp.asarray(after_one))) == pytest.approx(rate, rel=1e-9)
    if multiplier > 0.1:
        later = np.max(np.abs(np.linalg.eigvals(after_six))) ** (1 / 6)
        assert later == pytest.approx(multiplier, rel=1e-3)


@every_orbit
def test_mean_and_rms_are_those_of_a_fine_sampling(orbits, name):
    """The integrals along the motion agree with averages of the sampled force."""
    _, evaluation = orbits[name]
    force = evaluation.series.force
    mean, _, rms = numbers(evaluation)
    # The force has corners: its 2520 samples average to second order only.
    assert np.mean(force) == pytest.approx(mean, rel=2e-5)
    assert np.sqrt(np.mean(force**2)) == pytest.approx(rms, rel=2e-5)
    pair, state = pair_and_state(orbits, name)
    times = jnp.arange(1, 20_161) / 20_160
    fine = np.asarray(force_at(pair, state, times, integrator(1e-9)))
    assert np.mean(fine) == pytest.approx(mean, rel=1e-6)
    assert np.sqrt(np.mean(fine**2)) == pytest.approx(rms, rel=1e-6)


@every_orbit
def test_peak_is_the_greatest_force(orbits, name):
    """No sample exceeds the peak, and a brute-force search around it finds no other value."""
    _, evaluation = orbits[name]
    series, peak = evaluation.series, evaluation.response["peak_force_N"]
    assert np.max(series.force) <= peak * (1 + 1e-9)
    pair, state = pair_and_state(orbits, name)
    samples = len(series.force) // 3
    best = int(np.argmax(series.force[:samples]))
    times = (best + np.linspace(-1, 1, 801)) / samples
    around = force_at(pair, state, jnp.asarray(times), integrator(1e-12))
    assert float(np.max(around)) == pytest.approx(peak, rel=1e-6)


def test_series_is_the_motion_over_one_revolution(orbits):
    """Uniform times cover a revolution and repeat with the mesh; forces act where flanks
    overlap."""
    evaluator, evaluation = orbits["paper"]
    series = evaluation.series
    count = len(series.time)
    np.testing.assert_allclose(series.time, 0.02 * np.arange(count) / count, rtol=1e-12)
    np.testing.assert_allclose(series.rotation, 2 * np.pi * np.arange(count) / count, rtol=1e-12)
    third = count // 3
    for part in (series.relative, series.rate):
        np.testing.assert_array_equal(part[:third], part[third : 2 * third])
    # The rate is the slope of the angle: central differences over 2.6 µs.
    slope = np.gradient(series.relative, series.time)[1:-1]
    assert np.max(np.abs(slope - series.rate[1:-1])) < 1e-2 * np.ptp(series.rate)
    assert not np.any(series.force[series.depth <= 0])
    assert np.all(series.drive_force * series.coast_force == 0)
    assert evaluator.config.scene.speed_rpm == 3000


# Gradients


# Statuses


SCENES = {
    "periodic": config_of(),
    "doubled": config_of(*gear(backlash=0.2, damping=0.2, load=4.775, speed=4000)),
    "tripled": config_of(*gear(backlash=0.1, damping=0.05, load=2.0, speed=6000)),
    "noisy": config_of(*gear(backlash=0.1, damping=0.05, load=4.775, speed=6000)),
    # An exponent of 0.7 per mesh period. Where it is 0.1, half of all windows do not show it.
    "chaotic": config_of(
        *gear(backlash=0.4, damping=0.1, load=1.0, speed=3000),
        *("profile.involute_length_mm=9.0", "contact.exponent=2.2"),
        "scene.timing_gear.stiffness_N_m_per_rad=2.0e4",
    ),
    "impatient": config_of(
        *gear(backlash=0.2, damping=0.05, load=2.0, speed=4000), "solver.max_mesh_periods=16"
    ),
    "weak gear": config_of(*gear(load=40.0), "scene.timing_gear.stiffness_N_m_per_rad=1.0"),
    "soft": config_of(*gear(backlash=2.0, load=300.0), "contact.stiffness_N_per_mm_e=200"),
}
OUTCOMES = {
    "periodic": {Status.PERIODIC},
    "doubled": {Status.PERIODIC},
    "tripled": {Status.PERIODIC},
    "noisy": {Status.PERIODIC},
    "chaotic": {Status.CHAOTIC},
    "impatient": {Status.NOT_SETTLED},
    "weak gear": {Status.PASSED_THROUGH},
    "soft": {Status.TOO_DEEP},
}


@pytest.fixture(scope="module")
def settled():
    """Return the evaluation of every scene at the default settings."""
    return {name: evaluate(config) for name, config in SCENES.items()}


@pytest.mark.parametrize("name", SCENES)
def test_status_names_the_outcome(settled, name):
    """Each scene ends with the correct status."""
    evaluation = settled[name]
    assert evaluation.status in OUTCOMES[name]
    assert evaluation.message == message_of(SCENES[name], evaluation.status)
    assert evaluation.usable == (evaluation.status is Status.PERIODIC)


@pytest.mark.parametrize("name", SCENES)
def test_no_number_without_its_status(settled, name):
    """Responses, gradient and series exist exactly where the status allows them."""
    evaluation = settled[name]
    status, steady = evaluation.status, evaluation.steady_state
    described = status in (Status.PERIODIC, Status.TOO_DEEP, Status.CHAOTIC, Status.NOT_SETTLED)
    assert bool(evaluation.response) == described
    assert not described or {*RESPONSES} <= evaluation.response.keys()
    assert (evaluation.series is not None) == described
    differentiable = status is Status.PERIODIC and bool(evaluation.design)
    assert evaluation.gradient.keys() == (evaluation.response.keys() if differentiable else set())
    for row in evaluation.gradient.values():
        assert set(row) == set(DESIGN_KEYS)
    kinds = {Status.PERIODIC: "periodic", Status.TOO_DEEP: "periodic", Status.CHAOTIC: "chaotic"}
    assert steady["kind"] == kinds.get(status, "transient")
    # Strict JSON knows no NaN and no infinity.
    record = json.loads(json.dumps(evaluation.record(), allow_nan=False))
    assert record["status"] == status.label
    if described:
        mean, peak, rms = numbers(evaluation)
        assert 0 < mean <= rms <= peak


@pytest.mark.parametrize("name", ["periodic", "doubled", "tripled", "noisy"])
def test_derivatives_are_those_before_a_negligible_correction(settled, name):
    """The last correction does not count."""
    assert settled[name].steady_state["residual"] < 3e-9
    # Each mesh begins with the peak of the one before; from anywhere else, it takes 7 steps.
    assert settled["periodic"].statistics["newton_steps"] <= 5


def test_chaos_has_a_positive_exponent_and_no_gradient(settled):
    """A chaotic scene has an exponent that exceeds its own error."""
    evaluation = settled["chaotic"]
    steady = evaluation.steady_state
    exponent = steady["lyapunov_exponent_per_mesh_period"]
    assert exponent > 3 * steady["lyapunov_standard_error"] > 0
    assert evaluation.gradient == {}
    assert not evaluation.usable
    # Two motions 1e-9 apart diverge at about that rate, up to 1e-2.
    evaluator = Evaluator.of(SCENES["chaotic"])
    pair = pair_of(evaluator.scene, jnp.array(list(evaluation.design.values())))
    scale, rate = float(pair.angle_scale), float(pair.angle_scale) / float(pair.mesh_period)
    start = jnp.array([evaluation.series.relative[0] / scale, evaluation.series.rate[0] / rate])
    starts = start + 1e-9 * jnp.array([[0.0, 0.0], [1.0, 0.0]])
    ends = np.asarray(run_strobe(pair, starts, 120, integrator(1e-12)))
    apart = np.linalg.norm(ends[0] - ends[1], axis=1)
    assert np.max(apart) > 1e-2


@pytest.mark.parametrize(("name", "period"), [("doubled", 2), ("tripled", 3), ("noisy", 1)])
def test_the_least_period_is_named(settled, name, period):
    """With period k, neighbouring mesh periods differ and the motion repeats after k of them.

    In the noisy scene the transient, at its coarser tolerance, never repeats to the settling
    threshold, and first seems to repeat after four periods."""
    evaluation = settled[name]
    assert evaluation.steady_state["period"] == period
    # A gap of some 1e-5 m is the difference of lengths of 0.1 m: forces round at 1e-12.
    assert evaluation.steady_state["residual"] < 1e-11
    assert evaluation.gradient
    series = evaluation.series
    per_mesh = len(series.force) // (-(-3 // period) * period)
    force = series.force.reshape(-1, per_mesh)
    changes = [np.max(np.abs(force[k] - force[0])) for k in range(1, len(force))]
    peak = evaluation.response["peak_force_N"]
    for k, change in enumerate(changes, start=1):
        assert (change < 1e-6 * peak) if k % period == 0 else (change > 1e-2 * peak)


def test_period_doubled_orbit_agrees_with_plain_motion(settled):
    """A long, tight integration from rest ends on the closed orbit of period 2."""
    evaluation = settled["doubled"]
    evaluator = Evaluator.of(SCENES["doubled"])
    pair = pair_of(evaluator.scene, jnp.array(list(evaluation.design.values())))
    states = run_strobe(pair, jnp.zeros((1, 2)), 200, integrator(1e-10))[0][-2:]
    nearest = np.min(np.max(np.abs(states - evaluation.state), axis=1))
    assert nearest < 1e-3
