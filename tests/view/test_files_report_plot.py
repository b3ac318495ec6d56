"""Tests of result files, tables and figures, from made-up evaluations and sweeps.

Figures are those of forces, of an optimum against its baseline, and of sweeps; labels have room."""

import dataclasses
import functools
import itertools
import json
import os
from unittest import mock

import numpy as np
import pytest
from PIL import Image
from rich.console import Console

from rootsopt.commands.work.sweep import outcome, rows_of, summary
from rootsopt.config import load
from rootsopt.response.result import Evaluation, Series
from rootsopt.response.sweeps.plan import plan_of
from rootsopt.response.sweeps.points import lost
from rootsopt.response.sweeps.scenes import dataset_of
from rootsopt.scene import outline_mm
from rootsopt.status import Status
from rootsopt.view import files, names, tables, terminal
from rootsopt.view.facts import swept
from rootsopt.view.figures import runs
from rootsopt.view.figures.designs import plot_departure, plot_forces_together
from rootsopt.view.figures.force import amplitude_spectrum, plot_force, plot_gap
from rootsopt.view.figures.style import figure
from rootsopt.view.figures.sweep import MARKERS, status_entries, sweep_figure
from rootsopt.view.names import table

CIC = load("cic_drawn")
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
    _check(next(tables.gradient_tables(record)), {"involute length (mm)": ["0.65000"]})
    errors = {"mean_force_N": {"involute_length_mm": 0.25}}
    record["steady_state"] = {"gradient_standard_error": errors}
    slopes = next(tables.gradient_tables(record))
    _check(slopes, {"involute length (mm)": ["0.65000 ± 0.25000"]})
    assert "0.65000 +- 0.25000" in _render(slopes)


def test_pump_sheet():
    """The sheet shows baseline beside optimum, with rows of both or one of them, and the forces."""
    known = {"design": DESIGN, "response": {"mean_force_N": 10.0}}
    first = known | {"pump": {"flow_ripple": 0.2, "flow_lines": [0.5, 0.25]}}
    sheet = {"flow_ripple": 0.1, "tip_leakage_l_min": 2.5,
             "flank_interference_um": 30.0, "flank_interference_at_deg": 5.0}  # fmt: skip
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
    text = _render(table("Wide [table]", heads, [("", rows)], "Nothing is lost → here."))
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


# --------------------------------------------------------------------------- figures


def drawn(ax, number):
    """Return the points (n, 2) of a line on an axis."""
    return np.asarray(ax.lines[number].get_xydata())


def test_departure_of_a_scaled_rotor_is_that_of_its_supporting_lines():
    """Scaling by 1.001 moves the tip by 45.1 µm outwards, and every point by 1/1000 of its
    support."""
    outline = outline_mm(CIC)
    _, axes = figure(6, 4, 1, 2)
    plot_departure(axes[0, 0], outline, 1.001 * outline, 3, 33.0)
    along, away = drawn(axes[0, 0], 1).T
    radius = np.hypot(*outline.T)
    assert away[[0, -1]] == pytest.approx([radius.max(), radius.min()], rel=1e-3)
    assert along[-1] > np.ptp(radius)
    assert "outwards" in axes[0, 0].get_title()
    plot_departure(axes[0, 1], outline, outline, 3, 33.0)
    np.testing.assert_allclose(drawn(axes[0, 1], 1)[:, 1], 0.0, atol=1e-6)


def test_forces_begin_at_the_same_rotation():
    """A force that depends only on the rotor's angle coincides, wherever its series begins."""

    def run(first):
        rotation = first + np.linspace(0, 2 * np.pi, 601)
        force, zero = 1 + np.sin(3 * rotation), 0 * rotation
        return Series(rotation / 314, rotation, zero, zero, force, zero, zero)

    ax = figure(6, 4)[1][0, 0]
    plot_forces_together(ax, {"a": run(0.0), "b": run(5.0)}, 2 * np.pi / 3)
    first, second = (drawn(ax, k) for k in (0, 1))
    assert ax.get_xlim() == pytest.approx((0, 120))
    np.testing.assert_allclose(np.interp(second[:, 0], *first.T), second[:, 1], atol=1e-3)


def overlaps(figure):
    """Return what leaves a figure, and what covers something else, as pairs of names.

    Compared are its panels with their labels, its legends and its title."""
    figure.draw_without_rendering()
    named = {
        **{ax.get_label() or f"panel {k}": ax for k, ax in enumerate(figure.axes)},
        **{f"legend {k}": legend for k, legend in enumerate(figure.legends)},
        **{text.get_text(): text for text in figure.texts},
    }
    boxes = {name: one.get_tightbbox() for name, one in named.items()}
    width, height = figure.bbox.size + 0.5
    left = [
        (name, "edge")
        for name, box in boxes.items()
        if box.x0 < -0.5 or box.y0 < -0.5 or box.x1 > width or box.y1 > height
    ]
    pairs = itertools.combinations(boxes.items(), 2)
    return left + [(a, b) for (a, one), (b, other) in pairs if one.overlaps(other)]


