"""Tests that the competitors of the benchmark give rootsopt's numbers in the same scene."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments._common import engines
from experiments._common.engines import FD_STEPS, motion_of, rotor_of
from experiments._common.engines.scipy_nodes import (
    NODES_1E3,
    NodeContact,
    ScipyNodes,
    polar_area_moment,
)
from rootsopt.config import load
from rootsopt.contact import FlankPair
from rootsopt.profiles import CIC
from rootsopt.response.evaluation import RESPONSES, Evaluator
from rootsopt.scene import Scene

pytest.importorskip("numba")

from experiments._common.engines import numba_pair
from experiments._common.engines.numba_pair import (
    MAP_1E3,
    SEARCH_1E3,
    SEARCH_GRADIENT_1E3,
    NumbaPair,
)

CONFIG = load("configs/cic_drawn.yaml", ["solver.method=dopri8", "solver.rtol=1e-12"])
SCENE = engines.Scene.of(CONFIG)
BASELINE = (36.43, 9.0, 4.0)
DESIGNS = [BASELINE, (33.0, 6.0, 3.0), (40.0, 8.0, 6.0), (37.0, 8.5, 0.5)]
every_design = pytest.mark.parametrize("design", DESIGNS, ids=str)


@functools.cache
def reference():
    """Return rootsopt's response and gradient in the shipped scene, as arrays (3,) and (3, 3)."""
    found = Evaluator.of(CONFIG)(series=False)
    gradient = [list(found.gradient[key].values()) for key in RESPONSES]
    return np.array([found.response[key] for key in RESPONSES]), np.array(gradient)


def poses(count):
    """Return random poses that cover the mesh and both hand-overs as a motion does."""
    rng = np.random.default_rng(5)
    rolls = np.sort(rng.uniform(-0.12, np.pi / 3 + 0.12, count))
    return rolls, -(10 ** rng.uniform(-4, -2.5, count))


@eqx.filter_jit
def _pair(model, design):
    return model.pair(design)


@functools.partial(jax.jit, static_argnums=0)
def _approach(lobes, radius, design, rolls, relatives):
    alpha, length, tip = design
    profile = CIC(lobes, radius, jnp.radians(alpha), length * 1e-3, jnp.radians(tip))
    return jax.vmap(FlankPair.of(profile))(rolls, relatives)


def approach(design, rolls, relatives):
    """Return rootsopt's gap and levers (n, 3) in m, NaN without a common normal."""
    found = _approach(SCENE.lobes, SCENE.pitch_radius, design, rolls, relatives)
    columns = np.stack([found.gap, found.lever1, found.lever2], axis=1)
    return np.where(np.asarray(found.found)[:, None], columns, np.nan)


def error(result):
    return np.max(np.abs(result.response / reference()[0] - 1))


def gradient_error(gradient):
    """Return the error of a gradient, relative to the greatest entry of each response."""
    truth = reference()[1]
    return np.max(np.abs(gradient - truth).max(axis=1) / np.abs(truth).max(axis=1))


@every_design
def test_constants_are_those_of_the_model(design):
    pair = _pair(Scene.from_config(CONFIG), jnp.asarray(design))
    rotor = rotor_of(SCENE, design)
    moment = polar_area_moment(rotor)
    assert numba_pair.polar_area_moment(rotor) == pytest.approx(moment, rel=1e-13)
    motion = motion_of(SCENE, moment)
    assert pair.gear is not None
    inertia = motion.period**2 / (motion.angle_scale * motion.agility)
    assert inertia == pytest.approx(float(pair.inertia), rel=1e-12)
    assert motion.angle_scale == pytest.approx(float(pair.angle_scale), rel=1e-12)
    assert motion.gear_damping == pytest.approx(float(pair.gear.damping), rel=1e-12)
    assert motion.stiffness == pytest.approx(float(pair.law.stiffness), rel=1e-12)


@every_design
def test_compiled_search_finds_the_closest_approach(design):
    rolls, relatives = poses(3000)
    truth = approach(design, rolls, relatives)
    found = numba_pair.gaps(rotor_of(SCENE, design), rolls, relatives)
    # Poses that cannot touch yet are not searched.
    touching = truth[:, 0] < 0
    assert touching.mean() > 0.6
    np.testing.assert_allclose(found[touching], truth[touching], rtol=0, atol=1e-13)
    assert not np.any(found[~touching, 0] < 0)


