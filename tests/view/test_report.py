"""The report: its content, the escaping of text, and its behaviour in a browser."""

import dataclasses
import html as entities
import io
import json
import os
import re
import shlex
import subprocess

import numpy as np
import pytest
from browser import FLAGS, chromium
from rich.console import Console

from rootsopt.commands.table import explore, pareto, profile
from rootsopt.config import load
from rootsopt.response.records import message_of
from rootsopt.response.result import Series
from rootsopt.status import Status
from rootsopt.view import pages, tables, terminal
from rootsopt.view.files import ResultFolder, response_columns
from rootsopt.view.pages import charts
from rootsopt.view.pages.gather import Run, glossary, linked
from rootsopt.view.pages.html import report_text
from tests.commands.test_pareto import FEW

CIC = "cic_drawn"
HOSTILE = '</script><script>document.title = "taken"</script><b>&amp;'
SAMPLES, PITCHES = 240, 3


def motion():
    """Return three mesh periods with a known force on the drive flank and none on the other.

    The force is 50 + 30 cos(2 t) + 20 cos(5 t), with t from 0 to 2 π over one period."""
    phase = 2 * np.pi * np.arange(SAMPLES) * PITCHES / SAMPLES
    force = 50 + 30 * np.cos(2 * phase) + 20 * np.cos(5 * phase)
    none = np.zeros(SAMPLES)
    # A mesh frequency of 150 Hz.
    return Series(phase / (300 * np.pi), phase / 3, none - 1e-3, none, force, none, none)


def run_of(place, result, series=None, source="cic", usable=True, rows=()):
    folder = ResultFolder(place)
    folder.write_text("config.yaml", load(CIC).to_yaml())
    if series is not None:
        folder.write_csv("response_design.csv", response_columns(series))
    return Run(folder, result, source, usable, rows=rows)


def result_of(command="simulate", **more):
    design = dict(zip(load(CIC).design_keys, map(float, load(CIC).design), strict=True))
    slopes = dict(zip(design, (-7.0, 2.0, 1.0), strict=True))
    return {
        "design": design,
        "geometry": {"outer_radius_mm": 45.1, "area_efficiency": 0.43},
        "response": {"mean_force_N": 50.0, "peak_force_N": 100.0, "rms_force_N": 56.0},
        "gradient": {"mean_force_N": dict.fromkeys(design, 1.5), "peak_force_N": slopes},
        "steady_state": {"kind": "periodic", "period": 1, "floquet_multiplier": 0.1,
                         "residual": 1e-12},
        "statistics": {"seconds": 1.0},
        "status": "periodic",
        "message": Status.PERIODIC.value,
        "versions": {"numpy": "2"},
        "run": {"command": command},
    } | more  # fmt: skip


@pytest.fixture(scope="module")
def simulated(tmp_path_factory):
    """Return a run with a motion, whose command line and status name are hostile."""
    place = tmp_path_factory.mktemp("run")
    ResultFolder(place).write_bytes("figures/force.png", b"\x89PNG")
    note = "`rotor.helix_deg` is 1 °, which is unusual"
    result = result_of(message=f"Settled. {HOSTILE}", notes=[note])
    return run_of(place, result, motion(), source=HOSTILE)


@pytest.fixture(scope="module")
def page(simulated):
    return report_text(simulated)


def words_of(page):
    """Return the page's text, without scripts, styles, tags and unbreakable blanks."""
    page = re.sub(r'<span class="word">(.*?)</span>', r"\1", page)
    bare = re.sub(r"<(script|style).*?</\1>|</?(code|a)\b[^>]*>", "", page, flags=re.S)
    return " ".join(entities.unescape(re.sub(r"<[^>]*>", " ", bare)).split())


def report_of(*arguments, **more):
    return words_of(report_text(run_of(*arguments, **more)))


def data_of(page):
    (found,) = re.findall(r'<script type="application/json" id="data">(.*?)</script>', page, re.S)
    return json.loads(found)


