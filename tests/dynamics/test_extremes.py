"""Tests at the limits of what a config may contain: a correct result or a named status."""

import itertools
import json

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from rootsopt.config import load
from rootsopt.contact.law import ImpactLaw, force_rounding
from rootsopt.dynamics.integrator import Integrator
from rootsopt.dynamics.orbit import Orbit
from rootsopt.dynamics.parts import TimingGear
from rootsopt.dynamics.parts.base import Timescales
from rootsopt.dynamics.steady import final, is_consistent, is_idle, is_steady
from rootsopt.response.evaluation import Evaluator, _motion
from rootsopt.scene import Scene, design_vector
from rootsopt.status import Status


def config_of(**changes):
    """Return the shipped CIC scene with changed keys, `__` for a dot."""
    return load(
        "configs/cic_drawn.yaml", [f"{k.replace('__', '.')}={v}" for k, v in changes.items()]
    )


pair_of = eqx.filter_jit(Scene.pair)


# The contact law at the ends of its ranges


def extreme_laws():
    """Return the parameters (n, 5; SI units) of laws at every combination of limits."""
    stiffness, exponents = (1e3, 1e6, 1e9), (1.0, 1.5, 2.0, 3.0, 5.0)
    damping, depths, smoothing = (0.0, 1e-4, 10.0), (1e-5, 1e-2, 1.0), (0.0, 1e-6, 1e-4, 0.1)
    rows = [
        (k * 1e3**e, e, c * 1e3, d * 1e-3, h * 1e-3)
        for k, e, c, d, h in itertools.product(stiffness, exponents, damping, depths, smoothing)
    ]
    return np.array(rows)


DEPTHS = np.concatenate([[-1e-3, 0.0], np.geomspace(1e-36, 1e-2, 58)])
RATES = np.concatenate([-np.geomspace(1e-9, 1e3, 9), [0.0], np.geomspace(1e-9, 1e3, 5)])


@jax.jit
def values_and_slopes(rows, depths, rates):
    def force(row, depth, rate):
        return ImpactLaw(*row)(depth, rate)

    def at(*x):
        value, (by_row, by_depth, by_rate) = jax.value_and_grad(force, (0, 1, 2))(*x)
        return jnp.concatenate([jnp.stack([value, by_depth, by_rate]), by_row])

    def one(row):
        return jax.vmap(lambda d: jax.vmap(lambda r: at(row, d, r))(rates))(depths)

    return jax.lax.map(one, rows)


def test_law_and_its_slopes_are_finite_at_every_limit():
    """Force and derivatives in depth, rate and parameters are finite, from 1e-36 m to 10 mm of
    depth."""
    rows = extreme_laws()
    found = values_and_slopes(*map(jnp.asarray, (rows, DEPTHS, RATES)))
    wrong = np.argwhere(~np.isfinite(found))
    assert len(wrong) == 0, [(rows[i], DEPTHS[j], RATES[k], n) for i, j, k, n in wrong[:3]]
    assert np.all(np.asarray(found[..., 0]) >= 0)


# Steps from the scene


def timescales(play=1e-3, torque=5.0, inertia=2e-3, exponent=1.0, stiffness=1e7):
    """Return timescales of a pair of 33 mm pitch radius, a gear of 2e4 N·m/rad, and its parts."""
    law = ImpactLaw(*(jnp.asarray(x) for x in (stiffness, exponent, 0.0, 1e-5, 0.0)))
    gear = TimingGear(*(jnp.asarray(x) for x in (2e4, 0.0, play / 2, 0.0)))
    radius = 0.033
    force = jnp.asarray(torque / radius)
    return Timescales.of(
        law, (gear,), jnp.asarray(inertia), force, jnp.asarray(radius), jnp.asarray(0.0)
    )


