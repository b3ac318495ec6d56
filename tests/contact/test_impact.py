"""Tests of the contact law alone: a single impact, its scaling laws, and restitution."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from rootsopt.contact.law import ImpactLaw

K, E, C, D = 1e8, 1.5, 1000.0, 1e-3
MASS, SPEED = 1.0, 1.0


def law(stiffness=K, exponent=E, damping=C):
    numbers = stiffness, exponent, damping, D, 0.0
    return ImpactLaw(*(jnp.asarray(x) for x in numbers))


def impact(law):
    """Return restitution, peak force (N), penetration (m) and duration (s) of a mass hitting a
    wall."""
    force = jax.jit(law.__call__)

    def slope(_, state):
        depth, rate = state
        return [rate, -float(force(jnp.asarray(depth), jnp.asarray(rate))) / MASS]

    def leaves(_, state):
        return state[0] + 1e-12

    leaves.terminal, leaves.direction = True, -1
    found = solve_ivp(
        slope, (0, 0.02), [0.0, SPEED], "DOP853", rtol=1e-10, atol=1e-13, events=leaves
    )
    times = np.linspace(0, found.t[-1], 2001)
    dense = solve_ivp(
        slope, (0, found.t[-1]), [0.0, SPEED], "DOP853", times, rtol=1e-10, atol=1e-13
    )
    depth, rate = dense.y
    forces = np.asarray(jax.vmap(force)(jnp.asarray(depth), jnp.asarray(rate)))
    return -found.y[1, -1] / SPEED, forces.max(), depth.max(), found.t[-1]


def test_a_single_impact_is_that_of_the_stated_law():
    restitution, peak, depth, duration = impact(law())
    assert restitution == pytest.approx(0.778785, abs=2e-6)
    assert peak == pytest.approx(1660.220, rel=1e-6)
    assert depth == pytest.approx(0.62599e-3, rel=2e-5)
    assert duration == pytest.approx(2.09463e-3, rel=1e-5)
