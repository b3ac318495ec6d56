"""Tests of the solvers.

Forces and motion are compared with an independent model in `tests/scene`, with closed forms and
SciPy in `test_gear_errors` and `test_extremes`."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from rootsopt.config import load
from rootsopt.dynamics.flow import one_period, strobe
from rootsopt.dynamics.integrator import METHODS, Integrator
from rootsopt.scene import Scene, design_vector


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
