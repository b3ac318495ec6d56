"""Sides, switches, limits and friction of a pair, against closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rootsopt.dynamics.parts import Friction
from rootsopt.dynamics.steady import TOO_DEEP
from rootsopt.status import Status
from tests.standins import HALF_BACKLASH, SCALE, Near, oscillator


def test_rotor_2_behind_touches_the_drive_flank():
    """ε < 0: rotor 2 lags, so that rotor 1 drives it forward; ε > 0: the other way about."""
    pair = oscillator(contact=Near())
    for relative, drives in ((-1e-3, True), (1e-3, False)):
        found = pair.contact_force(jnp.asarray(0.1), jnp.asarray(relative), jnp.asarray(0.0))
        forces = float(found.drive), float(found.coast)
        assert (forces[0] > 0, forces[1] > 0) == (drives, not drives)
        assert float(found.total) == pytest.approx(1e9 * (0.03 * 1e-3) ** 1.5, rel=1e-12)
        assert float(found.torque2) == pytest.approx((1 if drives else -1) * 0.03 * max(forces))
        assert float(found.torque1) == pytest.approx(-float(found.torque2))


def test_switches_of_a_pair_are_those_of_its_parts():
    """They change where the penetration passes the rounding of the onset and the depth of full
    damping, and |ε| the backlash and its rounding; a flank out of reach is of no account."""
    pair = oscillator(contact=Near())
    switches = jax.jit(lambda relative: pair.switches(jnp.asarray(0.2), relative))
    places = {1: 1e-7 / 0.03, 2: 1e-5 / 0.03, 6: HALF_BACKLASH, 7: HALF_BACKLASH + 1e-6}
    for side in (-1, 1):
        for number, place in places.items():
            for share in (0.9999, 1.0001):
                flags, _ = switches(jnp.array([side * share * place / SCALE, 0.0]))
                assert flags[number] == (share > 1)
        flags, counts = switches(jnp.array([side * 1e-3 / SCALE, 0.0]))
        assert flags[0]
        assert bool(flags[5]) == (side < 0)
        assert np.all(counts)
    _, counts = oscillator().switches(jnp.asarray(0.2), jnp.array([0.1, 0.0]))
    assert counts.tolist() == 6 * [False] + 2 * [True]


def test_limits_are_those_that_are_told():
    """A pair is lost a quarter of the angle from a lobe's axis to its flank away; the depth that a
    status tells of is the one that sets it."""
    pair = oscillator()
    for place in (-1.001, -0.999, 0.999, 1.001):
        state = jnp.array([place * np.pi / 24 / SCALE, 0.0])
        slope, _ = pair.derivative(jnp.asarray(0.0), state)
        assert bool(pair.lost(state)) == bool(slope[1] == 0) == (abs(place) > 1)
    assert f"({100 * TOO_DEEP:g} % of the pitch radius)" in Status.TOO_DEEP.value


def test_friction_is_made_of_cubic_steps():
    """From -static to static, and on to kinetic: odd, bounded and smooth."""
    static, kinetic, low, high = 0.2, 0.1, 0.1, 1.0
    law = Friction(*map(jnp.asarray, (static, kinetic, low, high)))
    speed = np.linspace(0, 3, 601)
    shares = np.clip([(speed / low + 1) / 2, (speed - low) / (high - low)], 0, 1)
    rise, fall = 3 * shares**2 - 2 * shares**3
    expected = static * (2 * rise - 1) - (static - kinetic) * fall
    for sign in (1, -1):
        np.testing.assert_allclose(law(jnp.asarray(sign * speed)), sign * expected, atol=1e-15)
