"""The twist as a design parameter: keys, bounds, gradients, and nothing where it is fixed."""

import jax.numpy as jnp
import numpy as np
import pytest

from rootsopt import InputError, Scene, Status, load_config
from rootsopt.config.units import DEG
from rootsopt.optimize.search import Search
from rootsopt.pump.sheet import sheet
from rootsopt.response.evaluation import Evaluator, build
from rootsopt.response.terms import terms_of, values_of
from rootsopt.scene.space import Space, bounds_of

FREE = "optimizer.bounds.helix_deg=[0, 90]", "rotor.helix_deg=20", "solver.slices=2"
GAS = "scene.load={pressure_difference_Pa: 5e4}", "scene.bearings={weight: true}"


def scene_of(name: str, *changes: str) -> tuple[Scene, jnp.ndarray]:
    config = load_config(name, changes)
    return Scene.from_config(config), jnp.asarray(config.design)


@pytest.mark.parametrize("name", ["cic_drawn", "ee", "free"])
def test_twist_is_the_last_parameter(name):
    """Behind those of any family: none, single numbers, or a list."""
    fixed, free = load_config(name), load_config(name, FREE)
    assert free.design_keys == (*fixed.design_keys, "helix_deg")
    np.testing.assert_array_equal(free.design, [*fixed.design, 20.0])
    wanted = [*(fixed.design * 0.99), 33.0]
    np.testing.assert_array_equal(free.with_design(wanted).design, wanted)
    assert free.with_design(wanted).rotor.helix_deg == 33.0
    assert fixed.with_design(fixed.design) == fixed
    assert bounds_of(free) == [*bounds_of(fixed), (0.0, 90.0)]
    space = Space.of(free, Scene.from_config(free))
    point = np.append(np.linspace(0.3, 0.6, len(fixed.design)), 0.25)
    design = space.design(jnp.asarray(point))
    assert float(design[-1]) == pytest.approx(22.5)
    np.testing.assert_allclose(space.point(design), point, atol=1e-12)


def test_derivatives_are_those_of_the_scene():
    """The pair's derivatives along the last parameter are those with respect to `scene.helix`."""
    free, design = scene_of("ee", *GAS, *FREE)
    assert free.at(design).helix == pytest.approx(20 * DEG)
    pair, tangents, _ = build(free, design)
    # What depends on the twist alone, and only on it.
    np.testing.assert_allclose(tangents.contact.twist, [DEG], rtol=1e-12)
    np.testing.assert_allclose(tangents.load.offsets[0], pair.load.offsets / 20, rtol=1e-12)


def test_terms_and_sheet_follow_the_twist():
    """EE: one line of the flow, whose ripple 2/13 falls with sin(NΦ)/(NΦ)."""
    scene, _ = scene_of("ee", *FREE)
    terms, *nothing = terms_of(["flow_ripple"]), jnp.zeros(3), jnp.zeros((3, 1))
    for degrees in (30.0, 50.0):
        design, turn = jnp.asarray([degrees]), 3 * degrees * DEG
        values, slopes = values_of(scene, terms, design, *nothing)
        found = float(values[0]), sheet(scene, design)["flow_ripple"], float(slopes[0, 0])
        share = np.sin(turn) / turn
        wanted = 2 / 13 * np.array([share, share, (np.cos(turn) - share) / degrees])
        assert found == pytest.approx(wanted, rel=1e-9)


def test_slices_suffice_for_the_greatest_twist():
    scene, _ = scene_of("ee", FREE[0], FREE[1])
    assert scene.slices == scene_of("ee", "rotor.helix_deg=90")[0].slices
    assert scene.slices > scene_of("ee", FREE[1])[0].slices


def test_a_fixed_twist_costs_nothing():
    for changes in ((), FREE[1:]):
        scene, design = scene_of("cic_drawn", *changes)
        assert scene.at(design) is scene
    # A rotor from a file has no design parameters.
    outline = "profile={family: outline, lobes: 3, pitch_radius_mm: 33, outline_file: x.csv}"
    assert not load_config("cic_drawn", [outline, FREE[0]]).twist_free


@pytest.mark.parametrize(
    ("name", "changes", "words"),
    [
        ("cic_drawn", ["optimizer.bounds.helix_deg=[30, 20]"], "two increasing numbers"),
        ("cic_drawn", ["optimizer.bounds.helix_deg=[0, 400]"], r"in \[-360, 360\]"),
        ("cic_drawn", ["optimizer.bounds.helix_deg=30"], "helix_deg"),
        ("ee", [], r"or make the twist one with `optimizer.bounds.helix_d"),
    ],
)
def test_impossible_bounds_are_refused(name, changes, words):
    """So is a search without parameters."""
    with pytest.raises(InputError, match=words):
        Search(load_config(name, changes))


@pytest.mark.long
def test_gradients_against_differences():
    """Forces and loads of the bearings, greatest ones included, of twisted CIC rotors."""
    changes = (*GAS, *FREE, "rotor.helix_deg=40", "solver.rtol=1e-10")
    config = load_config("cic_drawn", changes)
    evaluator = Evaluator.of(config)
    here = evaluator()
    assert here.status is Status.PERIODIC
    names = (
        *("mean_force_N", "rms_force_N", "bearing_load_equivalent_N", "bearing_load_max_N"),
        *("axial_force_max_N", "tilting_moment_max_N_m"),
    )
    for key, step in (("helix_deg", 2e-3), ("pressure_angle_deg", 1e-3)):
        move = step * (np.array(config.design_keys) == key)
        ahead, behind = (evaluator(config.design + k * move).response for k in (1, -1))
        slopes = {name: (ahead[name] - behind[name]) / (2 * step) for name in names}
        assert {name: here.gradient[name][key] for name in names} == pytest.approx(slopes, rel=1e-3)
