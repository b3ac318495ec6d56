"""Bearing loads against virtual work, statics, momentum, pressure on polygons and differences."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import KDTree

import rootsopt
from rootsopt import Scene
from rootsopt.config.units import DEG
from rootsopt.dynamics.parts import GasLoad
from rootsopt.dynamics.parts.load import GasResultant, tooth_force
from rootsopt.profiles import geometry, place_pair
from rootsopt.pump import flow, loads
from rootsopt.pump.loads import BearingSet, static_loads
from rootsopt.response.terms import needs_forces, terms_of
from rootsopt.scene.reading import GRAVITY
from tests.conformance.families import LOBES, R, made, measure, outline_of

GAS, BEARINGS = "scene.load={pressure_difference_Pa: 5e4}", "scene.bearings={weight: true}"


def scene_of(*changes: str) -> tuple[Scene, jnp.ndarray]:
    config = rootsopt.load_config("cic_drawn", changes)
    return Scene.from_config(config), jnp.asarray(config.design)


bearing_set = eqx.filter_jit(BearingSet.of)


@pytest.fixture(scope="module")
def twisted():
    bearings = bearing_set(*scene_of(GAS, BEARINGS, "rotor.helix_deg=50", "solver.slices=4"))
    pair = bearings.pair

    @jax.jit
    def at(tau, state):
        motion = pair.motion(tau, state)
        return bearings.at(tau, state), pair.pushes(motion), pair.contact_at(tau, state), motion

    return bearings, [
        at(jnp.asarray(t), jnp.asarray([x, 0.3]))
        for t, x in ((0.13, 0.4), (0.31, -0.9), (0.62, 1.1), (0.9, -0.6))
    ]


def test_push_acts_on_its_line(twisted):
    """The moment of the force at its place is the torque, on either rotor."""
    bearings, found = twisted
    for _, pushes, contact, _ in found:
        force, place = (np.asarray(x) @ [1, 1j] for x in (pushes.force, pushes.place))
        on_1 = (np.conj(place) * -force).imag
        # Rotor 2 turns clockwise.
        on_2 = -(np.conj(place - 2 * float(bearings.loads.radius)) * force).imag
        np.testing.assert_allclose(on_1, pushes.torque[..., 0], rtol=1e-9, atol=1e-12)
        # To first order in the penetration: the force is one, its places on the rotors are two.
        np.testing.assert_allclose(on_2, pushes.torque[..., 1], rtol=1e-2, atol=1e-9)
        assert np.sum(np.abs(force)) == pytest.approx(float(contact.total), rel=1e-12)
        assert np.sum(pushes.torque[..., 1]) == pytest.approx(float(contact.torque2), rel=1e-12)


def test_axial_force_does_the_work_of_a_shift(twisted):
    """A shift of rotor 1 along its axis turns each of its sections: the energy of the slices."""
    bearings, found = twisted
    pair = dataclasses.replace(bearings.pair, contact=bearings.pair.contact.section)
    slices, step = bearings.pair.contact.slices, 1e-6

    @jax.jit
    @jax.vmap
    def depth(phi, other):
        return pair.contact_force(phi, other - phi, jnp.zeros(())).depth

    contact_only = eqx.tree_at(lambda s: s.loads.gas, bearings, None, is_leaf=lambda x: x is None)
    for _, pushes, _, motion in found:
        sections = np.asarray(motion.phi + slices.offsets)
        others = sections + float(motion.relative)
        turned = step * float(slices.twist) / float(bearings.length)
        slope = (depth(sections - turned, others) - depth(sections + turned, others)) / (2 * step)
        size = np.linalg.norm(np.asarray(pushes.force)[:, 0], axis=-1)
        axial = contact_only._from_flanks(pushes, jnp.zeros(4))[2]
        assert float(axial[0]) == pytest.approx(-np.sum(size * np.asarray(slope)), rel=1e-6)
        # What one rotor feels, the other feels in the opposite sense, but for the penetration.
        assert float(axial[1]) == pytest.approx(-float(axial[0]), rel=2e-2)


def test_bearings_balance_all_forces(twisted):
    """Sum and moments of the bearing loads, from the forces one by one."""
    bearings, found = twisted
    gas, loads = bearings.loads.gas, bearings.loads
    length, slices = float(bearings.length), gas.slices
    heights, rate = length * np.asarray(slices.places), float(slices.twist) / length
    slice_forces, chords = eqx.filter_jit(gas.slice_forces), eqx.filter_jit(gas.chords)
    for out, pushes, _, motion in found:
        pressed = np.asarray(slice_forces(motion.phi))
        torque = loads.gear(motion.relative, motion.rate)
        teeth = np.outer([-1, 1], tooth_force(-torque, loads.radius, loads.tooth_angle))
        force = np.asarray(pushes.force).sum(1)
        flank = np.stack([-force, force], axis=1)
        total = (flank + pressed).sum(0) + teeth + [0, -float(loads.weight)]
        np.testing.assert_allclose(np.asarray(out.radial).sum(1), total, rtol=1e-9)
        place = np.asarray(pushes.place)[:, 0]
        places = np.stack([place, place - [2 * float(loads.radius), 0]], axis=1)
        contact, tip = (np.asarray(x) * [[1, 1], [-1, 1]] for x in chords(motion.phi))
        axial = -rate * np.asarray(pushes.torque)[:, 0]
        against = (np.sum(tip**2, -1) - np.sum(contact**2, -1)) / 2
        across = rate * float(gas.pressure_length) * np.asarray(slices.weights)[:, None] * against
        np.testing.assert_allclose(out.axial, (axial + across).sum(0), rtol=1e-9)
        # Moments about the middle: r x F, with all three components of each force.
        up = np.broadcast_to(heights[:, None, None], (len(heights), 2, 1))
        moment = sum(
            np.cross(np.dstack([at, up]), np.dstack([push, along])).sum(0)
            for at, push, along in (
                (places, flank, axial), ((contact + tip) / 2, pressed, across)
            )
        )  # fmt: skip
        np.testing.assert_allclose(out.tilting, moment[:, :2], rtol=1e-9, atol=1e-12)
        moment += np.cross([0, 0, float(bearings.gear)], np.pad(teeth, ((0, 0), (0, 1))))
        ends = np.outer([1, -1], [0, 0, float(bearings.bearing)])
        carried = np.cross(ends, np.pad(out.radial, ((0, 0), (0, 0), (0, 1)))).sum(1)
        np.testing.assert_allclose(carried[:, :2], moment[:, :2], rtol=1e-9, atol=1e-12)
    assert (float(bearings.bearing), float(bearings.gear)) == pytest.approx((0.07, 0.1))
    area = float(measure(scene_of()[0].profile(jnp.asarray([36.43, 9.0, 4.0]))).area)
    assert float(loads.weight) == pytest.approx(GRAVITY * 7800 * 0.1 * area)


def test_pockets_of_twisted_rotors_open_at_once():
    """At the leading end: all tips of a pocket jump back together, on either rotor."""
    scene, design = scene_of(GAS, BEARINGS, "rotor.helix_deg=-50", "solver.slices=4")
    gas = bearing_set(scene, design).loads.gas
    phi = np.linspace(0, 2 * np.pi / 3, 2001)
    tips = np.asarray(jax.jit(jax.vmap(lambda x: gas.chords(x)[1]))(phi)) @ [1, 1j]
    back = np.angle(tips[1:] / tips[:-1]) < -1
    assert np.array_equal(back.sum(0), np.ones((4, 2)))
    assert np.array_equal(back, np.repeat(back[:, :1], 4, axis=1))
    for rotor in range(2):
        k = int(np.argmax(back[:, 0, rotor]))
        ends = np.angle(tips[k, :, rotor]) - np.asarray(gas.slices.offsets)
        # The end that leads by half the twist is at the lowest point.
        np.testing.assert_allclose(ends + 25 * DEG, -np.pi / 2, atol=2e-3)
        assert np.min(np.abs(np.mod(np.asarray(gas.corners()) - phi[k], 2 * np.pi / 3))) < 2e-3


def test_static_loads():
    """Gear and gas alone, from the formulas. Loads along a motion need its forces."""
    scene, design = scene_of(GAS, "scene.bearings={bearing_distance_mm: 0, kind: ball}")
    assert needs_forces(scene, *terms_of(["bearing_load_equivalent_N"]), design)
    bearings = bearing_set(scene, design)
    phi = 2 * np.pi / 3 * (np.arange(720) + 0.5) / 720
    pressed = jax.jit(jax.vmap(bearings.loads.gas.slice_forces))(phi)
    first, second = (np.asarray(pressed)[:, 0] @ [1, 1j]).T
    torque = jax.jit(jax.vmap(bearings.pair.load.torque2))(phi)
    teeth = tooth_force(*map(jnp.asarray, (torque, 0.033, np.radians(20.0)))) @ np.array([1, 1j])
    # Half of the gas, and the gear 50 mm beyond a bearing of two that are 100 mm apart.
    each = [
        *(first / 2 - 1.5 * teeth, first / 2 + 0.5 * teeth),
        *(second / 2 + 1.5 * teeth, second / 2 - 0.5 * teeth),
    ]
    equivalent, greatest = static_loads(scene, design)
    np.testing.assert_allclose(greatest, np.max(np.abs(each), axis=1), rtol=1e-9)
    np.testing.assert_allclose(equivalent**3, np.mean(np.abs(each) ** 3, axis=1), rtol=1e-9)


# Gear and pressure on polygons


# Pressure difference times length (N/m).
ACROSS = 3e4 * 0.1
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
    for k in range(0, len(PHI), 8):
        first, second = place_pair(outline_of(family) / 1e3, LOBES, 2 * R, PHI[k], PHI[k])
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
    np.testing.assert_allclose(
        loads.equivalent_load(jnp.asarray([[10.0 + 0j, 10.0j], [20.0, 0.0]]), 3.0),
        [10.0, 20 * 0.5 ** (1 / 3)],
    )
