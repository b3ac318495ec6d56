"""Bearing loads against pressure on polygons, and by virtual work."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import KDTree

from rootsopt.dynamics.parts import GasLoad
from rootsopt.dynamics.parts.load import GasResultant, tooth_force
from rootsopt.profiles import geometry, place_pair
from rootsopt.pump import flow, loads
from tests.conformance.families import LOBES, R, made, outline_of

ACROSS = 3e4 * 0.1
"""Pressure difference times length (N/m)."""
PHI = np.linspace(-0.9, 1.4, 23) + 0.0123


@jax.jit
def measured(profile):
    shape = geometry(profile)
    values = profile, shape, jnp.asarray(ACROSS), jnp.asarray(PHI)
    mean = jnp.asarray(1.0)
    load = GasLoad(jnp.asarray(ACROSS), profile, shape.outer_radius, mean)
    own = jax.vmap(lambda phi: jnp.stack([load.torque1(phi), load.torque2(phi)]))(values[3])
    through = flow.relative_flow(profile, shape, values[3])
    through = through * shape.area_efficiency * shape.outer_radius**2
    gas = GasResultant(values[2], profile, shape.outer_radius, jnp.asarray(0.0))
    found = jnp.sum(jax.vmap(gas.slice_forces)(values[3]), axis=1)
    return (found[..., 0] + 1j * found[..., 1]).T, own.T, through


@functools.cache
def of(family):
    return [np.asarray(one) for one in measured(made(family))]


@pytest.mark.parametrize("family", ["ee", "cic"])
def test_pressure_on_polygons(family):
    """Sum of the pressure on the sides of each rotor's polygon, from the tip that seals to the
    contact, and of its moment about the axis."""
    forces, moments, _ = of(family)
    outline = outline_of(family) / 1e3
    for k in range(0, len(PHI), 5):
        first, second = place_pair(outline, LOBES, 2 * R, PHI[k], PHI[k])
        # Rotor 2 in a mirror is passed through in the same sense as rotor 1.
        for row, points in ((0, first), (1, (second * [-1, 1] + [2 * R, 0])[::-1])):
            z = points[:-1] @ [1, 1j]
            other = second if row == 0 else first * [-1, 1] + [2 * R, 0]
            near = int(np.argmin(KDTree(other).query(points[:-1])[0]))
            tips = np.arange(LOBES) * len(z) // LOBES
            before = np.mod(-np.pi / 2 - np.angle(z[tips]), 2 * np.pi)
            tip = tips[np.argmin(before)]
            side = np.roll(z, -tip)[: np.mod(near - tip, len(z)) + 1]
            step, middle = np.diff(side), (side[1:] + side[:-1]) / 2
            push = 1j * ACROSS * step
            force = np.sum(push)
            expected = forces[row, k] if row == 0 else -np.conj(forces[row, k])
            assert abs(force - expected) < 0.02 * ACROSS * R
            against = -np.sum((np.conj(middle) * push).imag)
            assert against == pytest.approx(moments[row, k], abs=0.02 * ACROSS * R**2)


@pytest.mark.parametrize("family", ["ee", "cic"])
def test_torques_do_the_work_of_the_flow(family):
    _, moments, through = of(family)
    np.testing.assert_allclose(np.sum(moments, axis=0), ACROSS * through, rtol=1e-9)


def test_gear_and_equivalent_load():
    force = complex(*tooth_force(*map(jnp.asarray, (3.3, R, np.radians(20)))))
    assert abs(force) == pytest.approx(3.3 / R / np.cos(np.radians(20)))
    # Its moment about rotor 2, in its own sense (clockwise), from the pitch point at (-r, 0).
    assert -(np.conj(-R) * force).imag == pytest.approx(3.3)
    # A torque the other way turns the push round; the teeth part the rotors all the same.
    back = complex(*tooth_force(*map(jnp.asarray, (-3.3, R, np.radians(20)))))
    assert back == pytest.approx(force.conjugate())
    assert back.real > 0
    given = jnp.asarray([[10.0 + 0j, 10.0j], [20.0, 0.0]])
    found = loads.equivalent_load(given, 3.0)
    np.testing.assert_allclose(found, [10.0, 20 * 0.5 ** (1 / 3)])
