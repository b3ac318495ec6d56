"""Tests at the limits of what a config may contain: a correct result or a named status."""

import itertools
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from rootsopt import Status, load_config
from rootsopt.contact.law import ImpactLaw, force_rounding
from rootsopt.dynamics.integrator import Integrator
from rootsopt.dynamics.orbit import Orbit
from rootsopt.dynamics.parts import TimingGear
from rootsopt.dynamics.parts.base import Timescales
from rootsopt.dynamics.steady import final, is_consistent, is_idle, is_steady
from rootsopt.response.evaluation import Evaluator, _motion


def config_of(**changes):
    """Return the shipped CIC scene with changed keys, `__` for a dot."""
    return load_config(
        "configs/cic_drawn.yaml", [f"{k.replace('__', '.')}={v}" for k, v in changes.items()]
    )


# The contact law at the ends of its ranges


LIMITS = (1e3, 1e9), (1.0, 1.5, 2.0, 5.0), (0.0, 1e-4, 10.0), (1e-5, 1e-2, 1.0), (0.0, 1e-6, 0.1)
"""Of stiffness, exponent, damping, depth and smoothing, in the units of a config."""
DEPTHS = np.concatenate([[-1e-3, 0.0], np.geomspace(1e-36, 1e-2, 58)])
RATES = np.concatenate([-np.geomspace(1e-9, 1e3, 9), [0.0], np.geomspace(1e-9, 1e3, 5)])


@jax.jit
def values_and_slopes(rows, depths, rates):
    slopes = jax.value_and_grad(lambda row, *at: ImpactLaw(*row)(*at), (0, 1, 2))
    each = jax.vmap(jax.vmap(slopes, (None, None, 0)), (None, 0, None))
    return jax.lax.map(lambda row: each(row, depths, rates), rows)


def test_law_and_its_slopes_are_finite_at_every_limit():
    """Force and derivatives in depth, rate and parameters are finite, from 1e-36 m to 10 mm of
    depth."""
    rows = [
        (k * 1e3**e, e, c * 1e3, d * 1e-3, h * 1e-3) for k, e, c, d, h in itertools.product(*LIMITS)
    ]
    force, slopes = values_and_slopes(*map(jnp.asarray, (rows, DEPTHS, RATES)))
    assert all(np.all(np.isfinite(slope)) for slope in slopes)
    assert np.all(force >= 0)


# Steps from the scene


@pytest.mark.parametrize(
    ("play", "exponent", "stiffness", "depth", "fall"),
    [
        # A linear contact beside the gear is a spring; the fall through the backlash is s = a t²/2.
        (1e-3, 1.0, 1e7, 1.0, np.sqrt(2 * 1e-3 * 2e-3 / 5)),
        # The work of the load over the backlash equals K δ³/3, in a deeper, stiffer contact.
        (5e-3, 2.0, 1e12, (3 * 5 * 5e-3 / 1e12) ** (1 / 3), np.sqrt(2 * 5e-3 * 2e-3 / 5)),
        # Without backlash, the static depth counts and there is no free flight.
        (0.0, 2.0, 1e12, (5 / 0.033 / 1e12) ** 0.5, np.inf),
    ],
)
def test_pace_in_closed_form(play, exponent, stiffness, depth, fall):
    """Swing and fall of a pair of 33 mm pitch radius with a gear of 2e4 N·m/rad."""
    law = ImpactLaw(*(jnp.asarray(x) for x in (stiffness, exponent, 0.0, 1e-5, 0.0)))
    gear = TimingGear(*(jnp.asarray(x) for x in (2e4, 0.0, play / 2, 0.0)))
    found = Timescales.of(law, (gear,), *map(jnp.asarray, (2e-3, 5 / 0.033, 0.033, 0.0)))
    spring = exponent * stiffness * depth ** (exponent - 1) * 0.033**2 + 2e4
    assert float(found.swing) == pytest.approx(np.sqrt(2e-3 / spring), rel=1e-12)
    assert float(found.fall) == pytest.approx(fall, rel=1e-12)


@pytest.mark.parametrize(("speed", "stiffness"), [(3000, 2e5), (1, 1e9), (60_000, 1e3)])
def test_steps_follow_the_scene(speed, stiffness):
    """The first step is short compared with an oscillation, the longest compared with a free
    flight.

    Steps of that length do not use up the allowed number."""
    config = config_of(scene__speed_rpm=speed, contact__stiffness_N_per_mm_e=stiffness)
    pair = Evaluator.of(config).pair(config.design)
    control = Integrator("tsit5", jnp.asarray(1e-8), 4096).controller(pair)
    swing, fall = (x / pair.mesh_period for x in (pair.timescales.swing, pair.timescales.fall))
    found = float(control.first), float(control.base.dtmax)
    expected = min(1e-3, float(swing) / 20), min(1 / 32, max(float(fall) / 8, 4 / 4096))
    assert found == pytest.approx(expected)
    if speed == 1:
        assert found[0] < 1e-7
        assert found[1] == 4 / 4096


# What counts as a result


def orbit_of(multipliers=(0.5, 0.1), size=1.0, residual=0.0, peak=1.0, mean=1.0):
    """Return a closed orbit with a diagonal monodromy matrix and little else."""
    return Orbit.empty(jnp.array([size, 0.0]), 0, 3)._replace(
        residual=jnp.asarray(residual),
        monodromy=jnp.diag(jnp.array(multipliers)),
        multiplier=jnp.max(jnp.abs(jnp.array(multipliers))),
        response=jnp.array([mean, 0.0, peak]),
        depth=jnp.asarray(1e-5),
    )


