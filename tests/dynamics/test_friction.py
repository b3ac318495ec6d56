"""Tests of Coulomb friction as multibody programs smooth it."""

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from rootsopt.dynamics.parts import Friction

STATIC, KINETIC, LOW, HIGH = 0.2, 0.1, 0.1, 1.0


def friction():
    return Friction(*(jnp.asarray(x) for x in (STATIC, KINETIC, LOW, HIGH)))


_law = jax.jit(lambda speed: friction()(speed))
_slope = jax.jit(jax.grad(lambda speed: friction()(speed)))


def test_named_points_of_the_curve():
    law = friction()
    speeds = jnp.asarray([0.0, LOW, (LOW + HIGH) / 2, HIGH, 50.0])
    expected = [0.0, STATIC, (STATIC + KINETIC) / 2, KINETIC, KINETIC]
    np.testing.assert_allclose(law(speeds), expected, atol=1e-15)
    # The cubic step from -0.2 at -0.1 m/s to 0.2 at 0.1 m/s, half way up its upper half.
    np.testing.assert_allclose(law(jnp.asarray(LOW / 2)), 0.4 * (3 * 0.75**2 - 2 * 0.75**3) - 0.2)


@given(st.floats(-3, 3))
def test_friction_is_odd_bounded_and_smooth(speed):
    at = jnp.asarray(speed)
    np.testing.assert_allclose(_law(-at), -_law(at), atol=1e-16)
    assert abs(float(_law(at))) <= STATIC + 1e-15
    assert float(_law(at)) * speed >= 0
    # Of a cubic step the slope's greatest change is 6 h / w².
    change = abs(float(_slope(at + 1e-6) - _slope(at - 1e-6)))
    assert change <= 2e-6 * 1.01 * 6 * 2 * STATIC / (2 * LOW) ** 2 + 1e-12


def test_switches_mark_the_ends_of_the_steps():
    law = friction()
    speeds = np.array([-2.0, -0.5, 0.0, 0.5, 2.0])
    flags = np.asarray([law.drag_switches(jnp.asarray(v)) for v in speeds])
    assert len(np.unique(flags, axis=0)) == 5
