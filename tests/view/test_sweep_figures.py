"""Figures and terminal tables of sweeps: statuses are visible in every kind."""

import pytest

from rootsopt.commands.work.sweep import outcome, rows_of, summary
from rootsopt.config import load
from rootsopt.response.sweeps.plan import plan_of
from rootsopt.response.sweeps.points import lost
from rootsopt.response.sweeps.scenes import dataset_of
from rootsopt.status import Status
from rootsopt.view.facts import swept
from rootsopt.view.figures.sweep import MARKERS, sweep_figure
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


@pytest.fixture
def drawn(tmp_path, monkeypatch):
    """Return a function (plan, data) → the figure of a sweep, or None."""
    kept = [None]
    monkeypatch.setattr(ResultFolder, "write_figure", lambda _, name, figure: kept.append(figure))

    def draw(plan, data):
        sweep_figure(ResultFolder(tmp_path), plan, data)
        return kept[-1]

    return draw


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
def test_statuses_are_in_every_figure(axes, options, panels, drawn):
    plan, _, data = made(axes, **options)
    figure = drawn(plan, data)
    assert len(figure.axes) == panels
    assert overlaps(figure) == []
    found = {str(label).replace("_", " ") for label in data.status.values.ravel()}
    entries = [text.get_text() for one in figure.legends for text in one.get_texts()]
    told = {label for label in found if any(entry.startswith(label) for entry in entries)}
    assert found - told <= ({"periodic"} if panels == 4 else set())


@pytest.mark.parametrize(
    ("force", "shown", "heading", "words"),
    [
        (5.0, ["mean force (N)", "peak force (N)"], "Peak force",
         "It is lowest, 0 N, at clearance 0.15 mm; highest, 5 N, at clearance 0.1 mm."),
        (0.0, ["contact reserve (µm)", "gear force (N)"], "Contact reserve",
         "It is lowest, 1 µm, at clearance 0.1 mm; highest, 21 µm, at clearance 0.2 mm."),
    ],
)  # fmt: skip
def test_flanks_that_stay_apart_have_their_reserve_on_the_axes(force, shown, heading, words, drawn):
    """Without any contact, a sweep shows the reserve and the gear's force, and tells its ends."""
    plan, rows = plan_of({"contact.clearance_mm": "0.1:0.2:3"}), {}
    for number in range(3):
        peak = 0.0 if number else force
        response = {"mean_force_N": peak / 2, "peak_force_N": peak, "gear_force_N": 200.0,
                    "contact_reserve_um": 10.0 * number + 1}  # fmt: skip
        rows[number] = lost(Status.IDLE) | {"response": response}
    figure = drawn(plan, dataset_of(load("cic_drawn"), plan, rows))
    assert [ax.get_ylabel() for ax in figure.axes] == shown
    assert figure.axes[1].get_xlabel() == "clearance (mm)"
    first, sure = swept({}, rows_of(plan, rows))
    assert (first, sure[0]) == ((heading, words), "How sure")


def test_every_status_has_a_marker_of_its_own():
    assert [*map(len, (MARKERS, {*MARKERS.values()}))] == [len(Status)] * 2


def test_no_figure_over_three_keys(drawn):
    plan, _, data = made({SPEED: "1,2", PLAY: "1,2", "rotor.length_mm": "1,2"})
    assert drawn(plan, data) is None


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
