"""Figures and terminal tables of sweeps: statuses are visible in every kind."""

import pytest

from rootsopt.commands.work.sweep import outcome, rows_of, summary
from rootsopt.config import load
from rootsopt.response.sweeps.plan import plan_of
from rootsopt.response.sweeps.points import lost
from rootsopt.response.sweeps.scenes import dataset_of
from rootsopt.status import Status
from rootsopt.view.facts import swept
from rootsopt.view.figures import sweep as drawing
from rootsopt.view.figures.sweep import MARKERS
from rootsopt.view.files import ResultFolder
from rootsopt.view.tables import scene_tables
from tests.view.test_optimum_figures import overlaps

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
    return plan, rows, dataset_of(load("cic_drawn"), plan, rows)


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
def test_statuses_are_in_every_figure(axes, options, panels, tmp_path, monkeypatch):
    kept = []
    monkeypatch.setattr(ResultFolder, "write_figure", lambda _, name, figure: kept.append(figure))
    plan, _, data = made(axes, **options)
    drawing.sweep_figure(ResultFolder(tmp_path), plan, data)
    (figure,) = kept
    assert len(figure.axes) == panels
    assert overlaps(figure) == []
    found = {str(label).replace("_", " ") for label in data.status.values.ravel()}
    entries = [text.get_text() for one in figure.legends for text in one.get_texts()]
    for label in found - ({"periodic"} if panels == 4 else set()):
        assert any(entry.startswith(label) for entry in entries)


@pytest.mark.parametrize("touching", [False, True])
def test_flanks_that_stay_apart_have_their_reserve_on_the_axes(touching, tmp_path, monkeypatch):
    """Without any contact, a sweep shows the reserve and the gear's force, and tells its ends."""
    kept = []
    monkeypatch.setattr(ResultFolder, "write_figure", lambda _, name, figure: kept.append(figure))
    plan, rows = plan_of({"contact.clearance_mm": "0.1:0.2:3"}), {}
    for number in range(3):
        force = 5.0 if touching and number == 0 else 0.0
        response = {"mean_force_N": force / 2, "peak_force_N": force}
        response |= {"contact_reserve_um": 10.0 * number + 1, "gear_force_N": 200.0}
        rows[number] = lost(Status.IDLE) | {"response": response}
    drawing.sweep_figure(ResultFolder(tmp_path), plan, dataset_of(load("cic_drawn"), plan, rows))
    shown = [ax.get_ylabel() for ax in kept[0].axes]
    (name, words), sure = swept({}, rows_of(plan, rows))
    assert sure[0] == "How sure"
    if touching:
        assert shown == ["mean force (N)", "peak force (N)"]
        assert (name, "lowest, 0 N, at clearance 0.15 mm" in words) == ("Peak force", True)
        return
    assert shown == ["contact reserve (µm)", "gear force (N)"]
    assert kept[0].axes[1].get_xlabel() == "clearance (mm)"
    assert name == "Contact reserve"
    assert words == "It is lowest, 1 µm, at clearance 0.1 mm; highest, 21 µm, at clearance 0.2 mm."


def test_every_status_has_a_marker_of_its_own():
    assert [*map(len, (MARKERS, {*MARKERS.values()}))] == [len(Status)] * 2


def test_no_figure_over_three_keys(tmp_path):
    plan, _, data = made({SPEED: "1,2", PLAY: "1,2", "rotor.length_mm": "1,2"})
    drawing.sweep_figure(ResultFolder(tmp_path), plan, data)
    assert not any(tmp_path.rglob("*.png"))


def test_rows_and_outcome():
    plan, rows, _ = made({SPEED: "1:5:5"})
    table = rows_of(plan, rows)
    assert [row[SPEED] for row in table] == [1.0, 2.0, 3.0, 4.0, 5.0]
    assert [row["mean_force_N"] for row in table] == [10.0, 11.0, 12.0, None, None]
    assert outcome(plan, rows)[0] is Status.PERIODIC
    assert outcome(plan, {3: rows[3], 4: rows[4]})[0] is Status.INTERRUPTED
    worst = {number: rows[3] for number in range(5)}
    assert outcome(plan, worst)[0] is Status.INVALID
    part = {0: rows[0]}
    assert summary(plan, part)["statuses"] == {"periodic": 1, "not_simulated": 4}
    _, counts, ranges = scene_tables(summary(plan, rows), table, 40)
    shown = [row[0].text for row in counts.groups[0][1]]
    assert shown == [*dict.fromkeys(status.label.replace("_", " ") for status in CYCLE)]
    low = [cell.text for cell in ranges.groups[0][1][0]]
    assert low == ["mean force", "10.000", "0", "11.000", "1"]  # The chaotic point is not usable.
