"""Tests of config files: which are accepted, which are rejected, and that each message names a
key."""

import itertools
import shlex
from pathlib import Path
from typing import Literal, get_args, get_origin

import pytest
import yaml

from rootsopt.config import Config, load, parse
from rootsopt.config.explain import describe
from rootsopt.config.families import families, family_of
from rootsopt.config.section import Section
from rootsopt.config.units import unit_of
from rootsopt.errors import InputError
from rootsopt.scene import check_geometry

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
SHIPPED = sorted((Path(__file__).parents[2] / "configs").glob("*.yaml"))


def with_line(old, new):
    """Return the minimal config with one piece of text replaced."""
    assert MINIMAL.count(old) == 1
    return MINIMAL.replace(old, new)


def refusal(text, *overrides):
    """Return the message with which a config is rejected; it must be one line."""
    with pytest.raises(InputError) as caught:
        parse(text, overrides)
    message = str(caught.value)
    assert message
    assert "\n" not in message
    return message


# What loads


def test_units_of_names():
    """The longest ending counts: an expansion per kelvin is no temperature."""
    known = {"rotor_warming_K": "K", "rotor_expansion_per_K": "1/K", "x_J_per_kg_K": "J/(kg·K)"}
    assert {name: unit_of(name) for name in known} == known


def test_minimal_config_loads_with_its_values_and_defaults():
    """Required keys are enough. Values are read as written, and absent parts stay absent."""
    config = parse(MINIMAL)
    assert config.profile.pressure_angle_deg == 36.43
    assert config.profile.lobes == 3
    assert config.scene.load.torque_N_m == 1.0
    assert config.scene.timing_gear is None
    assert config.contact.clearance_mm == 0.0
    assert config.solver.method == "tsit5"


def test_whole_numbers_serve_as_numbers():
    """A quantity may be written as `3000` or `3000.0`."""
    config = parse(with_line("speed_rpm: 3000.0", "speed_rpm: 3000"))
    assert config.scene.speed_rpm == 3000.0


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.name)
def test_shipped_configs_load_and_mesh(path):
    """Every config in configs/ is valid, and its profile can be made."""
    check_geometry(load(path))


def test_there_are_shipped_configs():
    """There are shipped configs for the test above."""
    assert any(path.name == "cic.yaml" for path in SHIPPED)


@pytest.mark.parametrize(
    ("written", "value"),
    [
        ("2.0e5", 2e5),
        ("1e5", 1e5),
        ("1.5E+5", 1.5e5),
        ("200000", 2e5),
        (".5e6", 5e5),
        ("+3e5", 3e5),
    ],
)
def test_scientific_notation_is_a_number(written, value):
    """YAML 1.1 reads `1e5` as text; a config accepts every usual spelling of a number."""
    config = parse(with_line("2.0e5", written))
    assert config.contact.stiffness_N_per_mm_e == value


def test_resolved_yaml_round_trips():
    """to_yaml() writes every default, and reading it again gives an equal config."""
    overrides = [
        "scene.timing_gear.stiffness_N_m_per_rad=1e4",
        "scene.timing_gear.backlash_mm=0.05",
        "solver.rtol=1e-9",
        "optimizer.bounds.involute_length_mm=[4, 9]",
    ]
    for config in (parse(MINIMAL), parse(MINIMAL, overrides), parse(EE_PROFILE)):
        text = config.to_yaml()
        assert parse(text) == config
        # A plain YAML reader must be able to read it too.
        assert Config.model_validate_json(config.model_dump_json()) == config
        assert yaml.safe_load(text)["solver"]["method"] == config.solver.method
    assert config.solver.orbit_tolerance == pytest.approx(1e-8)


def test_load_reads_a_file_and_applies_overrides(tmp_path):
    """load() is parse() of a file."""
    path = tmp_path / "scene.yaml"
    path.write_text(MINIMAL + "# Ø of a comment\n", encoding="utf-8")
    assert load(path) == parse(MINIMAL)
    assert load(str(path), ["scene.speed_rpm=1500"]).scene.speed_rpm == 1500.0


