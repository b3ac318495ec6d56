"""Twisted rotors: against sections averaged by another rule, virtual work, and differences."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rootsopt import Scene
from rootsopt.contact.search import SearchContact
from rootsopt.contact.wrapped import MOST, TwistedContact, sliced_mean, slices_needed, slices_of
from rootsopt.dynamics.parts import TwistedLoad
from tests.scene.test_free_twist import scene_of

pair_of = eqx.filter_jit(Scene.pair)
torques = eqx.filter_jit(lambda load, phi: jax.vmap(load.torque2)(phi))
PHI = np.linspace(0, 2 * np.pi / 3, 1200, endpoint=False)


@eqx.filter_jit
def forces(pair, phi, relative):
    return jax.lax.map(lambda x: pair.contact_force(x, relative, jnp.asarray(0.3)), phi)


def test_slices_are_means_over_sections():
    """Gauss points against equally many degrees of a midpoint rule; error falls as n grows.

    There is a drive and a coast contact of EE rotors."""
    straight, twist = pair_of(*scene_of("ee")), jnp.asarray(np.radians(25.0))
    offsets = np.radians(25.0) * ((np.arange(600) + 0.5) / 600 - 0.5)
    contacts = [TwistedContact(straight.contact, twist, count) for count in (2, 4, 8)]
    pairs = [dataclasses.replace(straight, contact=contact) for contact in contacts]
    for depth in (-3e-4, 2e-4):
        relative, worst = jnp.asarray(-depth), np.zeros(3)
        section = forces(straight, PHI, relative)
        for k, pair in enumerate(pairs):
            found = forces(pair, PHI[::60], relative)
            for name in ("drive", "coast", "torque1", "torque2"):
                expected = sliced_mean(np.asarray(getattr(section, name)), offsets, 3)[::60]
                off = np.max(np.abs(np.asarray(getattr(found, name)) - expected))
                worst[k] = max(worst[k], off / max(np.max(np.abs(expected)), 1e-9))
        assert worst[1] < worst[0] / 4
        assert worst[2] < worst[1] / 4
        assert worst[2] < 2e-3
    # Depth is that of the deepest slice.
    places = np.asarray(slices_of(twist, 8).offsets)
    each = np.interp(places, PHI - PHI[600], np.roll(np.asarray(section.depth), 600))
    np.testing.assert_allclose(found.depth[0], np.max(each), rtol=1e-4)


def test_gas_torque_is_the_mean_over_sections():
    changes = ("scene.load={pressure_difference_Pa: 5e4}",)
    twist = "rotor.helix_deg=50", "solver.slices=12"
    one, other = (pair_of(*scene_of("ee", *changes, *x)).load for x in ((), twist))
    angles = PHI[::4]
    section = np.asarray(torques(one, angles))
    expected = sliced_mean(section, np.radians(50) * ((np.arange(500) + 0.5) / 500 - 0.5), 3)
    np.testing.assert_allclose(torques(other, angles), expected, rtol=2e-3)
    assert float(other.torque) == pytest.approx(np.mean(section), rel=1e-4)


def test_number_of_slices_follows_the_error():
    scene, design = scene_of("ee")
    fixed = scene.profile(design), scene.law, scene.clearance, jnp.asarray(scene.static_depth)
    counts = [slices_needed(*fixed, np.radians(60), error) for error in (0.1, 1e-2, 1e-3)]
    assert 2 <= counts[0] <= counts[1] <= counts[2] < MOST
    assert counts[0] < counts[2]
    assert slices_needed(*fixed, np.radians(10), 1e-2) <= counts[1]
    assert scene_of("ee", "rotor.helix_deg=60")[0].slices == counts[1]
    # A config without twist has no slices at all.
    pair = pair_of(*scene_of("ee", "scene.load={pressure_difference_Pa: 5e4}"))
    assert isinstance(pair.contact, SearchContact)
    assert not isinstance(pair.load, TwistedLoad)
    assert scene_of("ee", "rotor.helix_deg=60", "solver.slices=5")[0].slices == 5
