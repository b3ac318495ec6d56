"""Tests of config files: which are accepted, which are rejected, and that each message names a
key."""

import itertools
import re
import shlex
from typing import Literal, get_args, get_origin

import pytest
import yaml

from rootsopt.config import Config, load, parse
from rootsopt.config.explain import describe, tree
from rootsopt.config.families import families, family_of
from rootsopt.scene import check_geometry
from tests.standins import ROOT
from tests.standins import refusal as refused

MINIMAL = """\
profile:
  family: cic
  lobes: 3
  pitch_radius_mm: 33.0
  pressure_angle_deg: 36.43
  involute_length_mm: 8.5
  tip_arc_angle_deg: 4.0
rotor:
  length_mm: 100.0
  density_kg_m3: 7800.0
contact:
  stiffness_N_per_mm_e: 2.0e5
  exponent: 2.2
  max_damping_N_s_per_mm: 0.25
  full_damping_depth_mm: 0.01
scene:
  speed_rpm: 3000.0
  load:
    torque_N_m: 1.0
"""
EE_PROFILE = ("profile: {family: ee, lobes: 3, pitch_radius_mm: 33.0}\n") + MINIMAL[
    MINIMAL.index("rotor:") :
]


def with_line(old, new):
    assert MINIMAL.count(old) == 1
    return MINIMAL.replace(old, new)


def refusal(text, *overrides):
    return refused(parse, text, overrides)


# What loads


def test_resolved_yaml_round_trips():
    """to_yaml() writes every default, for any YAML reader; reading it gives an equal config."""
    config = parse(MINIMAL, ["optimizer.bounds.involute_length_mm=[4, 9]"])
    assert Config.model_validate_json(config.model_dump_json()) == config
    assert yaml.safe_load(config.to_yaml())["solver"]["method"] == config.solver.method
    assert parse(config.to_yaml()) == config


# What is refused


