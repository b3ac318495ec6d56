"""The configs whose results are stored: a shipped config, overrides and a name each.

Every profile family, scene part, contact, method, measure, motion and status occurs at least once.
What is not the subject of a case is as in the shipped config, except the tolerance. At the shipped
tolerance rounding alone can change the steps, and forces differ by up to 1e-7."""

from typing import NamedTuple


class Case(NamedTuple):
    """Hold a config to be evaluated.

    nudged: whether the case is also evaluated at speeds that differ by rounding when it is written.
    Long cases are not."""

    name: str
    config: str
    overrides: list[str]
    nudged: bool = True


def _tight(case: Case) -> Case:
    """Return the case at a tight tolerance, unless its tolerance is its subject."""
    loose = case.name.startswith(_AS_SHIPPED) or any("rtol" in one for one in case.overrides)
    return case if loose else case._replace(overrides=["solver.rtol=1e-11", *case.overrides])


# Beginnings of the names of cases that use the config's own tolerance.
_AS_SHIPPED = ("as shipped", "inaccurate", "ensemble")


def _sections(**values: str) -> list[str]:
    """Return overrides of a scene from short names."""
    return [f"{_KEYS[key]}={value}" for key, value in values.items()]


_KEYS = {
    "speed": "scene.speed_rpm",
    "load": "scene.load.torque_N_m",
    "backlash": "scene.timing_gear.backlash_mm",
    "damping": "scene.timing_gear.damping_ratio",
    "gear": "scene.timing_gear.stiffness_N_m_per_rad",
    "clearance": "contact.clearance_mm",
    "stiffness": "contact.stiffness_N_per_mm_e",
    "rtol": "solver.rtol",
    "method": "solver.method",
}


def _profile(family: str, lobes: int, keys: str = "") -> str:
    inside = f"family: {family}, lobes: {lobes}, pitch_radius_mm: 33.0"
    return f"profile={{{inside}{', ' if keys else ''}{keys}}}"


