"""Tests of the loads: gas torque against geometry and displaced volume."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rootsopt.config import load
from rootsopt.dynamics.parts import Motion
from rootsopt.scene import Scene, design_vector, outline_mm
from tests.scene.test_scene import pair_of

GAS = ["scene.load={pressure_difference_Pa: 4e4}"]


@pytest.mark.parametrize(
    ("family", "overrides"),
    [("cic_drawn", ["profile.involute_length_mm=7"]), ("ee", []), ("ee", ["profile.lobes=2"])],
)
def test_the_mean_gas_torque_is_the_displaced_volume(family, overrides):
    """Over a revolution, both rotors together take Δp times the displaced volume / 2π.

    The volume is twice the difference of the bore and the rotor, from the outline's polygon."""
    pair, config = pair_of([*GAS, *overrides], family)
    phi = np.linspace(0, 2 * np.pi, 60001)[:-1] + 1e-6
    torques = pair.load.torque1, pair.load.torque2
    means = [np.mean(jax.jit(jax.vmap(torque))(phi)) for torque in torques]
    x, y = 1e-3 * outline_mm(config).T
    area = abs(np.sum(x[:-1] * y[1:] - x[1:] * y[:-1])) / 2
    volume = 2 * (np.pi * np.max(np.hypot(x, y)) ** 2 - area) * 0.1
    # A polygon of some hundred corners a lobe has its area to 1e-5.
    assert sum(means) == pytest.approx(4e4 * volume / (2 * np.pi), rel=3e-5)
    np.testing.assert_allclose(means, float(pair.load.torque), rtol=1e-6)


def along(model, design, phi):
    """Return the torque on rotor 2, and the margins."""
    gas = model.pair(design).load
    rest = jnp.zeros(())

    def each(phi):
        return gas.torque2(phi), gas.margins(Motion(phi, rest, rest, rest), jnp.zeros(0))

    return jax.vmap(each)(phi)


_along = eqx.filter_jit(along)
_slopes = eqx.filter_jit(jax.jacfwd(lambda m, d, phi: along(m, d, phi)[0], 1))


@pytest.mark.parametrize("length", [7.0, 8.893, 9.0])
def test_gas_torque_has_no_jump_and_its_derivative_is_that_of_differences(length):
    """This also holds at and past the longest involute, where the whole tip arc meshes at once."""
    config = load("configs/cic_drawn.yaml", [*GAS, f"profile.involute_length_mm={length}"])
    model, design = Scene.from_config(config), design_vector(config)
    phi = jnp.linspace(0.001, 1.04, 4001)

    here, margins = (np.asarray(x) for x in _along(model, design, phi))
    # It rises by its mean in no less than a quarter of a brief stretch, 0.01 rad.
    assert np.max(abs(np.diff(here))) < np.mean(here) * 1.2 * np.ptp(phi) / 4000 / 0.0025
    # Margins must not jump where they change their sign: they locate and move events.
    assert np.max(abs(np.diff(margins, axis=0))) < 200 * float(phi[1] - phi[0])
    if length == 8.893:
        return  # The longest to within rounding of its own difference.
    for unit, found in zip(jnp.eye(3), _slopes(model, design, phi).T, strict=True):
        ends = [np.asarray(_along(model, design + way * unit, phi)[0]) for way in (-1e-5, 1e-5)]
        expected = (ends[1] - ends[0]) / 2e-5
        # Where pieces meet the difference straddles a kink.
        assert np.mean(abs(found - expected) > 1e-5 * np.max(abs(expected))) < 0.002


@pytest.mark.parametrize("length", [8.89, 9.0])
def test_steps_end_where_a_spread_jump_begins_and_ends(length):
    """Wherever the slope of the torque has a kink, a flag changes. The kinks are found in the
    torque."""
    pair, _ = pair_of([*GAS, f"profile.involute_length_mm={length}"])
    phi = jnp.linspace(0.02, 1.02, 10001)

    def flags(phi):
        still = jnp.zeros(())
        return pair.load.switches(Motion(phi, still, still, jnp.ones(())), np.zeros(0))

    bend = np.asarray(jax.jit(jax.vmap(jax.grad(jax.grad(pair.load.torque2))))(phi))
    places = np.flatnonzero(np.any(np.diff(jax.jit(jax.vmap(flags))(phi), axis=0), axis=1))
    # The ramp over 0.01 rad bends a hundred times more than the smooth torque beside it.
    jumps = np.flatnonzero(abs(np.diff(bend)) > 0.3 * np.max(abs(bend)))
    assert len(jumps) >= 2
    assert all(np.min(abs(places - jump)) <= 1 for jump in jumps)
