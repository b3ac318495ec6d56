"""A scene is the sum of its parts.

Forces and motion are compared with Newton's laws written independently (`planar`). Energy is
balanced, and an absent part costs nothing."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from rootsopt import InputError, Scene, Status, load_config
from rootsopt.dynamics.integrator import Integrator
from rootsopt.response.evaluation import Evaluator
from tests.planar import Planar

MOTOR = ["scene.drive=torque", "scene.motor={slope_N_m_s_per_rad: 0.1}"]
PARTS = {
    "motor": ["scene.drive=torque", "scene.motor={slope_N_m_s_per_rad: 0.1, torque_N_m: 5}"],
    "gas": ["scene.load={pressure_difference_Pa: 5e4}"],
    "friction": ["contact.friction={}"],
    "phase error": ["scene.phase_error_mrad=0.4"],
    "centre distance error": ["scene.center_distance_error_mm=0.02"],
    "supports": ["scene.supports={stiffness_N_per_mm: 2e5, damping_N_s_per_mm: 5}"],
}
ALL = [override for part in PARTS.values() for override in part]
SHARE = 0.35
WITHIN = "profile.involute_length_mm=8.5"
"""Override with an involute short enough for `planar`.

Past the longest involute, two points of a flank mesh at once, and `planar` cannot order them."""


@eqx.filter_jit
def build(model, design):
    return model.pair_and_shape(design)


def pair_of(overrides, family="cic_drawn"):
    config = load_config(f"configs/{family}.yaml", list(overrides))
    return build(Scene.from_config(config), jnp.asarray(config.design))[0], config


def planar_of(pair, config):
    """Return the same scene, which has all parts, in plain coordinates."""
    torques = jax.jit(lambda phi: jnp.stack([pair.load.torque1(phi), pair.load.torque2(phi)]))
    mass = float(pair.supports.mass)
    return Planar(config, float(pair.inertia), mass, lambda phi: np.asarray(torques(phi)))


def plain(pair, tau, state):
    """Return the state of `planar` for rotation `tau` and a scaled state."""
    motion = pair.motion(jnp.asarray(tau), jnp.asarray(state))
    positions = [[motion.phi, motion.phi + motion.relative], jnp.ravel(motion.shift)]
    rates = [[motion.speed, motion.speed + motion.rate], jnp.ravel(motion.drift)]
    return np.concatenate([np.asarray(x, float) for x in positions + rates])


@eqx.filter_jit
def contacts(pair, tau, states):
    return jax.lax.map(lambda at: pair.contact_at(*at), (tau, states))


@pytest.mark.parametrize("family", ["cic_drawn", "ee"])
def test_forces_of_all_parts_are_newtons(family):
    """Forces and torques agree with `planar` at random states with displaced axes.

    They are torques on both rotors, force on the axes and contact force. The distances are wider
    and closer than nominal, and flanks, tips and roots touch."""
    # Rounding of the geometry is some 1e-17 m of a depth of 1e-6 m.
    for error in (0.02, -0.02):
        more = [f"scene.center_distance_error_mm={error}", "contact.clearance_mm=0.002",
                *[WITHIN] * (family == "cic_drawn")]  # fmt: skip
        pair, config = pair_of([*ALL, *more], family)
        reference = planar_of(pair, config)
        rng = np.random.default_rng(3)
        tau, states = rng.uniform(0, 1, 60), rng.normal(0, 0.7, (60, pair.states))
        states[:, -8:] *= 0.3
        # The axis of a lobe on the line of centres, where one side hands over to the other.
        tau[:6] = np.array([0.0, 0.5, 1.0]).repeat(2) + 3e-3 * np.array([-1, 1] * 3)
        found = contacts(pair, jnp.asarray(tau), jnp.asarray(states))
        got = np.column_stack([found.torque1, found.torque2, found.push, found.total])
        expected = []
        for at in zip(tau, states, strict=True):
            torques, pushes, total = reference.forces(plain(pair, *at))
            expected.append([*torques, pushes[1].real, pushes[1].imag, total])
        expected = np.array(expected)
        scale = np.max(abs(expected), axis=0)
        np.testing.assert_array_less(0, scale)
        assert 5 < np.sum(expected[:, 4] > 0) < 55
        np.testing.assert_allclose(got / scale, expected / scale, rtol=0, atol=1e-9)


def test_motion_of_all_parts_is_scipys():
    """With every part on, all states agree with DOP853 through an impact.

    The motion covers a third of a mesh period of rotation."""
    pair, config = pair_of([*ALL, WITHIN])
    reference = planar_of(pair, config)
    start = np.array([-0.6, 0.0, 0.0, 0.1, 0.0, -0.1, 0.05, 0.0, 0.0, 0.0, 0.0])
    how = Integrator("dopri8", jnp.asarray(1e-11), 20000)

    @jax.jit
    def run(start):
        return diffrax.diffeqsolve(
            diffrax.ODETerm(lambda tau, y, _: pair.derivative(tau, y)[0]), how.solver(),
            0.0, SHARE, None, start, stepsize_controller=diffrax.PIDController(how.rtol, how.rtol),
            max_steps=how.max_steps, adjoint=diffrax.ForwardMode(),
        ).ys[-1]  # fmt: skip

    # With the angle as what runs on: an event in time would be found by interpolation.
    scale = 1e-5 * np.array([1, 1, 1, 1, 1, 1, *np.full(6, 1 / float(pair.mesh_period))])
    end = solve_ivp(
        lambda phi, y: reference(0, y) / y[6], (0, SHARE * 2 * np.pi / 3), plain(pair, 0.0, start),
        "DOP853", rtol=1e-13, atol=1e-13 * scale, max_step=0.06,
    ).y[:, -1]  # fmt: skip
    got = plain(pair, SHARE, run(jnp.asarray(start)))
    moved = np.max(abs(end - plain(pair, SHARE, start)) / scale)
    assert moved > 1  # Otherwise closeness would be that of a pair at rest.
    np.testing.assert_allclose((got - end)[1:] / scale[1:] / moved, 0, atol=1e-8)


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["scene.drive=torque"], "`scene.motor` is missing"),
        (["scene.motor={slope_N_m_s_per_rad: 1}"], "belongs to `scene.drive` = torque"),
        (["scene.load={}"], "neither"),
        (["scene.load.pressure_difference_Pa=1e4"], "both"),
        (["scene.timing_gear=null", "scene.phase_error_mrad=1"], "scene.timing_gear"),
        (["contact.friction={friction_speed_mm_s: 50}"], "must be greater than"),
    ],
)  # fmt: skip
def test_parts_that_do_not_go_together_are_refused(overrides, words):
    with pytest.raises(InputError, match=words):
        load_config("configs/cic_drawn.yaml", overrides)


@pytest.mark.long
def test_orbit_of_all_parts():
    """With all parts, eleven states, the orbit closes."""
    config = load_config("configs/cic_drawn.yaml", [*ALL, WITHIN, "solver.rtol=1e-10"])
    found = Evaluator.of(config)()
    assert found.status is Status.PERIODIC
    assert found.steady_state["residual"] < 1e-9
    assert len(found.steady_state["floquet_multipliers"]) == 11
    # The motor's speed forgets slowest of all.
    assert 0.5 < found.steady_state["floquet_multiplier"] < 1
    # Time is that of the turning rotor, on the average that of its mean speed.
    series = found.series
    assert np.all(np.diff(series.time) > 0)
    mean = np.trapezoid(series.force, series.time) / np.ptp(series.time)
    assert found.response["mean_force_N"] == pytest.approx(mean, rel=2e-3)
    assert found.response["peak_force_N"] == pytest.approx(series.force.max(), rel=2e-3)