def test_page_opens_without_a_network(page):
    """Nothing is loaded, and the page forbids its own scripts to load anything.

    The text of a run is no markup."""
    markup = re.sub(r"<script>.*?</script>", "", page, flags=re.S)
    assert not re.search(r"<(script|link|iframe)[^>]*(src|href)=", markup)
    assert {*re.findall(r'src="([^"]{,22})', markup)} == {"data:image/png;base64,"}
    assert "default-src 'none'" in markup
    assert HOSTILE not in page
    assert page.count("<script") == page.count("</script>") == 3
    assert words_of(page).count('document.title = "taken"') >= 2


def test_page_says_what_came_out_and_what_every_status_means(page, simulated):
    text = words_of(page)
    told = [
        "mean of 50 N and a peak of 100 N, 2 times the mean",
        "(1° more of pressure angle lowers the peak force by 7 N)",
        "the motion repeats every mesh period.",
        "timing gear with 0.1 mm backlash",
        "backlash_mm: 0.1",
        *(f"{one}: {other}" for one, other in (*simulated.end.facts, *simulated.end.steps)),
        *(status.label.replace("_", " ") for status in Status),
        *(message_of(load(CIC), status).replace("`", "") for status in Status),
    ]
    assert [words for words in told if words not in text] == []


def test_words_lead_to_their_meaning(page):
    """Mentions lead to the entry and show it; options, keys and other uses of a word do not."""
    entries = dict(re.findall(r'<dt id="(.*?)">(.*?)</dt>', page))
    assert {*entries.values()} == {*glossary()}
    assert len(entries) == len(glossary()) > 30
    links = re.findall(r'<a class="term" href="#(.*?)" title="(.*?)">(.*?)</a>', page)
    assert {word for *_, word in links} >= {"backlash", "mesh period", "Floquet multiplier"}
    for where, meaning, _ in links:
        assert entities.unescape(meaning) == glossary()[entries[where]]
    shown = linked("<th>order (°)</th><th>orders</th> in order, objective.motion <a>land</a> Land")
    assert re.findall(r"#word-(\w+)", shown) == ["order", "land"]
    code = "<code>backlash</code><i title='orbit'>"
    assert linked(code) == code


def test_force_is_drawn_over_milliseconds(simulated):
    """Three periods of a mesh frequency of 150 Hz take 20 ms."""
    chart = charts.force_chart(simulated.cases)
    drive, mean, coast = (one.data_source.data for one in chart.renderers)
    assert drive["x"][[0, -1]] == pytest.approx([0, 20 * (1 - 1 / SAMPLES)], rel=1e-5, abs=0)
    assert drive["y"][0] == pytest.approx(100)
    assert [*mean["y"]] == [50, 50]
    assert not np.any(coast["y"])


def test_animation_shows_forces_and_turns_one_period(page):
    animation = data_of(page)["animation"]
    (case,), (rotor,) = animation["cases"], animation["rotors"]
    drive, coast = case["forces"]
    assert (rotor["lobes"], rotor["outer"]) == (3, pytest.approx(45.1029, abs=1e-3))
    assert len(case["rotation"]) == len(drive) == len(case["time"]) == 40
    assert case["rotation"][-1] - case["rotation"][0] == pytest.approx(117, abs=2)
    assert max(drive) == pytest.approx(100, rel=1e-3)
    assert {*coast} == {0}
    assert case["relative"][0] == pytest.approx(-1)


def test_run_without_a_result_says_why(tmp_path):
    """A run with exit code 3 shows the reason and the advice, and no empty charts.

    The table of statuses gives the same advice, for the scene of the run: it has a timing gear."""
    status = Status.PASSED_THROUGH
    bare = {"response": {}, "gradient": {}, "steady_state": {"kind": "transient"}}
    message = message_of(load(CIC), status)
    given = result_of(status=status.label, message=message) | bare
    page = report_text(run_of(tmp_path, given, usable=False))
    text, data = words_of(page), data_of(page)
    assert "Passed through: The lobes passed through each other" in text
    assert f"What to do next {message.partition('. ')[2]}" in text
    assert message in text
    assert "Add a scene.timing_gear" not in text
    assert "✗" not in text  # drawn by the style, not read out twice
    assert data["charts"] == []
    assert data["animation"]["cases"][0]["forces"] is None
    assert len(page) < 1e6  # without the library