def test_every_key_is_described():
    """The help lists every key once."""
    lines = describe(Config).splitlines()
    names = [line.split()[0] for line in lines]
    assert len(names) == len(set(names))
    assert "scene.timing_gear.backlash_mm" in names
    assert "profile.pressure_angle_deg" in names
    assert all(len(line.split()) > 1 for line in lines if "bounds" not in line)


# Unknown, missing, misplaced


@pytest.mark.parametrize(
    ("old", "new", "wrong", "right"),
    [
        ("speed_rpm", "sped_rpm", "scene.sped_rpm", "scene.speed_rpm"),
        ("tip_arc_angle_deg", "tip_arc_angle", "profile.tip_arc_angle", "tip_arc_angle_deg"),
        ("    torque_N_m", "    torque_Nm", "scene.load.torque_Nm", "scene.load.torque_N_m"),
        ("rotor:", "rotors:", "rotors", "rotor"),
    ],
)
def test_unknown_key_is_named_with_its_nearest_match(old, new, wrong, right):
    """A misspelt key is rejected under its full name, with the key that was probably meant."""
    message = refusal(with_line(old, new))
    assert f"`{wrong}`" in message
    assert "did you mean" in message
    assert right in message.split("did you mean")[1]


@pytest.mark.parametrize(
    ("override", "answer"),
    [
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
    ],
)
def test_keys_of_catalogues_are_answered_with_the_right_key_and_value(override, answer):
    message = refusal(MINIMAL, override)
    assert message.startswith(f"config: `{override.split('=')[0]}` is not a known key; ")
    assert f"did you mean {answer}" in message


def test_unknown_key_without_a_match_lists_the_valid_ones():
    """If no key is similar, the message lists the valid keys of the section."""
    message = refusal(MINIMAL, "rotor.zzz=1")
    assert "`rotor.zzz`" in message
    assert "length_mm" in message
    assert "density_kg_m3" in message


def test_key_in_the_wrong_section_is_sent_to_the_right_one():
    """For a key in the wrong section, the message names the right section."""
    message = refusal(MINIMAL, "rotor.speed_rpm=1000")
    assert "`rotor.speed_rpm`" in message
    assert "`scene.speed_rpm`" in message


@pytest.mark.parametrize(
    ("line", "key"),
    [
        ("  speed_rpm: 3000.0\n", "scene.speed_rpm"),
        ("    torque_N_m: 1.0\n", "scene.load"),
        ("  length_mm: 100.0\n", "rotor.length_mm"),
        ("  exponent: 2.2\n", "contact.exponent"),
        ("  lobes: 3\n", "profile.lobes"),
        ("  family: cic\n", "profile.family"),
        ("  tip_arc_angle_deg: 4.0\n", "profile.tip_arc_angle_deg"),
    ],
)
def test_missing_key_is_named(line, key):
    """The message for a missing key contains its full name."""
    assert f"`{key}" in refusal(with_line(line, ""))


@pytest.mark.parametrize("section", ["profile", "rotor", "contact", "scene"])
def test_missing_section_is_named(section):
    """The message for a missing section names it."""
    data = yaml.safe_load(MINIMAL)
    del data[section]
    message = refusal(yaml.safe_dump(data))
    assert f"`{section}`" in message
    assert "missing" in message


@pytest.mark.parametrize("key", ["pressure_angle_deg", "involute_length_mm", "tip_arc_angle_deg"])
def test_keys_must_belong_to_the_family(key):
    """The family `cic` needs its three keys; `ee` rejects them."""
    line = next(line for line in MINIMAL.splitlines(keepends=True) if key in line)
    message = refusal(with_line(line, ""))
    assert f"`profile.{key}`" in message
    assert "cic" in message
    message = refusal(EE_PROFILE, f"profile.{key}=5.0")
    assert f"`profile.{key}`" in message
    assert "ee" in message


PAIRS = [
    pair for pair in itertools.permutations(families(), 2) if family_of(pair[0]).maker is not None
]


