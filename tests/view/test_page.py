"""The explorer's session, and its page in a real browser."""

import contextlib
import dataclasses
import queue
import re
import time
from types import SimpleNamespace

import numpy as np
import pytest
from browser import Browser

from rootsopt.config import load, parse
from rootsopt.optimize.design import optimize_design
from rootsopt.optimize.outcome import Optimization
from rootsopt.profiles import EE
from rootsopt.response.evaluation import Evaluator
from rootsopt.status import Status
from rootsopt.view.pages import html as texts
from rootsopt.view.pages.knobs import Engine, Shape, same_motion
from rootsopt.view.pages.session import (
    FromRest,
    NewMotion,
    NewShape,
    Problem,
    Progress,
    Saved,
    Searched,
    Session,
)
from tests.standins import evaluation_of
from tests.view.test_server import serving

CIC = "cic_drawn"
SPEED, TIP, LOAD = "scene.speed_rpm", "profile.tip_arc_angle_deg", "scene.load.torque_N_m"


@pytest.fixture(scope="module")
def engine():
    made = Engine(load(CIC), optimize_design)
    made.prepare()
    return made


class Told(Session):
    """A session whose messages are collected."""

    def __init__(self, engine, idle=0.05):
        self.messages: queue.Queue = queue.Queue()
        super().__init__(engine, self.messages.put, idle)

    def next(self, kind, number):
        """Return the next message of a kind for the values with this number."""
        while True:
            message = self.messages.get(timeout=120)
            if isinstance(message, kind) and message.number == number:
                return message


@pytest.fixture
def session(engine):
    with contextlib.closing(Told(engine)) as made:
        assert made.next(NewMotion, 0).evaluation.status is Status.PERIODIC
        yield made


class Stub(Engine):
    """An engine that computes nothing: a motion near another one has the given `status`.

    Its force is 1 N, that of a motion from rest 2 N. `calls`: names and times (s) of both."""

    def __init__(self):
        super().__init__(load(CIC), optimize_design)
        self.status, self.calls = Status.PERIODIC, []
        self.base = self.given
        self.ready.set()

    def shape(self, config):
        return Shape(np.zeros((1, 2)), {}, None, EE(3, 33e-3))

    def near(self, config, start):
        self.calls.append(("near", time.monotonic()))
        return evaluation_of(1.0, self.status)

    def from_rest(self, config):
        self.calls.append(("rest", time.monotonic()))
        return evaluation_of(2.0)


@pytest.fixture
def told():
    """Return a session in which nothing is computed, after its first motion."""
    with contextlib.closing(Told(Stub(), idle=0.3)) as made:
        made.next(NewMotion, 0)
        yield made


def test_rest_waits_until_the_slider_rests(told):
    """A motion that is known near the last one is compared with that from rest only later."""
    for _ in range(3):
        number = told.move({SPEED: 3100.0})
        told.next(NewMotion, number)
    told.next(FromRest, number)
    names, times = zip(*told.engine.calls, strict=True)
    assert (names[0], names[1], names[-1]) == ("rest", "near", "rest")
    assert times[-1] - times[-2] >= 0.3


def test_motion_without_a_result_is_final_only_after_rest(told):
    """One that is not known near the last one is simulated from rest at once.

    Notes on the values come with the shape, and are no markup."""
    told.idle, told.engine.status = 600.0, Status.NOT_SETTLED
    number = told.move({LOAD: 1e5})
    (note,) = told.next(NewShape, number).notes
    assert "is that N·mm? write 100" in texts.notes_lines((note,))
    assert texts.notes_lines(("<b>",)) == '<div class="note">&lt;b&gt;</div>'
    shown = [told.next(NewMotion, number) for _ in range(2)]
    assert [(one.near, one.final) for one in shown] == [(True, False), (False, True)]


def test_motion_from_rest_is_shown_when_asked(told):
    """On its own it only says that there is another motion; asked for, it is shown, once."""
    number = told.move({SPEED: 3100.0})
    assert told.next(NewMotion, number).near
    assert not told.next(FromRest, number).same
    told.show_from_rest()
    shown = told.next(NewMotion, number)
    assert not shown.near
    assert shown.evaluation.response["mean_force_N"] == 2
    told.show_from_rest()
    assert told.next(FromRest, number).same


def test_sliders_of_whole_numbers_give_whole_numbers(told):
    told.move({"profile.lobes": 4.0})
    assert type(told.config().profile.lobes) is int


