"""Tests of the default ranges of the design parameters."""

import pytest

from rootsopt.config.families import Parameter, parameters


def test_ranges_of_parameters_that_a_config_leaves_open():
    """Lengths scale with the pitch radius and the tip land with the lobe pitch.

    Every other parameter has the range of its kind; no length is negative."""
    other = Parameter("some_other_angle_deg", "an angle", 0, 180)
    expected = {
        "arc_center_mm": (15.0, 29.97),
        "rolling_radius_mm": (0.3, 45.0),
        "edge_radius_mm": (0.3, 45.0),
        "tip_arc_angle_deg": (0.0, 15.0),
        "tip_arc_turn_deg": (1.0, 90.0),
        "pressure_angle_deg": (15.0, 60.0),
        "trochoid_ratio": (0.0, 2.0),
        "coefficients": (-1.0, 1.0),
        "some_other_angle_deg": (0.0, 90.0),
    }
    for key, pair in expected.items():
        found = (parameters() | {other.key: other})[key].usually(30.0, 3)
        assert found == pytest.approx(pair), key