@pytest.mark.parametrize(("old", "new"), PAIRS)
def test_change_of_family_is_answered_by_the_overrides_that_it_needs(old, new):
    """The message lists them all, in words that a shell takes."""
    data = yaml.safe_load(MINIMAL)
    example = {k: [*v] if isinstance(v, tuple) else v for k, v in family_of(old).example.items()}
    data["profile"] = {"family": old, "lobes": 3, "pitch_radius_mm": 33.0, **example}
    text, change = yaml.safe_dump(data), f"profile.family={new}"
    if {*family_of(old).keys} == {*family_of(new).keys} and family_of(new).maker is not None:
        return
    message = refusal(text, change)
    assert len(message) < 400
    words = shlex.split(message[message.index("--set") :])
    overrides = [word.replace("FILE", "rotor.csv") for word in words if word != "--set"]
    foreign = {*family_of(old).keys} - {*family_of(new).keys}
    assert {f"profile.{key}=null" for key in foreign} <= {*overrides}
    config = parse(text, [change, *overrides])
    assert config.profile.family == new
    assert config.profile.parameters.keys() == {*family_of(new).keys}


def test_overrides_of_a_family_suit_the_size_of_the_rotor():
    """`arc` instead of CIC needs three keys less, and one more of the rotor's own size."""
    less = [f"--set profile.{key}=null" for key in family_of("cic").keys]
    message = refusal(MINIMAL, "profile.family=arc", "profile.arc_center_mm=29.7")
    assert message.endswith(f"for this family, add {' '.join(less)}")
    sized = refusal(MINIMAL, "profile.family=arc", "profile.pitch_radius_mm=66")
    assert sized.endswith(f"{' '.join(less)} --set profile.arc_center_mm=59.4")


# Wrong values


@pytest.mark.parametrize("value", ["fast", "'3000'", "true", "[1, 2]", "{a: 1}", "null", "~", ""])
def test_what_is_no_number_is_refused(value):
    """Text, booleans, lists, sections and an empty value are not a speed."""
    message = refusal(with_line("speed_rpm: 3000.0", f"speed_rpm: {value}"))
    assert "`scene.speed_rpm` must be a number" in message
    assert repr(yaml.safe_load(value)) in message


@pytest.mark.parametrize("value", ["2.5", "three", "true", "null", "[3]"])
def test_number_of_lobes_is_a_whole_number(value):
    """A fraction, a text or a boolean is rejected as number of lobes."""
    message = refusal(with_line("lobes: 3", f"lobes: {value}"))
    assert "`profile.lobes` must be a whole number" in message
    assert repr(yaml.safe_load(value)) in message


@pytest.mark.parametrize(
    ("override", "limit"),
    [
        ("profile.lobes=1", "at least 2"),
        ("profile.lobes=7", "at most 6"),
        ("profile.pitch_radius_mm=0", "greater than 0"),
        ("profile.pitch_radius_mm=-33", "greater than 0"),
        ("profile.pressure_angle_deg=90", "less than 90"),
        ("profile.pressure_angle_deg=0", "greater than 0"),
        ("profile.tip_arc_angle_deg=-1", "at least 0"),
        ("rotor.density_kg_m3=0", "greater than 0"),
        ("contact.exponent=0.5", "at least 1"),
        ("contact.clearance_mm=-0.1", "at least 0"),
        ("contact.smoothing_mm=-1e-4", "at least 0"),
        ("scene.speed_rpm=0", "greater than 0"),
        ("scene.load.torque_N_m=-1", "at least 0"),
        ("solver.rtol=1", "at most 0.01"),
        ("solver.rtol=1e-13", "at least 1e-12"),
        ("optimizer.iterations=0", "at least 1"),
        ("optimizer.seed=-1", "at least 0"),
        ("constraints.undercut_margin_min_mm=-1", "at least 0"),
    ],
)
def test_value_out_of_range_is_refused_with_the_range(override, limit):
    """The message contains key, limit and value."""
    key, value = override.split("=")
    message = refusal(MINIMAL, override)
    assert f"`{key}` must be {limit}" in message
    number = message.split("but is ")[1]
    assert float(number) == float(value)


