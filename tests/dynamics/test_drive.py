"""The drives: a motor's torque-speed line, and what its freedom changes of time and averages."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from rootsopt.dynamics.parts import MotorDrive
from tests.scene.test_scene import MOTOR, pair_of


def test_a_motor_follows_its_line():
    motor = MotorDrive(*(jnp.asarray(x) for x in (300.0, 5.0, 0.1, 0.0)))
    assert float(motor.torque_at(jnp.asarray(300.0))) == 5.0
    assert float(motor.torque_at(jnp.asarray(290.0))) == pytest.approx(6.0)
    assert float(motor.torque_at(jnp.asarray(380.0))) == pytest.approx(-3.0)


def test_a_motor_without_torque_of_its_own_balances_the_load():
    """A constant load acts on rotor 2 alone, gas on both rotors."""
    pair, config = pair_of(MOTOR)
    assert float(pair.drive.torque) == pytest.approx(config.scene.load.torque_N_m)
    pair, _ = pair_of([*MOTOR, "scene.load={pressure_difference_Pa: 5e4}"])
    assert float(pair.drive.torque) == pytest.approx(2 * float(pair.load.torque))
    pair, _ = pair_of(["scene.drive=torque", "scene.motor={slope_N_m_s_per_rad: 1, torque_N_m: 7}"])
    assert float(pair.drive.torque) == 7.0


def test_time_passes_as_the_rotor_turns():
    """dt/dτ is the mesh period over the speed's ratio, and a mesh period takes ∫ lapse dτ."""
    pair, _ = pair_of(MOTOR)
    assert pair.states == 3
    share = pair.angle_scale / pair.mesh_period / pair.drive.speed
    state = jnp.asarray([0.1, -0.2, 0.02 / share])
    assert float(pair.speed(state)) == pytest.approx(1.02 * float(pair.drive.speed))
    assert float(pair.lapse(state)) == pytest.approx(1 / 1.02)
    # A stalled motor creeps on, so that τ, and with it the integration, can go on to its end.
    stalled = jnp.asarray([0.0, 0.0, -2 / share])
    assert bool(pair.stalled(stalled))
    assert bool(pair.lost(stalled))
    assert float(pair.lapse(stalled)) == pytest.approx(40.0)
    assert not bool(pair.lost(state))
    slope, _ = eqx.filter_jit(pair.derivative)(jnp.asarray(0.3), stalled)
    np.testing.assert_array_equal(slope, 0)
