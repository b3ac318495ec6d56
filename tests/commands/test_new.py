"""`rootsopt new`: a config from a catalogue sheet."""

import io
import math
import re
import shlex

import numpy as np
import pytest

from experiments._common.polygons import pair_gap
from rootsopt.commands.console import main
from rootsopt.config import load, notes, parse
from rootsopt.config.sheet import MATERIALS, MEDIA, gear_backlash, gear_stiffness, line_stiffness
from rootsopt.scene import outline_mm

BOOSTER = {
    "centre-distance-mm": 125,
    "outer-diameter-mm": 200,
    "length-mm": 300,
    "lobes": 2,
    "speed-rpm": 3000,
    "power-kW": 10,
}


def made(path, *options, **changes):
    """Return the exit code of `rootsopt new` for the booster's sheet with `changes`."""
    values = BOOSTER | {name.replace("_", "-"): value for name, value in changes.items()}
    given = [f"--{name}={value}" for name, value in values.items() if value is not None]
    return main(["new", str(path), *given, *options])


def head_of(path):
    return path.read_text().split("# A comment")[0].replace("\n#", "")


@pytest.mark.parametrize(
    ("lobes", "across", "outer", "family"),
    [
        (2, 125.0, 200.0, None),
        (3, 20.0, 29.0, "five_arcs"),
        pytest.param(5, 300.0, 353.0, "hypo_epicycloid", marks=pytest.mark.long),
        pytest.param(6, 1000.0, 1180.0, "arc", marks=pytest.mark.long),
    ],
)
def test_rotors_have_the_diameter_and_mesh_at_the_centre_distance(
    tmp_path, lobes, across, outer, family
):
    """Seen on polygons: the outer radius to 1e-6 mm, and no overlap beyond that of the polygons."""
    path = tmp_path / "pump.yaml"
    sheet = {
        "centre_distance_mm": across, "outer_diameter_mm": outer, "length_mm": across,
        "power_kW": None, "pressure_difference_bar": 0.3, "speed_rpm": 3e5 / across,
    }  # fmt: skip
    assert made(path, lobes=lobes, family=family, **sheet) == 0
    config = load(path)
    line = outline_mm(config)
    assert config.profile.family == (family or "cic")
    assert np.max(np.hypot(*line.T)) == pytest.approx(outer / 2, abs=1e-6)
    gaps = [pair_gap(line, lobes, across, x, x) for x in np.linspace(0.0, math.pi / lobes, 7)]
    assert np.max(np.abs(gaps)) < 2e-5 * across
    assert notes(config) == ()


def test_load_and_comments_are_those_of_the_sheet(tmp_path, capsys):
    """Power and pressure agree with the polygon's displacement; each key has a comment."""
    path = tmp_path / "pump.yaml"
    assert made(path) == 0
    power = load(path)
    assert power.scene.load.torque_N_m * 2 * 2 * math.pi * 50 == pytest.approx(1e4, rel=1e-3)
    x, y = outline_mm(power).T
    area = np.sum(x[:-1] * np.diff(y) - y[:-1] * np.diff(x)) / 2
    volume = 2 * (math.pi * 100**2 - area) * 300 * 1e-9
    assert power.pump.pressure_difference_Pa == pytest.approx(1e4 / (volume * 50), rel=1e-3)
    assert f"{volume * 1e3:.3f}"[:4] in capsys.readouterr().out
    text = path.read_text()
    lines = [line for line in text.splitlines() if not line.startswith("#") and line]
    assert all(" # " in line for line in lines if not line.endswith(":"))
    assert parse(text) == power == parse(power.to_yaml())

    more = {"pressure_difference_bar": 0.3, "medium": "water", "material": "Stainless Steel"}
    assert made(path, **more) == 2
    assert "exists; give `--overwrite`" in capsys.readouterr().err
    assert made(path, "--overwrite", **more, clearance_mm=0.05) == 0
    gas = load(path)
    ideal = 0.3e5 * volume * 50 / 1e3
    words = f"takes {ideal:.3g} kW without losses, {ideal / 10:.0%} of the 10 kW"
    assert words in capsys.readouterr().out
    assert gas.scene.load.pressure_difference_Pa == 3e4
    assert (gas.pump.gas, gas.pump.viscosity_mPa_s) == (None, 1.0)
    assert gas.rotor.density_kg_m3 == 7900
    assert gas.objective.terms == {"leakage_fraction": 1}
    assert gas.contact.clearance_mm == gas.scene.timing_gear.backlash_mm == 0.05
    # The command in the first comment makes the same sheet.
    assert re.search("rootsopt new .*--medium water --material stainless-steel", head_of(path))