@pytest.mark.parametrize("value", [".nan", ".inf", "-.inf"])
@pytest.mark.parametrize(
    "key",
    [
        "profile.pitch_radius_mm",
        "profile.pressure_angle_deg",
        "profile.tip_arc_angle_deg",
        "contact.exponent",
        "contact.smoothing_mm",
        "scene.speed_rpm",
        "scene.load.torque_N_m",
        "solver.rtol",
        "constraints.area_efficiency_min",
    ],
)
def test_nan_and_infinity_are_refused(key, value):
    """No quantity may be NaN or infinite."""
    message = refusal(MINIMAL, f"{key}={value}")
    assert f"`{key}`" in message
    assert value.strip("-.") in message


@pytest.mark.parametrize(
    ("key", "choices"),
    [
        ("profile.family", ("cic", "ee")),
        ("solver.method", ("tsit5", "dopri8")),
        ("scene.drive", ("prescribed",)),
        ("optimizer.method", ("adam",)),
    ],
)
def test_word_outside_the_choice_is_refused_with_the_choices(key, choices):
    """The message for a wrong word lists the valid words."""
    message = refusal(MINIMAL, f"{key}=nonsense")
    assert f"`{key}`" in message
    assert "'nonsense'" in message
    assert all(choice in message for choice in choices)


@pytest.mark.parametrize("value", ["1", "text", "[1]", "true"])
def test_section_must_be_a_section(value):
    """A plain value is rejected where a section belongs."""
    message = refusal(MINIMAL, f"scene.timing_gear={value}")
    assert "`scene.timing_gear`" in message
    assert "section" in message


def test_objective_needs_a_weight():
    """An objective whose weights are all zero is rejected."""
    message = refusal(MINIMAL, "objective.mean_weight=0", "objective.peak_weight=0")
    assert "objective.mean_weight" in message
    assert "objective.peak_weight" in message


@pytest.mark.parametrize(
    "value", ["[9, 4]", "[4, 4]", "[1]", "[1, 2, 3]", "[a, b]", "5", "[1, .nan]"]
)
def test_bounds_are_two_increasing_numbers(value):
    """Bounds of the search must be (low, high)."""
    message = refusal(MINIMAL, f"optimizer.bounds.involute_length_mm={value}")
    assert "optimizer.bounds.involute_length_mm" in message


def test_equal_bounds_are_refused_with_a_narrow_range():
    """A parameter is held by a narrow range, which the message suggests."""
    message = refusal(MINIMAL, "optimizer.bounds.tip_arc_angle_deg=[4, 4]")
    assert "to hold it, give a narrow range, such as [4, 4.004]" in message


# Ranges, units, choices


def leaves():
    """Return dotted key and field of every key that has no keys below it."""
    kinds: list[tuple[str, type[Section]]] = [("", Config)]
    while kinds:
        prefix, model = kinds.pop()
        for name, field in model.model_fields.items():
            inner = [
                part
                for part in (field.annotation, *getattr(field.annotation, "__args__", ()))
                if isinstance(part, type) and issubclass(part, Section)
            ]
            if inner:
                kinds.append((f"{prefix}{name}.", inner[0]))
            else:
                yield f"{prefix}{name}", field


def numeric(annotation):
    """Return whether an annotation stands for numbers."""
    if get_origin(annotation) is Literal:
        return False
    return annotation in (float, int) or any(numeric(part) for part in get_args(annotation))


NUMERIC = [key for key, field in leaves() if numeric(field.annotation) and "bounds" not in key]
PUMP = next(path for path in SHIPPED if path.name == "pump.yaml").read_text(encoding="utf-8")
"""Text of a config with every part of a scene."""


