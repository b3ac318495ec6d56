"""Tests of the drives: a motor's characteristic, and its effect on time and averages."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from rootsopt.config import load
from rootsopt.dynamics.parts import ConstantLoad, MotorDrive
from rootsopt.scene import Scene
from tests.scene.test_scene import MOTOR, pair_of
from tests.standins import INERTIA, LOAD, LOBES, SCALE, SPEED, oscillator


def test_a_motor_without_torque_of_its_own_balances_the_load():
    """A constant load acts on rotor 2 alone, gas on both rotors."""
    pair, config = pair_of(MOTOR)
    assert float(pair.drive.torque) == pytest.approx(config.scene.load.torque_N_m)
    pair, _ = pair_of([*MOTOR, "scene.load={pressure_difference_Pa: 5e4}"])
    assert float(pair.drive.torque) == pytest.approx(2 * float(pair.load.torque))
    pair, _ = pair_of(["scene.drive=torque", "scene.motor={slope_N_m_s_per_rad: 1, torque_N_m: 7}"])
    assert float(pair.drive.torque) == 7.0


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
    config = load("configs/cic_drawn.yaml", ["scene.drive=torque", motor])
    drive = Scene.from_config(config)._drive(ConstantLoad(jnp.asarray(LOAD)))
    assert isinstance(drive, MotorDrive)
    numbers = [float(x) for x in (drive.speed, drive.torque, drive.slope, drive.inertia)]
    assert numbers == pytest.approx([100 * np.pi, 6, 0.3, 0.004])
