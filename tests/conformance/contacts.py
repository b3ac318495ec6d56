"""Checks that every contact must pass (`rootsopt.contact.Contact`)."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments._common.polygons import pair_gap
from rootsopt.errors import InputError
from tests.conformance.kinks import along, unmarked


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