@pytest.mark.parametrize("key", NUMERIC)
def test_every_number_has_two_ends(key):
    """Every number has a lower and an upper limit, and the help lists both."""
    parts = "timing_gear", "motor", "supports", "load", "friction"
    text = PUMP if any(part in key for part in parts) else MINIMAL
    if key.startswith("tolerances."):
        text += "\ntolerances: {over: {rotor.length_mm: {normal: 0.01}}}\n"
    if key.startswith("pump."):
        own = "viscosity_mPa_s: 1.0, pressure_difference_Pa: 1.0e5, gas: {inlet_pressure_Pa: 1.0e5}"
        text += f"\npump: {{{own}}}\n"
    for number in ("1.0e300", "-1.0e300", 10**390, ".inf", ".nan"):
        assert f"`{key}" in refusal(text, f"{key}={number}")
    for value in ("[1.0e300, 2.0e300]", "{1: 1.0e300, from: 1.0e300}"):
        assert f"`{key}" in refusal(text, f"{key}={value}")
    line = next(line for line in describe(Config).splitlines() if line.split()[0] == key)
    assert "from" in line or "above" in line
    assert " to " in line or "below" in line


def test_help_has_unit_default_range_and_choices():
    """The help has one line for each key."""
    lines = {line.split()[0]: line for line in describe(Config).splitlines()}
    assert lines["profile.pitch_radius_mm"].endswith("[mm, from 1 to 5000, required]")
    assert lines["scene.timing_gear.damping_ratio"].endswith("[from 0 to 100, default 0.0]")
    assert lines["scene.drive"].endswith("[prescribed | torque, default prescribed]")
    assert lines["profile.tip_arc_angle_deg"].endswith("[°, from 0 below 45]")
    assert "N·m/rad" in lines["scene.timing_gear.stiffness_N_m_per_rad"]
    assert "default: 25 to 45; from 1 to 80" in lines["profile.pressure_angle_deg"]


@pytest.mark.parametrize(
    ("text", "override", "words"),
    [
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
    ],
)  # fmt: skip
def test_number_in_another_unit_is_recognised(text, override, words):
    """If a value out of range would fit in a usual other unit, the message asks about this unit."""
    with pytest.raises(InputError) as caught:
        check_geometry(parse(text, [override]))
    message = str(caught.value)
    assert words in message
    assert f"`{override.partition('=')[0]}" in message


@pytest.mark.parametrize("value", ["0", "-33", "1e-300", "1e300", "0.0005"])
def test_hint_is_given_only_where_it_fits(value):
    """If a value fits in no unit, the message states only the range."""
    assert "is that" not in refusal(MINIMAL, f"profile.pitch_radius_mm={value}")


