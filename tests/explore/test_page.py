"""The explorer's session, and its page in a real browser.

Orbits are closed by shooting, whose programs are half as large as those of collocation."""

import dataclasses
import queue
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from browser import Browser

from rootsopt.config import load, parse
from rootsopt.explore import session as sessions
from rootsopt.explore import texts
from rootsopt.explore.engine import Engine
from rootsopt.explore.session import (
    FromRest,
    NewMotion,
    NewShape,
    Problem,
    Saved,
    Searched,
    Session,
)
from rootsopt.optimize.search import Optimization
from rootsopt.response.evaluation import Evaluator
from rootsopt.status import Status

pytest.importorskip("bokeh")
ROOT = Path(__file__).parents[2]
CIC = ROOT / "configs" / "cic.yaml"
SPEED, TIP, LOAD = "scene.speed_rpm", "profile.tip_arc_angle_deg", "scene.load.torque_N_m"


@pytest.fixture(scope="module")
def engine():
    made = Engine(load(CIC, ["solver.orbit=shooting"]))
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
    made = Told(engine)
    assert made.next(NewMotion, 0).evaluation.status is Status.PERIODIC
    yield made
    made.close()


def test_forces_near_a_motion_are_those_from_rest(session, engine):
    """The motion that follows a slider has the forces of a simulation from rest, and says so."""
    number = session.move({SPEED: 3050.0, TIP: 4.2})
    shape = session.next(NewShape, number).shape
    motion = session.next(NewMotion, number)
    assert motion.near
    assert motion.evaluation.series is not None
    assert session.next(FromRest, number).same
    config = load(CIC, [f"{SPEED}=3050", f"{TIP}=4.2"])
    alone = Evaluator.of(config)()
    assert motion.evaluation.response == pytest.approx(alone.response, rel=1e-5)
    assert shape.record == pytest.approx(alone.geometry)
    assert np.hypot(*shape.outline.T).max() == pytest.approx(alone.geometry["outer_radius_mm"])


def test_values_that_do_not_fit_are_refused_in_words(session):
    number = session.move({TIP: 31.0})
    problem = session.next(Problem, number)
    assert "`profile.tip_arc_angle_deg` must be less than 30" in problem.words
    assert "Traceback" not in problem.words
    number = session.move({TIP: 4.0})
    assert session.next(NewMotion, number).evaluation.usable


def test_refused_values_are_not_saved_or_simulated(session):
    number = session.move({"profile.involute_length_mm": 17.0})
    session.next(Problem, number)
    session.save()
    session.show_from_rest()
    assert "involute_length_mm" in session.next(Problem, number).words
    seen = []
    time.sleep(0.5)
    while not session.messages.empty():
        seen.append(session.messages.get())
    assert not [one for one in seen if isinstance(one, Saved | NewMotion)]


def test_motion_without_a_result_is_final_only_after_rest(session):
    """Under a load that no flank can hold, the status is that of a simulation from rest."""
    number = session.move({LOAD: 1e5})
    (note,) = session.next(NewShape, number).notes
    assert "is that N·mm? write 100" in texts.notes_lines((note,))
    assert texts.notes_lines(("<b>",)) == '<div class="note">&lt;b&gt;</div>'
    first = session.next(NewMotion, number)
    assert not first.final
    last = session.next(NewMotion, number)
    assert last.final
    assert not last.near
    assert not last.evaluation.usable
    assert "Lower" in last.evaluation.message or "lower" in last.evaluation.message
    number = session.move({LOAD: 4.775})
    assert session.next(NewMotion, number).evaluation.usable


def test_bursts_are_coalesced(session):
    """Of many values within a moment, few are computed, and the last of them is."""
    for k in range(200):
        number = session.move({SPEED: 3000.0 + k})
    assert session.next(NewMotion, number).evaluation.usable
    rest = session.next(FromRest, number)
    assert rest.same
    assert session.messages.empty()


def test_yaml_reproduces_the_numbers(session):
    number = session.move({SPEED: 2900.0})
    shown = session.next(NewMotion, number).evaluation
    session.save()
    saved = session.next(Saved, number)
    config = parse(saved.text)
    assert config.scene.speed_rpm == 2900
    assert Evaluator.of(config)().response == pytest.approx(shown.response, rel=1e-5)


def test_sessions_do_not_disturb_each_other(session, engine):
    other = Told(engine)
    other.next(NewMotion, 0)
    one, two = session.move({SPEED: 3100.0}), other.move({SPEED: 2800.0})
    first, second = session.next(NewMotion, one), other.next(NewMotion, two)
    assert first.evaluation.response != second.evaluation.response
    assert session.config().scene.speed_rpm == 3100
    assert other.config().scene.speed_rpm == 2800
    other.close()


