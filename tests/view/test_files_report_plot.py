"""Tests of result files and tables, from made-up evaluations."""

import dataclasses
import functools
import json
import os

import numpy as np
import pytest
from rich.console import Console

from rootsopt.response.result import Evaluation, Series
from rootsopt.status import Status
from rootsopt.view import files, names, tables, terminal
from rootsopt.view.names import table
from tests.standins import refusal

DESIGN = {"pressure_angle_deg": 36.43, "involute_length_mm": 8.5, "tip_arc_angle_deg": 4.0}


def made_up(periods=3, samples=64):
    tau = np.arange(periods * samples) / samples
    wave, none = np.cos(2 * np.pi * tau), 0 * tau
    return Series(
        time=tau / 150,
        rotation=2 * np.pi / 3 * tau,
        relative=-1e-4 * tau,
        rate=none,
        drive_force=np.maximum(0, 30 * wave),
        coast_force=np.maximum(0, -10 * wave),
        depth=none,
    )


def _evaluation(mean=14.830332, peak=83.824854, **changes):
    made = Evaluation(
        design=dict(DESIGN),
        geometry={"outer_radius_mm": 45.1028545, "polar_inertia_kg_m2": 0.00210070},
        response={"mean_force_N": mean, "peak_force_N": peak, "rms_force_N": 22.45494},
        gradient={"mean_force_N": {"pressure_angle_deg": -0.24457, "involute_length_mm": 0.65}},
        steady_state={"kind": "periodic", "period": 2, "floquet_multiplier": 0.37066967},
        status=Status.PERIODIC,
        message=Status.PERIODIC.value,
        statistics={"solver_steps": 3055, "seconds": 21.16},
        series=made_up(),
    )
    return dataclasses.replace(made, **changes)


def failed():
    return _evaluation(
        response={},
        gradient={},
        steady_state={"kind": "transient"},
        status=Status.PASSED_THROUGH,
        message=Status.PASSED_THROUGH.value,
        series=None,
    )


# ---------------------------------------------------------------------------- files


def test_csv_keeps_ten_digits(tmp_path):
    series = made_up()
    columns = files.response_columns(series)
    path = files.ResultFolder(tmp_path).write_csv("response_baseline.csv", columns)
    assert path == tmp_path / "response_baseline.csv"
    rows = np.genfromtxt(path, delimiter=",", names=True)
    assert rows.dtype.names == (
        "time_s", "rotation_deg", "relative_rotation_rad", "relative_speed_rad_s",
        "drive_flank_force_N", "coast_flank_force_N", "contact_force_N",
    )  # fmt: skip
    np.testing.assert_allclose(rows.tolist(), np.transpose([*columns.values()]), rtol=1e-9)
    assert rows["rotation_deg"][64] == 120
    np.testing.assert_allclose(columns["contact_force_N"], series.drive_force + series.coast_force)


def test_csv_of_rows_keeps_text_truth_and_gaps(tmp_path):
    rows = [{"a": 1, "b": True, "c": "x,y"}, {"a": 2, "b": False, "d": float("nan")}]
    for columns, text in (
        (files.row_columns(rows), 'a,b,c,d\n1,true,"x,y",\n2,false,,nan\n'),
        (files.row_columns([], keys=("a", "b")), "a,b\n"),
    ):
        assert files.ResultFolder(tmp_path).write_csv("history.csv", columns).read_text() == text


def test_json_has_null_for_what_is_not_finite(tmp_path):
    data = {
        "a": float("nan"),
        "b": [np.inf, np.float64(1.5)],
        "c": np.array([1, 2]),
        "d": {"e": np.bool_(True), "f": None, "g": Status.CHAOTIC},
    }
    path = files.ResultFolder(tmp_path).write_json("result.json", data)
    # `str` for NaN and infinity, which are no JSON.
    assert json.loads(path.read_text(), parse_constant=str) == {
        "a": None, "b": [None, 1.5], "c": [1, 2],
        "d": {"e": True, "f": None, "g": "chaotic"},
    }  # fmt: skip