def test_stock_agrees_with_the_formulas_of_its_sources():
    """Steel rollers (Palmgren), a gear's compliance, a tabled backlash of ISO/TR 10064-2."""
    _, modulus, poisson, *_ = MATERIALS["steel"]
    for force, length in ((10.0, 50.0), (1e4, 800.0)):
        depth = (force / line_stiffness(modulus, poisson, length)) ** 0.9
        # Palmgren's 3.84e-5 is that of 206 GPa.
        assert depth == pytest.approx(3.84e-5 * (206 / 210 * force) ** 0.9 / length**0.8, rel=0.01)
    torque, radius, face = 100.0, 0.1, 60.0
    slide = torque / (radius * math.cos(math.radians(20))) / (20.0 * face)  # µm
    turn = slide * 1e-6 / (radius * math.cos(math.radians(20)))
    assert torque / turn == pytest.approx(gear_stiffness(200.0), rel=1e-12)
    # The approach of two cylinders by Hertz depends a little on their radius.
    for _, modulus, poisson, *_ in MATERIALS.values():
        length, radius, compliance = 300.0, 30.0, 2 * (1 - poisson**2) / (math.pi * modulus * 1e3)
        for each in (10.0, 100.0):
            half = math.sqrt(2 * each * radius * compliance)
            depth = each * compliance * (2 * math.log(4 * radius / half) - 1)
            found = (each * length / line_stiffness(modulus, poisson, length)) ** 0.9
            assert 1.0 < found / depth < 1.4
    assert gear_backlash(100.0) * math.cos(math.radians(20)) == pytest.approx(0.113, abs=1e-3)


GASES = {
    # Molar mass (g/mol), collision diameter (Å) and energy over k (K) by Hirschfelder et al. 1954.
    "air": (28.965, 3.711, 78.6),
    "nitrogen": (28.013, 3.798, 71.4),
    "oxygen": (31.998, 3.467, 106.7),
    "argon": (39.948, 3.542, 93.3),
    "helium": (4.0026, 2.551, 10.22),
    "hydrogen": (2.01588, 2.827, 59.7),
    "carbon-dioxide": (44.0095, 3.941, 195.2),
    "methane": (16.0425, 3.758, 148.6),
}


def test_gases_agree_with_kinetic_theory():
    """Viscosity by Chapman and Enskog, with the collision integral of Neufeld et al. 1972."""

    def viscosity(mass, size, energy, kelvin):
        t = kelvin / energy
        integral = 1.16145 * t**-0.14874 + 0.52487 * math.exp(-0.7732 * t)
        integral += 2.16178 * math.exp(-2.43787 * t)
        return 2.6693e-3 * math.sqrt(mass * kelvin) / (size**2 * integral)

    assert {*GASES} == {name for name, row in MEDIA.items() if row[1] is not None}
    for name, (mass, *collision) in GASES.items():
        found, constant, *_ = MEDIA[name]
        cold, usual, hot = (viscosity(mass, *collision, x + 273.15) for x in (-10, 20, 150))
        assert found == pytest.approx(usual, rel=0.02)
        assert constant * mass == pytest.approx(8314.46, rel=1e-4)
        assert 0.9 < cold / usual < hot / usual < 1.4


