"""Tests of a motion between samples and within steps, against closed forms."""

import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np

from rootsopt.dynamics import peak
from tests.standins import oscillator

_COUNT = """
import jax, jax.numpy as jnp, rootsopt
from rootsopt.dynamics.flow import flow, strobe
from rootsopt.dynamics.integrator import Integrator

jax.config.update("jax_enable_x64", True)
config = rootsopt.load_config("configs/ee.yaml")
pair = rootsopt.Scene.from_config(config).pair(config.design)
how = Integrator("tsit5", jnp.asarray(1e-8), 1024)
state = jnp.zeros(2)
programs = (
    lambda state: strobe(pair, state, 4, how),
    lambda state: flow(pair, state, jnp.asarray(2.0), how, 32),
)
print([str(jax.make_jaxpr(program)(state)).count("callback") for program in programs])
"""


def test_no_callback_to_python_in_an_integration():
    """An integration has no callback to Python, because programs with callbacks cannot be cached.

    Equinox's checks of the arguments of diffrax would be such callbacks. A command turns them off,
    but a caller from Python does not."""
    variables = {name: x for name, x in os.environ.items() if name != "EQX_ON_ERROR"}
    command = [sys.executable, "-c", _COUNT]
    done = subprocess.run(command, env=variables, check=True, capture_output=True, text=True)
    assert done.stdout == "[0, 0]\n"


def test_motion_between_samples_and_within_steps():
    """A motion of degree five in time is exact between samples; one of degree three within a step.

    This includes the rate. Other states are exact to degree four, and linearly within a step."""
    pair = oscillator()
    curve, other = (
        np.polynomial.Polynomial([0.3, -1, 2, 0.5, -3, 2]),
        np.polynomial.Polynomial([1, 2, -1, 0.5, 3]),
    )
    width = 0.125
    times = width * np.arange(9)
    states = jnp.asarray(np.column_stack([curve(times), curve.deriv()(times), other(times)]))
    between = jax.jit(lambda place: peak.motion(pair, states, place, jnp.asarray(width)))
    for tau in (0.0, 0.31, 0.4375, 0.5, 0.93):
        expected = [curve(tau), curve.deriv()(tau), other(tau)]
        np.testing.assert_allclose(between(jnp.asarray(tau / width)), expected, atol=1e-12)
    cubic = curve.cutdeg(3)
    ends = np.array([0.2, 0.5, 1.1, np.inf])
    begins = np.array([0.0, 0.2, 0.5, 1.1])

    def at(tau):
        tau = np.where(np.isfinite(tau), tau, 0.0)
        return jnp.asarray(np.column_stack([cubic(tau), cubic.deriv()(tau), 5 * tau]))

    steps = peak.Steps(jnp.asarray(begins), jnp.asarray(ends), at(begins), at(ends), jnp.asarray(3))
    within = jax.jit(lambda tau: steps.motion(pair, tau))
    for tau in (0.05, 0.2, 0.44, 0.8, 1.1):
        expected = [cubic(tau), cubic.deriv()(tau), 5 * tau]
        np.testing.assert_allclose(within(jnp.asarray(tau)), expected, atol=1e-12)
    # At the fraction x of a step of length h, the cubic is as accurate as samples w apart if
    # x (1 - x) h² < w².
    for tau, good in ((0.51, True), (0.8, False), (1.09, True), (0.35, True)):
        assert bool(steps.reaches(jnp.asarray(tau), jnp.asarray(0.2))) == good
