"""The loads: gas torque against geometry and displaced volume."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_scene import pair_of

from rootsopt.model import outline_mm

GAS = ["scene.load={pressure_difference_Pa: 4e4}"]
LENGTH = 0.1


@pytest.mark.parametrize(
    ("family", "overrides"),
    [("cic", ["profile.involute_length_mm=7"]), ("ee", []), ("ee", ["profile.lobes=2"])],
)
def test_the_mean_gas_torque_is_the_displaced_volume(family, overrides):
    """Over a revolution both rotors together take Δp times the displaced volume over 2π: twice
    the housing's bore less the rotor, from the outline's polygon."""
    pair, config = pair_of([*GAS, *overrides], family)
    phi = np.linspace(0, 2 * np.pi, 60001)[:-1] + 1e-6
    both = [np.asarray(jax.jit(jax.vmap(f))(phi)) for f in (pair.load.torque1, pair.load.torque2)]
    x, y = 1e-3 * outline_mm(config).T
    area = abs(np.sum(x[:-1] * y[1:] - x[1:] * y[:-1])) / 2
    volume = 2 * (np.pi * np.max(np.hypot(x, y)) ** 2 - area) * LENGTH
    expected = 4e4 * volume / (2 * np.pi)
    # A polygon of some hundred corners a lobe has its area to 1e-5.
    assert np.mean(both[0] + both[1]) == pytest.approx(expected, rel=3e-5)
    means = [np.mean(torque) for torque in both]
    np.testing.assert_allclose(means, float(pair.load.torque), rtol=1e-6)


@pytest.mark.parametrize("family", ["cic", "ee"])
def test_gas_torque_follows_the_radius_of_contact(family):
    """A vane from the point of contact to the tip, found on the outline; at the line of centres
    the tip of one rotor seals and takes no torque."""
    pair, config = pair_of([*GAS, *(["profile.involute_length_mm=7"] * (family == "cic"))], family)
    x, y = 1e-3 * outline_mm(config).T
    points, outer = x + 1j * y, np.max(np.hypot(x, y))
    radius, lobes = 0.033, 3
    assert float(pair.load.torque1(0.0)) == pytest.approx(0, abs=1e-12)
    assert float(pair.load.torque2(jnp.pi / lobes)) == pytest.approx(0, abs=1e-12)
    for phi in (0.2, 0.5, 0.9, 1.3, 1.9):
        # In contact the two outlines, placed by hand, come closest at a point of both.
        first = points * np.exp(1j * phi)
        second = 2 * radius - np.conjugate(points * np.exp(1j * (phi + np.pi / lobes)))
        apart = abs(first[:, None] - second[None, :])
        i, j = np.unravel_index(np.argmin(apart), apart.shape)
        assert apart[i, j] < 3e-4
        for number, place in ((1, first[i]), (2, second[j] - 2 * radius)):
            torque = 4e4 * LENGTH * (outer**2 - abs(place) ** 2) / 2
            found = getattr(pair.load, f"torque{number}")(phi)
            assert float(found) == pytest.approx(torque, abs=0.02 * float(pair.load.torque) + 1e-6)


def test_switches_of_gas_mark_where_its_torque_jumps():
    """Past the longest involute the whole tip arc meshes at once: the torque jumps, and its
    switch changes there."""
    pair, _ = pair_of(GAS)
    phi = jnp.linspace(0.001, 1.0, 20001)
    torque = np.asarray(jax.jit(jax.vmap(pair.load.torque2))(phi))
    jump = np.argmax(abs(np.diff(torque)))
    assert abs(np.diff(torque))[jump] > 0.1 * float(pair.load.torque)
    flags = np.asarray(jax.jit(jax.vmap(pair.load.switches))(phi))
    assert np.any(flags[jump] != flags[jump + 1])
    assert np.sum(np.any(flags[1:] != flags[:-1], axis=1)) <= 3