ARC = EE_PROFILE.replace("ee", "arc", 1).replace("33.0", "33.0, arc_center_mm: 29.7", 1)
MANY = ", ".join(f"{k}: 1" for k in range(1, 40))
REFUSED = [
    # Unknown, missing, misplaced.
    (MINIMAL, "scene.sped_rpm=1", ["`scene.sped_rpm`", "did you mean `scene.speed_rpm`"]),
    (MINIMAL, "profile.tip_arc_angle=1", ["`profile.tip_arc_angle`", "tip_arc_angle_deg"]),
    (with_line("rotor:", "rotors:"), None, ["`rotors`", "did you mean `rotor`"]),
    (MINIMAL, "rotor.zzz=1", ["`rotor.zzz`", "length_mm", "density_kg_m3"]),
    (MINIMAL, "rotor.speed_rpm=1000", ["`rotor.speed_rpm`", "`scene.speed_rpm`"]),
    (with_line("  speed_rpm: 3000.0\n", ""), None, ["`scene.speed_rpm`"]),
    (with_line("    torque_N_m: 1.0\n", ""), None, ["`scene.load"]),
    (with_line("  family: cic\n", ""), None, ["`profile.family`"]),
    (MINIMAL, "scene=null", ["`scene"]),
    ("---\n", None, ["`profile` is missing"]),
    ("- profile\n- scene\n", None, ["sections"]),
    ("just words", None, ["sections"]),
    (MINIMAL + "rotor: {length_mm: 1.0}\n", None, ["'rotor'", "twice"]),
    (with_line("  lobes: 3\n", "  lobes: 3\n  lobes: 4\n"), None, ["'lobes'", "twice"]),
    (MINIMAL, "float=1", ["`float` is not a known key"]),
    (MINIMAL, "'a[b'=1", ["is not a known key"]),
    # Values of another kind.
    (MINIMAL, "scene.speed_rpm=fast", ["`scene.speed_rpm` must be a number", "'fast'"]),
    (MINIMAL, "scene.speed_rpm=true", ["`scene.speed_rpm` must be a number", "True"]),
    (MINIMAL, "scene.speed_rpm=[1, 2]", ["`scene.speed_rpm` must be a number", "[1, 2]"]),
    (MINIMAL, "profile.lobes=2.5", ["`profile.lobes` must be a whole number", "2.5"]),
    (MINIMAL, "scene.timing_gear=text", ["`scene.timing_gear`", "section"]),
    (MINIMAL, "profile.family=nonsense", ["`profile.family`", "'nonsense'", "cic", "ee"]),
    (MINIMAL, "scene.drive=Torqe", ["did you mean torque?"]),
    (MINIMAL, "constraints.area_efficiency_min=much", ["one of 'baseline' or a number"]),
    (MINIMAL, "optimizer.bounds.involute_length_mm=[1, 2, 3]", ["two numbers"]),
    (MINIMAL, "optimizer.bounds.involute_length_mm=[a, b]", ["bounds.involute_length_mm"]),
    # Values out of range.
    (MINIMAL, "profile.lobes=7", ["`profile.lobes` must be at most 6", "but is 7"]),
    (MINIMAL, "profile.pressure_angle_deg=90", ["must be less than 90"]),
    (MINIMAL, "scene.speed_rpm=0", ["`scene.speed_rpm` must be greater than 0"]),
    (MINIMAL, "solver.rtol=1e-13", ["`solver.rtol` must be at least 1e-12"]),
    (MINIMAL, "solver.accuracy=1e-10", ["`solver.accuracy`"]),
    (MINIMAL, "constraints.area_efficiency_min=2", ["less than 1"]),
    (MINIMAL, "optimizer.bounds.involute_length_mm=[9, 4]", ["bounds.involute_length_mm"]),
    (MINIMAL, "optimizer.bounds.tip_arc_angle_deg=[4, 4]", ["such as [4, 4.004]"]),
    (MINIMAL, "objective={mean_weight: 0, peak_weight: 0}", ["must not all be 0"]),
    (MINIMAL, "objective.line_weights={1: 2e6}", ["at most 1e+06"]),
    (MINIMAL, "objective.line_weights={0: 1}", ["greater than 0"]),
    (MINIMAL, "objective.line_weights={1: 1, '1': 2}", ["line_weights"]),
    (MINIMAL, f"objective.line_weights={{{MANY}}}", ["most 32"]),
    (MINIMAL, f"response.lines={list(range(1, 40))}", ["at most 32"]),
    (MINIMAL, "scene.speed_rpm=" + "9" * 399, ["ordinary size"]),
    (MINIMAL, "profile.outline_file='a\tb\u0007'", ["outline_file"]),
    (ARC, "optimizer.bounds.arc_center_mm=[0.02, 0.03]", ["metres? write 30"]),
    # Overrides.
    *((MINIMAL, one, ["--set", repr(one), "dotted.key=value"]) for one in ("x", "=5", "a..b=5")),
    (MINIMAL, "scene.speed_rpm.deep=5", ["scene.speed_rpm"]),
    (MINIMAL, "scene.speed_rpm=[1", ["not valid YAML"]),
    (MINIMAL, "nothing.at.all=1", ["`nothing`"]),
    # Keys of former versions.
    (MINIMAL, "drawing.revision=B", ["drawing.title_block"]),
    (MINIMAL, "sweep.speed_rpm={}", ["--over scene.speed_rpm="]),
]