def test_any_key_can_be_set(tmp_path, capsys):
    """A plain value, and one in a section that the sheet has not."""
    path = tmp_path / "pump.yaml"
    more = ["--set", "pump.viscosity_mPa_s=500", "--set", "objective.terms={flow_ripple: 2}"]
    assert made(path, *more, "--clearance-mm=0") == 0
    assert "may be chaotic" in capsys.readouterr().err
    config = load(path)
    assert (config.pump.viscosity_mPa_s, config.objective.terms) == (500, {"flow_ripple": 2})
    assert path.read_text().count("# --set\n") == 2
    assert shlex.join(more) in head_of(path)
    assert made(tmp_path / "other.yaml", "--set", "pump.viscosity_mPas=500") == 2
    assert "did you mean `pump.viscosity_mPa_s`?" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"outer_diameter_mm": None}, "`--outer-diameter-mm` must be given"),
        ({"power_kW": None}, "`--power-kW` or `--pressure-difference-bar` must be given"),
        ({"lobes": 7}, "`--lobes` must be at most 6, but is 7"),
        ({"length_mm": "long"}, "`--length-mm` must be a number, but is 'long'"),
        ({"medium": "ari"}, "but is 'ari'; did you mean air?"),
        ({"family": "cci"}, "did you mean cic?"),
        ({"family": "ee"}, "`--outer-diameter-mm` must be 187.5 in family ee at 2 lobes"),
        ({"family": "outline"}, "`--family` must be one of 'cic', 'ee'"),
        # 125 (1 + sin 30°), the limit of three lobes.
        ({"lobes": 3}, "`--outer-diameter-mm` must be below 187.5 at 3 lobes and 125 mm"),
    ],
)
def test_refusals_are_one_sentence_that_names_the_option(tmp_path, capsys, changes, words):
    assert made(tmp_path / "pump.yaml", **changes) == 2
    (told,) = capsys.readouterr().err.splitlines()
    assert re.match(f"rootsopt new: .*{re.escape(words)}", told)
    assert not [*tmp_path.iterdir()]


def test_the_stated_range_can_be_met(tmp_path, capsys):
    """Both ends of the range in a refusal are diameters that the family has; beyond, none is."""
    family = {"family": "hypo_epicycloid"}
    assert made(tmp_path / "pump.yaml", outer_diameter_mm=201, **family) == 2
    assert not [*tmp_path.iterdir()]
    words = r"`--outer-diameter-mm` must be from (.*) to (.*) \(by"
    low, high = map(float, re.search(words, capsys.readouterr().err).groups())
    # EE, without a land, is the widest of this family; the land is at least 0.5 °, with room.
    assert 0.98 * 187.5 < high < 187.5
    for diameter in (low + 0.2, high - 0.2):
        assert made(tmp_path / f"{diameter}.yaml", outer_diameter_mm=diameter, **family) == 0


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_a_terminal_is_asked_for_what_is_missing(tmp_path, capsys, monkeypatch):
    """An empty line takes the default; a value that is not allowed is asked for again."""
    path = tmp_path / "pump.yaml"
    answers = ["200", "300", "two", "2", "3000", "", "0.3", "", "", "argon", ""]
    monkeypatch.setattr("sys.stdin", Terminal("\n".join(answers) + "\n"))
    assert main(["new", str(path), "--centre-distance-mm", "125", "--family", "cic"]) == 0
    told = capsys.readouterr().err
    asked = (
        "length of a rotor in mm: lobes of a rotor: ",
        "gap of flanks in mm [outer diameter / 1000]: ",
        "`--lobes` must be a whole number, but is 'two'",
        "what is pumped (air | nitrogen",
    )
    assert [words for words in asked if words not in told] == []
    config = load(path)
    assert config.scene.load.pressure_difference_Pa == 3e4
    assert config.pump.gas.heat_ratio == 1.667
    monkeypatch.setattr("sys.stdin", Terminal(""))
    assert main(["new", str(tmp_path / "other.yaml")]) == 2
    assert "must be given" in capsys.readouterr().err
