"""`rootsopt improve`: a rotor from a file, and a better one in its place."""

import json

import ezdxf
import jax.numpy as jnp
import numpy as np
import pytest

from rootsopt.commands.table import improve
from rootsopt.profiles import CIC, outline

DESIGN = {"pressure_angle_deg": 36.43, "involute_length_mm": 8.5, "tip_arc_angle_deg": 4.0}
QUICK = ("optimizer.iterations=2", "optimizer.starts=1", "optimizer.screening=0")


def file_of(folder, inset, unit=25.4):
    """Write a CIC rotor that is smaller by `inset` (mm), in inches, turned and off its axis."""
    values = (0.033, np.radians(36.43), 0.0085, np.radians(4.0))
    points = np.asarray(outline(CIC(3, *map(jnp.asarray, values)), 1500))[:-1] @ [1e3, 1e3j]
    along = np.roll(points, -1) - np.roll(points, 1)
    points = (points + 1j * along / np.abs(along) * inset) * np.exp(0.4j) + 5 - 3j
    rows = np.stack([points.real, points.imag], axis=1)[::-1] / unit
    np.savetxt(folder / "rotor.csv", rows, fmt="%.10g", delimiter=",", header="x,y", comments="")
    return str(folder / "rotor.csv")


def test_a_better_rotor_takes_the_place_of_that_of_a_file(tmp_path, capsys):
    file, folder = file_of(tmp_path, 0.02), tmp_path / "run"
    scene = ["scene.timing_gear.backlash_mm=0.3", *QUICK]
    sets = [word for one in scene for word in ("--set", one)]
    assert improve.main([file, "--no-figures", "-o", str(folder), *sets, "--length-mm", "100"]) == 0
    shown = capsys.readouterr().out
    assert "Your rotor against a better one" in shown
    assert "inset 0.02 mm" in shown
    result = json.loads((folder / "result.json").read_text())
    before, after, told = result["baseline"], result["optimized"], result["improve"]
    assert told["inset_mm"] == pytest.approx(0.02, abs=1e-3)
    assert told["aims"] == ["quieter"]
    assert before["design"] == pytest.approx(DESIGN, abs=5e-3)
    # The better rotor fits the housing, displaces as much, and is cut by the same clearance.
    radius = [one["geometry"]["outer_radius_mm"] for one in (before, after)]
    volume = [one["pump"]["displaced_volume_cm3"] for one in (before, after)]
    assert radius[1] <= radius[0] + 1e-5
    assert volume[1] >= volume[0] - 1e-3
    assert result["improvement"]["objective"] > 0
    drawn = ezdxf.readfile(folder / "rotor.dxf").modelspace().query('ARC[layer=="OUTLINE"]')
    farthest = max(arc.start_point.magnitude for arc in drawn)
    assert farthest == pytest.approx(radius[1] - told["inset_mm"], abs=1e-6)
    assert {"report.html", "config.yaml", "optimized.yaml"} <= {*result["run"]["files"]}
    # The gain with errors follows from the objectives of both rotors with the same error.
    assert len(told["cases"]) == 5
    for one in told["cases"]:
        gain = 1 - one["optimized"] / one["baseline"]
        assert one["share"] == pytest.approx(gain / result["improvement"]["objective"], rel=1e-3)


REFUSED = {
    "flanks that never touch": (("--quieter",), "`--quieter` needs flanks that touch"),
    "a parameter of a family": (("--set", "profile.arc_center_mm=30"), "follows from the file"),
    "an unknown unit": (("--unit", "furlong"), "`profile.outline_unit` must be"),
    "another distance": (("--centre-distance-mm", "90"), "`--centre-distance-mm` must be about"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_does_not_suit_the_file_is_refused_in_one_sentence(name, tmp_path, capsys):
    options, message = REFUSED[name]
    assert improve.main([file_of(tmp_path, 0.1), "-o", str(tmp_path / "run"), *options]) == 2
    told = capsys.readouterr().err.strip()
    assert message in told
    assert "\n" not in told
    assert not (tmp_path / "run").exists()