# Keys of catalogues, and the right key and value.
CATALOGUE = [
    ("profile.center_distance_mm=125", "`profile.pitch_radius_mm: 62.5`?"),
    ("profile.centre_distance_cm=12.5", "`profile.pitch_radius_mm: 62.5`?"),
    ("profile.outer_diameter_mm=200", "`profile.outer_radius_mm: 100`? it belongs to"),
    ("diameter_mm=200", "`profile.outer_radius_mm: 100`?"),
    ("scene.rpm=1500", "`scene.speed_rpm`?"),
    ("scene.speed=1500", "`scene.speed_rpm`?"),
    ("scene.speed_Hz=50", "`scene.speed_rpm: 3000`?"),
    ("scene.load.pressure_bar=0.3", "`scene.load.pressure_difference_Pa: 30000`?"),
    ("scene.load.pressure_difference_kPa=40", "`scene.load.pressure_difference_Pa: 40000`?"),
    ("pump.pressure_difference_mbar=300", "`pump.pressure_difference_Pa: 30000`?"),
    ("rotor.length_m=0.3", "`rotor.length_mm: 300`?"),
    ("rotor.density_g_cm3=7.2", "`rotor.density_kg_m3: 7200`?"),
    ("rotor.length_m=long", "`rotor.length_mm`?"),
    # 10 kW at the config's 3000 rpm is 31.83 N·m, half of it on rotor 2.
    ("scene.power_kW=10", "`scene.load.torque_N_m: 15.92`? it is half of that power at 3000"),
    ("scene.load.power_W=10000", "`scene.load.torque_N_m: 15.92`?"),
    ("power=10", "`scene.load.torque_N_m`? it is half of the power over the speed"),
]

PAIRS = [
    pair
    for pair in itertools.permutations(families(), 2)
    if "cic" in pair and family_of(pair[0]).maker is not None
]


@pytest.mark.parametrize(("old", "new"), PAIRS)
def test_change_of_family_is_answered_by_the_overrides_that_it_needs(old, new):
    """The message lists them all, in words that a shell takes."""
    before, after = {*family_of(old).keys}, {*family_of(new).keys}
    if before == after and family_of(new).maker is not None:
        return
    example = {k: [*v] if isinstance(v, tuple) else v for k, v in family_of(old).example.items()}
    profile = {"family": old, "lobes": 3, "pitch_radius_mm": 33.0, **example}
    text, change = (
        yaml.safe_dump(yaml.safe_load(MINIMAL) | {"profile": profile}),
        f"profile.family={new}",
    )
    message = refusal(text, change)
    assert len(message) < 400
    words = shlex.split(message[message.index("--set") :])
    overrides = [word.replace("FILE", "rotor.csv") for word in words if word != "--set"]
    assert {f"profile.{key}=null" for key in before - after} <= {*overrides}
    config = parse(text, [change, *overrides])
    assert (config.profile.family, {*config.profile.parameters}) == (new, after)


# Ranges, units, choices


def numeric(annotation):
    parts = () if get_origin(annotation) is Literal else get_args(annotation)
    return annotation in (float, int) or any(numeric(part) for part in parts)


# A config with every part of a scene.
SECTIONS = {
    "tolerances": "\ntolerances: {over: {rotor.length_mm: {normal: 0.01}}}\n",
    "pump": "\npump: {viscosity_mPa_s: 1.0, pressure_difference_Pa: 1.0e5, "
    "gas: {inlet_pressure_Pa: 1.0e5}}\n",
}
PUMP = (ROOT / "configs" / "pump.yaml").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def lines():
    return {line.split()[0]: line for line in describe(Config).splitlines()}


@pytest.mark.parametrize(
    "key",
    [
        key
        for key, field in tree(Config).items()
        if numeric(field.annotation) and key != "optimizer.bounds"
    ],
)
def test_every_number_has_two_ends(key, lines):
    parts = "timing_gear", "motor", "supports", "load", "friction"
    text = PUMP if any(part in key for part in parts) else MINIMAL
    text += SECTIONS.get(key.partition(".")[0], "")
    groups = "[1.0e300, 2.0e300]", "{1: 1.0e300, from: 1.0e300}"
    for value in ("1.0e300", "-1.0e300", 10**390, ".inf", ".nan", *groups):
        assert f"`{key}" in refusal(text, f"{key}={value}")
    assert re.search(r"\b(from|above) .*\b(to|below)\b", lines[key])


