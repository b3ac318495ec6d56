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
from rootsopt.errors import InputError
from rootsopt.profiles import CIC, EE, geometry
from tests.conformance.kinks import along, unmarked
from tests.conformance.laws import check_law
from tests.conformance.parts import SPEED, check_part, size
from tests.standins import LOBES, SCALE, Far, oscillator

R = 0.033
PROFILES = {
    "cic": CIC(3, R, np.radians(36.43), 8.0e-3, np.radians(4.0)),
    "ee": EE(3, R),
}


@eqx.filter_jit
def _look(contact, rolls, relatives):
    """Return gap, levers and derivatives of the gap with respect to φ1 and φ2, at many poses."""

    def at(roll, relative):
        # x = -(φ1 + φ2) / 2, ε = φ2 - φ1.
        gap, slopes = jax.value_and_grad(
            lambda turns: contact(roll - (turns[0] + turns[1]) / 2, relative + turns[1] - turns[0])[
                0
            ]
        )(jnp.zeros(2))
        return gap, *contact(roll, relative), slopes

    return jax.lax.map(lambda pose: at(*pose), (jnp.asarray(rolls), jnp.asarray(relatives)))


def check_contact(contact, profile, outline, deepest, gap_error, lever_error=1e-12):
    """Check a contact of `profile`, whose closed `outline` (n, 2) (m) comes from another method.

    `deepest` (rad) < 0: ε down to which the contact is used; `gap_error` (m): promised error of the
    gap against the polygon; `lever_error` (m): promised difference between the levers and the
    derivatives of the gap."""
    rng = np.random.default_rng(9)
    half, lobes = float(profile.half_pitch), profile.lobes
    rolls = rng.uniform(0.02, 2 * half - 0.02, 80)
    relatives = deepest * rng.uniform(0.05, 1, 80)
    _, gap, lever1, lever2, slopes = (np.asarray(x) for x in _look(contact, rolls, relatives))
    deep = gap < -1e-7
    distance = 2 * float(profile.pitch_radius)
    assert np.mean(deep) > 0.4
    for x, e, found in np.stack([rolls, relatives, gap], 1)[deep][:25]:
        expected = pair_gap(outline, lobes, distance, -x - e / 2, -x + e / 2)
        assert found == pytest.approx(expected, abs=gap_error, rel=0)
    # Virtual work: d gap = -lever1 dφ1 + lever2 dφ2.
    np.testing.assert_allclose(-lever1[deep], slopes[deep, 0], rtol=0, atol=lever_error)
    np.testing.assert_allclose(lever2[deep], slopes[deep, 1], rtol=0, atol=lever_error)
    # The gap is the same one mesh period later, and with the rotors exchanged.
    _, *again, _ = _look(contact, rolls + 4 * half, relatives)
    _, *other, _ = _look(contact, 2 * half - rolls, relatives)
    for found, first in ((again, (gap, lever1, lever2)), (other, (gap, lever2, lever1))):
        np.testing.assert_allclose(np.subtract(found, first)[:, deep], 0, rtol=0, atol=1e-9)
    wild = _look(contact, rng.uniform(-50, 50, 80), rng.uniform(-0.3, 0.3, 80))
    assert all(np.all(np.isfinite(x)) for x in wild)
    if contact.smooth:
        _check_kinks(contact, half, deepest)
    _check_place(contact, rolls[deep][0], relatives[deep][0])


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


def _check_place(contact, roll, relative):
    """Check that the point of contact agrees with the gap, if the contact gives one."""

    def known(roll, relative):
        found = contact.approach(roll, relative)
        point = contact.point(roll, relative, found)
        gap = contact.center_distance * point.radial - point.support1 - point.support2
        by_distance = jax.grad(lambda distance: contact.at_distance(distance)(roll, relative)[0])
        return found.gap - gap, by_distance(contact.center_distance) - point.radial

    try:
        errors = jax.jit(known)(jnp.asarray(roll), jnp.asarray(relative))
    except InputError:
        assert not contact.two_sided
        with pytest.raises(InputError, match="does not give"):
            contact.at_distance(jnp.ones(()))
        return
    np.testing.assert_allclose(errors, 0.0, atol=1e-9)


@pytest.mark.parametrize(
    ("two_sided", "family"), [(False, "cic"), (True, "cic"), (True, "ee")], ids=str
)
def test_contacts(two_sided, family, graded_outline):
    profile = PROFILES[family]
    distance = jnp.asarray(2 * R) if two_sided else None
    contact = eqx.filter_jit(SearchContact.of)(profile, distance, two_sided=two_sided)
    check_contact(contact, profile, graded_outline(profile, 1000), -2e-3, 2e-8, 1e-9)


def law(exponent, smoothing):
    """Return a law with any exponent that has the same force at 20 µm, and whose damping can
    release it."""
    stiffness = 4e11 * 2e-5 ** (2.2 - exponent)
    return ImpactLaw(*(jnp.asarray(x) for x in (stiffness, exponent, 250.0, 1e-5, smoothing)))


@pytest.mark.parametrize(("exponent", "smoothing"), [(2.2, 1e-6), (1.5, 1e-6), (2.2, 0.0)])
def test_laws(exponent, smoothing):
    check_law(law(exponent, smoothing), 2e-5, 0.3, smoothing)


def arrays(*numbers):
    return [jnp.asarray(float(x)) for x in numbers]


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
        lambda: GasLoad(
            *arrays(4e3), PROFILES["cic"], geometry(PROFILES["cic"]).outer_radius, *arrays(5)
        ),
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
    with pytest.raises(InputError, match="`two_sided` = False"):
        oscillator(supports=supports)
    with pytest.raises(InputError, match="Supports and Supports both"):
        oscillator(supports=supports, parts=(supports,))
    with pytest.raises(InputError, match="right for one of them at a time"):
        oscillator(two_sided=True)
    rubbing = oscillator(parts=(PARTS["friction"][0](),))
    with pytest.raises(InputError, match="does not give the point of contact, which friction"):
        rubbing.derivative(jnp.zeros(()), jnp.zeros(2))