def test_pace_in_closed_form():
    """A linear contact beside the gear is a spring; the fall through the backlash is s = a t²/2."""
    found = timescales()
    spring = 1e7 * 0.033**2 + 2e4
    assert float(found.swing) == pytest.approx(np.sqrt(2e-3 / spring), rel=1e-12)
    assert float(found.fall) == pytest.approx(np.sqrt(2 * 1e-3 * 2e-3 / 5.0), rel=1e-12)


def test_impact_after_a_fall_sets_the_pace():
    """With e = 2, the work of the load over the backlash equals K δ³/3, in a deeper, stiffer
    contact.

    Without backlash, the static depth counts and there is no free flight."""
    found, radius, torque = timescales(play=5e-3, exponent=2.0, stiffness=1e12), 0.033, 5.0
    depth = (3 * torque * 5e-3 / 1e12) ** (1 / 3)
    assert depth > (torque / radius / 1e12) ** 0.5
    spring = 2 * 1e12 * depth * radius**2 + 2e4
    assert float(found.swing) == pytest.approx(np.sqrt(2e-3 / spring), rel=1e-12)
    still = timescales(play=0.0, exponent=2.0, stiffness=1e12)
    spring = 2 * 1e12 * (torque / radius / 1e12) ** 0.5 * radius**2 + 2e4
    assert float(still.swing) == pytest.approx(np.sqrt(2e-3 / spring), rel=1e-12)
    assert np.isinf(float(still.fall))


@pytest.mark.parametrize(("speed", "stiffness"), [(3000, 2e5), (1, 1e9), (60_000, 1e3)])
def test_steps_follow_the_scene(speed, stiffness):
    """The first step is short compared with an oscillation, the longest compared with a free
    flight.

    Steps of that length do not use up the allowed number."""
    config = config_of(scene__speed_rpm=speed, contact__stiffness_N_per_mm_e=stiffness)
    pair = pair_of(Scene.from_config(config), design_vector(config))
    how = Integrator("tsit5", jnp.asarray(1e-8), 4096)
    swing, fall = (
        float(t / pair.mesh_period) for t in (pair.timescales.swing, pair.timescales.fall)
    )
    control = how.controller(pair)
    first, longest = float(control.first), float(control.base.dtmax)
    assert first == pytest.approx(min(1e-3, swing / 20))
    assert longest == pytest.approx(min(1 / 32, max(fall / 8, 4 / 4096)))
    if speed == 1:
        assert first < 1e-7
        assert longest == 4 / 4096


# What counts as a result


def orbit_of(multipliers=(0.5, 0.1), size=1.0, residual=0.0, peak=1.0, depth=1e-5, mean=1.0):
    """Return a closed orbit with a diagonal monodromy matrix and little else."""
    blank = Orbit.empty(jnp.array([size, 0.0]), 0, 3)
    return blank._replace(
        residual=jnp.asarray(residual),
        monodromy=jnp.diag(jnp.array(multipliers)),
        multiplier=jnp.max(jnp.abs(jnp.array(multipliers))),
        response=jnp.array([mean, 0.0, peak]),
        depth=jnp.asarray(depth),
    )


judgement = jax.jit(is_steady)


def accepted(orbit, rtol=1e-8, moved=0.0, residual=1e-9):
    state = orbit.state + moved
    return bool(judgement(orbit, state, (1e-3, residual), (1e-8, rtol)))


def test_an_orbit_that_multiplies_errors_is_none():
    """Errors grow by 1/(1 - multiplier). If that is too large, the orbit is rejected."""
    near = orbit_of((1 - 1e-5, 0.1))
    assert accepted(near, 1e-8)
    assert not accepted(near, 1e-3)
    assert accepted(orbit_of(), 1e-3)
    assert not accepted(orbit_of((1.01, 0.1)))


def test_distances_are_relative_to_large_states():
    """With a residual of 3e-8, an orbit of size 1 is open and one of size 400 is closed."""
    assert not accepted(orbit_of(residual=3e-8))
    assert accepted(orbit_of(residual=3e-8, size=400.0))
    assert accepted(orbit_of(), moved=1e-3)
    assert not accepted(orbit_of(), moved=0.1)


