"""Tests of an orbit's monodromy matrix against the matrix exponential of an oscillator."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rootsopt.dynamics import window
from rootsopt.dynamics.integrator import Integrator
from rootsopt.dynamics.orbit import Shots, close_orbit
from tests.standins import (
    DAMPING,
    HALF_BACKLASH,
    INERTIA,
    LOAD,
    LOBES,
    SCALE,
    SPEED,
    STIFFNESS,
    oscillator,
)


def test_multiplier_is_that_of_the_whole_orbit():
    """A damped oscillator decays by exp(-c t/2I): over k mesh periods, k times as far as over one.

    The monodromy matrix is its matrix exponential, and the multiplier is not a root or power of
    that."""
    pair = oscillator()
    period = 2 * np.pi / (LOBES * SPEED)
    matrix = np.array([[0.0, 1.0], [-STIFFNESS / INERTIA, -DAMPING / INERTIA]])
    roots, vectors = np.linalg.eig(matrix)
    assert roots[0].imag != 0
    rest = -(HALF_BACKLASH + LOAD / STIFFNESS) / SCALE
    how = Integrator("tsit5", jnp.asarray(1e-9), 512)
    unit = np.diag([SCALE, SCALE / period])

    @jax.jit
    def close(length):
        still, shots = window.no_tangents(pair), Shots(how, samples=840)
        return close_orbit(pair, still, jnp.array([rest + 0.01, 0.0]), length, shots)

    for length in (1, 2, 3):
        orbit = close(jnp.asarray(length))
        grown = (vectors * np.exp(roots * length * period)) @ np.linalg.inv(vectors)
        expected = np.linalg.inv(unit) @ grown.real @ unit
        np.testing.assert_allclose(orbit.monodromy, expected, atol=1e-6)
        assert float(orbit.multiplier) == pytest.approx(
            np.exp(-DAMPING / (2 * INERTIA) * length * period), rel=1e-5
        )
        np.testing.assert_allclose(orbit.state, [rest, 0.0], atol=1e-8)
        assert float(orbit.residual) < 1e-9
        # For a linear equation, one step of Newton's method finds the orbit.
        assert int(orbit.newton_steps) < 8