def test_names_that_are_no_text_are_shown(tmp_path):
    """The page shows file names that UTF-8 cannot hold, and scenes without a gear."""
    config = load(CIC, ["scene.timing_gear=null", "contact.friction={}"])
    folder = ResultFolder(tmp_path)
    folder.write_text("config.yaml", config.to_yaml())
    text = words_of(report_text(Run(folder, result_of(), "caf\udce9.yaml", True)))
    assert "caf?.yaml" in text
    assert "with friction between the flanks, without a timing gear" in text


@pytest.mark.parametrize(
    ("status", "usable", "mark"),
    [("periodic", True, "good"), ("not_converged", True, "bad"), ("chaotic", False, "bad")],
)
def test_header_marks_a_result_that_is_not_to_be_trusted(status, usable, mark, tmp_path):
    """And numbers stay with their units."""
    result = result_of(status=status, message="Yes. 5 N at 3000 rpm and 2 Newtons.")
    page = report_text(run_of(tmp_path, result, usable=usable))
    assert f'<span class="status {mark}">' in page
    assert "5\N{NO-BREAK SPACE}N at 3000\N{NO-BREAK SPACE}rpm and 2 Newtons" in page


@pytest.mark.parametrize(
    ("command", "source", "resumed"),
    [("optimize", "cic -o run", "cic -o run --resume"), ("sweep", "cic --resume", "cic --resume"),
     ("pareto", "cic", "cic --resume")],
)  # fmt: skip
def test_stopped_run_says_how_to_go_on(command, source, resumed, tmp_path):
    """A search that is stopped before anything is known has neither design nor numbers."""
    message = "The search was stopped after 2 designs. The best of them is reported."
    given = result_of(command, status="interrupted", message=message)
    if command == "optimize":
        known = "status", "message", "versions", "run"
        given = {"baseline": None, "optimized": None} | {key: given[key] for key in known}
    text = report_of(tmp_path, given, source=source, usable=False)
    assert f"Interrupted: {message}" in text
    assert f"Go on from where it stopped: rootsopt {command} {resumed}" in text


def test_optimum_is_reported_in_the_users_words(tmp_path):
    """The page shows prices of the limits, certificate, change against the baseline, pump sheet."""
    pump = {"displaced_volume_cm3": 541.7, "flow_lines": [0.08, 0.01]}
    less = {"mean_force_N": 40.0, "peak_force_N": 70.0, "rms_force_N": 45.0}
    before, after = result_of(pump=pump), result_of(pump=pump, response=less)
    limit = {"name": "area_efficiency", "sense": ">=", "limit": 0.43, "unit": "", "baseline": 0.44,
             "optimized": 0.43, "satisfied": True, "active": True, "multiplier": 2.0,
             "relaxed_by": -0.01, "relaxed_objective_percent": -2.63}  # fmt: skip
    optimality = {
        "converged": True, "reason": "converged", "message": "The first-order conditions hold.",
        "residual": 2e-11, "required_residual": 1e-4, "violation": 0.0, "method": "slsqp",
        "held_by": [], "optima": [{"objective": 0.8, "found": 2, "design": {}}],
        "starts": [{"start": 0, "reason": "converged", "evaluations": 9, "objective": 0.8}],
        "unseen": {"share_of_starts": 1.0},
    }  # fmt: skip
    given = {"baseline": before, "optimized": after, "improvement": {"objective": 0.2},
             "constraints": [limit], "optimality": optimality, "status": "periodic",
             "message": "Found.", "run": {"command": "optimize"}}  # fmt: skip
    text = report_of(tmp_path, given)
    assert "About 100 % of further starts" in text
    assert "displaced volume (cm³) 541.70 541.70 0.00 %" in text
    # The terminal shows the same tables, with the same facts.
    console = Console(width=80, file=io.StringIO(), record=True)
    shown = tables.tables_of(given)
    console.print(terminal.shown(shown))
    plain = console.export_text()
    cells = {cell.text for one in shown for _, rows in one.groups for row in rows for cell in row}
    assert len(cells) > 40
    assert [one for one in cells if " ".join(one.split()) not in text] == []
    assert [one for one in cells if terminal.ascii_text(one)[:20] not in plain] == []
    optimality |= {"converged": False, "reason": "evaluations", "message": "Raise iterations."}
    assert "The design is no optimum, so prices are rough." in report_of(tmp_path, given)