def test_search_can_be_cancelled_and_its_design_is_taken(session, monkeypatch):
    design = {"pressure_angle_deg": 40.0}
    optimum = dataclasses.replace(session.next(NewMotion, session.move({SPEED: 3020.0})).evaluation,
                                  design=design)  # fmt: skip
    found = Optimization(None, optimum, optimum, [], {}, interrupted=True)

    def search(config, progress, stop):
        assert config.scene.speed_rpm == 3010
        progress(1, 9, 0.9)
        assert stop.wait(60)
        return found

    monkeypatch.setattr(sessions, "optimize_design", search)
    number = session.move({SPEED: 3010.0})
    session.optimize()
    assert session.next(sessions.Progress, number).best == 0.9
    session.cancel()
    while not isinstance(message := session.messages.get(timeout=60), Searched):
        pass
    assert message.values == {"profile.pressure_angle_deg": 40.0}
    assert not session.searching.is_set()


def test_search_without_design_parameters_says_why(engine):
    made = Told(Engine(load(ROOT / "configs" / "ee.yaml")))
    made.engine.ready.set()
    made.optimize()
    while not isinstance(message := made.messages.get(timeout=60), Searched):
        pass
    assert "has no design parameter" in message.words
    made.close()


@pytest.fixture(scope="module")
def address(engine):
    from rootsopt.explore.server import PageServer

    found, up, stop = [], threading.Event(), threading.Event()

    def serve():
        PageServer(engine, "cic").run(stop, lambda url: (found.append(url), up.set()))

    thread = threading.Thread(target=serve)
    thread.start()
    assert up.wait(60)
    yield found[0]
    stop.set()
    thread.join(30)


@pytest.fixture
def page(address, tmp_path):
    """Return a browser that shows the page, once its numbers are there."""
    made = Browser(tmp_path)
    try:
        made.open(address)
        shown(made, "motion 0")
        yield made
    finally:
        made.close()


MODEL = "const model = name => Bokeh.documents[0].get_model_by_name(name); "
LOADED = "if (!(window.Bokeh && Bokeh.documents.length)) return false; "


def shown(page, mark, seconds=120):
    """Wait until the numbers with this `mark` are shown."""
    code = LOADED + MODEL + "const m = model('mark'); return m && m.text === arguments[0];"
    page.wait(code, mark, seconds=seconds)


def read(page):
    """Return what the page shows: outline, forces, texts."""
    return page.run(
        MODEL
        + """
        const list = x => Array.from(x);
        return {
          outline: list(model("outline_now").data.x), force: list(model("force_now").data.drive),
          numbers: model("force_text").text, geometry: model("geometry_text").text,
          gradient: model("gradient_text").text, status: model("status_text").text,
          field: model("field profile.pressure_angle_deg").value, pose: model("pose").text,
          wide: document.documentElement.scrollWidth,
          outside: performance.getEntriesByType("resource").map(one => one.name)
            .filter(name => !name.startsWith(location.origin) && !name.startsWith("data:")),
        };"""
    )


def test_dragged_slider_moves_outline_force_and_numbers(page):
    """A drag with the mouse changes all that is shown, without a word on the console.

    The page loads nothing from elsewhere, and is not wider than the window."""
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
    share = (36.43 - 25) / (45 - 25)
    page.drag(left + share * width, top + height / 2, 0.1 * width)
    page.wait(MODEL + "return model('field profile.pressure_angle_deg').value > 37;")
    page.wait("return window.rootsoptDelay > 0;")
    page.wait(MODEL + "return model('status_text').text.includes('the motion is the same');")
    after = read(page)
    for key in ("outline", "force", "numbers", "geometry", "gradient"):
        assert after[key] != before[key], key
    assert len(after["force"]) > 100
    assert "drive flank" in after["pose"]
    assert after["outside"] == []
    assert after["wide"] <= 1400
    assert [line for line in page.console() if not line.startswith("INFO")] == []


def test_values_that_do_not_fit_show_no_old_numbers(page):
    before = read(page)
    page.run(MODEL + f"model('field {TIP}').value = 31;")
    page.wait(MODEL + "return model('mark').text.startsWith('problem');")
    after = read(page)
    assert "must be less than 30" in after["status"]
    assert after["force"] == []
    assert "–" in after["numbers"].split("</td>")[1]
    assert after["outline"] == before["outline"]  # faded
    page.run(MODEL + f"model('field {TIP}').value = 4;")
    page.wait(MODEL + "return model('mark').text.startsWith('motion');")
    assert read(page)["force"] != []


def test_button_saves_a_config(page, tmp_path):
    page.run(MODEL + f"model('field {SPEED}').value = 2950;")
    page.wait(MODEL + "return model('mark').text.startsWith('motion ');")
    page.wait("return window.rootsoptDelay > 0;")
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
    (first,) = page.tabs()
    second = page.tab()
    page.switch(second)
    page.open(address)
    shown(page, "motion 0")
    page.run(MODEL + f"model('field {SPEED}').value = 2500;")
    shown(page, "motion 1")
    other = read(page)
    page.switch(first)
    assert page.run(MODEL + f"return model('field {SPEED}').value;") == 3000
    assert read(page)["numbers"] != other["numbers"]
