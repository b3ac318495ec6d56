"""Motions of a pair whose gear errs over a turn, against closed forms and SciPy."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from rootsopt import Scene, Status, load_config, steady_response
from rootsopt.dynamics.closed import Start, steady_motion
from rootsopt.dynamics.flow import one_period, strobe
from rootsopt.dynamics.integrator import Integrator, Solver
from rootsopt.dynamics.orbit import Measures
from rootsopt.dynamics.parts import GearErrors
from rootsopt.dynamics.parts.base import Timescales
from rootsopt.dynamics.window import lyapunov
from tests.standins import (
    DAMPING,
    HALF_BACKLASH,
    INERTIA,
    LOAD,
    SCALE,
    SPEED,
    STIFFNESS,
    oscillator,
)

HOW = Integrator("tsit5", jnp.asarray(1e-9), 4096)
SIZE, ANGLE, TOOTH = np.array([4e-5, 3e-5]), np.array([0.3, -1.1]), 0.35


def erring(lobes, size=SIZE):
    """A pair whose gears are eccentric, and whose flanks never touch."""
    pair = oscillator(lobes=lobes)
    errors = GearErrors(*map(jnp.asarray, (size, ANGLE, TOOTH)))
    pair = eqx.tree_at(lambda p: p.gear.errors, pair, errors, is_leaf=lambda x: x is None)
    # Teeth swing fast, and the load closes the backlash slowly.
    times = Timescales(*map(jnp.asarray, (1e-3, 0.02, 1.0)))
    return eqx.tree_at(lambda p: p.timescales, pair, times, is_leaf=lambda x: x is None)


def limits(time, size=SIZE):
    """Return ε at both ends of the play, and their rates, from displacements of the centres."""
    turn = SPEED * time + ANGLE
    away, across = -np.sum(size * np.cos(turn)), size @ (np.sin(turn) * [1, -1])
    moving = np.sum(size * np.sin(turn)), size @ (np.cos(turn) * [1, -1])
    ends = [across + side * (HALF_BACKLASH + np.tan(TOOTH) * away) for side in (-1, 1)]
    return ends, [SPEED * (moving[1] + side * np.tan(TOOTH) * moving[0]) for side in (-1, 1)]


@pytest.mark.long
@pytest.mark.parametrize("lobes", [3, 4, 5, 6])
def test_orbit_is_closed_after_a_turn(lobes):
    """The silent orbit is the linear motion at every number of lobes, and stops at one turn.

    `tests/pump/test_rattle.py` has two lobes in a quicker test."""
    pair = erring(lobes)
    solver = Solver(HOW, HOW, Measures(np.zeros(0)), jnp.asarray(320.0), jnp.asarray(0.0), 8)
    numbers, rest = eqx.partition(pair, eqx.is_inexact_array)
    tangents = eqx.combine(jax.tree.map(lambda x: jnp.zeros((0, *x.shape)), numbers), rest)
    start = Start.at(pair, jnp.zeros(2), solver.max_orbit)
    found = eqx.filter_jit(steady_motion)(pair, tangents, start, jnp.asarray(0.03), solver)
    assert Status.of(int(found.status)) is Status.IDLE
    assert int(found.period) == pair.repeats == lobes
    assert found.known.elements.mesh.times.shape[0] >= 64 * 2
    drive = [limits(t)[0][0] for t in 2 * np.pi / SPEED * np.arange(8) / 8]
    error = 2 * np.fft.fft(drive)[1] / 8
    spring, mass = STIFFNESS + 1j * SPEED * DAMPING, INERTIA * SPEED**2
    swing = -mass * error / (spring - mass)
    wanted = error.real - HALF_BACKLASH - LOAD / STIFFNESS - swing.real
    assert float(found.orbit.state[0]) * SCALE == pytest.approx(wanted, rel=1e-7)


def test_every_way_of_integrating_keeps_the_phase():
    """Mesh periods in a row, one after the other, and in a window are one motion of SciPy's."""
    size = 3 * SIZE
    pair, period = erring(3, size), 2 * np.pi / (3 * SPEED)
    ends = period * np.arange(1, 17)

    def slope(time, state):
        relative, rate = state
        torque = 0.0
        for side, end, moving in zip((-1, 1), *limits(time, size), strict=True):
            if side * (relative - end) > 0:
                torque += STIFFNESS * (relative - end) + DAMPING * (rate - moving)
        return [rate, (-LOAD - torque) / INERTIA]

    how = {"rtol": 1e-11, "atol": 1e-14, "max_step": period / 200, "t_eval": ends}
    flown = solve_ivp(slope, (0, ends[-1]), [0, 0], "DOP853", **how)
    wanted = flown.y.T * [1 / SCALE, period / SCALE]
    row = eqx.filter_jit(strobe)
    states = row(pair.later(0), jnp.zeros(2), 16, HOW).states
    np.testing.assert_allclose(states, wanted, atol=2e-5)
    later = row(pair.later(5), states[4], 16, HOW).states
    np.testing.assert_allclose(later[:2], states[5:7], atol=1e-9)
    once = eqx.filter_jit(one_period)(pair.later(4).later(1), states[4], HOW)
    np.testing.assert_allclose(once.end, states[5], atol=1e-6)
    window = eqx.filter_jit(lyapunov)(pair, jnp.zeros(2), 16, HOW)
    np.testing.assert_allclose(window.end, states[15], atol=1e-4)


def _leaves(scene):
    errors = scene.gear.errors
    return errors.eccentricity, errors.angle, scene.gear.half_backlash


@pytest.mark.long
def test_gradient_of_forces_is_that_of_differences():
    """Flanks in contact: derivatives with respect to eccentricities, angles, backlash and more."""
    gear = "scene.timing_gear."
    changes = f"{gear}eccentricity_um=[10, 4]", f"{gear}eccentricity_angle_deg=[30, -50]"
    config = load_config("cic_drawn", changes)
    scene, design = Scene.from_config(config), jnp.asarray(config.design)
    units = np.array([1e-4, 1e-4, 0.3, 0.3, 1e-3, 1.0])

    @eqx.filter_jit
    def found(change, start):
        def forces(change):
            by = change * units
            changed = zip(_leaves(scene), (by[:2], by[2:4], by[4]), strict=True)
            moved = tuple(x + d for x, d in changed)
            response = steady_response(
                eqx.tree_at(_leaves, scene, moved), design.at[0].add(by[5]), start
            )
            found = jnp.stack([response.mean, response.peak, response.rms])
            return found, (found, response)

        return jax.jacfwd(forces, has_aux=True)(change)

    slopes, (_, response) = found(jnp.zeros(6), None)
    assert Status.of(int(response.status)) is Status.PERIODIC
    assert int(response.period) == 3
    for direction in np.random.default_rng(5).normal(size=(2, 6)):
        step = 1e-3 * jnp.asarray(direction)
        ahead, behind = (found(x, response.start)[1][0] for x in (step, -step))
        np.testing.assert_allclose(slopes @ direction, (ahead - behind) / 2e-3, rtol=1e-4)
