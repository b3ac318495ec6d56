"""What is seen of a motion between samples and within steps, against closed forms."""

import jax
import jax.numpy as jnp
import numpy as np

from rootsopt.dynamics import peak
from tests.standins import oscillator


def test_motion_between_samples_and_within_steps():
    """A motion of degree five in time is known exactly between its samples, and one of degree three
    within a step, with its rate; other states to degree four and in proportion."""
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
    # At x of a step of length h the cubic is as good as samples a width w apart: x (1 - x) h² < w².
    for tau, good in ((0.51, True), (0.8, False), (1.09, True), (0.35, True)):
        assert bool(steps.reaches(jnp.asarray(tau), jnp.asarray(0.2))) == good
