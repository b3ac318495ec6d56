"""Tests of gradients of closed orbits against central differences of orbits."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments._common.shooting import closed, differentiated, forces_near
from rootsopt.config import family_of, load
from rootsopt.contact.closest import FlankPair
from rootsopt.profiles.epicycloid import EE
from rootsopt.response.evaluation import Evaluator
from rootsopt.response.sensitivity import by_scene
from rootsopt.status import Status
from tests.dynamics.test_steady import ALL

FORCES = ("mean_force_N", "peak_force_N", "rms_force_N")
SHARP = ("solver.rtol=1e-12", *ALL)
SCENES = {
    "shipped": (),
    "slow, loaded": ("scene.speed_rpm=1500", "scene.load.torque_N_m=10"),
    "fast, lively": (
        "scene.speed_rpm=4500",
        "scene.timing_gear.damping_ratio=0.2",
        "scene.timing_gear.backlash_mm=0.05",
    ),
}
CIC = [(36.43, 9.0, 4.0), (36.43, 8.0, 4.0), (30.0, 5.0, 2.0)]
OF_SCENE = ("scene.speed_rpm", "scene.load.torque_N_m", "scene.timing_gear.backlash_mm")
STEP = 1e-3
"""Greatest relative step. Extrapolated differences agree from 2e-3 down to 2e-4; below, they show
the noise of the orbits (1e-11)."""


def errors(config, levels=3):
    """Return the error of each response's derivatives with respect to the design, relative to the
    greatest of them, by name. `levels`: number of steps of the differences."""
    evaluator, columns = Evaluator.of(config), []
    here, design = evaluator(series=False), config.design
    for unit in np.diag(design):

        def responses(change, unit=unit):
            found = evaluator(design + change * unit, start=here.start, series=False)
            assert found.status is here.status is Status.PERIODIC
            return np.array(list(found.response.values()))

        columns.append(differentiated(responses, STEP, levels)[0])
    truths = dict(zip(here.response, np.stack(columns, axis=1), strict=True))
    # Without a line between those of an orbit that repeats every mesh period.
    found = {
        name: np.max(np.abs(design * list(here.gradient[name].values()) - truth))
        / np.max(np.abs(truth))
        for name, truth in truths.items()
        if np.any(truth)
    }
    assert len(found) == 7
    return found


@pytest.mark.parametrize(
    ("scene", "design"),
    [
        pytest.param(scene, design, marks=[pytest.mark.long] * (i != k))
        for i, scene in enumerate(SCENES)
        for k, design in enumerate(CIC)
    ],
)
def test_cic(scene, design):
    """Derivatives of mean, peak, lines and p-norm with respect to the three design parameters are
    correct."""
    changes = [f"profile.{k}={v}" for k, v in zip(family_of("cic").keys, design, strict=True)]
    found = errors(load("configs/cic_drawn.yaml", [*SHARP, *SCENES[scene], *changes]))
    assert max(found.values()) < 1e-6, found


@pytest.mark.long
@pytest.mark.parametrize("lobes", [2, 3, 4])
@pytest.mark.parametrize("scene", SCENES)
def test_ee(scene, lobes):
    """Derivatives with respect to speed, load and backlash are correct for a profile without
    parameters.

    The deeper of two contacts beside the cusp at the pitch point changes, and the force jumps:
    without that in the derivative it is 4e-6 off with three lobes, 4e-5 with four."""
    config = load("configs/ee.yaml", [*SCENES[scene], f"profile.lobes={lobes}"])
    evaluator = Evaluator.of(config).at_tolerance(1e-11)
    here = evaluator(series=False)
    # Rounding beside the cusp hides the error at the finest tolerance, but the orbit is closed.
    assert evaluator.at_tolerance(1e-12)(series=False).status is Status.PERIODIC
    gradient, columns = by_scene(evaluator, here).gradient, []
    orbit = closed(evaluator.pair([]), here.state, 1)
    for key in OF_SCENE:

        def pair(change, key=key):
            moved = config.replaced({key: config.value(key) * (1 + change)})
            return Evaluator.of(moved).pair([])

        columns.append(differentiated(forces_near(pair, orbit, 1), STEP)[0])
    assert here.steady_state["period"] == 1
    for name, truth in zip(FORCES, np.stack(columns, axis=1), strict=True):
        slope = [gradient[name][key] * config.value(key) for key in OF_SCENE]
        assert slope == pytest.approx(truth, abs=1e-6 * np.max(np.abs(truth)))


NARROW = (
    "profile.pressure_angle_deg=10.9",
    "profile.tip_arc_angle_deg=14.44",
    "profile.involute_length_mm=1.146",
    "scene.speed_rpm=28859",
    "scene.load.torque_N_m=1.7",
    "scene.timing_gear.backlash_mm=0.93",
    "scene.timing_gear.stiffness_N_m_per_rad=21095",
    "scene.timing_gear.damping_ratio=0.5",
    "contact.stiffness_N_per_mm_e=47086",
    "contact.exponent=1.93",
    "contact.max_damping_N_s_per_mm=5e-4",
    "contact.full_damping_depth_mm=0.35",
    "contact.smoothing_mm=5e-5",
    "rotor.length_mm=3.1",
)


def slopes_of(found):
    """Return the gradients of the forces as an array (force, design parameter)."""
    return np.array([list(found.gradient[name].values()) for name in FORCES])


def test_many_kinks_in_a_thousandth_of_a_mesh():
    """Derivatives at a loose tolerance are as accurate as it promises.

    Light rotors cross the rounded edges of the backlash four times in a mesh period, each within
    1e-5 mesh periods."""
    evaluator = Evaluator.of(load("configs/cic_drawn.yaml", NARROW))
    sharp = evaluator.at_tolerance(1e-12)(series=False)
    truth = slopes_of(sharp)
    for rtol, within in ((1e-7, 3e-2), (1e-9, 1e-4)):
        found = evaluator.at_tolerance(rtol)(start=sharp.start, series=False)
        one, other = (x.steady_state["floquet_multiplier"] for x in (found, sharp))
        assert one == pytest.approx(other, rel=within)
        off = np.abs(slopes_of(found) - truth) / np.max(np.abs(truth), axis=1, keepdims=True)
        assert np.max(off) < within, (rtol, off)


@pytest.mark.long
def test_contact_jumps_beside_a_joint():
    """Derivatives follow the jump of the contact over the joint of two arcs.

    Otherwise, that of the mean with respect to the outer radius would be wrong by a third."""
    arcs = "family: five_arcs, lobes: 3, pitch_radius_mm: 33.0, outer_radius_mm: 45.19"
    rest = "tip_arc_angle_deg: 1.9156, tip_arc_radius_mm: 15.912, tip_arc_turn_deg: 80"
    changes = [f"profile={{{arcs}, {rest}}}", "optimizer.bounds={}"]
    found = errors(load("configs/cic_drawn.yaml", [*SHARP, *changes]), levels=6)
    assert max(found.values()) < 1e-5, found


@pytest.mark.parametrize(("lobes", "depth"), [(3, 1e-4), (4, 1.2e-3)])
def test_jump_is_a_switch(lobes, depth):
    """A switch changes where the contact jumps beside a cusp, twice in a mesh period.

    A step short enough for the derivative therefore encloses the jump at any tolerance. This switch
    tells the minima apart, and changes nowhere else while the contact passes the cusp."""
    pair = FlankPair.of(EE(lobes, 0.033))
    rolls = pair.profile.half_pitch + depth * jnp.linspace(-12, 12, 1201)

    @jax.jit
    def look(roll):
        found = pair(roll, jnp.asarray(-depth))
        return found.normal2, pair.margins(roll, found) > 0

    normals, switches = (np.asarray(x) for x in jax.lax.map(look, rolls))
    jumps = np.flatnonzero(np.abs(np.diff(normals)) > 3 * depth)
    assert len(jumps) == 2
    np.testing.assert_array_equal(np.flatnonzero(switches[1:, 2] != switches[:-1, 2]), jumps)


BRIEF = [
    "profile.pressure_angle_deg=39.23",
    "profile.involute_length_mm=7.61",
    "profile.tip_arc_angle_deg=3.18",
    "scene.speed_rpm=2846.7",
    "scene.load.torque_N_m=4.647",
    "scene.timing_gear.backlash_mm=0.372",
    "scene.timing_gear.damping_ratio=0.32",
    "scene.timing_gear.stiffness_N_m_per_rad=42910",
]


@pytest.mark.long
def test_a_short_touch_is_an_event():
    """A flank touches for a 300th of a mesh period with 6 mN when ε changes its sign.

    Without this touch, derivatives of the forces would be 6e-4 off."""
    config = load("cic_drawn", BRIEF)
    near = Evaluator.of(config).at_tolerance(1e-9)(series=False)
    design, way = np.array(list(near.design.values())), np.array([1.0, -0.7, 0.8])
    assert near.steady_state["period"] == 6

    def pair(change):
        return Evaluator.of(config).pair(design * (1 + change * way))

    orbit = closed(pair(0.0), near.state, 6)
    truth, noise = differentiated(forces_near(pair, orbit, 6), 1e-3, 6)
    terms = slopes_of(near) * design * way
    off = np.maximum(np.abs(np.sum(terms, axis=1) - truth) - noise, 0.0)
    assert np.max(off / np.max(np.abs(terms), axis=1)) < 1e-5