@pytest.mark.parametrize(
    ("key", "words"),
    [
        ("profile.pitch_radius_mm", "[mm, from 1 to 5000, required]"),
        ("scene.timing_gear.damping_ratio", "[from 0 to 100, default 0.0]"),
        ("scene.drive", "[prescribed | torque, default prescribed]"),
        ("profile.tip_arc_angle_deg", "[°, from 0 below 45]"),
        ("scene.timing_gear.stiffness_N_m_per_rad", "N·m/rad"),
        ("scene.heat.rotor_warming_K", "[K, from"),
        # No temperature: the longest ending counts.
        ("scene.heat.rotor_expansion_per_K", "[1/K, from"),
        ("pump.gas.gas_constant_J_per_kg_K", "[J/(kg·K), from"),
        ("profile.pressure_angle_deg", "default: 25 to 45; from 1 to 80"),
    ],
)
def test_help_has_unit_default_range_and_choices(key, words, lines):
    assert words in lines[key]


# Values that would fit in another usual unit, about which the message asks.
ANOTHER_UNIT = [
    (MINIMAL, "profile.pitch_radius_mm=0.033", "metres? write 33"),
    (MINIMAL, "profile.pitch_radius_mm=33000", "micrometres? write 33"),
    (MINIMAL, "profile.pressure_angle_deg=0.63", "radians? write 36.1"),
    (MINIMAL, "profile.involute_length_mm=0.0085", "metres? write 8.5"),
    (MINIMAL, "rotor.length_mm=0.1", "metres? write 100"),
    (MINIMAL, "rotor.bore_mm=0.012", "metres? write 12"),
    (MINIMAL, "rotor.density_kg_m3=7.8", "g/cm³? write 7800"),
    (MINIMAL, "rotor.density_kg_m3=7.8e-6", "kg/mm³? write 7800"),
    (MINIMAL, "rotor.density_kg_m3=7.8e-9", "t/mm³? write 7800"),
    (MINIMAL, "constraints.outer_radius_max_mm=0.045", "metres? write 45"),
    (MINIMAL, "constraints.area_efficiency_min=42", "percentage? write 0.42"),
    (MINIMAL, "optimizer.bounds.pressure_angle_deg=[0.45, 0.79]", "radians? write 25.78"),
    (EE_PROFILE, "profile={family: arc, lobes: 3, pitch_radius_mm: 33, arc_center_mm: 0.0297}",
     "metres? write 29.7"),
    (EE_PROFILE, "profile={family: ellipse, lobes: 3, pitch_radius_mm: 33, "
     "ellipse_center_mm: 27, ellipse_height_mm: 0.018}", "metres? write 18"),
    (EE_PROFILE, "profile={family: circle_epicycloid, lobes: 3, pitch_radius_mm: 33, "
     "rolling_radius_mm: 7, tip_arc_turn_deg: 0.52}", "radians? write 29.79"),
    (EE_PROFILE, "profile={family: arcs_epicycloid, lobes: 3, pitch_radius_mm: 33, "
     "arc_center_mm: 27, tip_arc_angle_deg: 8, edge_radius_mm: 0.001}", "metres? write 1"),
    (MINIMAL, "scene.speed_rpm='3000,5'", "write 3000.5"),
]  # fmt: skip


CHOICES = [
    ("profile.family", "cic", ("CIC", "Ci-c")),
    ("solver.method", "dopri8", ("Dopri8", "DOPRI-8", "dopri 8")),
    ("objective.motion", "worst", ("WORST",)),
    ("scene.drive", "prescribed", ("Prescribed",)),
    ("constraints.area_efficiency_min", "baseline", ("Baseline", "BASE-LINE")),
]


