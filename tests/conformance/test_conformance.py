"""Tests every contact, law and part of the package in its conformance suite."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments._common.polygons import pair_gap
from rootsopt.contact import ImpactLaw
from rootsopt.contact.gap import ContactPoint
from rootsopt.contact.search import SearchContact
from rootsopt.dynamics.parts import (
    ConstantLoad,
    Friction,
    GasLoad,
    MotorDrive,
    Part,
    PrescribedDrive,
    Supports,
    TimingGear,
)
from tests.conformance.families import LOBES, R, made, measure, outline_of
from tests.conformance.kinks import along, unmarked
from tests.conformance.laws import check_law
from tests.conformance.parts import SPEED, check_part, size
from tests.standins import SCALE, Far, oscillator, refusal


@eqx.filter_jit
def _look(contact, rolls, relatives):
    """Return gap, levers and derivatives of the gap with respect to φ1 and φ2, at many poses."""

    def at(pose):
        def gap(turns):
            # x = -(φ1 + φ2) / 2, ε = φ2 - φ1.
            moved = pose[0] - (turns[0] + turns[1]) / 2, pose[1] + turns[1] - turns[0]
            found = contact(*moved)
            return found[0], found

        (_, found), slopes = jax.value_and_grad(gap, has_aux=True)(jnp.zeros(2))
        return *found, slopes

    return jax.lax.map(at, (jnp.asarray(rolls), jnp.asarray(relatives)))


@pytest.mark.parametrize("two_sided", [False, True])
def test_contacts(two_sided):
    """Gaps are those of polygons, and levers the derivatives of the gap."""
    profile, deepest = made("cic"), -2e-3
    distance = jnp.asarray(2 * R) if two_sided else None
    contact = eqx.filter_jit(SearchContact.of)(profile, distance, two_sided=two_sided)
    rng = np.random.default_rng(9)
    half = float(profile.half_pitch)
    rolls = rng.uniform(0.02, 2 * half - 0.02, 80)
    relatives = deepest * rng.uniform(0.05, 1, 80)
    gap, lever1, lever2, slopes = (np.asarray(x) for x in _look(contact, rolls, relatives))
    deep = gap < -1e-7
    assert np.mean(deep) > 0.4
    for x, e, found in np.stack([rolls, relatives, gap], 1)[deep][:25]:
        expected = pair_gap(outline_of("cic"), LOBES, 2e3 * R, -x - e / 2, -x + e / 2)
        assert found == pytest.approx(expected * 1e-3, abs=2e-8, rel=0)
    # Virtual work: d gap = -lever1 dφ1 + lever2 dφ2.
    np.testing.assert_allclose(-lever1[deep], slopes[deep, 0], rtol=0, atol=1e-9)
    np.testing.assert_allclose(lever2[deep], slopes[deep, 1], rtol=0, atol=1e-9)
    # The gap is the same one mesh period later, and with the rotors exchanged.
    *again, _ = _look(contact, rolls + 4 * half, relatives)
    *other, _ = _look(contact, 2 * half - rolls, relatives)
    for found, first in ((again, (gap, lever1, lever2)), (other, (gap, lever2, lever1))):
        np.testing.assert_allclose(np.subtract(found, first)[:, deep], 0, rtol=0, atol=1e-9)
    wild = _look(contact, rng.uniform(-50, 50, 80), rng.uniform(-0.3, 0.3, 80))
    assert all(np.all(np.isfinite(x)) for x in wild)
    _check_kinks(contact, half, deepest)
    pose = jnp.asarray(rolls[deep][0]), jnp.asarray(relatives[deep][0])
    np.testing.assert_allclose(_misplaced(contact, *pose), 0.0, atol=1e-9)


def _check_kinks(contact, half, deepest):
    """Check that kinks of the levers (second derivatives of the gap) are marked where flanks
    touch."""

    def function(pose):
        found = contact.approach(*pose)
        flags = contact.switches(pose[0], found)
        return jnp.stack([found.lever1, found.lever2]), jnp.append(flags, found.gap < 0)

    lines = [((0.0, share * deepest), (2 * half, 0.9 * share * deepest)) for share in (0.3, 0.9)]
    for values, slopes, flags in along(function, lines):
        missed = unmarked(values, slopes, flags)
        missed = missed[flags[missed, -1] & flags[missed + 1, -1]]
        assert missed.size == 0, f"kinks of the levers that no switch marks: {missed}"


@eqx.filter_jit
def _misplaced(contact, roll, relative):
    """Return errors (m) of the gap from the point of contact, and of its slope with distance."""
    found = contact.approach(roll, relative)
    point = contact.point(roll, relative, found)
    gap = contact.center_distance * point.radial - point.support1 - point.support2
    by_distance = jax.grad(lambda distance: contact.at_distance(distance)(roll, relative)[0])
    return found.gap - gap, by_distance(contact.center_distance) - point.radial


def arrays(*numbers):
    return [jnp.asarray(float(x)) for x in numbers]


@pytest.mark.parametrize(("exponent", "smoothing"), [(2.2, 1e-6), (1.5, 1e-6), (2.2, 0.0)])
def test_laws(exponent, smoothing):
    """With any exponent, the force at 20 µm is the same, and the damping can release it."""
    stiffness = 4e11 * 2e-5 ** (2.2 - exponent)
    law = ImpactLaw(*arrays(stiffness, exponent, 250, 1e-5, smoothing))
    check_law(law, 2e-5, 0.3, smoothing)


def held(part, motion, own):
    """Return the energy (J) of a gear with sharp edges."""
    excess = jnp.maximum(jnp.abs(motion.relative - part.offset) - part.half_backlash, 0)
    return part.stiffness * excess**2 / 2


def rubbed(part, motion, own):
    """Return the power (W) that the damper of such a gear dissipates."""
    engaged = jnp.abs(motion.relative - part.offset) > part.half_backlash
    return jnp.where(engaged, part.damping * motion.rate**2, 0.0)


def driven(part, motion, own):
    return part.torque_on_1(motion, own) * motion.speed


def against(part, motion, own):
    first = part.torque1(motion.phi)
    first = 0.0 if first is None else first
    return -first * motion.speed - part.torque2(motion.phi) * (motion.speed + motion.rate)


PARTS = {
    "prescribed drive": (lambda: PrescribedDrive(*arrays(SPEED)), {}),
    "motor": (lambda: MotorDrive(*arrays(SPEED, 5, 0.1, 1e-3)), {"supply": driven}),
    "load": (lambda: ConstantLoad(*arrays(5)), {"supply": against}),
    "gas": (
        lambda: GasLoad(*arrays(4e3), made("cic"), measure(made("cic")).outer_radius, *arrays(5)),
        {"supply": against},
    ),
    "sharp gear": (
        lambda: TimingGear(*arrays(2e4, 1.7, 1.5e-3, 0, 4e-4)),
        {"energy": held, "losses": rubbed},
    ),
    "friction": (lambda: Friction(*arrays(0.1, 0.05, 0.1, 1.0)), {}),
    "supports": (
        lambda: Supports(*arrays(2e8, 5e3, 3.0, R)),
        {
            "energy": lambda part, motion, own: part.stiffness * jnp.sum(motion.shift**2) / 2,
            "losses": lambda part, motion, own: part.damping * jnp.sum(motion.drift**2),
        },
    ),
}


@pytest.mark.parametrize("name", PARTS)
def test_parts(name):
    make, powers = PARTS[name]
    check_part(make(), **powers)


def test_what_a_part_leaves_alone_costs_nothing():
    pair = oscillator()
    assert size(dataclasses.replace(pair, parts=(Part(), Part()))) == size(pair)


class Unbalance(Part):
    """Force on the axes that turns with the rotors."""

    pull: jnp.ndarray

    def force_on_axes(self, motion, own):
        turns = jnp.stack([motion.phi, -motion.phi - motion.relative])
        return self.pull * jnp.stack([jnp.cos(turns), jnp.sin(turns)], axis=-1)


class FarAnywhere(Far):
    """The contact `Far` at any distance of the axes."""

    two_sided = True
    center_distance = jnp.asarray(2 * R)

    def at_distance(self, distance):
        return self

    def point(self, roll, relative, approach):
        return ContactPoint(*(jnp.ones_like(roll) for _ in range(3)))


def test_a_part_that_acts_on_axes_needs_them_to_move():
    """With rigid bearings its force adds nothing; on supports each axis starts to move with F /
    m."""
    pair = oscillator()
    pulls = (Unbalance(jnp.asarray(7.0)),)
    assert size(dataclasses.replace(pair, parts=pulls))[:2] == size(pair)[:2]
    supports = PARTS["supports"][0]()
    moving = oscillator(contact=FarAnywhere(), two_sided=True, supports=supports, parts=pulls)
    slope, _ = jax.jit(lambda y: moving.derivative(jnp.asarray(0.2), y))(jnp.zeros(10))
    turn = 0.2 * 2 * np.pi / LOBES
    expected = 7.0 / 3.0 * np.array([np.cos(turn), np.sin(turn), np.cos(turn), -np.sin(turn)])
    period = float(moving.mesh_period)
    np.testing.assert_allclose(slope[6:], expected * period**2 / (SCALE * R), rtol=1e-12)
    assert np.all(np.asarray(slope[2:6]) == 0)


def test_parts_that_exclude_each_other_are_refused():
    supports = PARTS["supports"][0]()
    assert "`two_sided` = False" in refusal(oscillator, supports=supports)
    twice = {"supports": supports, "parts": (supports,)}
    assert "Supports and Supports both" in refusal(oscillator, **twice)
    assert "right for one of them at a time" in refusal(oscillator, two_sided=True)
    rubbing = oscillator(parts=(PARTS["friction"][0](),))
    message = refusal(rubbing.derivative, jnp.zeros(()), jnp.zeros(2))
    assert "does not give the point of contact, which friction" in message
