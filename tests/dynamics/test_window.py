"""Tests of the Lyapunov exponent of a window, from made-up growth and noise."""

import jax.numpy as jnp
import numpy as np
import pytest

from rootsopt.dynamics import window
from rootsopt.dynamics.integrator import Integrator
from tests.standins import oscillator, told_flow

PERIODS = 1024


def window_of(monkeypatch, growth, noise=0.0):
    """Return a window in which distances grow by told factors and steps add `noise`."""

    def flow(pair, state, one, how, samples, measures):
        out = told_flow(pair, state, np.ones(PERIODS))
        at = jnp.round(state[0])
        aside = jnp.exp(jnp.asarray(growth)[at.astype(int)]) * (state[0] - at)
        aside = jnp.sign(aside) * jnp.hypot(aside, noise)
        end = jnp.stack([at + 1 + aside, 0.0 * at])
        return out._replace(end=end, states=jnp.tile(state, (samples, 1)))

    monkeypatch.setattr(window, "flow", flow)
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
    found = window_of(monkeypatch, np.full(PERIODS, -2.0), noise)
    assert not bool(found.chaotic)
    assert bool(window_of(monkeypatch, np.full(PERIODS, 0.7), min(noise, 1e-3)).chaotic)