def test_compiled_map_interpolates_the_search():
    rotor = rotor_of(SCENE, BASELINE)
    table = numba_pair.Table(*numba_pair.tabulate(rotor, -2.4e-3, 384, 16))
    rolls, relatives = poses(1500)
    relatives = np.maximum(relatives, -2.4e-3)
    truth = numba_pair.gaps(rotor, rolls, relatives)
    # Away from the hand-over, where the lever has a kink.
    inner = (rolls > 0.2) & (rolls < np.pi / 3 - 0.2)
    half = rotor.half_pitch
    found = [
        numba_pair.mapped(half, table, x, e)
        for x, e in zip(rolls[inner], relatives[inner], strict=True)
    ]
    np.testing.assert_allclose(np.array(found)[:, 0], truth[inner, 0], rtol=0, atol=1e-10)
    np.testing.assert_allclose(np.array(found)[:, 1:], truth[inner, 1:], rtol=0, atol=1e-6)


@pytest.mark.parametrize("contact", ["search", "map"])
def test_compiled_pair_gives_the_response(contact):
    pair = NumbaPair(SCENE, contact, rtol=1e-10, settle=4)
    if contact == "map":
        pair = pair.fitted(BASELINE)
    assert error(pair.simulate(BASELINE)) < (1e-7 if contact == "search" else 5e-6)


def test_map_that_is_left_is_built_deeper():
    shallow = NumbaPair(SCENE, "map", rtol=1e-8, settle=2, deepest=-1e-3)
    assert error(shallow.simulate(BASELINE)) < 1e-4


def test_compiled_pair_gives_the_gradient():
    tight = NumbaPair(SCENE, "search", rtol=1e-10, settle=3)
    result, gradient = tight.gradient(BASELINE, [step / 2 for step in FD_STEPS])
    assert error(result) < 1e-6
    assert gradient_error(gradient) < 2e-4
    assert gradient_error(NumbaPair(SCENE, **SEARCH_GRADIENT_1E3).gradient(BASELINE)[1]) < 1e-3


def test_cheap_compiled_settings_reach_one_in_a_thousand():
    assert error(NumbaPair(SCENE, **SEARCH_1E3).simulate(BASELINE)) < 1e-3
    assert error(NumbaPair(SCENE, **MAP_1E3).fitted(BASELINE).simulate(BASELINE)) < 1e-3


@pytest.mark.parametrize("curved", [False, True])
def test_node_gap_converges_to_the_closest_approach(curved):
    """The order in the node spacing is two with straight segments, and higher with curved ones."""
    rolls, relatives = poses(300)
    rotor = rotor_of(SCENE, BASELINE)
    truth = numba_pair.gaps(rotor, rolls, relatives)
    deep = truth[:, 0] < -1e-7
    typical = []
    for nodes in (200, 800):
        contact = NodeContact(rotor, nodes, curved)
        found = np.array([contact(x, e) for x, e in zip(rolls, relatives, strict=True)])
        assert np.all(found[np.isnan(truth[:, 0]), 0] > -1e-7)
        off = np.abs(found - truth)[deep]
        assert off[:, 0].max() < (30e-6 if curved else 40e-6) * (200 / nodes) ** 2
        typical.append(np.median(off[:, 0]))
    assert typical[0] / typical[1] > (30 if curved else 10)


def test_node_contact_gives_the_response():
    """The error is 1e-3 with 800 nodes per flank, and 2e-4 with 3000."""
    assert error(ScipyNodes(SCENE, **NODES_1E3).simulate(BASELINE)) < 1e-3
    fine = ScipyNodes(SCENE, nodes=3000, method="RK45", rtol=1e-6, settle=2)
    assert error(fine.simulate(BASELINE)) < 2e-4


def test_straight_segments_give_the_response():
    """With Eq. 9 as printed, the corners of the polygons remain in the peak."""
    straight = ScipyNodes(SCENE, nodes=2000, curved=False, rtol=1e-4, settle=1)
    assert error(straight.simulate(BASELINE)) < 2e-2


def test_scene_without_gear_and_other_families():
    config = CONFIG.model_copy(
        update={"scene": CONFIG.scene.model_copy(update={"timing_gear": None})}
    )
    assert engines.Scene.of(config).gear_stiffness == 0
    with pytest.raises(ValueError, match="family"):
        engines.Scene.of(load("configs/ee.yaml"))