_FAMILIES = {
    "cic, 2 lobes": ("cic", 2, "pressure_angle_deg: 40, involute_length_mm: 8, "
                     "tip_arc_angle_deg: 4"),
    "cic, 4 lobes": ("cic", 4, "pressure_angle_deg: 33, involute_length_mm: 6, "
                     "tip_arc_angle_deg: 2"),
    "ee, 2 lobes": ("ee", 2, ""),
    "ee, 4 lobes": ("ee", 4, ""),
    "arc, 2 lobes": ("arc", 2, "arc_center_mm: 26.4"),
    "arc, 3 lobes": ("arc", 3, "arc_center_mm: 29.7"),
    "arcs_epicycloid": ("arcs_epicycloid", 3, "arc_center_mm: 27, tip_arc_angle_deg: 8, "
                        "edge_radius_mm: 1"),
    "arc_involute, 3 lobes": ("arc_involute", 3, "pressure_angle_deg: 36, involute_length_mm: 6"),
    "arc_involute, 4 lobes": ("arc_involute", 4, "pressure_angle_deg: 33, involute_length_mm: 5"),
    "four_arcs": ("four_arcs", 3, "arc_center_mm: 30, tip_arc_radius_mm: 13, "
                  "tip_arc_turn_deg: 40"),
    "five_arcs": ("five_arcs", 3, "outer_radius_mm: 45, tip_arc_angle_deg: 3, "
                  "tip_arc_radius_mm: 13, tip_arc_turn_deg: 60"),
    "circle_epicycloid": ("circle_epicycloid", 3, "rolling_radius_mm: 7, tip_arc_turn_deg: 30"),
    "hypo_epicycloid, 3 lobes": ("hypo_epicycloid", 3, "tip_arc_angle_deg: 4"),
    "hypo_epicycloid, 4 lobes": ("hypo_epicycloid", 4, "tip_arc_angle_deg: 3"),
    "extended_cycloid": ("extended_cycloid", 3, "trochoid_ratio: 1.3"),
    "ellipse": ("ellipse", 3, "ellipse_center_mm: 27, ellipse_height_mm: 18"),
    "outline of a cic": ("outline", 3, "outline_file: HERE/cic.csv"),
    "outline of an ee, measured": ("outline", 2, "outline_file: HERE/ee.csv, "
                                   "outline_smoothing_mm: 2.0e-3"),
}  # fmt: skip
_GEAR = "scene.timing_gear={stiffness_N_m_per_rad: 2.0e4, damping_ratio: 0.5, backlash_mm: 0.1}"
# A light load at high speed, at which the motion is sound without a timing gear.
_BARE = [
    "scene.timing_gear=null",
    *_sections(speed="6000", load="0.1"),
    "profile.involute_length_mm=6",
]
_PARTS = {
    "no gear": [],
    "gear": [_GEAR],
    "gear with phase error": [_GEAR, "scene.phase_error_mrad=0.4"],
    "motor": ["scene.drive=torque", "scene.motor={slope_N_m_s_per_rad: 0.1}"],
    "motor with inertia": [
        _GEAR,
        "scene.load.torque_N_m=4.775",
        "scene.drive=torque",
        "scene.motor={slope_N_m_s_per_rad: 0.1, torque_N_m: 6, inertia_kg_m2: 2.0e-3}",
    ],
    "gas load": ["scene.load={pressure_difference_Pa: 1000}"],
    "gas load and gear": [_GEAR, "scene.load={pressure_difference_Pa: 5.0e4}"],
    "friction": ["contact.friction={}"],
    "centre distance error": [
        _GEAR,
        "scene.load.torque_N_m=4.775",
        "scene.center_distance_error_mm=0.02",
    ],
    # The contact slides over tips.
    "supports": [
        _GEAR,
        "scene.load.torque_N_m=4.775",
        "scene.supports={stiffness_N_per_mm: 2.0e4, damping_N_s_per_mm: 2}",
    ],
}
# A stable orbit of two mesh periods, which is sensitive to small changes.
_SHAKY = [
    *_sections(speed="1700", load="3", backlash="0.25", damping="0.3", gear="9000"),
    "profile.pressure_angle_deg=30.7",
    "profile.involute_length_mm=4",
    "profile.tip_arc_angle_deg=1.5",
]
# A backlash at which motions coexist at 6000 rpm.
_TWO = ["scene.timing_gear.backlash_mm=0.2", "scene.timing_gear.damping_ratio=0.2"]
_GRID = ["attractors.relatives=5", "attractors.rates=4"]
_FEW = ["ensemble.members=4", "ensemble.settle_periods=24", "ensemble.periods=8"]
_MEASURED = ["response.lines=[1, 2, 3.5]", "objective.peak_norm=16"]

