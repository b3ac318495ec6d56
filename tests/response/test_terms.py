"""Objective terms: the table, the package's own, and the one of docs/extending.md."""

import jax.numpy as jnp
import numpy as np
import pytest

from rootsopt import InputError, Scene, load_config, register_term
from rootsopt.optimize.problem import Problem
from rootsopt.pump.sheet import sheet
from rootsopt.response import terms
from rootsopt.response.evaluation import Evaluator
from rootsopt.response.result import RESPONSES
from rootsopt.response.terms import values_of
from tests.conformance.test_extending import imported
from tests.standins import Own

CIC = "configs/cic_drawn.yaml"
OUTSIDE = "revolutions_per_litre"
NAMES = (
    *("displaced_volume_cm3", "theoretical_flow_l_min", "flow_ripple", "gear_backlash_max_mm"),
    *("angular_play_min_mrad", "flank_gap_min_um", "flank_gap_mean_um"),
    *("static_bearing_load_max_N", "static_bearing_load_equivalent_N", "leakage_fraction"),
    "delivered_flow_l_min",
)
PUMP = (
    "pump={viscosity_mPa_s: 0.018, tip_clearance_mm: 0.08, radial_allowance_mm: 0.01}",
    "contact.clearance_mm=0.05",
    "scene.load={pressure_difference_Pa: 5e4}",
    "scene.bearings={}",
    "scene.center_distance_error_mm=0.02",
)


@pytest.fixture(scope="module")
def outside(tmp_path_factory):
    """Register the term of docs/extending.md from its file."""
    imported("displacement.py", tmp_path_factory.mktemp("term"), 60)
    yield terms.terms_of([OUTSIDE])[0]
    del terms._terms[OUTSIDE]


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene.from_config(load_config(CIC))


def test_gradients_of_terms_are_those_of_differences(outside, scene):
    """Every term, the one from outside among them, has the slopes of differences."""
    design, forces = np.array([36.43, 9.0, 4.0]), np.array([76.0, 242.0, 113.0])
    slopes = np.array([[-1.7, 7.9, -0.1], [-6.9, 4.7, 1.1], [-1.7, 6.3, 0.0]])
    wanted = terms.terms_of(["rms_force_N", "polar_inertia_kg_m2", "flow_ripple", OUTSIDE])
    gradients = np.asarray(values_of(scene, wanted, design, forces, slopes)[1])
    ends = [
        values_of(scene, wanted, design + s * move, forces + s * slopes @ move, slopes)[0]
        for s in (1, -1)
        for move in 1e-4 * np.eye(3)
    ]
    expected = np.transpose(np.subtract(ends[:3], ends[3:])) / 2e-4
    size = np.max(np.abs(gradients), axis=1, keepdims=True)
    np.testing.assert_allclose(gradients / size, expected / size, atol=1e-6, rtol=0)


def test_outside_term_is_in_results_and_objective(outside):
    """The outside term is in the results, and an objective can consist of it alone.

    Its value is that of its own formula."""
    only = [f"objective.terms.{OUTSIDE}=1", "objective.mean_weight=0", "objective.peak_weight=0"]
    config = load_config(CIC, only)
    evaluator = Evaluator.of(config)
    found = evaluator(series=False)
    area = np.pi * found.geometry["outer_radius_mm"] ** 2 - found.geometry["area_mm2"]
    litres = 2e-6 * config.rotor.length_mm * area
    assert found.response[OUTSIDE] == pytest.approx(1 / litres, rel=1e-12)
    assert list(found.response) == [*RESPONSES, OUTSIDE]
    problem = Problem.of(config, evaluator.scene, found)
    assert problem.objective(found) == pytest.approx(1.0, rel=1e-14)
    point = problem.point(config.design)
    _, jacobian, *_ = problem.look(point)
    slope = np.array(list(found.gradient[OUTSIDE].values())) / found.response[OUTSIDE]
    np.testing.assert_allclose(problem.slope(found, point), slope @ jacobian, rtol=1e-12)


def test_unknown_terms_are_refused():
    with pytest.raises(InputError, match="names noise; correct it, or register it"):
        Evaluator.of(load_config(CIC, ["objective.terms.noise=1"]))
    with pytest.raises(InputError, match="belong to a periodic motion"):
        load_config(CIC, ["objective.terms.area_mm2=1", "objective.motion=ensemble"])


@pytest.mark.parametrize(
    ("name", "words"),
    [("area_mm2", "'area_mm2' is that of `Formula`"), ("two words", "must be a word")],
)
def test_table_keeps_names_apart(name, words):
    with pytest.raises(ValueError, match=words):
        register_term(name, Own(lambda *_: jnp.ones(())))


@pytest.mark.long
def test_terms_are_the_rows_of_the_sheet_and_have_gradients():
    config = load_config("cic_drawn", PUMP)
    scene, design = Scene.from_config(config), jnp.asarray(config.design)
    wanted, *nothing = terms.terms_of(NAMES), jnp.zeros(3), jnp.zeros((3, 3))
    values, slopes = map(np.asarray, values_of(scene, wanted, design, *nothing))
    rows = sheet(scene, design)
    rows["leakage_fraction"] = 1 - rows["volumetric_efficiency"]
    rows["delivered_flow_l_min"] = rows["theoretical_flow_l_min"] * rows["volumetric_efficiency"]
    np.testing.assert_allclose(values, [rows[name] for name in NAMES], rtol=1e-9)
    steps = np.diag([1e-4, 1e-4, 1e-4])
    ends = [[values_of(scene, wanted, design + k * s, *nothing)[0] for k in (1, -1)] for s in steps]
    expected = np.stack([(np.asarray(a) - np.asarray(b)) / 2e-4 for a, b in ends], axis=1)
    # Slopes below a tenth of the value count by this. Longer steps pass corners of the least play.
    scale = np.maximum(np.abs(expected), 0.1 * np.abs(values)[:, None])
    assert np.max(np.abs(slopes - expected) / scale) < 2e-4


@pytest.mark.parametrize(
    ("changes", "name", "words"),
    [
        ((), "axial_force_max_N", "needs the section `scene.bearings`"),
        ((), "static_bearing_load_max_N", "needs the section `scene.bearings`"),
        ((), "flank_gap_min_um", "needs the section `pump`"),
        (
            ("scene.bearings={}",),
            "tilting_moment_max_N_m",
            r"needs twisted rotors.*optimizer.bounds.helix_deg",
        ),
    ],
)
def test_terms_name_the_section_they_need(changes, name, words):
    config = load_config(CIC, changes)
    arguments = jnp.asarray(config.design), jnp.zeros(3), jnp.zeros((3, 3))
    with pytest.raises(InputError, match=words):
        values_of(Scene.from_config(config), terms.terms_of([name]), *arguments)