@pytest.mark.parametrize("command", ["optimize", "simulate", "profile"])
def test_advice_names_the_config_of_the_result(command, tmp_path):
    """Each file in an advised command can be read and holds the design that the page is about."""
    config, given = load(CIC), result_of(command)
    if command == "optimize":
        config = config.with_design([37.0, 8.0, 4.5])
        design = dict(zip(config.design_keys, config.design, strict=True))
        given = {"baseline": given, "optimized": result_of(design=design), "message": "Found.",
                 "status": "periodic", "run": {"command": command}}  # fmt: skip
        (tmp_path / "optimized.yaml").write_text(config.to_yaml())
    run = run_of(tmp_path, given)
    assert len(run.end.steps) >= 2
    for _, step in run.end.steps:
        np.testing.assert_array_equal(load(shlex.split(step)[2]).design, config.design)


def test_sweep_over_two_quantities(tmp_path):
    """The report says which quantities differ, and in how many scenes there is a steady state."""
    rows = [
        {"scene.speed_rpm": speed, "scene.timing_gear.backlash_mm": play, "mean_force_N": 10.0,
         "peak_force_N": speed * play, "status": "chaotic" if speed > 2000 else "periodic"}
        for play in (0.1, 0.2) for speed in (1000.0, 3000.0, 2000.0)
    ]  # fmt: skip
    rows[0] |= {"mean_force_N": None, "peak_force_N": None, "status": "passed_through"}
    rows[2] |= {"status": "averaged", "rms_force_N": float("nan")}
    run = run_of(tmp_path, result_of("sweep", status="chaotic"), rows=rows)
    text = words_of(report_text(run))
    assert "3 of 6 scenes have a steady state." in text
    assert "these differ: speed: 1000 rpm, 3000 rpm and 2000 rpm; backlash: 0.1 mm and 0.2" in text


def test_command_writes_a_report_of_a_run_without_a_result(tmp_path, capsys):
    """An infeasible front: exit code 3, with advice on the terminal, and with a report."""
    place = tmp_path / "run"
    limits = "--set=constraints={area_efficiency_min: 0.48, seal_width_min_mm: 25}"
    assert pareto.main([CIC, "-o", str(place), "--report", *FEW, limits]) == 3
    assert re.search("Infeasible: .*seal width", " ".join(capsys.readouterr().out.split()))
    result = json.loads((place / "result.json").read_text())
    assert (result["points"], pages.REPORT in result["run"]["files"]) == ([], True)
    assert {row["name"] for row in result["infeasible"]["conflicts"]} >= {"seal width"}
    text = words_of((place / pages.REPORT).read_text("utf-8"))
    told = "Infeasible: ", "Constraints in conflict", "seal width ≥ 25 mm"
    assert [words for words in told if words not in text] == []


