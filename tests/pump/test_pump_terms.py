"""Terms of the pump sheet that need no simulation: values and gradients."""

import jax.numpy as jnp
import numpy as np
import pytest

from rootsopt import InputError, Scene, load_config
from rootsopt.pump.sheet import sheet
from rootsopt.response.terms import terms_of, values_of

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


@pytest.mark.long
def test_terms_are_the_rows_of_the_sheet_and_have_gradients():
    config = load_config("cic_drawn", PUMP)
    scene, design = Scene.from_config(config), jnp.asarray(config.design)
    nothing = jnp.zeros(3), jnp.zeros((3, 3))
    terms = terms_of(NAMES)
    values, slopes = map(np.asarray, values_of(scene, terms, design, *nothing))
    rows = sheet(scene, design)
    rows["leakage_fraction"] = 1 - rows["volumetric_efficiency"]
    rows["delivered_flow_l_min"] = rows["theoretical_flow_l_min"] * rows["volumetric_efficiency"]
    np.testing.assert_allclose(values, [rows[name] for name in NAMES], rtol=1e-9)
    steps = np.diag([1e-4, 1e-4, 1e-4])
    ends = [[values_of(scene, terms, design + k * s, *nothing)[0] for k in (1, -1)] for s in steps]
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
    config = load_config("cic_drawn", changes)
    scene, design = Scene.from_config(config), jnp.asarray(config.design)
    with pytest.raises(InputError, match=words):
        values_of(scene, terms_of([name]), design, jnp.zeros(3), jnp.zeros((3, 3)))