_EVERY = [
    Case("as shipped, cic", "cic_drawn", []),
    Case("as shipped, ee", "ee", []),
    Case("as shipped, pump", "pump", []),
    Case("as shipped, measures", "cic_drawn", _MEASURED),
    Case("cic", "cic_drawn", []),
    Case("dopri8", "cic_drawn", _sections(method="dopri8")),
    Case("ee", "ee", []),
    Case("paper cic", "paper_cic", []),
    Case("paper ee", "paper_ee", []),
    Case("free form", "free", []),
    Case("pump", "pump", []),
    Case("bore and short rotor", "cic_drawn", ["rotor.bore_mm=20", "rotor.length_mm=40"]),
    Case("clearance", "cic_drawn", _sections(clearance="0.01")),
    Case("corners as they stand", "cic_drawn", ["contact.smoothing_mm=0"]),
    Case("wide rounding", "cic_drawn", ["contact.smoothing_mm=0.003"]),
    Case("slow", "cic_drawn", _sections(speed="700")),
    Case("fast", "cic_drawn", _sections(speed="12000")),
    Case("no play", "cic_drawn", _sections(backlash="0")),
    Case("one mesh period, lively", "cic_drawn", _sections(speed="4500", damping="0.2",
                                                     backlash="0.05")),
    Case("two mesh periods, shaky", "cic_drawn", _SHAKY),
    Case("two mesh periods, shaky, at 1e-9", "cic_drawn", [*_SHAKY, *_sections(rtol="1e-9")]),
    # At 4000 rpm, three motions coexist, and rounding decides which one is reached from rest.
    Case("two mesh periods", "cic_drawn", _sections(backlash="0.2", damping="0.2", speed="4100")),
    Case("three mesh periods", "cic_drawn", _sections(damping="0.05", load="2", speed="6000")),
    Case("noisy", "cic_drawn", _sections(damping="0.05", speed="6000")),
    Case("four mesh periods", "cic_drawn", _sections(backlash="0.2415")),
    Case("six mesh periods", "cic_drawn", [*_TWO, *_sections(speed="6000")]),
    Case("held apart", "cic_drawn", _sections(clearance="0.3")),
    Case("no load", "cic_drawn", _sections(load="0")),
    Case("too deep", "cic_drawn", _sections(backlash="2", load="300", stiffness="200")),
    Case("slow and stiff", "cic_drawn", _sections(speed="1", stiffness="1e9")),
    Case("not settled", "cic_drawn", [*_sections(backlash="0.2", damping="0.05", load="2",
                                           speed="4000"), "solver.max_mesh_periods=16"]),
    Case("several speeds", "cic_drawn", ["objective.speeds_rpm=[4000, 2000]",
                                   "objective.speed_weights=[3, 1]"]),
    Case("several speeds, worst", "cic_drawn", ["objective.speeds_rpm=[2000, 3000, 5000]",
                                          "objective.over_speeds=worst"]),
    Case("chaotic", "cic_drawn", _sections(backlash="0.4", damping="0.1", load="1")),
    Case("measures", "cic_drawn", _MEASURED),
    Case("passed through", "cic_drawn", ["scene.timing_gear=null", *_sections(load="30")]),
    *(Case(f"bare, {name}", "cic_drawn", [*_BARE, *more]) for name, more in _PARTS.items()),
    Case("stalled", "cic_drawn", ["scene.drive=torque",
                            "scene.motor={slope_N_m_s_per_rad: 0.001, torque_N_m: 0.5}"]),
    Case("inaccurate, no room for a check", "cic_drawn",
         [*_sections(damping="0.05", load="2", speed="6000"), "solver.max_steps_per_period=320"]),
    *(Case(name, "cic_drawn", [_profile(*rest)]) for name, rest in _FAMILIES.items()),
    Case("worst motion", "cic_drawn", [*_TWO, *_GRID, *_sections(speed="6000"),
                                 "objective.motion=worst"]),
    Case("weighted motions", "cic_drawn", [*_TWO, *_GRID, *_sections(speed="6000"),
                                     "objective.motion=weighted"]),
    Case("worst motion at several speeds", "cic_drawn", [*_TWO, *_GRID, "objective.motion=worst",
                                                   "objective.speeds_rpm=[3000, 6000]"]),
    Case("ensemble of a periodic motion", "cic_drawn", [*_FEW, "objective.motion=ensemble",
                                                  "ensemble.designs=12"]),
    Case("ensemble of a chaotic motion", "cic_drawn", [*_FEW, "objective.motion=ensemble",
                                                 "ensemble.designs=12",
                                                 *_sections(damping="0.1", backlash="0.4",
                                                            load="1")], nudged=False),
]  # fmt: skip
"""All cases; those that share compiled programs are adjacent."""
CASES = [_tight(case) for case in _EVERY]
SHORT = ("slow", "held apart", "no load", "too deep")
"""Names of cases that share the program of most tests."""