def test_motions_are_the_same_if_all_their_forces_agree():
    one, other = evaluation_of(100.0), evaluation_of(100.05)
    apart = dataclasses.replace(other, response=other.response | {"peak_force_N": 101.0})
    chaotic = dataclasses.replace(other, status=Status.CHAOTIC)
    assert [same_motion(one, x) for x in (other, apart, chaotic)] == [True, False, False]


def test_changes_have_the_sign_of_what_they_change():
    """Now against the start in the tables; the optimum against the start of its search."""
    now, first = (evaluation_of(force).record() for force in (90.0, 100.0))
    assert "−10.00\N{NO-BREAK SPACE}%" in texts.numbers_table(now, first)
    # The objective is a fifth lower, and the peak force a tenth higher.
    better = {"objective": 0.2, "peak_force_N": -0.1}
    found = SimpleNamespace(
        status=Status.PERIODIC, optimized=True, optimality=None, improvement=better
    )
    assert "objective −20.00 %, peak force +10.00 %" in texts.searched_line(Searched(0, found, {}))


def test_forces_near_a_motion_are_those_from_rest(session):
    """The motion that follows a slider has the forces of a simulation from rest, and says so.

    The YAML that is saved reproduces them."""
    number = session.move({SPEED: 3050.0, TIP: 4.2})
    shape = session.next(NewShape, number).shape
    motion = session.next(NewMotion, number)
    assert motion.near
    turned, taken = (np.subtract(motion.frames[key], motion.frames[key][0])
                     for key in ("rotation", "time"))  # fmt: skip
    # 3050 revolutions per minute are 18.3 degrees per millisecond.
    np.testing.assert_allclose(taken, turned / 18.3, rtol=1e-6, atol=1e-9)
    assert session.next(FromRest, number).same
    session.save()
    config = parse(session.next(Saved, number).text)
    assert (config.scene.speed_rpm, config.profile.tip_arc_angle_deg) == (3050, 4.2)
    alone = Evaluator.of(config)()
    assert motion.evaluation.response == pytest.approx(alone.response, rel=1e-5)
    assert shape.record == pytest.approx(alone.geometry)
    assert np.hypot(*shape.outline.T).max() == pytest.approx(alone.geometry["outer_radius_mm"])


def test_refused_values_are_not_saved_or_simulated(session):
    """The page says in words why they are refused; values that fit are shown again."""
    number = session.move({TIP: 31.0})
    assert "`profile.tip_arc_angle_deg` must be less than 30" in session.next(Problem, number).words
    number = session.move({TIP: 4.0, "profile.involute_length_mm": 17.0})
    session.next(Problem, number)
    session.save()
    session.show_from_rest()
    assert "involute_length_mm" in session.next(Problem, number).words
    time.sleep(0.5)
    seen = [session.messages.get() for _ in range(session.messages.qsize())]
    assert not [one for one in seen if isinstance(one, Saved | NewMotion)]
    number = session.move({"profile.involute_length_mm": 8.5})
    assert session.next(NewMotion, number).evaluation.usable


def test_search_can_be_cancelled_and_its_design_is_taken(told, monkeypatch):
    optimum = dataclasses.replace(evaluation_of(), design={"pressure_angle_deg": 40.0})

    def search(config, progress, stop):
        assert config.scene.speed_rpm == 3010
        progress(1, 9, 0.9)
        assert stop.wait(60)
        return Optimization(None, optimum, optimum, [], {}, interrupted=True)

    monkeypatch.setattr(told.engine, "optimize", search)
    number = told.move({SPEED: 3010.0})
    told.optimize()
    assert told.next(Progress, number).best == 0.9
    told.cancel()
    assert told.next(Searched, number).values == {"profile.pressure_angle_deg": 40.0}
    assert not told.searching.is_set()


def test_search_without_design_parameters_says_why():
    with contextlib.closing(Told(Engine(load("ee"), optimize_design))) as made:
        made.engine.ready.set()
        made.optimize()
        assert "has no design parameter" in made.next(Searched, 0).words


@pytest.fixture(scope="module")
def address(engine):
    with serving(engine) as found:
        yield found


@pytest.fixture
def page(address, tmp_path):
    with contextlib.closing(Browser(tmp_path)) as made:
        made.call("POST", "/url", {"url": address})
        shown(made, "motion 0")
        yield made


MODEL = "const model = name => Bokeh.documents[0].get_model_by_name(name); "


