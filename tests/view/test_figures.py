"""Figures: of forces, of an optimum against its baseline, and of sweeps; room for labels."""

import dataclasses
import itertools
import os
from unittest import mock

import numpy as np
import pytest
from PIL import Image

from rootsopt.commands.work.sweep import outcome, rows_of, summary
from rootsopt.config import load
from rootsopt.response.result import Series
from rootsopt.response.sweeps.plan import plan_of
from rootsopt.response.sweeps.points import lost
from rootsopt.response.sweeps.scenes import dataset_of
from rootsopt.scene import outline_mm
from rootsopt.status import Status
from rootsopt.view.facts import swept
from rootsopt.view.figures import runs
from rootsopt.view.figures.designs import plot_departure, plot_forces_together
from rootsopt.view.figures.force import amplitude_spectrum, plot_force, plot_gap
from rootsopt.view.figures.style import figure
from rootsopt.view.figures.sweep import MARKERS, status_entries, sweep_figure
from rootsopt.view.files import ResultFolder
from rootsopt.view.tables import scene_tables
from tests.view.test_files_report_plot import failed, made_up

CIC = load("cic_drawn")


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
    boxes = {ax.get_label() or f"panel {k}": ax.get_tightbbox() for k, ax in enumerate(figure.axes)}
    boxes |= {f"legend {k}": legend.get_tightbbox() for k, legend in enumerate(figure.legends)}
    boxes |= {text.get_text(): text.get_tightbbox() for text in figure.texts}
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
    file = ResultFolder(tmp_path).write_figure("figures/history.png", made)
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
    runs.simulation_figures(ResultFolder(tmp_path), failed(), CIC)
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
    """Return the figure of a sweep, or None."""
    with mock.patch.object(ResultFolder, "write_figure") as written:
        sweep_figure(ResultFolder(folder), plan, data)
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


def test_every_status_has_a_marker_of_its_own():
    assert [*map(len, (MARKERS, {*MARKERS.values()}))] == [len(Status)] * 2


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
    _, counts, ranges = scene_tables(summary(plan, rows), table, 40)
    shown = [row[0].text for row in counts.groups[0][1]]
    assert shown == [*dict.fromkeys(status.label.replace("_", " ") for status in CYCLE)]
    low = [cell.text for cell in ranges.groups[0][1][0]]
    assert low == ["mean force", "10.000", "0", "11.000", "1"]  # The chaotic point is not usable.
