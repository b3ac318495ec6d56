"""Tests of gradients of closed orbits against central differences of the orbits."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rootsopt.config import DESIGN_KEYS, load
from rootsopt.contact.closest import FlankPair
from rootsopt.dynamics.measures import Measures
from rootsopt.dynamics.orbit import Shots, close_orbit
from rootsopt.dynamics.settle import settle, settled_within
from rootsopt.profiles.ee import EE
from rootsopt.response.evaluation import Evaluator
from rootsopt.scene import design_vector

SHARP = ("solver.method=dopri8", "solver.rtol=1e-12")
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
# Lobes of EE. The deeper of two contacts beside the cusp at the pitch point changes, and the force
# jumps: without that in the derivative it is 4e-6 off with three lobes, 4e-5 with four.
EE_LOBES = [*(pytest.param(n, marks=pytest.mark.long) for n in (2, 3)), 4]
MEASURES = Measures(np.array([1.0, 2.0]), jnp.asarray(16.0))
STEP = 2e-5
"""Relative step. Differences of order 4 agree from 1e-3 down to 1e-5; orbits have a noise of
1e-12."""


def moved(model, design, factors):
    """Return the pair with its design multiplied by `factors`, or else speed, load and backlash."""
    if design.shape[0]:
        return model.pair(design * factors)

    def entries(model):
        return model.speed, model.load_torque, model.gear.half_backlash

    scene = [x * f for x, f in zip(entries(model), factors, strict=True)]
    return eqx.tree_at(entries, model, scene).pair(design)


@eqx.filter_jit
def closed(model, design, factors, state, period, how):
    """Return a closed orbit with derivatives with respect to the factors."""

    def arrays(factors):
        return eqx.filter(moved(model, design, factors), eqx.is_inexact_array)

    pair = moved(model, design, factors)
    units = jnp.eye(factors.shape[0])
    tangents = jax.vmap(lambda unit: jax.jvp(arrays, (factors,), (unit,))[1])(units)
    return close_orbit(pair, tangents, state, period, Shots(how, MEASURES))


@eqx.filter_jit
def settled(model, design, how):
    """Return the end of the motion from rest, when it repeats."""
    within, most = settled_within(how.rtol), jnp.asarray(400)
    return settle(model.pair(design), jnp.zeros(2), how, within, most, 4)


def orbits_of(config):
    """Return a function (factors, state or None) → closed orbit, from rest without a state."""
    evaluator, design = Evaluator.of(config), design_vector(config)
    transient = settled(evaluator.scene, design, evaluator.scene.solver.transient)
    assert int(transient.period) > 0

    def orbit(factors, state=None):
        state = transient.state if state is None else state
        how = evaluator.scene.solver.orbit
        found = closed(evaluator.scene, design, factors, state, transient.period, how)
        assert float(found.residual) <= 1e-9
        assert float(found.multiplier) < 1
        return found

    return orbit, evaluator, int(transient.period)


def errors(config):
    """Return the error of each response's derivatives, relative to the greatest of them, by
    name."""
    orbit, _, period = orbits_of(config)
    ones = jnp.ones(len(design_vector(config)) or 3)

    def responses(factors, state):
        rows = np.asarray(orbit(factors, state).response)[:, None]
        return np.array([value for value, _ in MEASURES.named(rows, period).values()])

    here = orbit(ones)
    named = MEASURES.named(np.column_stack([here.response, here.sensitivity]), period)
    columns = []
    for k in range(len(ones)):
        unit = STEP * jnp.eye(len(ones))[k]
        up, down = (responses(ones + m * unit, here.state) for m in (1, -1))
        columns.append((up - down) / (2 * STEP))
    found = {}
    for (name, (_, slope)), truth in zip(named.items(), np.stack(columns, axis=1), strict=True):
        found[name] = float(np.max(np.abs(slope - truth)) / np.max(np.abs(truth)))
    assert len(found) == 6
    return found


@pytest.mark.parametrize("design", CIC)
@pytest.mark.parametrize("scene", SCENES)
def test_cic(scene, design):
    """Derivatives of mean, peak, lines and p-norm with respect to the three design parameters are
    correct."""
    changes = [f"profile.{k}={v}" for k, v in zip(DESIGN_KEYS, design, strict=True)]
    found = errors(load("configs/cic.yaml", [*SHARP, *SCENES[scene], *changes]))
    assert max(found.values()) < 1e-6, found


@pytest.mark.parametrize("lobes", EE_LOBES)
@pytest.mark.parametrize("scene", SCENES)
def test_ee(scene, lobes):
    """Derivatives with respect to speed, load and backlash are correct for a profile without
    parameters."""
    found = errors(load("configs/ee.yaml", [*SHARP, *SCENES[scene], f"profile.lobes={lobes}"]))
    assert max(found.values()) < 1e-6, found


NARROW = (
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


def test_many_kinks_in_a_thousandth_of_a_mesh():
    """Derivatives of a coarse motion are as accurate as its tolerance promises.

    Light rotors cross the rounded edges of the backlash four times in a mesh period, each within
    1e-5 mesh periods."""
    design = ("profile.pressure_angle_deg=10.9", "profile.tip_arc_angle_deg=14.44")
    changes = [*SHARP, *NARROW, *design, "profile.involute_length_mm=1.146"]
    orbit, evaluator, period = orbits_of(load("configs/cic.yaml", changes))
    ones = jnp.ones(3)
    sharp = orbit(ones)
    config_design = design_vector(evaluator.config)
    for rtol, within in ((1e-7, 3e-2), (1e-9, 1e-4)):
        how = dataclasses.replace(evaluator.scene.solver.orbit, rtol=jnp.asarray(rtol))
        start = np.asarray(sharp.state), np.asarray(period)
        found = closed(evaluator.scene, config_design, ones, *start, how)
        assert float(found.multiplier) == pytest.approx(float(sharp.multiplier), rel=within)
        size = np.max(np.abs(sharp.sensitivity[:3]), axis=1, keepdims=True)
        off = np.abs(found.sensitivity[:3] - sharp.sensitivity[:3]) / size
        assert np.max(off) < within, (rtol, off)


@pytest.mark.long
def test_contact_jumps_beside_a_joint():
    """Derivatives follow the jump of the contact over the joint of two arcs.

    Otherwise, that of the mean with respect to the outer radius would be wrong by a third."""
    arcs = "family: five_arcs, lobes: 3, pitch_radius_mm: 33.0, outer_radius_mm: 45.19"
    rest = "tip_arc_angle_deg: 1.9156, tip_arc_radius_mm: 15.912, tip_arc_turn_deg: 80"
    changes = [f"profile={{{arcs}, {rest}}}", "optimizer.bounds={}"]
    found = errors(load("configs/cic.yaml", [*SHARP, *changes]))
    assert max(found.values()) < 1e-5, found


@pytest.mark.parametrize("lobes", [2, 3, 4])
@pytest.mark.parametrize("depth", [1e-4, 1.2e-3, 4e-3])
def test_jump_is_a_switch(lobes, depth):
    """A switch changes where the contact jumps beside a cusp, twice in a mesh period.

    A step short enough for the derivative therefore encloses the jump at any tolerance. The switch
    that tells the minima apart changes nowhere else while the contact passes the cusp."""
    pair = FlankPair.of(EE(lobes, 0.033))
    rolls = pair.profile.half_pitch + depth * jnp.linspace(-12, 12, 1201)

    @jax.jit
    def look(roll):
        found = pair(roll, jnp.asarray(-depth))
        return found.normal2, pair.switches(roll, found)

    normals, switches = (np.asarray(x) for x in jax.lax.map(look, rolls))
    jumps = np.flatnonzero(np.abs(np.diff(normals)) > 3 * depth)
    changes = np.any(switches[1:] != switches[:-1], axis=1)
    assert len(jumps) == 2
    assert np.all(changes[jumps])
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
    config = load("cic", BRIEF)
    near = Evaluator.of(config).at_tolerance(1e-9)(series=False)
    sharp = config.replaced({"solver.orbit": "shooting", "solver.rtol": 1e-11})
    usual = Evaluator.of(sharp)(start=near.state, series=False)
    assert near.statistics["collocated"] == 1
    assert near.steady_state["period"] == usual.steady_state["period"] == 6
    for force, slope in usual.gradient.items():
        slopes = np.array([list(near.gradient[force].values()), list(slope.values())])
        most = np.max(np.abs(slopes))
        np.testing.assert_allclose(slopes[0], slopes[1], rtol=0, atol=1e-5 * most)
