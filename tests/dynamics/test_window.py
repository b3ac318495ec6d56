"""Tests of the Lyapunov exponent of a window, from made-up growth factors."""

import jax.numpy as jnp
import numpy as np
import pytest

from rootsopt.dynamics import window
from rootsopt.dynamics.integrator import Integrator
from tests.standins import oscillator, told_flow


def test_lyapunov_exponent_and_its_standard_error(monkeypatch):
    """The exponent is the mean logarithm of the growth, with the standard error from 16 batches.

    For independent growth factors, this error is their standard deviation over the root of their
    number."""
    periods = 4096
    growth = 0.3 + 0.5 * np.random.default_rng(3).normal(size=periods)

    def flow(pair, state, one, how, samples, still, measures):
        out = told_flow(pair, state, np.ones(periods), growth)
        return out._replace(states=jnp.tile(state, (samples, 1)))

    monkeypatch.setattr(window, "flow", flow)
    how = Integrator("tsit5", jnp.asarray(1e-6), 64)
    found = window.lyapunov(oscillator(), jnp.zeros(2), periods, how)
    assert float(found.exponent) == pytest.approx(np.mean(growth), rel=1e-9)
    batches = [np.mean(growth[k : k + 256]) for k in range(0, periods, 256)]
    assert float(found.error) == pytest.approx(np.std(batches, ddof=1) / np.sqrt(16), rel=1e-9)
    assert float(found.error) == pytest.approx(np.std(growth) / np.sqrt(periods), rel=0.4)
    assert float(found.end[0]) == int(found.done) == periods
    np.testing.assert_array_equal(found.states[:, 0, 0], np.arange(periods))