CHOICES = [
    ("solver.method", "dopri8", ("Dopri8", "DOPRI-8", "dopri 8")),
    ("optimizer.method", "rmsprop", ("RMSprop", "RMS prop", "rms-prop")),
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


@pytest.mark.parametrize(
    ("spelling", "family"),
    [
        *(("CIC", "cic"), ("Cic", "cic"), ("EE", "ee"), ("Five arcs", "five_arcs")),
        *(("Hypo-Epicycloid", "hypo_epicycloid"), ("extended cycloid", "extended_cycloid")),
    ],
)
def test_family_is_taken_in_any_spelling(spelling, family):
    """Any spelling is accepted in the file and with --set, before the family's keys are checked."""
    keys = {
        "cic": "pressure_angle_deg: 36, involute_length_mm: 8, tip_arc_angle_deg: 4",
        "hypo_epicycloid": "tip_arc_angle_deg: 4",
        "extended_cycloid": "trochoid_ratio: 1.3",
        "five_arcs": "outer_radius_mm: 45, tip_arc_angle_deg: 3, tip_arc_radius_mm: 13, "
        "tip_arc_turn_deg: 60",
    }
    body = f"lobes: 3, pitch_radius_mm: 33, {keys.get(family, '')}"
    text = EE_PROFILE.partition("\n")[2]
    config = parse(f"profile: {{family: {spelling}, {body}}}\n{text}")
    assert config.profile.family == family
    assert parse(text, [f"profile={{family: {spelling}, {body}}}"]) == config
    assert f"family: {family}\n" in config.to_yaml()


def test_keys_that_are_choices_are_taken_in_any_case():
    """So are the keys `from`, `to` and `points` of a sweep, but no key may be given twice."""
    given = parse(MINIMAL, ["sweep.speed_rpm={From: 300, TO: 6000, Points: 39}"])
    assert given == parse(MINIMAL, ["sweep.speed_rpm={from: 300, to: 6000, points: 39}"])
    message = refusal(MINIMAL, "sweep.speed_rpm={from: 300, From: 400, to: 6000, points: 39}")
    assert "From" in message


@pytest.mark.parametrize(
    ("override", "word"),
    [
        ("profile.family=cid", "cic"),
        ("solver.method=tsitt5", "tsit5"),
        ("scene.drive=Torqe", "torque"),
    ],
)
def test_near_miss_of_a_choice_names_what_was_meant(override, word):
    """The message for a misspelt word suggests a valid one, as for keys."""
    assert f"did you mean {word}?" in refusal(MINIMAL, override)


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("constraints.area_efficiency_min=2", "less than 1"),
        ("constraints.area_efficiency_min=much", "one of 'baseline' or a number"),
        ("optimizer.bounds.involute_length_mm=[1]", "two numbers"),
        ("optimizer.bounds.involute_length_mm=[1, 2, 3]", "two numbers"),
        ("objective.line_weights={1: 2e6}", "at most 1e+06"),
        ("objective.line_weights={0: 1}", "greater than 0"),
        ("objective.line_weights={1: 1, '1': 2}", "line_weights"),
        ("objective.line_weights={" + ", ".join(f"{k}: 1" for k in range(1, 40)) + "}", "most 32"),
        ("response.lines=[" + ", ".join(f"{k}" for k in range(1, 40)) + "]", "at most 32"),
        ("attractors.relative_range_mrad=[-.inf, .inf]", "finite"),
        ("attractors.rate_range_rad_s=[-1, 1e9]", "at most 1e+06"),
        ("optimizer.seed=99999999999", "at most"),
        ("objective={mean_weight: 1e-300, peak_weight: 0}", "must not all be 0"),
        ("scene.speed_rpm=" + "9" * 399, "ordinary size"),
        ("profile.outline_file='a\tb\u0007'", "outline_file"),
        ("profile={family: outline, lobes: 3, pitch_radius_mm: 33, outline_file: \"a\\0b\"}",
         "printed"),
        ("float=1", "`float` is not a known key"),
        ("profile.int=1", "`profile.int` is not a known key"),
        ("'a[b'=1", "is not a known key"),
        ("optimizer.bounds.arc_center_mm=[0.02, 0.03]", "metres? write 30"),
    ],
    ids=lambda text: text[:30],
)  # fmt: skip
def test_odd_values_have_their_words(override, words):
    """Messages of pydantic about lists, unions and dictionaries are expressed in the words of a
    config."""
    text = MINIMAL
    if "arc_center" in override:
        arc = "profile: {family: arc, lobes: 3, pitch_radius_mm: 33, arc_center_mm: 29.7}\n"
        text = arc + EE_PROFILE.partition("\n")[2]
    message = refusal(text, override)
    assert words in message
    assert len(message) <= 500


# Files and YAML


def test_file_that_cannot_be_read_is_refused(tmp_path):
    """The message names the path if it is missing, a folder, or not UTF-8 text."""
    binary = tmp_path / "binary.yaml"
    binary.write_bytes(MINIMAL.encode() + b"# \xff\xfe\n")
    for path, words in (
        (tmp_path / "absent.yaml", "no such file"),
        (tmp_path, "folder"),
        (binary, "UTF-8"),
    ):
        with pytest.raises(InputError) as caught:
            load(path)
        assert str(path) in str(caught.value)
        assert words in str(caught.value)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("text", ["", "\n# only a comment\n", "---\n", "{}"])
def test_empty_config_names_what_is_missing(text):
    """The message for an empty file names the first required section."""
    assert "`profile` is missing" in refusal(text)


