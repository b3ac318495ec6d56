"""Notes on values that look as if given in another unit, and usual ranges.

Those of design parameters, and of the config section `assumptions`."""

import functools
import re

import pytest

from rootsopt.config import Config, load, notes, parse
from rootsopt.config.explain import keys_of
from rootsopt.config.families import Parameter, parameters
from rootsopt.config.plausible import USUAL, notes_on_swept, usual_of
from rootsopt.config.units import _UNITS, unit_of
from rootsopt.errors import InputError
from tests.standins import ROOT, refusal

FULL = [
    "contact.clearance_mm=0.05",
    # Static friction may be kinetic friction.
    "contact.friction={static: 0.1, kinetic: 0.1}",
    "contact.wear={offset_mm: 0.02, depth_mm: 0.03}",
    "rotor.helix_deg=60",
    "rotor.bore_mm=12",
    "scene.motor.torque_N_m=4",
    "scene.bearings={port_deg: 10, bearing_distance_mm: 30}",
    "scene.heat={rotor_warming_K: 60, rotor_expansion_per_K: 2.3e-5}",
    "pump={viscosity_mPa_s: 1.0, pressure_difference_Pa: 2.0e5, tip_clearance_mm: 0.1}",
    "constraints={seal_width_min_mm: 2, outer_radius_max_mm: 45, terms: {peak_force_N: {max: 90}}}",
    "optimizer.bounds={pressure_angle_deg: [25, 45], helix_deg: [0, 90]}",
    "objective.speeds_rpm=[1500, 3000]",
]
"""Overrides that give a pump most of the quantities with a unit."""


def test_every_quantity_has_a_usual_range():
    """No key with a unit is forgotten, and no range is left for a key that is gone."""
    keys = [key.name for key in keys_of(Config)]
    assert [key for key in keys if unit_of(key) and usual_of(key) is None] == []
    assert set(USUAL) <= set(keys)


def test_values_of_the_pages_are_usual():
    """`--set KEY=NUMBER` in the pages gives no note on the config of the paper's rotor."""
    pages = " ".join(page.read_text("utf-8") for page in (ROOT / "docs").glob("*.md"))
    given = re.findall(r"--set '?([a-z_.]+)=([-\d.e]+)\b", pages)
    seen = {pair for pair in given if usual_of(pair[0]) is not None and "outline" not in pair[0]}
    assert len(seen) > 10
    for key, text in seen:
        assert notes_on_swept(load("cic_drawn"), {key: [float(text)]}) == ()


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("scene.load={pressure_difference_Pa: 8.0}", "bar? write 8e+05"),
        ("scene.load.torque_N_m=4775.0", "N·mm? write 4.775"),
        ("scene.timing_gear.backlash_mm=5.0", "usually 0.00033 to 1.2"),
        ("scene.timing_gear.stiffness_N_m_per_rad=20.0", "kN·m/rad? write 2e+04"),
        ("scene.timing_gear.damping_ratio=50.0", "percentage? write 0.5"),
        ("scene.speed_rpm=50.0", "Hz? write 3000"),
        ("pump={viscosity_mPa_s: 0.001, pressure_difference_Pa: 1.0e5}", "Pa·s? write 1"),
        ("rotor.helix_deg=1.05", "radians? write 60.16"),
        ("contact.clearance_mm=0.0001", "metres? write 0.1"),
        ("constraints.terms={peak_force_N: {max: 0.2}}", "kN? write 200"),
        ("tolerances.conditions={a: {}, b: {scene.speed_rpm: 50.0}}", "conditions.b.scene.speed"),
    ],
)
def test_odd_value_has_a_note(override, words):
    (note,) = notes(load("cic_drawn", [override]))
    assert words in note
    assert re.match("`.*unusual", note)


def test_values_in_another_unit_do_not_pass_in_silence():
    """Each quantity of a pump, given in a unit that differs by a thousand, is told.

    Viscosity is left out: water in µPa·s has the number of an oil in mPa·s."""
    config = load("pump", ["scene.load={torque_N_m: 4.0, pressure_difference_Pa: null}", *FULL])
    assert notes(config) == ()
    told = 0
    for key in USUAL.keys() - {"pump.viscosity_mPa_s"}:
        value = functools.reduce(lambda at, part: getattr(at, part, None), key.split("."), config)
        others = [others for end, (_, others) in _UNITS.items() if key.endswith(end)]
        if not isinstance(value, float) or not value or not others:
            continue
        for factor in (one for one in others[0].values() if not 0.01 <= one <= 100):
            try:
                found = notes(config.replaced({key: value / factor}))
            except InputError as error:
                found = (str(error),)
            assert any(f"`{key}" in note for note in found), (key, value / factor)
            told += 1
    assert told > 40