def test_rounding_of_the_gap():
    """The gap has a rounding error of the pitch radius, and the force is a power of the gap."""
    radius, exponent = jnp.asarray(0.033), jnp.asarray(2.0)
    eps = np.finfo(float).eps
    found = float(force_rounding(jnp.asarray(1e-9), exponent, radius))
    assert found == pytest.approx(2 * eps * 0.033 / 1e-9)
    assert float(force_rounding(jnp.asarray(-0.03), exponent, radius)) == 0


def test_mean_rms_and_peak_must_not_contradict_each_other():
    """mean ≤ RMS ≤ peak, except for 1 % and for forces below the least force."""

    def consistent(mean, square, peak, least=1e-3):
        orbit = orbit_of(mean=mean, peak=peak)
        numbers = jnp.array([mean, square, peak])
        return bool(is_consistent(orbit._replace(response=numbers), jnp.asarray(least)))

    assert consistent(3.0, 10.0, 4.0)
    assert consistent(3.0, 9.0, 3.0)
    assert not consistent(3.0, -1.0, 4.0)
    assert not consistent(3.0, 10.0, 0.0)
    assert not consistent(-3.0, 10.0, 4.0)
    assert consistent(1e-4, -1e-8, 1e-4)


def test_idle_is_without_force():
    """An idle orbit has no force, and drifts freely (multiplier 1 or unknown) or is steady."""
    nothing = {"mean": 0.0, "peak": 0.0}
    assert bool(is_idle(orbit_of((1.0, 1.0), **nothing)))
    assert bool(is_idle(orbit_of((np.nan, 1.0), **nothing)))
    assert not bool(is_idle(orbit_of(**nothing)))
    assert bool(is_idle(orbit_of(**nothing), 0.0, True))
    assert not bool(is_idle(orbit_of(), 0.0, True))
    rounding = {"mean": 1e-50, "peak": 1e-48}
    assert bool(is_idle(orbit_of((1.0, 1.0), **rounding), 1e-18))
    assert not bool(is_idle(orbit_of((1.0, 1.0))))


# Whole scenes; one compiled program serves them all

BOUNDARIES = {
    # A million oscillations in a mesh period: the allowed number of steps, and no more.
    "slow and stiff": (
        {"scene__speed_rpm": 1, "contact__stiffness_N_per_mm_e": 1e9},
        Status.SOLVER_FAILED,
    ),
    "no load": ({"scene__load__torque_N_m": 0}, Status.IDLE),
    "fast": ({"scene__speed_rpm": 60_000}, Status.PERIODIC),
    "no play": ({"scene__timing_gear__backlash_mm": 0}, Status.PERIODIC),
    "hardly any play": ({"scene__timing_gear__backlash_mm": 1e-3}, Status.PERIODIC),
    "coarse": ({"solver__rtol": 1e-2, "solver__accuracy": 0.1}, Status.PERIODIC),
}


@pytest.mark.parametrize("name", BOUNDARIES)
def test_boundary_scenes_end_as_they_must(name):
    """Each scene ends with a finite result or a named status, in a bounded number of steps."""
    changes, expected = BOUNDARIES[name]
    evaluation = Evaluator.of(config_of(**changes))(series=False)
    assert evaluation.status is expected
    record = json.loads(json.dumps(evaluation.record(), allow_nan=False))
    assert bool(record["gradient"]) == expected.usable
    assert evaluation.statistics["solver_steps"] <= 5 * 4096
    if expected is Status.SOLVER_FAILED:
        assert 1e5 < evaluation.statistics["swings_per_mesh_period"] < 1e7


@pytest.mark.long
def test_a_pair_with_a_motor_that_floats_is_idle():
    """Newton's equations are then singular, and the state is kept."""
    scene = {"scene__drive": "torque", "scene__motor": "{slope_N_m_s_per_rad: 0.1}"}
    scene |= {"scene__timing_gear": "null", "scene__load__torque_N_m": 0}
    contact = {"contact__clearance_mm": 0.01}
    evaluation = Evaluator.of(config_of(**scene, **contact))(series=False)
    assert evaluation.status is Status.IDLE


