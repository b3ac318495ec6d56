"""Bearing loads against pressure on polygons, and by virtual work."""

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
    across, phi, outer = jnp.asarray(ACROSS), jnp.asarray(PHI), shape.outer_radius
    load = GasLoad(across, profile, outer, jnp.asarray(1.0))
    own = jax.vmap(lambda phi: jnp.stack([load.torque1(phi), load.torque2(phi)]))(phi)
    through = flow.relative_flow(profile, shape, phi) * shape.area_efficiency * outer**2
    gas = GasResultant(across, profile, outer, jnp.asarray(0.0))
    found = jnp.sum(jax.vmap(gas.slice_forces)(phi), axis=1)
    return (found[..., 0] + 1j * found[..., 1]).T, own.T, through


@pytest.mark.parametrize("family", ["ee", "cic"])
def test_pressure_on_polygons(family):
    """Sum of the pressure on the sides of each rotor's polygon, from the tip that seals to the
    contact, and of its moment about the axis. The torques do the work of the flow."""
    forces, moments, through = map(np.asarray, measured(made(family)))
    np.testing.assert_allclose(np.sum(moments, axis=0), ACROSS * through, rtol=1e-9)
    outline = outline_of(family) / 1e3
    for k in range(0, len(PHI), 5):
        first, second = place_pair(outline, LOBES, 2 * R, PHI[k], PHI[k])
        # Rotor 2 in a mirror is passed through in the same sense as rotor 1.
        for row, points in ((0, first), (1, (second * [-1, 1] + [2 * R, 0])[::-1])):
            z = points[:-1] @ [1, 1j]
            other = second if row == 0 else first * [-1, 1] + [2 * R, 0]
            near = int(np.argmin(KDTree(other).query(points[:-1])[0]))
            tips = np.arange(LOBES) * len(z) // LOBES
            tip = tips[np.argmin(np.mod(-np.pi / 2 - np.angle(z[tips]), 2 * np.pi))]
            side = np.roll(z, -tip)[: np.mod(near - tip, len(z)) + 1]
            push, middle = 1j * ACROSS * np.diff(side), (side[1:] + side[:-1]) / 2
            expected = forces[row, k] if row == 0 else -np.conj(forces[row, k])
            assert abs(np.sum(push) - expected) < 0.02 * ACROSS * R
            against = -np.sum((np.conj(middle) * push).imag)
            assert against == pytest.approx(moments[row, k], abs=0.02 * ACROSS * R**2)


def test_gear_and_equivalent_load():
    force = complex(*tooth_force(*map(jnp.asarray, (3.3, R, np.radians(20)))))
    assert abs(force) == pytest.approx(3.3 / R / np.cos(np.radians(20)))
    # Its moment about rotor 2, in its own sense (clockwise), from the pitch point at (-r, 0).
    assert -(np.conj(-R) * force).imag == pytest.approx(3.3)
    # A torque the other way turns the push round; the teeth part the rotors all the same.
    back = complex(*tooth_force(*map(jnp.asarray, (-3.3, R, np.radians(20)))))
    assert back == pytest.approx(force.conjugate())
    assert back.real > 0
    found = loads.equivalent_load(jnp.asarray([[10.0 + 0j, 10.0j], [20.0, 0.0]]), 3.0)
    np.testing.assert_allclose(found, [10.0, 20 * 0.5 ** (1 / 3)])
