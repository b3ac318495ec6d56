"""Tests of a pair, its loads and drives, against closed forms, geometry and displaced volume."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rootsopt import Scene, Status, load_config
from rootsopt.dynamics.parts import ConstantLoad, Friction, Motion, MotorDrive
from rootsopt.dynamics.steady import TOO_DEEP
from rootsopt.scene import outline_mm
from tests.scene.test_scene import MOTOR, pair_of
from tests.standins import HALF_BACKLASH, INERTIA, LOAD, LOBES, SCALE, SPEED, Near, oscillator

GAS = ["scene.load={pressure_difference_Pa: 4e4}"]


@pytest.mark.parametrize(
    ("family", "overrides"),
    [("cic_drawn", ["profile.involute_length_mm=7"]), ("ee", ["profile.lobes=2"])],
)
def test_the_mean_gas_torque_is_the_displaced_volume(family, overrides):
    """Over a revolution, both rotors together take Δp times the displaced volume / 2π.

    The volume is twice the difference of the bore and the rotor, from the outline's polygon."""
    pair, config = pair_of([*GAS, *overrides], family)
    phi = np.linspace(0, 2 * np.pi, 60001)[:-1] + 1e-6
    both = jax.jit(jax.vmap(lambda phi: (pair.load.torque1(phi), pair.load.torque2(phi))))
    means = np.mean(both(phi), axis=1)
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
    config = load_config("configs/cic_drawn.yaml", [*GAS, f"profile.involute_length_mm={length}"])
    model, design = Scene.from_config(config), jnp.asarray(config.design)
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


@eqx.filter_jit
def bends_and_flags(load, phi):
    """Return the second derivative of the torque on rotor 2, and the flags."""
    still, turning = jnp.zeros(()), jnp.ones(())
    flags = jax.vmap(lambda x: load.switches(Motion(x, still, still, turning), np.zeros(0)))
    return jax.vmap(jax.grad(jax.grad(load.torque2)))(phi), flags(phi)


@pytest.mark.parametrize("length", [8.89, 9.0])
def test_steps_end_where_a_spread_jump_begins_and_ends(length):
    """Wherever the slope of the torque has a kink, a flag changes. The kinks are found in the
    torque."""
    pair, _ = pair_of([*GAS, f"profile.involute_length_mm={length}"])
    bend, flags = map(np.asarray, bends_and_flags(pair.load, jnp.linspace(0.02, 1.02, 10001)))
    places = np.flatnonzero(np.any(np.diff(flags, axis=0), axis=1))
    # The ramp over 0.01 rad bends a hundred times more than the smooth torque beside it.
    jumps = np.flatnonzero(abs(np.diff(bend)) > 0.3 * np.max(abs(bend)))
    assert len(jumps) >= 2
    assert all(np.min(abs(places - jump)) <= 1 for jump in jumps)


# Drives: a motor's characteristic, and its effect on time and averages


def test_a_motor_without_torque_of_its_own_balances_the_load():
    """A constant load acts on rotor 2 alone, gas on both rotors."""
    pair, config = pair_of(MOTOR)
    assert float(pair.drive.torque) == pytest.approx(config.scene.load.torque_N_m)
    pair, _ = pair_of([*MOTOR, *GAS])
    assert float(pair.drive.torque) == pytest.approx(2 * float(pair.load.torque))


def test_a_stalled_motor_keeps_creeping():
    """τ and the integration can reach their end."""
    pair, _ = pair_of(MOTOR)
    stalled = -2 * pair.mesh_period * pair.drive.speed / pair.angle_scale * jnp.eye(3)[2]
    assert bool(pair.stalled(stalled))
    assert bool(pair.lost(stalled))
    assert float(pair.lapse(stalled)) == pytest.approx(40.0)
    assert not bool(pair.lost(0.01 * stalled))
    slope, _ = eqx.filter_jit(pair.derivative)(jnp.asarray(0.3), stalled)
    np.testing.assert_array_equal(slope, 0)


def test_inertia_of_a_motor_turns_with_rotor_1():
    """The excess torque accelerates rotor 1 with both inertias; the load decelerates rotor 2."""
    slope, torque, own, over = 0.2, 5.0, 7e-3, 4.0
    motor = MotorDrive(*(jnp.asarray(x) for x in (SPEED, torque, slope, own)))
    pair = oscillator(drive=motor, gear=None)
    period = 2 * np.pi / (LOBES * SPEED)
    found, _ = pair.derivative(jnp.asarray(0.2), jnp.array([0.1, 0.3, over * period / SCALE]))
    first = (torque - slope * over) / (INERTIA + own)
    lapse = SPEED / (SPEED + over)
    unit = lapse * period**2 / SCALE
    expected = [lapse * 0.3, unit * (-LOAD / INERTIA - first), unit * first]
    np.testing.assert_allclose(found, expected, rtol=1e-12)


def test_motor_of_a_config_is_that_of_its_pair():
    motor = "scene.motor={slope_N_m_s_per_rad: 0.3, torque_N_m: 6, inertia_kg_m2: 0.004}"
    config = load_config("configs/cic_drawn.yaml", ["scene.drive=torque", motor])
    drive = Scene.from_config(config)._drive(ConstantLoad(jnp.asarray(LOAD)))
    assert isinstance(drive, MotorDrive)
    numbers = [float(x) for x in (drive.speed, drive.torque, drive.slope, drive.inertia)]
    assert numbers == pytest.approx([100 * np.pi, 6, 0.3, 0.004])


# Sides, switches, limits and friction of a pair, against closed forms


def test_rotor_2_behind_touches_the_drive_flank():
    """ε < 0: rotor 2 lags, so that rotor 1 drives it forward; ε > 0: the other way about."""
    pair = oscillator(contact=Near())
    force = 1e9 * (0.03 * 1e-3) ** 1.5
    for relative, drive, coast in ((-1e-3, force, 0.0), (1e-3, 0.0, force)):
        found = pair.contact_force(jnp.asarray(0.1), jnp.asarray(relative), jnp.asarray(0.0))
        torque = 0.03 * (drive - coast)
        expected = drive, coast, force, -torque, torque
        shown = found.drive, found.coast, found.total, found.torque1, found.torque2
        np.testing.assert_allclose(shown, expected, rtol=1e-12)


def test_switches_of_a_pair_are_those_of_its_parts():
    """They change where the penetration passes the rounding of the onset and the depth of full
    damping, and |ε| the backlash and its rounding; a flank out of reach is of no account."""
    pair = oscillator(contact=Near())
    switches = jax.jit(lambda relative: pair.switches(jnp.asarray(0.2), relative))
    places = {1: 1e-7 / 0.03, 2: 1e-5 / 0.03, 6: HALF_BACKLASH, 7: HALF_BACKLASH + 1e-6}
    for side in (-1, 1):
        for number, place in places.items():
            ends = (jnp.array([side * x * place / SCALE, 0.0]) for x in (0.9999, 1.0001))
            assert [bool(switches(state)[0][number]) for state in ends] == [False, True]
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
    found = law(jnp.asarray([speed, -speed]))
    np.testing.assert_allclose(found, [expected, -expected], atol=1e-15)
