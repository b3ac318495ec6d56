"""Tests of closed orbits against the same by shooting, which shares only the equation of motion."""

import pytest

import rootsopt
from experiments.orbits.study import compared
from rootsopt.dynamics.flanks import has_margins
from rootsopt.dynamics.parts import TimingGear

LIVELY = [
    "scene.speed_rpm=1700",
    "scene.load.torque_N_m=3",
    "scene.timing_gear.backlash_mm=0.25",
    "scene.timing_gear.damping_ratio=0.3",
    "scene.timing_gear.stiffness_N_m_per_rad=9000",
    "profile.pressure_angle_deg=30.7",
    "profile.involute_length_mm=4",
    "profile.tip_arc_angle_deg=1.5",
]
STIFF = [
    "scene.speed_rpm=657.2",
    "scene.load.torque_N_m=2.069",
    "scene.timing_gear={stiffness_N_m_per_rad: 42986, damping_ratio: 0.276, backlash_mm: 0.104}",
]
TWISTED = [
    "rotor.helix_deg=40",
    "solver.slices=4",
    "contact.friction={static: 0.12, kinetic: 0.1}",
    "scene.center_distance_error_mm=0.02",
]
FOUR = [
    "profile={family: cic, lobes: 4, pitch_radius_mm: 33.0, pressure_angle_deg: 33, "
    "involute_length_mm: 6, tip_arc_angle_deg: 2}"
]
ARCS = [
    "profile={family: four_arcs, lobes: 3, pitch_radius_mm: 33.0, arc_center_mm: 23.964, "
    "tip_arc_radius_mm: 20.659, tip_arc_turn_deg: 34.22}",
    "scene.load.torque_N_m=20",
    "optimizer.bounds={}",
]
BEARINGS = ["scene.supports={stiffness_N_per_mm: 20000, damping_N_s_per_mm: 2}"]
SOFT = [
    "scene.speed_rpm=779",
    "contact.clearance_mm=0.021",
    "scene.supports={stiffness_N_per_mm: 6483, damping_N_s_per_mm: 1.179}",
    "scene.load.torque_N_m=2.21",
]


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "overrides", "period"),
    [
        ("cic_drawn", [], 1),
        ("ee", [], 1),
        ("ee", STIFF, 1),
        ("cic_drawn", FOUR, 1),
        ("cic_drawn", LIVELY, 2),
        ("pump", [], 1),
        ("cic_drawn", TWISTED, 1),
        ("cic_drawn", ["contact.wear.depth_mm=0.02"], 1),
        ("cic_drawn", ARCS, 1),
        ("cic_drawn", ["scene.center_distance_error_mm=0.03"], 1),
        ("cic_drawn", BEARINGS, 1),
        ("ee", SOFT, 1),
    ],
    ids=[
        *("cic_drawn", "ee", "steps down to rounding", "four lobes", "lively", "pump", "twisted"),
        *("worn", "contact jumps over a joint", "centre distance", "contact slides over a tip"),
        "contact slides past a cusp",
    ],
)
def test_orbit_is_that_by_shooting(name, overrides, period):
    row = compared(rootsopt.load_config(f"configs/{name}.yaml", overrides))
    assert row["status"] == "periodic"
    assert row["period"] == period
    for force in ("mean", "peak", "rms"):
        assert row[f"{force}_difference"] < 5e-7
        slack = max(2e-5, 2 * row[f"{force}_gradient_noise"])
        assert row[f"{force}_gradient_difference"] < slack < 1e-3
    # Kinks within 1e-5 of the state leave some 1e-5 in the differences of the reference.
    assert row["multiplier_difference"] < 5e-5


class _Untold(TimingGear):
    """A gear whose flags are newer than its margins."""

    def switches(self, motion, own):
        return super().switches(motion, own)


def test_flags_newer_than_margins_have_none():
    """An orbit with events that only a flag tells is closed in `tests/conformance`."""
    assert has_margins(TimingGear)
    assert not has_margins(_Untold)