@pytest.mark.parametrize(("key", "word", "spellings"), CHOICES)
def test_choices_are_taken_in_any_spelling(key, word, spellings):
    """Case, spaces and dashes do not matter. The config stores the word as listed."""
    expected = parse(MINIMAL, [f"{key}={word}"])
    for spelling in spellings:
        config = parse(MINIMAL, [f"{key}='{spelling}'"])
        assert config == expected
        assert f": {word}\n" in config.to_yaml()


# Files and YAML


@pytest.mark.parametrize(
    ("text", "line"),
    [
        (MINIMAL + "rotor: [1,\n", 20),
        ("profile:\n\tfamily: cic\n", 2),
        ("profile: {family: cic\nrotor: 1\n", 2),
        ("a: b: c\n", 1),
        ("? [1, 2]\n: 3\n", 1),
        ("!!python/object:os.system {}\n", 1),
    ],
)
def test_broken_yaml_is_refused_with_its_line(text, line):
    assert re.search(f"not valid YAML.*line ({line}|{line + 1})", refusal(text))


# Keys and values of former versions

FORMER = {
    "solver.fidelity": ("search", "map"),
    "solver.nodes": ("400", "100"),
    "solver.map_error": ("1e-4", "1e-3"),
    "solver.map_rolls": ("null", "96"),
    "solver.gradient": ("forward", "reverse"),
    "solver.orbit": ("Collocation", "shooting"),
    "solver.precision": ("Float64", "float32"),
    "solver.transient_rtol": ("null", "1e-6"),
    "solver.slice_error": ("0.01", "0.1"),
    "attractors.rate_range_rad_s": ("null", "[-1, 1]"),
    "optimizer.method": ("slsqp", "adam"),
    "optimizer.learning_rate": ("0.05", "0.1"),
    "sweep.speed_rpm": ("null", "{from: 300, to: 600, points: 3}"),
    "drawing.points": ("361", "91"),
    "drawing.revision": ("null", "B"),
}


def test_removed_keys_are_accepted_only_where_they_change_nothing():
    """A resolved config of a former version loads. Any other value gets a sentence on its own."""
    plain = parse(MINIMAL, ["drawing={}"])
    config = parse(MINIMAL, ["drawing={}", *(f"{key}={x}" for key, (x, _) in FORMER.items())])
    assert config == plain
    assert config.to_yaml() == plain.to_yaml()
    for key, (_, other) in FORMER.items():
        assert f"`{key}` must be left out, but is" in refusal(MINIMAL, f"{key}={other}")
        said = refused(config.replaced, {key: yaml.safe_load(other)})
        assert f"`{key}` must be left out" in said


# Overrides


def test_overrides_replace_and_create_nested_keys():
    """The last override has precedence."""
    config = parse(
        MINIMAL,
        [
            "scene.timing_gear.stiffness_N_m_per_rad=2e4",
            "scene.timing_gear.backlash_mm=0.05",
            "scene.speed_rpm=1000",
            "scene.speed_rpm = 1500",
            "constraints.area_efficiency_min=0.4",
            "solver.method=dopri8",
        ],
    )
    assert config.scene.timing_gear.stiffness_N_m_per_rad == 2e4
    assert (config.scene.speed_rpm, config.solver.method) == (1500.0, "dopri8")
    assert config.constraints.area_efficiency_min == 0.4


# Geometry


# Designs for which no profile can be made.
IMPOSSIBLE = [
    ({"involute_length_mm": 9.2}, ["`profile.involute_length_mm`", "8.893", "9.2"]),
    (
        {"pressure_angle_deg": 89.78, "tip_arc_angle_deg": 0.475, "involute_length_mm": 17.3},
        ["`profile.involute_length_mm` must be less than 17", "no radius"],
    ),
    (
        {"pressure_angle_deg": 25, "tip_arc_angle_deg": 0, "involute_length_mm": 7.2},
        ["`profile.involute_length_mm`", "undercut", "7.2", "25"],
    ),
    (
        {"pressure_angle_deg": 12, "involute_length_mm": 0.2},
        ["`profile.involute_length_mm` must be at least 0.2395"],
    ),
    # A longer involute meets the pitch circle; its arc still undercuts the other rotor.
    ({"pressure_angle_deg": 12, "involute_length_mm": 0.24}, ["undercut"]),
    ({"tip_arc_angle_deg": 30}, ["`profile.tip_arc_angle_deg`", "less than 30", "but is 30"]),
]