def test_a_force_lost_in_rounding_is_no_result(monkeypatch):
    """Beyond the limit of `force_rounding`, the forces have a status and no gradient."""

    def stricter(pair, tangents, start, radius, solver):
        found = _motion(pair, tangents, start, radius, solver)
        return final(pair, jax.tree.map(jnp.asarray, found), radius)

    # The program has the usual limit; what it finds is judged by another one.
    monkeypatch.setattr("rootsopt.dynamics.steady.UNRESOLVED", 1e-14)
    monkeypatch.setattr("rootsopt.response.evaluation._motion", stricter)
    evaluation = Evaluator.of(config_of())(series=False)
    assert evaluation.status is Status.UNRESOLVED
    assert not evaluation.usable
    assert evaluation.gradient == {}
    assert 1e-14 < evaluation.statistics["force_rounding"] < 1e-11


def test_motion_of_many_swings_agrees_with_scipy():
    """A stiff pair at low speed has hundreds of oscillations in a mesh period.

    SciPy returns to the orbit's state and gives the same mean, peak and RMS force."""
    changes = {
        "contact__stiffness_N_per_mm_e": 4.29e7,
        "contact__max_damping_N_s_per_mm": 0.00424,
        "contact__full_damping_depth_mm": 1.53e-5,
        "contact__smoothing_mm": 0.00178,
        "contact__exponent": 1.45,
        "scene__speed_rpm": 1000,
        "scene__load__torque_N_m": 3.31,
        "scene__timing_gear__backlash_mm": 0,
        "scene__timing_gear__stiffness_N_m_per_rad": 3.12e4,
        "rotor__length_mm": 201,
        "profile__pressure_angle_deg": 42.1,
        "profile__involute_length_mm": 0.502,
        "profile__tip_arc_angle_deg": 20.9,
    }
    config = config_of(**changes)
    evaluation = Evaluator.of(config)(series=False)
    assert evaluation.status is Status.PERIODIC
    pair = pair_of(Scene.from_config(config), design_vector(config))

    @jax.jit
    def rates(tau, state):
        slope, contact = pair.derivative(tau, state)
        return jnp.stack([*slope, contact.total, contact.total**2])

    start = np.append(evaluation.state, [0.0, 0.0])
    scales = np.array([1e-9, 1e-9, 1e-7, 1e-5])
    done = solve_ivp(
        lambda tau, y: np.asarray(rates(tau, y[:2])),
        (0, 1), start, "DOP853", rtol=1e-9, atol=scales, max_step=1 / 32,
    )  # fmt: skip
    np.testing.assert_allclose(done.y[:2, -1], evaluation.state, rtol=1e-5, atol=1e-5)
    mean, peak, rms = (evaluation.response[f"{name}_force_N"] for name in ("mean", "peak", "rms"))
    assert [done.y[2, -1], np.sqrt(done.y[3, -1])] == pytest.approx([mean, rms], rel=1e-5)
    # At the ends of its steps the force is near its greatest value, but never above it.
    forces = jax.vmap(rates)(jnp.asarray(done.t), jnp.asarray(done.y[:2].T))[:, 2]
    assert 0.98 * peak < np.max(forces) < peak * (1 + 1e-5)


def test_a_tightened_tolerance_does_no_worse():
    """At the cusp of EE, finer meshes gain nothing. The forces are reported with their error."""
    usual, tight = (
        Evaluator.of(load("configs/paper_ee.yaml", [f"solver.rtol={rtol}"]))(series=False)
        for rtol in (1e-8, 1e-10)
    )
    assert tight.status is usual.status is Status.PERIODIC
    for name, force in usual.response.items():
        assert tight.response[name] == pytest.approx(force, rel=1e-6), name
    assert 1e-9 < tight.statistics["force_error"] < 1e-6
