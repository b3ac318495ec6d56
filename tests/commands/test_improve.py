"""`rootsopt improve`: a rotor from a file, and a better one in its place."""

import inspect
import json
import sys
from types import SimpleNamespace

import ezdxf
import numpy as np
import pytest

from rootsopt.commands.table import improve
from rootsopt.commands.work import improve as work
from rootsopt.view.comparison import NOTHING_BETTER, WORTH
from tests.commands.test_new import Terminal
from tests.measured.test_outline import POSES, cut_cic, cycloids, write
from tests.standins import evaluation_of

QUICK = (
    "--set=optimizer.iterations=2",
    "--set=optimizer.starts=1",
    "--set=optimizer.screening=0",
    "--set=optimizer.prove=false",
    "--set=assumptions.scenes=0",
)


def file_of(folder, inset):
    """Write a CIC rotor that is smaller by `inset` (mm), in inches, turned and off its axis."""
    points = cut_cic(inset) * np.exp(0.4j) + 5 - 3j
    return str(write(folder / "rotor.csv", points[::-1] / 25.4))


def improved(folder, file, *options):
    """Return the result for the rotor of a file, the records of both, and what was found.

    The better one fits the housing and displaces as much."""
    assert improve.main([str(file), "--no-figures", "-o", str(folder), *QUICK, *options]) == 0
    result = json.loads((folder / "result.json").read_text())
    before, after = result["baseline"], result["optimized"]
    assert after["geometry"]["outer_radius_mm"] <= before["geometry"]["outer_radius_mm"] + 1e-5
    assert after["pump"]["displaced_volume_cm3"] >= before["pump"]["displaced_volume_cm3"] - 1e-3
    return result, before, after, result["improve"]


LEAST = "--set=constraints.seal_width_min_mm=2"
TOUCHING = "--set=scene.timing_gear.backlash_mm=0.3"


@pytest.mark.parametrize(
    ("aim", "options"),
    [
        # Without a gear, no play has to be computed to know that the flanks touch.
        ("smoother", (LEAST, "--set=scene.timing_gear=null")),
        pytest.param("quieter", (LEAST, TOUCHING), marks=pytest.mark.long),
        pytest.param("tighter", (TOUCHING,), marks=pytest.mark.long),
    ],
)
def test_a_better_rotor_takes_the_place_of_that_of_a_file(
    aim, options, tmp_path, capsys, monkeypatch
):
    monkeypatch.setattr(*POSES)
    monkeypatch.setattr(work, "_COMMON", ("ee", "cic"))
    result, before, after, told = improved(
        tmp_path / "run", file_of(tmp_path, 0.02), "--length-mm=100", f"--{aim}", *options
    )
    shown = capsys.readouterr().out
    assert "Your rotor against a better one" in shown
    assert "inset 0.02 mm" in shown
    assert told["inset_mm"] == pytest.approx(0.02, abs=1e-3)
    assert told["aims"] == [aim]
    assert before["design"] == pytest.approx(
        {"pressure_angle_deg": 36.43, "involute_length_mm": 8.5, "tip_arc_angle_deg": 4.0}, abs=5e-3
    )
    # The better rotor is cut by the same clearance.
    seal = [one["geometry"]["seal_width_mm"] for one in (before, after)]
    assert seal[1] >= (2 if LEAST in options else seal[0]) - 1e-4
    assert result["improvement"]["objective"] > 0
    drawing = ezdxf.readfile(tmp_path / "run" / "rotor.dxf").modelspace()
    farthest = max(x.start_point.magnitude for x in drawing.query('ARC[layer=="OUTLINE"]'))
    radius = farthest + told["inset_mm"]
    assert radius == pytest.approx(after["geometry"]["outer_radius_mm"], abs=1e-6)
    assert {"report.html", "config.yaml", "optimized.yaml"} <= {*result["run"]["files"]}
    # The gain with errors follows from the objectives of both rotors with the same error.
    gains = np.array([1 - one["optimized"] / one["baseline"] for one in told["cases"]])
    shares = [one["share"] for one in told["cases"]]
    assert len(shares) == 5
    assert shares == pytest.approx(gains / result["improvement"]["objective"], rel=1e-3)


def test_a_gain_too_small_to_count_is_none(monkeypatch):
    gain = {"objective": 0.9 * WORTH}
    found = SimpleNamespace(improvement=gain, interrupted=False, optimized=evaluation_of())

    def searched(config, options, folder, further):
        return SimpleNamespace(usable=True, result={"improvement": gain} | further(found))

    monkeypatch.setattr(work.optimize, "body", searched)
    outcome = inspect.unwrap(work.body)(None, SimpleNamespace(known={"found": []}), None)
    told = outcome.result["status"], outcome.result["message"]
    assert (outcome.usable, *told) == (False, "not_improved", NOTHING_BETTER)


@pytest.mark.long
def test_a_rotor_without_parameters_is_improved_by_a_free_form(tmp_path):
    """EE has no seal and no parameters. The ripple of its flow needs no simulation."""
    result, before, after, told = improved(
        tmp_path / "run", write(tmp_path / "ee.csv", cycloids(2, 40.0)),
        "--smoother", "--config", "cic",
    )  # fmt: skip
    assert (told["fit"]["family"], before["design"]) == ("ee", {})
    # EE of N lobes is the free form with all coefficients N / (N + 1).
    begun = [result["beginning"]["design"][f"coefficients_{k}"] for k in (1, 2, 3)]
    assert begun == pytest.approx([2 / 3] * 3, abs=1e-6)
    assert before["geometry"]["outer_radius_mm"] == pytest.approx(60)
    assert after["pump"]["flow_ripple"] < before["pump"]["flow_ripple"]


@pytest.mark.parametrize(("answer", "value"), [("1500", 1500), ("", 3000.0), ("0", 0)])
def test_a_terminal_is_asked(answer, value, monkeypatch):
    monkeypatch.setattr("sys.stdin", Terminal(f"{answer}\n"))
    monkeypatch.setattr("sys.stderr", Terminal())
    assert work._asked("scene.speed_rpm", 3000.0) == value
    assert sys.stderr.getvalue() == "scene.speed_rpm [3000.0]: "


@pytest.mark.parametrize(
    ("options", "message"),
    [
        pytest.param(["--quieter"], "`--quieter` needs flanks that touch", marks=pytest.mark.long),
        (["--set", "profile.arc_center_mm=30"], "follows from the file"),
        (["--unit", "furlong"], "`profile.outline_unit` must be"),
        (["--centre-distance-mm", "90"], "`--centre-distance-mm` must be about"),
    ],
)
def test_what_does_not_suit_the_file_is_refused_in_one_sentence(
    options, message, tmp_path, capsys, monkeypatch
):
    monkeypatch.setattr(*POSES)
    assert improve.main([file_of(tmp_path, 0.1), "-o", str(tmp_path / "run"), *options]) == 2
    (told,) = capsys.readouterr().err.splitlines()
    assert message in told
    assert not (tmp_path / "run").exists()