@pytest.mark.parametrize("name", ["", "nul\0byte", "x" * 300, "file", "file/x/y"])
def test_places_where_no_folder_can_be_made(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("keep")
    assert "output folder" in refusal(files.ResultFolder, name)
    assert os.listdir(tmp_path) == ["file"]


# --------------------------------------------------------------------------- tables


def _render(*made):
    console = Console(width=80, force_terminal=False, color_system=None)
    with console.capture() as capture:
        console.print(terminal.shown(made))
    text = capture.get()
    assert text.isascii()
    assert "\x1b" not in text
    assert max(map(len, text.splitlines()), default=0) <= 80
    return text


def _check(made, rows):
    """Assert that a table has these `rows`, as texts by label."""
    found = {
        row[0].text: [cell.text for cell in row[1:]] for _, group in made.groups for row in group
    }
    assert {label: found.get(label) for label in rows} == rows


CONSTRAINTS = [
    {"name": "area_efficiency", "baseline": 0.4344578, "optimized": 0.4344579, "unit": "",
     "limit": 0.4344578, "sense": ">=", "satisfied": True, "active": True, "multiplier": 2.0,
     "relaxed_by": -0.01, "relaxed_objective_percent": -2.63},
    {"name": "undercut_margin", "baseline": 7.4, "optimized": -0.1, "unit": "mm", "limit": 0.0,
     "sense": ">=", "satisfied": False, "active": False, "baseline_satisfied": False,
     "baseline_limit": 7.0},
]  # fmt: skip


def _compared(first, second, **gains):
    return {"baseline": first.record(), "optimized": second.record(), "improvement": gains,
            "constraints": CONSTRAINTS}  # fmt: skip


def test_numbers_of_two_designs_are_compared():
    result = _compared(_evaluation(), _evaluation(13.3472988, 41.912427), objective=0.25)
    made = tables.numbers_table(result)
    _check(made, {
        "relative to the baseline": ["1", "0.75000", "−25.00 %"],
        "mean force (N)": ["14.830", "13.347", "−10.00 %"],
        "peak force (N)": ["83.825", "41.912", "−50.00 %"],
        "pressure angle (°)": ["36.430", "36.430", "0.00 %"],
        "polar inertia (kg·m²)": ["0.0021007", "0.0021007", "0.00 %"],
        "status": ["periodic", "periodic", ""],
    })  # fmt: skip
    assert made.note == f"both: {Status.PERIODIC.value}"
    _check(tables.constraint_table(result), {
        "area efficiency ≥ 0.43446": ["0.43446", "0.43446", "active", "−2.63 % for −0.01"],
        "undercut margin ≥ 0 mm": ["7.4000 > 7.0000", "−0.10000", "violated", ""],
    })  # fmt: skip
    titles = [one.title.rpartition(", ")[2] for one in tables.gradient_tables(result)]
    assert titles == ["baseline", "optimised"]
    text = _render(*tables.tables_of(result))
    assert "polar inertia (kg m^2)" in text
    assert "undercut margin >= 0 mm" in text


def test_numbers_without_a_usable_result():
    result = _compared(_evaluation(), failed(), objective=float("nan"))
    made = tables.numbers_table(result)
    _check(made, {
        "relative to the baseline": ["–", "–", ""],
        "mean force (N)": ["14.830", "–", ""],
        "status": ["periodic", "passed through", ""],
    })  # fmt: skip
    assert made.groups[-1][1][-1][2].good is False
    assert "passed through each other" in made.note
    assert len([one for one in tables.gradient_tables(result) if one]) == 1


def test_numbers_of_one_design():
    record = _evaluation().record()
    numbers = {"mean force (N)": ["14.830"], "period (mesh periods)": ["2"], "status": ["periodic"]}
    _check(tables.numbers_table(record), numbers)
    _check(tables.effort_table(record), {"time (s)": ["21.160"]})
    slopes = next(tables.gradient_tables(record))
    _check(slopes, {"involute length (mm)": ["0.65000"]})
    errors = {"mean_force_N": {"involute_length_mm": 0.25}}
    record["steady_state"] = {"gradient_standard_error": errors}
    slopes = next(tables.gradient_tables(record))
    _check(slopes, {"involute length (mm)": ["0.65000 ± 0.25000"]})
    assert "0.65000 +- 0.25000" in _render(slopes)


def test_pump_sheet():
    """The sheet shows baseline beside optimum, with rows of both or one of them, and the forces."""
    known = {"design": DESIGN, "response": {"mean_force_N": 10.0}}
    first = known | {"pump": {"flow_ripple": 0.2, "flow_lines": [0.5, 0.25]}}
    overlap = {"flank_interference_um": 30.0, "flank_interference_at_deg": 5.0}
    sheet = {"flow_ripple": 0.1, "tip_leakage_l_min": 2.5, **overlap}
    made = tables.pump_table({"baseline": first, "optimized": known | {"pump": sheet}})
    _check(made, {
        "flow ripple": ["0.20000", "0.10000", "−50.00 %"],
        "tip leakage (l/min)": ["–", "2.5000", ""],
        "flow lines, 2 of 2": ["0.25000", "–", ""],
        "mean force (N)": ["10.000", "10.000", "0.00 %"],
    })  # fmt: skip
    assert "optimised: The flanks overlap" in made.note
    _render(made)


def test_steps_of_the_scene_have_their_own_unit():
    """A clearance moves by a micrometre, another length by a hundredth of itself."""
    row = {"unit": "mm", "mean_force_N": 0.1, "peak_force_N": -0.2}
    rows = [row | {"quantity": "clearance", "step": 1e-3, "value": 0.1},
            row | {"quantity": "rotor length", "step": 1.0, "value": 100.0}]  # fmt: skip
    optimality = {"converged": True, "reason": "converged", "message": "", "residual": 0.0,
                  "required_residual": 1e-4, "violation": 0.0, "method": "slsqp",
                  "sensitivities": rows}  # fmt: skip
    made = [one for one in tables.certificate_tables({"optimality": optimality}) if one][-1]
    slopes = ["+0.1", "−0.2", "–"]
    _check(made, {"clearance +1 µm": slopes, "rotor length +1 %": slopes})
    assert "clearance +1 um" in _render(made)


def test_scenes_have_columns_for_what_differs():
    """Values that all rows share stand below; long tables are truncated, and say so."""
    rows = [{"speed_rpm": 1000.0 * k, "mean_force_N": 10.0 + k, "peak_force_N": None,
             "period": 2, "status": "periodic"} for k in range(1, 9)]  # fmt: skip
    (made,) = tables.scene_tables({}, rows, most=5)
    assert made.heads == ("speed (rpm)", "status", "mean force (N)")
    assert len(made.groups[0][1]) == 5
    assert made.note == "The first 5 of 8 rows. In all rows: period 2 mesh periods."
    of_both = {"baseline": {"design": DESIGN, "speeds": rows},
               "optimized": {"design": DESIGN, "speeds": rows},
               "objective_by_speed": [row | {"objective": 0.5} for row in rows]}  # fmt: skip
    first, second = tables.scene_tables(of_both, (), most=200)
    assert "objective" not in first.heads
    assert "objective 0.5" in second.note


def test_wide_tables_are_divided_on_the_terminal():
    """Every part repeats the first column, fits into the width, and no cell or note is lost."""
    heads = ["point", *(f"a quantity with number {k}, ½ (mm)" for k in range(30))]
    rows = [[f"row {k}", *(f"{k}.{j:04d} × 10⁻⁷" for j in range(30))] for k in range(3)]
    made = table("Wide [table]", heads, [("", rows)], "Nothing is lost → here.")
    text = _render(made)
    assert text.count("Wide [table]") > 3
    for row in rows:
        assert text.count(row[0]) == text.count("Wide [table]")
        for cell in row[1:]:
            assert text.count(f" {terminal.ascii_text(cell)} ") == 1
    assert "Nothing is lost -> here." in text
    assert table("Empty", heads, [("", [])]) is None


@pytest.mark.parametrize(
    ("work", "given", "shown"),
    [
        (terminal.ascii_text, "5 µm at 4° (°)", "5 um at 4 deg (deg)"),
        (terminal.ascii_text, "−1.2 × 10⁻⁷ kg·m²", "-1.2e-07 kg m^2"),
        (terminal.ascii_text, "3 × 10¹² ≥ – ± ≤", "3e+12 >= - +- <="),
        (terminal.ascii_text, "line at 2 × mesh", "line at 2 x mesh"),
        (terminal.ascii_text, "ψ(β)", "?(?)"),
        (names.value, 0.0, "0"),
        (names.value, 1973.3, "1973.3"),
        (names.value, -1.23456e-7, "−1.235 × 10⁻⁷"),
        (names.value, 3, "3"),
        (names.value, None, "–"),
        (names.value, float("nan"), "–"),
        (names.value, 123456.7, "123457"),
        (names.value, True, "yes"),
        (names.value, "passed_through", "passed through"),
        (names.value, [1, 2.5], "1, 2.5000"),
        (names.label, "scene.timing_gear.backlash_mm", "backlash (mm)"),
        (names.label, "rms_force_N", "RMS force (N)"),
        (names.label, "line_1.5_force_N", "line at 1.5 × mesh frequency (N)"),
        (names.label, "flank_gap_min_um", "flank gap min (µm)"),
        (names.label, "area_efficiency", "area efficiency"),
        (names.label, "tilting_moment_max_N_m", "tilting moment max (N·m)"),
        (functools.partial(names.percent, -2.0), -1.0, "+50.00 %"),
        (functools.partial(names.percent, 1.0), 1.0 - 1e-9, "0.00 %"),
        (functools.partial(names.percent, 0.001), 3.0, "+3 × 10⁵ %"),
        (functools.partial(names.percent, 0.0), 1.0, ""),
        (functools.partial(names.percent, None), 1.0, ""),
    ],
)
def test_signs_values_and_names(work, given, shown):
    """The terminal replaces the signs of print; values, names and changes are words."""
    assert work(given) == shown
