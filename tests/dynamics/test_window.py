"""Tests of the Lyapunov exponent of a window, from made-up growth and noise."""

import jax.numpy as jnp
import numpy as np
import pytest

from rootsopt.config import load
from rootsopt.dynamics import window
from rootsopt.dynamics.flow import strobe
from rootsopt.dynamics.integrator import Integrator
from rootsopt.response.evaluation import Evaluator, lyapunov_program
from rootsopt.runtime.programs import CachedFunction
from tests.standins import oscillator

PERIODS = 1024


def window_of(monkeypatch, growth, noise=0.0):
    """Return a window in which distances grow by told factors and steps add `noise`."""

    def one_period(pair, state, how):
        at, one = jnp.round(state[0]), jnp.ones(())
        aside = jnp.exp(jnp.asarray(growth)[at.astype(int)]) * (state[0] - at)
        aside = jnp.sign(aside) * jnp.hypot(aside, noise)
        end = jnp.stack([at + 1 + aside, 0.0 * at])
        states, yes = jnp.tile(state, (630, 1)), jnp.ones((), bool)
        return window.Period(end, jnp.asarray([1.0, 2.0, 3.0]), states, -one, yes, one)

    monkeypatch.setattr(window, "one_period", one_period)
    how = Integrator("tsit5", jnp.asarray(1e-6), 64)
    return window.lyapunov(oscillator(), jnp.zeros(2), PERIODS, how)


def test_lyapunov_exponent_and_its_standard_error(monkeypatch):
    """The exponent is the mean logarithm of the growth, with the standard error from 16 batches.

    For independent growth factors, this error is their standard deviation over the root of their
    number."""
    growth = 0.3 + 0.5 * np.random.default_rng(3).normal(size=PERIODS)
    found = window_of(monkeypatch, growth)
    assert float(found.exponent) == pytest.approx(np.mean(growth), rel=1e-9)
    batches = np.array([np.mean(growth[k : k + 64]) for k in range(0, PERIODS, 64)])
    scatter = np.mean([np.var(batches[k::2], ddof=1) for k in (0, 1)])
    assert float(found.error) == pytest.approx(np.sqrt(scatter / 16), rel=1e-9)
    assert float(found.error) == pytest.approx(np.std(growth) / np.sqrt(PERIODS), rel=0.4)
    assert bool(found.chaotic)
    assert float(found.end[0]) == int(found.done) == PERIODS
    np.testing.assert_array_equal(found.states[:, 0, 0], np.arange(PERIODS))


@pytest.mark.parametrize("noise", [1e-3, 1e-1])
def test_noise_of_steps_is_no_chaos(monkeypatch, noise):
    """Where the distance of two motions is noise, it grows, but the motion is not chaotic."""
    assert not bool(window_of(monkeypatch, np.full(PERIODS, -2.0), noise).chaotic)
    assert bool(window_of(monkeypatch, np.full(PERIODS, 0.7), min(noise, 1e-3)).chaotic)


_KEYS = (
    *("profile.involute_length_mm", "contact.exponent"),
    *("scene.timing_gear.stiffness_N_m_per_rad", "scene.timing_gear.backlash_mm"),
    *("scene.timing_gear.damping_ratio", "scene.speed_rpm", "scene.load.torque_N_m"),
)
STABLE = (
    (8.5, 1.53, 7.925e5, 0.24175, 0.5, 3000, 4.775),
    (8.361, 1.319, 2.124e5, 0.02046, 0.352, 2634, 1.673),
    (6.781, 1.540, 2.543e5, 0.2763, 0.442, 2748.1, 1.754),
    (4.126, 1.456, 6.502e5, 0.07077, 0.287, 4793.3, 1.333),
    (5.219, 1.999, 9.823e5, 0.3611, 0.499, 2196.8, 4.379),
)
WILD = (
    (9.0, 2.2, 2.0e4, 0.4, 0.1, 3000, 1.0),
    (6.025, 1.373, 4.715e5, 0.3349, 0.170, 3013.8, 1.923),
    (6.459, 1.853, 8798, 0.3485, 0.239, 2677.9, 1.156),
    (6.925, 1.388, 1.964e5, 0.218, 0.361, 3896.5, 1.217),
)


@CachedFunction
def _later(pair, state, integrator):
    return strobe(pair, state, 64, integrator).states[-1]


@pytest.mark.long
def test_chaos_is_told_from_stable_orbits():
    """Only the chaotic scenes count as chaotic.

    The stable scenes have Floquet multipliers from 1e-8 to 0.7."""
    found = []
    for values in STABLE + WILD:
        pairs = zip(_KEYS, values, strict=True)
        config = load("configs/cic_drawn.yaml", [f"{key}={x}" for key, x in pairs])
        evaluator = Evaluator.of(config)
        pair, how = evaluator.pair(config.design), evaluator.scene.solver.transient
        state = _later(pair, np.zeros(2, pair.angle_scale.dtype), how)
        found.append(bool(lyapunov_program(pair, state, 128, how).chaotic))
    assert found == [False] * len(STABLE) + [True] * len(WILD)
