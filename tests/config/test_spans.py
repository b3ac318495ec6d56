"""Ranges: of design parameters by default, of the config section `assumptions`, refusals."""

import pytest

from rootsopt.config import load, parse
from rootsopt.config.families import Parameter, parameters
from tests.standins import refusal

CLEARANCE, SPEED = "contact.clearance_mm", "scene.speed_rpm"
OVER = "assumptions.over"


def ranges(*overrides, name="cic_drawn"):
    return {one.key: one.ends for one in load(name, overrides).spans}


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


def test_usual_ranges_follow_the_scene():
    """A scene varies what it has; the clearance stays above 0, by 15 µm or by half of it."""
    own = ranges()
    assert own[SPEED] == (2400.0, 3600.0)
    assert own["scene.timing_gear.backlash_mm"] == pytest.approx((0.05, 0.15))
    assert own[CLEARANCE] == pytest.approx((0.0, 0.015))
    assert ranges("contact.clearance_mm=0.04")[CLEARANCE] == pytest.approx((0.02, 0.06))
    assert not [key for key in ranges("scene.timing_gear=null") if "gear" in key]
    gas = ranges(name="pump")
    assert gas["scene.load.pressure_difference_Pa"] == pytest.approx((3e4, 8e4))
    assert "scene.load.torque_N_m" not in gas
    # What the config does not allow is left out, unless the user asks for it.
    assert SPEED not in ranges("scene.speed_rpm=9.5e5")
    assert SPEED not in ranges("objective.speeds_rpm=[2000, 3000]")
    assert ranges("assumptions.scenes=0") == {}


def test_own_ranges_replace_the_usual_ones():
    """Dots and a mapping mean the same; `null` holds a key; the resolved config reads the same."""
    texts = f"{OVER}.{CLEARANCE}.Range=[0, 0.04]", f"{OVER}.{SPEED}=null"
    config = load("cic_drawn", texts)
    other = load("cic_drawn", [f"{OVER}={{{CLEARANCE}: {{range: [0, 0.04]}}, {SPEED}: null}}"])
    assert config == other == parse(config.to_yaml())
    found = {one.key: one.ends for one in config.spans}
    assert found[CLEARANCE] == (0.0, 0.04)
    assert found.keys() == ranges().keys() - {SPEED}
    assert ranges(f"{OVER}.rotor.density_kg_m3.factor=[0.9, 1.1]")["rotor.density_kg_m3"] == (
        pytest.approx((7020.0, 8580.0))
    )


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        ([f"{OVER}.{CLEARANCE}.range=[-1, 0.04]"], ["from -1 to 0.04", "at least 0", "narrow"]),
        ([f"{OVER}.contact.clearence_mm.range=[0, 1]"], ["mean `contact.clearance_mm`"]),
        ([f"{OVER}.clearance.range=[0, 1]"], ["mean `contact.clearance_mm`"]),
        ([f"{OVER}.{CLEARANCE}.rnge=[0, 1]"], [f"mean `{OVER}.{CLEARANCE}.range`"]),
        ([f"{OVER}.{CLEARANCE}.range=[1, 0]"], ["two increasing numbers"]),
        ([f"{OVER}={{{SPEED}: {{factor: [1, 2], range: [1, 2]}}}}"], ["one range"]),
        ([f"{OVER}.profile.tip_arc_angle_deg.factor=[1, 2]"], ["cannot vary", "contact and scene"]),
        ([f"{OVER}.scene.phase_error_mrad.range=[0, 1]"], ["give", "nominal value"]),
        ([f"{OVER}.{SPEED}.factor=[1, 2]", "objective.speeds_rpm=[2000]"], ["lists the speeds"]),
        (["objective.over=assumptions", "assumptions.scenes=0"], ["must be above 0"]),
        (
            ["objective.over=assumptions", f"tolerances.over.{SPEED}.normal=1"],
            ["`tolerances` must be absent"],
        ),
        (["objective.over=assumptions", "objective.motion=ensemble"], ["must not be ensemble"]),
    ],
)
def test_refusals_name_the_remedy(overrides, words):
    message = refusal(load, "cic_drawn", overrides)
    assert [word for word in words if word not in message] == []
