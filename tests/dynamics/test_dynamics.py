"""Tests of the motion of a rotor pair against closed forms, and of the solvers.

Forces and motion are compared with independent models in `test_independent` and `tests/scene`,
which also has the energy balance."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from rootsopt.config import load
from rootsopt.dynamics.flow import one_period, strobe
from rootsopt.dynamics.integrator import METHODS, Integrator
from rootsopt.scene import Scene, design_vector

R, LOBES = 0.033, 3


PERIODS = 10


def integrator(method="tsit5", rtol=1e-9, max_steps=20000):
    return Integrator(method, jnp.asarray(rtol), max_steps)


def pair_of(path, overrides=()):
    config = load(path, list(overrides))
    return build(Scene.from_config(config), design_vector(config)), config


@eqx.filter_jit
def build(model, design):
    return model.pair(design)


@eqx.filter_jit
def run_strobe(pair, state, periods, how):
    return strobe(pair, state, periods, how)


run_period = eqx.filter_jit(one_period)


def statistics(out):
    mean, square, peak = out.response
    return np.array([mean, peak, np.sqrt(square)])


# Solvers


@pytest.fixture(scope="module")
def orbit_by():
    """Return a function (method, rtol) → mean, peak, RMS on the CIC orbit, and the solver steps."""
    pair, _ = pair_of("configs/cic_drawn.yaml")

    def find(method, rtol):
        how, state = integrator(method, rtol), jnp.zeros(2)
        # The orbit's multiplier is 0.004: six periods leave 1e-14 of the start.
        for _ in range(7):
            out, before = run_period(pair, state, how), state
            assert bool(out.solved)
            state = out.end
        return statistics(out), int(run_strobe(pair, before, 1, how).steps)

    return find


@pytest.fixture(scope="module")
def tight_orbit(orbit_by):
    """Return mean, peak and RMS at rtol 1e-11."""
    return orbit_by("tsit5", 1e-11)[0]


@pytest.mark.parametrize("method", METHODS)
def test_solvers_agree(method, orbit_by, tight_orbit):
    """All methods give the same mean, peak and RMS force."""
    found, _ = orbit_by(method, 1e-8)
    np.testing.assert_allclose(found, tight_orbit, rtol=1e-5)


def test_error_falls_with_the_tolerance(orbit_by, tight_orbit):
    """With rtol a hundred times smaller, mean and RMS are closer to the limit, with more steps."""
    errors, steps = [], []
    for rtol in (1e-5, 1e-7, 1e-9):
        found, count = orbit_by("tsit5", rtol)
        errors.append(np.max(abs(found / tight_orbit - 1)[::2]))
        steps.append(count)
    assert errors[0] > 3 * errors[1] > 9 * errors[2]
    assert errors[2] < 1e-6
    assert steps[0] < steps[1] < steps[2]


# Closed forms


def loose_pair(load_torque):
    """Return a pair whose flanks never meet: its clearance far exceeds the gear's backlash.

    Gear: 2.0e4 N·m/rad, ζ = 0.3, 0.1 mm of backlash."""
    gear = "{stiffness_N_m_per_rad: 2.0e4, damping_ratio: 0.3, backlash_mm: 0.1}"
    overrides = [
        "contact.clearance_mm=0.5",
        f"scene.load.torque_N_m={load_torque}",
        f"scene.timing_gear={gear}",
    ]
    return pair_of("configs/cic_drawn.yaml", overrides)[0]


def test_gear_alone_carries_the_load_when_flanks_cannot_touch():
    """With a wide clearance no flank touches and ε rests at -(backlash/2 + load/stiffness)."""
    pair = loose_pair(4.775)
    found = run_strobe(pair, jnp.zeros(2), PERIODS, integrator())
    out = run_period(pair, found.states[-1], integrator())
    assert not np.any(out.response)
    rest = -(0.05e-3 / R + 4.775 / 2.0e4)
    relative = np.asarray(out.states)[:, 0] * float(pair.angle_scale)
    np.testing.assert_allclose(relative, rest, rtol=1e-9)


def test_gear_swings_as_a_damped_oscillator():
    """Beyond one edge of the backlash, ε is the closed-form damped oscillator of the gear."""
    pair = loose_pair(4.775)
    inertia, stiffness, ratio = float(pair.inertia), 2.0e4, 0.3
    # I ε̈ + c ε̇ + k ε = 0 about the rest, c = 2 ζ √(k I/2).
    decay = ratio * np.sqrt(stiffness * inertia / 2) / inertia
    swing = np.sqrt(stiffness / inertia - decay**2)
    time, scale = float(pair.mesh_period), float(pair.angle_scale)
    rest, start = -(0.05e-3 / R + 4.775 / stiffness), 1e-4
    state = jnp.array([(rest - start) / scale, 0.0])
    (found,) = run_strobe(pair, state, 1, integrator(rtol=1e-10)).states
    fade = start * np.exp(-decay * time)
    relative = rest - fade * (np.cos(swing * time) + decay / swing * np.sin(swing * time))
    rate = fade * (swing + decay**2 / swing) * np.sin(swing * time)
    assert fade > 1e-7
    np.testing.assert_allclose(found, [relative / scale, rate * time / scale], atol=1e-8)


def test_rotor_falls_freely_inside_the_backlash():
    """Between the flanks and the ends of the backlash, ε = -load t²/2I."""
    pair = loose_pair(0.05)
    (found,) = run_strobe(pair, jnp.zeros(2), 1, integrator()).states
    time, scale = float(pair.mesh_period), float(pair.angle_scale)
    rate = -0.05 / float(pair.inertia) * time
    assert abs(rate * time / 2) < 0.05e-3 / R
    np.testing.assert_allclose(found, [rate * time / 2 / scale, rate * time / scale], rtol=1e-9)


def test_a_pair_without_mesh_stands_still():
    """Beyond the angle limit the motion stops, so that the state stays finite."""
    pair, _ = pair_of("configs/cic_drawn.yaml")
    for side in (-1, 1):
        state = jnp.array([side * 1.01 * pair.angle_limit / float(pair.angle_scale), 7.0])
        slope, _ = pair.derivative(jnp.asarray(0.3), state)
        assert not np.any(slope)
        inside, _ = pair.derivative(jnp.asarray(0.3), state * jnp.array([0.98, 1.0]))
        assert float(inside[0]) == 7.0