@pytest.mark.parametrize(
    ("text", "overrides", "words"),
    [
        *((text, [override] if override else [], words) for text, override, words in REFUSED),
        *(
            (
                MINIMAL,
                [override],
                [f"config: `{override.split('=')[0]}` is not a known", f"did you mean {answer}"],
            )
            for override, answer in CATALOGUE
        ),
        *(
            (text, [override], [f"`{override.split('=')[0]}", words])
            for text, override, words in ANOTHER_UNIT
        ),
        *(
            (MINIMAL, [f"profile.{key}={value}" for key, value in design.items()], words)
            for design, words in IMPOSSIBLE
        ),
    ],
)
def test_refusals_name_key_value_and_remedy(text, overrides, words):
    message = refused(lambda: check_geometry(parse(text, overrides)))
    assert [word for word in words if word not in message] == []


def test_replaced_values_take_following_defaults_along():
    """A smoothing length that follows the load follows the new load; one that is given stays."""
    key, plain = {"scene.load.torque_N_m": 1e-3}, parse(MINIMAL)
    light = parse(MINIMAL, ["scene.load.torque_N_m=1e-3"])
    assert light.contact.smoothing_mm != plain.contact.smoothing_mm
    assert plain.replaced(key) == light
    given = parse(MINIMAL, ["contact.smoothing_mm=3e-5"]).replaced(key)
    assert given.contact.smoothing_mm == 3e-5


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"scene.sped_rpm": 1.0}, "did you mean `scene.speed_rpm`"),
        ({"scen.speed_rpm": 1.0}, "did you mean `scene`"),
        ({"scene.speed_rpm.x": 1.0}, "`scene.speed_rpm` holds no keys"),
        ({"profile.family": "ciq"}, "'ciq'; did you mean cic"),
        ({"profile.lobes": 3.5}, "`profile.lobes` must be a whole number, but is 3.5"),
        ({"scene.timing_gear": {"stiffness_N_m_per_rad": -1.0}}, "timing_gear.stiffness"),
    ],
)
def test_values_are_checked_by_themselves(values, words):
    assert words in refused(parse(MINIMAL).check_values, values)


def test_values_that_only_clash_with_others_pass_by_themselves():
    for values in ({"profile.family": "ee"}, {"scene.load.torque_N_m": None}):
        parse(MINIMAL).check_values(values)
        assert refused(parse(MINIMAL).replaced, values)


def test_entries_of_a_list_are_replaced_by_number():
    config = load("free")
    changed = config.replaced({"profile.coefficients_3": 0.5}).profile.coefficients
    assert changed == (*config.profile.coefficients[:2], 0.5, *config.profile.coefficients[3:])
    message = refused(config.check_values, {"profile.coefficients_3": 9e9})
    assert "`profile.coefficients.2` must be at most 1" in message
    assert "coefficients_99" in refused(config.check_values, {"profile.coefficients_99": 0.5})


@pytest.mark.parametrize(("override", "orbit"), [([], 1e-5), (["solver.rtol=1e-9"], 1e-9)])
def test_tolerances_follow_from_accuracy(override, orbit):
    """Explicit tolerances override what follows from `solver.accuracy`."""
    found = parse(MINIMAL, ["solver.accuracy=1e-2", *override]).solver
    assert (found.orbit_tolerance, found.transient_tolerance) == pytest.approx((orbit, 1e-4))