def shown(page, mark):
    """Wait until the page is loaded and the numbers with this `mark` are shown."""
    code = "if (!(window.Bokeh && Bokeh.documents.length)) return false; " + MODEL
    code += "const m = model('mark'); return m && m.text === arguments[0];"
    page.wait(code, mark, seconds=120)


def read(page):
    return page.run(
        MODEL
        + """
        const list = x => Array.from(x);
        return {
          outline: list(model("outline_now").data.x), force: list(model("force_now").data.drive),
          numbers: model("numbers_text").text,
          gradient: model("gradient_text").text, status: model("status_text").text,
          field: model("field profile.pressure_angle_deg").value,
          pose: document.getElementById("pose").textContent,
          rotors: [...document.querySelectorAll("#pair .rotor")].map(one => one.getAttribute("d")),
          wide: document.documentElement.scrollWidth,
          outside: performance.getEntriesByType("resource").map(one => one.name)
            .filter(name => !name.startsWith(location.origin) && !name.startsWith("data:")),
        };"""
    )


def test_sliders_and_button_work_in_a_browser(page, tmp_path):
    """A drag with the mouse changes all that is shown, without a word on the console.

    The page loads nothing from elsewhere, and is not wider than the window. Values that do not fit
    show no old numbers. A button saves the config."""
    before = read(page)
    assert "periodic" in before["status"]
    assert before["field"] == 36.43
    left, top, width, height = page.run(
        MODEL
        + """
        const view = Bokeh.index.find_one_by_id(model("slider profile.pressure_angle_deg").id);
        const box = view.el.getBoundingClientRect();
        return [box.left, box.top, box.width, box.height];"""
    )
    x, y = left + (36.43 - 25) / (45 - 25) * width, round(top + height / 2)
    steps = [
        {"type": "pointerMove", "x": round(x), "y": y, "duration": 0},
        {"type": "pointerDown", "button": 0},
        *(
            {"type": "pointerMove", "x": round(x + k * width / 50), "y": y, "duration": 30}
            for k in range(1, 6)
        ),
        {"type": "pointerUp", "button": 0},
    ]
    pointer = {"type": "pointer", "id": "mouse", "actions": steps}
    page.call("POST", "/actions", {"actions": [pointer]})
    page.wait(MODEL + "return model('field profile.pressure_angle_deg').value > 37;")
    page.wait("return window.rootsoptDelay > 0;")
    page.wait(MODEL + "return model('status_text').text.includes('the motion is the same');")
    after = read(page)
    for key in ("outline", "force", "numbers", "gradient", "rotors"):
        assert after[key] != before[key], key
    assert len(after["force"]) > 100
    assert "drive flank" in after["pose"]
    assert after["outside"] == []
    assert after["wide"] <= 1400
    told = page.call("POST", "/se/log", {"type": "browser"})
    assert [one for one in told if one["level"] != "INFO"] == []
    page.run(MODEL + f"model('field {TIP}').value = 31;")
    page.wait(MODEL + "return model('mark').text.startsWith('problem');")
    refused = read(page)
    assert "must be less than 30" in refused["status"]
    assert refused["force"] == []
    assert re.search(r"mean force \(N\)</th>\s*<td>[^<]*</td>\s*<td>–</td>", refused["numbers"])
    assert refused["outline"] == after["outline"]  # faded
    page.run(MODEL + f"model('field {TIP}').value = 4; model('field {SPEED}').value = 2950;")
    page.wait(MODEL + "return model('mark').text.startsWith('motion');")
    assert read(page)["force"] != []
    page.run(
        MODEL
        + """
        const view = Bokeh.index.find_one_by_id(model("save").id);
        view.el.shadowRoot.querySelector("button").click();"""
    )
    end = time.monotonic() + 60
    while not (files := list(tmp_path.glob("*.yaml"))) and time.monotonic() < end:
        time.sleep(0.1)
    assert [file.name for file in files] == ["cic-explored.yaml"]
    assert load(files[0]).scene.speed_rpm == 2950


def test_tabs_do_not_disturb_each_other(page, address):
    (first,) = page.call("GET", "/window/handles")
    second = page.call("POST", "/window/new", {"type": "tab"})["handle"]
    page.call("POST", "/window", {"handle": second})
    page.call("POST", "/url", {"url": address})
    shown(page, "motion 0")
    page.run(MODEL + f"model('field {SPEED}').value = 2500;")
    shown(page, "motion 1")
    other = read(page)
    page.call("POST", "/window", {"handle": first})
    assert page.run(MODEL + f"return model('field {SPEED}').value;") == 3000
    assert read(page)["numbers"] != other["numbers"]