def test_long_labels_have_room(tmp_path):
    """Small differences between large numbers, and many parameters fit; a picture is large.

    Screening, trials without a result and infeasible ones are part of the history."""
    keys = [f"radius_of_arc_{k}_mm" for k in range(5)]
    rows = [
        {"start": k // 4 - 1, "feasible": k != 6, "residual": 1e-9, "evaluation": k, "iteration": k}
        | {"objective": 1 - 1e-5 * k if k != 5 else np.nan, "best_objective": 1 - 1e-5 * k}
        | dict.fromkeys(keys, -123.45 + 0.12 * k)
        for k in range(12)
    ]
    made = runs._history(rows, keys)
    assert overlaps(made) == []
    file = files.ResultFolder(tmp_path).write_figure("figures/history.png", made)
    assert file.stat().st_size > 20_000
    with Image.open(file) as picture:
        assert picture.format == "PNG"
        assert min(picture.width - 1400, picture.height - 700) >= 0


@pytest.mark.parametrize("count", [96, 97])
def test_spectrum_of_a_cosine(count):
    step = 3 / (150 * count)  # three whole periods of 150 Hz
    time = step * np.arange(count)
    signal = 5 + 2.5 * np.cos(2 * np.pi * 150 * time + 0.3) + 0.5 * np.sin(2 * np.pi * 300 * time)
    frequency, amplitude = amplitude_spectrum(signal, step)
    np.testing.assert_allclose(frequency, 50 * np.arange(1, len(frequency) + 1), rtol=1e-9)
    expected = np.zeros_like(frequency)
    expected[[2, 5]] = 2.5, 0.5
    np.testing.assert_allclose(amplitude, expected, atol=1e-12)


def test_force_panels_show_each_peak_on_a_common_time_axis():
    long = made_up(periods=128)
    long.drive_force[100 * 64] = 500.0
    _, axes = figure(6, 4, 2, 1, sharex=True)
    responses = {"a": {"mean_force_N": 10.0, "peak_force_N": 500.0},
                 "b": {"mean_force_N": 10.0, "peak_force_N": 30.0}}  # fmt: skip
    plot_force(axes[:, 0], {"a": long, "b": made_up()}, responses)
    drawn = axes[0, 0].lines[0]
    assert drawn.get_ydata().max() == 500
    assert axes[0, 0].get_xlim() == pytest.approx((0, 20))
    assert drawn.get_xdata()[-1] < 20


def test_gap_panel_shows_the_least_gap():
    """One revolution is drawn; a gap as wide as the rotors does not set the scale."""
    series = made_up(periods=6)
    gap = 1e-4 * (1 + (np.arange(len(series.time)) % 64 == 32) * 600.0)
    gap[5] = 8e-5
    _, axes = figure(6, 2, 1, 1)
    plot_gap(axes[:, 0], {"a": dataclasses.replace(series, depth=-gap)})
    curve, least = axes[0, 0].lines
    assert (least.get_ydata()[0], least.get_label()) == (pytest.approx(80), "least gap 80.00 µm")
    assert axes[0, 0].get_ylim() == pytest.approx((0, 320))
    assert (
        np.ptp(series.rotation)
        > 2 * np.pi
        > 0.9 * np.ptp(series.rotation[: curve.get_xdata().size])
    )


def test_simulation_figures_without_a_series(tmp_path):
    runs.simulation_figures(files.ResultFolder(tmp_path), failed(), CIC)
    assert sorted(os.listdir(tmp_path / "figures")) == ["meshing.png", "profiles.png"]
    assert "pyplot" not in vars(runs)


SPEED, PLAY = "scene.speed_rpm", "scene.timing_gear.backlash_mm"
CYCLE = (Status.PERIODIC, Status.PERIODIC, Status.CHAOTIC, Status.INVALID, Status.PASSED_THROUGH)


def made(axes, **options):
    """A sweep whose points have the statuses of `CYCLE` in turn."""
    plan, rows = plan_of(axes, **options), {}
    for number in range(plan.count):
        status = CYCLE[number % len(CYCLE)]
        known = status in (Status.PERIODIC, Status.CHAOTIC)
        forces = {"mean_force_N": 10.0 + number, "peak_force_N": 30.0 + number}
        rows[number] = lost(status) | {"response": forces if known else {}}
    return plan, rows, dataset_of(CIC, plan, rows)


def figure_of(folder, plan, data):
    with mock.patch.object(files.ResultFolder, "write_figure") as written:
        sweep_figure(files.ResultFolder(folder), plan, data)
    return written.call_args and written.call_args.args[1]


@pytest.mark.parametrize(
    ("axes", "options", "panels"),
    [
        ({SPEED: "300:6000:39"}, {}, 2),
        ({SPEED: "1"}, {}, 2),
        ({"profile.family": "cic,ee,arc,ellipse"}, {}, 2),
        ({SPEED: "300:6000:12", PLAY: "0.1,0.2"}, {}, 2),
        ({"profile.family": "cic,ee", SPEED: "300:6000:12"}, {}, 2),
        ({SPEED: "300:6000:9", PLAY: "0.05:0.2:8"}, {}, 4),  # with colour bars
        ({SPEED: "300:6000", PLAY: "0.05:0.2"}, {"sobol": 16}, 4),
        ({SPEED: "1,2,3", PLAY: "1,2,3"}, {"zipped": True}, 4),
    ],
)
def test_statuses_are_in_every_figure(axes, options, panels, tmp_path):
    plan, _, data = made(axes, **options)
    figure = figure_of(tmp_path, plan, data)
    assert len(figure.axes) == panels
    assert overlaps(figure) == []
    found = {str(label).replace("_", " ") for label in data.status.values.ravel()}
    entries = [text.get_text() for one in figure.legends for text in one.get_texts()]
    told = {label for label in found if any(entry.startswith(label) for entry in entries)}
    assert found - told <= ({"periodic"} if panels == 4 else set())


def test_the_legend_says_what_a_marker_without_a_steady_motion_shows():
    """Every status has a marker of its own."""
    assert [*map(len, (MARKERS, {*MARKERS.values()}))] == [len(Status)] * 2
    entries = status_entries(["periodic", "not_closed", "inaccurate", "passed_through"])
    assert [one.get_label() for one in entries] == [
        "periodic",
        "not closed, average of a window",
        "inaccurate, no gradient",
        "passed through, no force",
    ]


@pytest.mark.parametrize(
    ("force", "shown", "heading", "words"),
    [
        (5.0, ["mean force (N)", "peak force (N)"], "Peak force",
         "It is lowest, 0 N, at clearance 0.15 mm; highest, 5 N, at clearance 0.1 mm."),
        (0.0, ["contact reserve (µm)", "gear force (N)"], "Contact reserve",
         "It is lowest, 1 µm, at clearance 0.1 mm; highest, 21 µm, at clearance 0.2 mm."),
    ],
)  # fmt: skip
def test_flanks_that_stay_apart_have_their_reserve_on_the_axes(
    force, shown, heading, words, tmp_path
):
    """Without any contact, a sweep shows the reserve and the gear's force, and tells its ends."""
    plan, rows = plan_of({"contact.clearance_mm": "0.1:0.2:3"}), {}
    for number in range(3):
        peak = 0.0 if number else force
        response = {"mean_force_N": peak / 2, "peak_force_N": peak, "gear_force_N": 200.0,
                    "contact_reserve_um": 10.0 * number + 1}  # fmt: skip
        rows[number] = lost(Status.IDLE) | {"response": response}
    figure = figure_of(tmp_path, plan, dataset_of(CIC, plan, rows))
    assert [ax.get_ylabel() for ax in figure.axes] == shown
    assert figure.axes[1].get_xlabel() == "clearance (mm)"
    first, sure = swept({}, rows_of(plan, rows))
    assert (first, sure[0]) == ((heading, words), "How sure")


def test_no_figure_over_three_keys(tmp_path):
    plan, _, data = made({SPEED: "1,2", PLAY: "1,2", "rotor.length_mm": "1,2"})
    assert figure_of(tmp_path, plan, data) is None


def test_rows_and_outcome():
    plan, rows, _ = made({SPEED: "1:5:5"})
    table = rows_of(plan, rows)
    assert [(row[SPEED], row["mean_force_N"]) for row in table] == [
        (1.0, 10.0), (2.0, 11.0), (3.0, 12.0), (4.0, None), (5.0, None)
    ]  # fmt: skip
    for numbers, status in (
        ({0: 0, 1: 1, 2: 2, 3: 3, 4: 4}, Status.PERIODIC),
        ({3: 3, 4: 4}, Status.INTERRUPTED),
        (dict.fromkeys(range(5), 3), Status.INVALID),
    ):
        assert outcome(plan, {at: rows[of] for at, of in numbers.items()})[0] is status
    assert summary(plan, {0: rows[0]})["statuses"] == {"periodic": 1, "not_simulated": 4}
    _, counts, ranges = tables.scene_tables(summary(plan, rows), table, 40)
    shown = [row[0].text for row in counts.groups[0][1]]
    assert shown == [*dict.fromkeys(status.label.replace("_", " ") for status in CYCLE)]
    low = [cell.text for cell in ranges.groups[0][1][0]]
    assert low == ["mean force", "10.000", "0", "11.000", "1"]  # The chaotic point is not usable.