@pytest.mark.parametrize(
    ("command", "options", "extra"),
    [
        (profile, ["-o", "run", "--report"], "pages"),
        (profile, ["-o", "run", "--export", "dxf,step"], "cad"),
        (explore, [], "explore"),
    ],
)
def test_missing_libraries_are_named(command, options, extra, tmp_path, monkeypatch, capsys):
    """The command ends before it computes, and says in one line what to install."""
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    monkeypatch.chdir(tmp_path)
    assert command.main([CIC, *options]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert f"pip install 'rootsopt[{extra}]'" in line
    assert os.listdir(tmp_path) == []


def test_failing_report_does_not_lose_the_run(tmp_path, monkeypatch, capfd):
    monkeypatch.setattr("rootsopt.view.pages.html.report_text", lambda run: 1 / 0)
    given = [CIC, "-o", str(tmp_path / "run"), "--report", "--no-figures", "--export", "none"]
    assert profile.main(given) == 0
    assert "division by zero" in capfd.readouterr().err
    assert {"result.json", pages.REPORT} & {*os.listdir(tmp_path / "run")} == {"result.json"}


def browsed(file, *options):
    """Return (standard output, console messages) of Chromium that shows a file.

    It runs headless with scripts, without a network and without a display."""
    command = [
        *(chromium(), *FLAGS, f"--user-data-dir={file.parent / 'profile'}"),
        *("--enable-logging=stderr", "--virtual-time-budget=8000", "--window-size=1280,900"),
        *(*options, file.as_uri()),
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)
    told = re.findall(r"^.*CONSOLE.*$", done.stderr, re.M)
    return done.stdout, [line for line in told if "[bokeh" not in line]  # Bokeh's own work


# A headless browser draws frames when it likes, so the page's frames are driven by a timer here.
_PROBE = """
<script>
window.requestAnimationFrame = step => setTimeout(() => step(performance.now()), 16);
window.cancelAnimationFrame = clearTimeout;
const probe = () => {
  if (document.querySelectorAll("#pair .rotor").length < 2) { setTimeout(probe, 50); return; }
  const seen = {};
  const pose = () => [...document.querySelectorAll("#pair .rotor")].map(one =>
    one.getAttribute("transform"));
  const slider = document.getElementById("frame");
  const turn = value => { slider.value = value; slider.dispatchEvent(new Event("input")); };
  turn(0);
  seen.first = pose();
  turn(10);
  seen.second = pose();
  seen.cursor = Bokeh.documents[0].get_model_by_name("cursor").location;
  seen.dots = [...document.querySelectorAll("#pair .contact")].map(one =>
    one.getAttribute("visibility"));
  document.getElementById("play").click();
  const clicked = performance.now();
  const wait = () => {
    seen.played = pose();
    const still = JSON.stringify(seen.played) === JSON.stringify(seen.second);
    if (still && performance.now() - clicked < 5000) { setTimeout(wait, 50); return; }
    document.getElementById("play").click();
    seen.plots = document.querySelectorAll(".plot > *").length;
    seen.wide = document.documentElement.scrollWidth;
    const out = document.createElement("pre");
    out.id = "seen";
    out.textContent = JSON.stringify(seen);
    document.body.append(out);
  };
  wait();
};
window.addEventListener("load", probe);
</script>
"""


@pytest.mark.parametrize("width", [1280, 800])
def test_slider_moves_the_rotors_in_a_browser(page, tmp_path, width):
    """Slider and button turn both rotors, in opposite senses.

    There is no message on the console, and nothing is wider than the window."""
    file = tmp_path / "page.html"
    file.write_text(page.replace("</body>", _PROBE + "</body>"), "utf-8")
    out, told = browsed(file, f"--window-size={width},900", "--dump-dom")
    assert told == []
    (found,) = re.findall(r'<pre id="seen">(.*?)</pre>', out)
    seen = json.loads(entities.unescape(found))
    turns = {
        name: [float(re.findall(r"rotate\((.*?)\)", pose)[0]) for pose in seen[name]]
        for name in ("first", "second", "played")
    }
    one, two = np.subtract(turns["second"], turns["first"])
    assert one == pytest.approx(-30, abs=1.6)  # a quarter of a pitch; SVG's y axis points down
    assert two == pytest.approx(one, abs=1e-6)
    assert seen["second"][1].startswith("translate(66) scale(-1 1)")
    assert turns["played"][0] != turns["second"][0]
    assert seen["dots"] == ["visible", "hidden"]
    assert seen["cursor"] == pytest.approx(1.75, abs=0.1)
    assert seen["plots"] >= 2
    assert seen["wide"] <= width
    assert "<title>taken</title>" not in out


def test_page_prints(page, tmp_path):
    file = tmp_path / "page.html"
    file.write_text(page, "utf-8")
    _, told = browsed(file, f"--print-to-pdf={tmp_path / 'page.pdf'}")
    assert told == []
    content = (tmp_path / "page.pdf").read_bytes()
    assert content.startswith(b"%PDF")
    assert len(re.findall(rb"/Type\s*/Page\b", content)) >= 4


def test_axes_are_drawn_where_they_are(simulated):
    """Two pitch radii of 33 mm and the error of the scene apart."""
    config = load(CIC, ["scene.center_distance_error_mm=0.25"])
    found = charts.animations([dataclasses.replace(simulated.cases[0], config=config, series=None)])
    assert found["rotors"][0]["center"] == 66.25