def test_notes_on_swept_values_name_the_option():
    values = {"scene.speed_rpm": (1000.0, 3000.0), "scene.timing_gear.backlash_mm": (0.1, 9.0)}
    (note,) = notes_on_swept(load("cic_drawn"), values)
    assert note.startswith("`--over scene.timing_gear.backlash_mm` is 9 mm")


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("constraints.terms={peak_force_N: {max: -1}}", r"peak_force_N\.max` must be at least 0"),
        (
            "constraints.terms={line_0.5_force_N: {max: -1}}",
            r"line_0\.5_force_N\.max` must be at least 0",
        ),
        ("constraints.terms={tilting_moment_max_N_m: {max: -1}}", "must be at least 0"),
        (
            "constraints.terms={mean_force_N: {min: 21}, peak_force_N: {max: 20}}",
            r"mean_force_N\.min` .* at most 20",
        ),
        (
            "constraints.terms={rms_force_N: {min: 21, max: 30}, peak_force_N: {max: 20}}",
            r"rms_force_N\.min`",
        ),
        ("constraints.terms={line_1_force_N: {min: 21}, mean_force_N: {max: 10}}", "at most 20"),
        (
            "constraints.terms={line_1_force_N: {min: 21}, peak_force_N: {max: 30}}",
            r"at most 19\.1",
        ),
        (
            "constraints.terms={line_1_force_N: {min: 21}, rms_force_N: {max: 18}}",
            r"at most 20\.78",
        ),
        (
            "constraints.terms={bearing_load_equivalent_N: {min: 9}, bearing_load_max_N: {max: 8}}",
            "at most 8",
        ),
        *(
            (
                f"contact.friction={friction}",
                r"`contact\.friction\.static` must be at least `contact",
            )
            for friction in ("{kinetic: 0.3}", "{static: 0.05}", "{static: 0, kinetic: 1}")
        ),
    ],
)
def test_limits_and_friction_that_cannot_be_are_refused(override, words):
    assert re.search(words, refusal(load, "cic_drawn", [override]))


CLEARANCE, SPEED = "contact.clearance_mm", "scene.speed_rpm"
OVER = "assumptions.over"


def ranges(*overrides, name="cic_drawn"):
    return {one.key: one.ends for one in load(name, overrides).spans}


@pytest.mark.parametrize(
    ("key", "ends"),
    [
        ("arc_center_mm", (15.0, 29.97)),
        ("rolling_radius_mm", (0.3, 45.0)),
        ("edge_radius_mm", (0.3, 45.0)),
        ("tip_arc_angle_deg", (0.0, 15.0)),
        ("tip_arc_turn_deg", (1.0, 90.0)),
        ("pressure_angle_deg", (15.0, 60.0)),
        ("trochoid_ratio", (0.0, 2.0)),
        ("coefficients", (-1.0, 1.0)),
        ("some_other_angle_deg", (0.0, 90.0)),
    ],
)
def test_ranges_of_parameters_that_a_config_leaves_open(key, ends):
    """Lengths scale with the pitch radius and the tip land with the lobe pitch.

    Every other parameter has the range of its kind; no length is negative."""
    other = Parameter("some_other_angle_deg", "an angle", 0, 180)
    assert parameters().get(key, other).usually(30.0, 3) == pytest.approx(ends)


@pytest.mark.parametrize(
    ("name", "overrides", "key", "ends"),
    [
        ("cic_drawn", [], SPEED, (2400.0, 3600.0)),
        ("cic_drawn", [], "scene.timing_gear.backlash_mm", (0.05, 0.15)),
        ("cic_drawn", ["scene.timing_gear=null"], "scene.timing_gear.backlash_mm", None),
        ("cic_drawn", [], CLEARANCE, (0.0, 0.015)),
        ("cic_drawn", ["contact.clearance_mm=0.04"], CLEARANCE, (0.02, 0.06)),
        ("pump", [], "scene.load.pressure_difference_Pa", (3e4, 8e4)),
        ("pump", [], "scene.load.torque_N_m", None),
        # What the config does not allow is left out, unless the user asks for it.
        ("cic_drawn", ["scene.speed_rpm=9.5e5"], SPEED, None),
        ("cic_drawn", ["objective.speeds_rpm=[2000, 3000]"], SPEED, None),
        ("cic_drawn", ["assumptions.scenes=0"], CLEARANCE, None),
    ],
)
def test_usual_ranges_follow_the_scene(name, overrides, key, ends):
    """A scene varies what it has; the clearance stays above 0, by 15 µm or by half of it."""
    assert ranges(*overrides, name=name).get(key) == pytest.approx(ends)


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