judgement = jax.jit(is_steady)


@pytest.mark.parametrize(
    ("orbit", "rtol", "moved", "accepted"),
    [
        # Errors grow by 1/(1 - multiplier). If that is too large, the orbit is rejected.
        ({"multipliers": (1 - 1e-5, 0.1)}, 1e-8, 0.0, True),
        ({"multipliers": (1 - 1e-5, 0.1)}, 1e-3, 0.0, False),
        ({}, 1e-3, 0.0, True),
        ({"multipliers": (1.01, 0.1)}, 1e-8, 0.0, False),
        # Distances are relative to large states: of size 1 the orbit is open, of 400 closed.
        ({"residual": 3e-8}, 1e-8, 0.0, False),
        ({"residual": 3e-8, "size": 400.0}, 1e-8, 0.0, True),
        ({}, 1e-8, 1e-3, True),
        ({}, 1e-8, 0.1, False),
    ],
)
def test_what_counts_as_a_closed_orbit(orbit, rtol, moved, accepted):
    found = orbit_of(**orbit)
    assert bool(judgement(found, found.state + moved, (1e-3, 1e-9), (1e-8, rtol))) is accepted


def test_rounding_of_the_gap():
    """The gap has a rounding error of the pitch radius, and the force is a power of the gap."""
    for depth, expected in ((1e-9, 2 * np.finfo(float).eps * 0.033 / 1e-9), (-0.03, 0.0)):
        found = force_rounding(*map(jnp.asarray, (depth, 2.0, 0.033)))
        assert float(found) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("numbers", "consistent"),
    [
        ((3.0, 10.0, 4.0), True),
        ((3.0, 9.0, 3.0), True),
        ((3.0, -1.0, 4.0), False),
        ((3.0, 10.0, 0.0), False),
        ((-3.0, 10.0, 4.0), False),
        ((1e-4, -1e-8, 1e-4), True),
    ],
)
def test_mean_rms_and_peak_must_not_contradict_each_other(numbers, consistent):
    """mean ≤ RMS ≤ peak, except for 1 % and for forces below the least force."""
    orbit = orbit_of()._replace(response=jnp.array(numbers))
    assert bool(is_consistent(orbit, jnp.asarray(1e-3))) is consistent


@pytest.mark.parametrize(
    ("multipliers", "mean", "peak", "others", "idle"),
    [
        ((1.0, 1.0), 0.0, 0.0, (), True),
        ((np.nan, 1.0), 0.0, 0.0, (), True),
        ((0.5, 0.1), 0.0, 0.0, (), False),
        ((0.5, 0.1), 0.0, 0.0, (0.0, True), True),
        ((0.5, 0.1), 1.0, 1.0, (0.0, True), False),
        ((1.0, 1.0), 1e-50, 1e-48, (1e-18,), True),
        ((1.0, 1.0), 1.0, 1.0, (), False),
    ],
)
def test_idle_is_without_force(multipliers, mean, peak, others, idle):
    """An idle orbit has no force, and drifts freely (multiplier 1 or unknown) or is steady."""
    assert bool(is_idle(orbit_of(multipliers, mean=mean, peak=peak), *others)) is idle


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
    evaluator = Evaluator.of(config_of(**scene, contact__clearance_mm=0.01))
    assert evaluator(series=False).status is Status.IDLE


def test_a_force_lost_in_rounding_is_no_result(monkeypatch):
    """Beyond the limit of `force_rounding`, the forces have a status and no gradient."""

    def stricter(pair, tangents, start, radius, solver):
        found = _motion(pair, tangents, start, radius, solver)
        return final(pair, jax.tree.map(jnp.asarray, found), radius)

    # The program has the usual limit; what it finds is judged by another one.
    monkeypatch.setattr("rootsopt.dynamics.steady.UNRESOLVED", 1e-14)
    monkeypatch.setattr("rootsopt.response.evaluation._motion", stricter)
    evaluation = Evaluator.of(config_of())(series=False)
    found = evaluation.status, evaluation.usable, evaluation.gradient
    assert found == (Status.UNRESOLVED, False, {})
    assert 1e-14 < evaluation.statistics["force_rounding"] < 1e-11


def test_motion_of_many_swings_agrees_with_scipy():
    """A stiff pair at low speed has hundreds of oscillations in a mesh period.

    SciPy returns to the orbit's state and gives the same mean, peak and RMS force."""
    config = config_of(**{
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
    })  # fmt: skip
    evaluation = Evaluator.of(config)(series=False)
    assert evaluation.status is Status.PERIODIC
    pair = Evaluator.of(config).pair(config.design)

    @jax.jit
    def rates(tau, state):
        slope, contact = pair.derivative(tau, state)
        return jnp.stack([*slope, contact.total, contact.total**2])

    done = solve_ivp(
        lambda tau, y: np.asarray(rates(tau, y[:2])),
        (0, 1), [*evaluation.state, 0.0, 0.0], "DOP853",
        rtol=1e-9, atol=np.array([1e-9, 1e-9, 1e-7, 1e-5]), max_step=1 / 32,
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
        Evaluator.of(load_config("configs/paper_ee.yaml", [f"solver.rtol={rtol}"]))(series=False)
        for rtol in (1e-8, 1e-10)
    )
    assert tight.status is usual.status is Status.PERIODIC
    for name, force in usual.response.items():
        assert tight.response[name] == pytest.approx(force, rel=1e-6), name
    assert 1e-9 < tight.statistics["force_error"] < 1e-6