@pytest.mark.parametrize("text", ["- profile\n- scene\n", "just words", "42", "true"])
def test_config_must_be_sections(text):
    """A list or a plain value at top level is rejected."""
    assert "sections" in refusal(text)


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
    """The message for a syntax error names its line."""
    message = refusal(text)
    assert "not valid YAML" in message
    assert f"line {line}" in message or f"line {line + 1}" in message


@pytest.mark.parametrize(
    ("text", "key"),
    [
        (MINIMAL + "rotor: {length_mm: 1.0, density_kg_m3: 1.0}\n", "rotor"),
        (MINIMAL.replace("  lobes: 3\n", "  lobes: 3\n  lobes: 4\n"), "lobes"),
    ],
)
def test_key_given_twice_is_refused(text, key):
    """A key given twice is rejected; the last one does not replace the first."""
    message = refusal(text)
    assert f"'{key}'" in message
    assert "twice" in message


# Keys and values of former versions

FORMER = {
    "fidelity": ("search", "map"),
    "nodes": ("400", "100"),
    "map_error": ("1e-4", "1e-3"),
    "map_rolls": ("null", "96"),
    "map_relatives": ("null", "16"),
    "gradient": ("forward", "reverse"),
    "orbit": ("Collocation", "shooting"),
    "precision": ("Float64", "float32"),
}


def test_removed_keys_are_accepted_only_where_they_change_nothing():
    """A resolved config of a former version loads. Any other value gets a sentence on its own."""
    given = [f"solver.{key}={default}" for key, (default, _) in FORMER.items()]
    config = parse(MINIMAL, given)
    assert config == parse(MINIMAL)
    assert not FORMER.keys() & config.model_dump()["solver"].keys()
    for key, (_, other) in FORMER.items():
        message = refusal(MINIMAL, f"solver.{key}={other}")
        assert f"`solver.{key}` must be left out, but is" in message
        assert "remove it, and set `solver.accuracy`" in message
    for key, (_, other) in FORMER.items():
        with pytest.raises(InputError, match=f"`solver.{key}` must be left out"):
            config.replaced({f"solver.{key}": other})
    for method in ("dopri5", "kvaerno3", "Kvaerno-5"):
        assert "was removed" in refusal(MINIMAL, f"solver.method={method}")


# Overrides


def test_overrides_replace_and_create_nested_keys():
    """`--set` reaches any key and creates missing sections. The last override has precedence."""
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
    assert config.scene.timing_gear is not None
    assert config.scene.timing_gear.stiffness_N_m_per_rad == 2e4
    assert config.scene.speed_rpm == 1500.0
    assert config.constraints.area_efficiency_min == 0.4
    assert config.solver.method == "dopri8"


def test_override_can_take_a_part_away():
    """`=null` removes an optional part."""
    text = MINIMAL + "  timing_gear: {stiffness_N_m_per_rad: 1.0e4, backlash_mm: 0.1}\n"
    assert parse(text).scene.timing_gear is not None
    assert parse(text, ["scene.timing_gear=null"]).scene.timing_gear is None


@pytest.mark.parametrize("override", ["scene.speed_rpm", "=5", "scene..speed_rpm=5", ".=5", ""])
def test_override_of_wrong_form_is_refused(override):
    """The message asks for the form dotted.key=value and shows what was given."""
    message = refusal(MINIMAL, override)
    assert "--set" in message
    assert repr(override) in message
    assert "dotted.key=value" in message


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("scene.speed_rpm.deep=5", "scene.speed_rpm"),
        ("scene.speed_rpm=[1", "not valid YAML"),
        ("scene.speed_rpm=quick", "`scene.speed_rpm` must be a number, but is 'quick'"),
        ("scene.sped_rpm=1000", "`scene.speed_rpm`"),
        ("nothing.at.all=1", "`nothing`"),
    ],
)
def test_override_with_a_bad_key_or_value_is_refused(override, words):
    """An override is checked in the same way as the file."""
    assert words in refusal(MINIMAL, override)


# Geometry


def geometry_refusal(*overrides):
    with pytest.raises(InputError) as caught:
        check_geometry(parse(MINIMAL, overrides))
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_sound_geometry_is_accepted():
    """The minimal design, the paper's (1.2 % past u_max) and any EE are accepted."""
    check_geometry(parse(MINIMAL))
    check_geometry(parse(MINIMAL, ["profile.involute_length_mm=9.0"]))
    for lobes in (2, 6):
        check_geometry(parse(EE_PROFILE, [f"profile.lobes={lobes}"]))


def test_involute_past_its_longest_is_refused():
    """For u > u_max, the message contains key, value and the longest length (8.893 mm here)."""
    message = geometry_refusal("profile.involute_length_mm=9.2")
    assert "`profile.involute_length_mm`" in message
    assert "8.893" in message
    assert "9.2" in message


def test_tip_arc_without_radius_is_refused():
    """Near 90°, an involute only 1.8 % longer than the longest leaves no tip arc."""
    message = geometry_refusal(
        "profile.pressure_angle_deg=89.78",
        "profile.tip_arc_angle_deg=0.475",
        "profile.involute_length_mm=17.3",
    )
    assert "`profile.involute_length_mm` must be less than 17" in message
    assert "no radius" in message


def test_undercut_is_refused():
    """For α below the canonical 27.64° and nearly the longest involute, the root is undercut."""
    message = geometry_refusal(
        "profile.pressure_angle_deg=25",
        "profile.tip_arc_angle_deg=0",
        "profile.involute_length_mm=7.2",
    )
    assert "`profile.involute_length_mm`" in message
    assert "undercut" in message
    assert "7.2" in message
    assert "25" in message


@pytest.mark.parametrize(("lobes", "limit"), [(3, 30), (6, 15)])
def test_tip_wider_than_its_lobe_is_refused(lobes, limit):
    """θ1 must be less than π/2N."""
    message = geometry_refusal(f"profile.lobes={lobes}", f"profile.tip_arc_angle_deg={limit}")
    assert "`profile.tip_arc_angle_deg`" in message
    assert f"less than {limit}" in message
    assert f"but is {limit}" in message


def test_replaced_values_take_following_defaults_along():
    """A smoothing length that follows the load follows the new load; one that is given stays."""
    key = {"scene.load.torque_N_m": 1e-3}
    light = parse(MINIMAL, ["scene.load.torque_N_m=1e-3"])
    assert light.contact.smoothing_mm != parse(MINIMAL).contact.smoothing_mm
    assert parse(MINIMAL).replaced(key) == light
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
    with pytest.raises(InputError, match=words):
        parse(MINIMAL).check_values(values)


def test_values_that_only_clash_with_others_pass_by_themselves():
    for values in ({"profile.family": "ee"}, {"scene.load.torque_N_m": None}):
        parse(MINIMAL).check_values(values)
        with pytest.raises(InputError):
            parse(MINIMAL).replaced(values)


def test_entries_of_a_list_are_replaced_by_number():
    config = load("free")
    changed = config.replaced({"profile.coefficients_3": 0.5}).profile.coefficients
    assert changed == (*config.profile.coefficients[:2], 0.5, *config.profile.coefficients[3:])
    with pytest.raises(InputError, match=r"`profile\.coefficients\.2` must be at most 1"):
        config.check_values({"profile.coefficients_3": 9e9})
    with pytest.raises(InputError, match="coefficients_99"):
        config.check_values({"profile.coefficients_99": 0.5})


def test_tolerances_follow_from_accuracy():
    """Explicit tolerances override what follows from `solver.accuracy`."""
    coarse = parse(MINIMAL, ["solver.accuracy=1e-2"]).solver
    assert coarse.orbit_tolerance == pytest.approx(1e-5)
    assert coarse.transient_tolerance == pytest.approx(1e-4)
    given = parse(MINIMAL, ["solver.accuracy=1e-2", "solver.rtol=1e-9"]).solver
    assert (given.orbit_tolerance, given.transient_tolerance) == (1e-9, pytest.approx(1e-4))
    with pytest.raises(InputError, match=r"solver\.accuracy"):
        parse(MINIMAL, ["solver.accuracy=1e-10"])
