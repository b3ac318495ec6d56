"""Makes the HTML of pages, and of pictures, texts and tables of the explorer.

The report of a run opens without a network: it is a Jinja2 template, and Bokeh's script is part of
it. Everything that comes from a config or a result is escaped."""

import base64
import dataclasses
import datetime
import functools
import html
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jinja2
import numpy as np
from bokeh.embed import json_item
from bokeh.models import ColumnDataSource, DataRange1d, Range1d, Span
from bokeh.resources import Resources
from markupsafe import Markup, escape
from numpy.typing import NDArray

import rootsopt
from rootsopt.config.reading import Config
from rootsopt.response.result import RESPONSES, Evaluation, Series
from rootsopt.status import Status
from rootsopt.view import tables
from rootsopt.view.figures.style import BLUE, GREY, SKY, VERMILION
from rootsopt.view.names import Table, brief, in_words, name_and_unit, percent
from rootsopt.view.pages import charts, gather
from rootsopt.view.pages.knobs import Knob, Shape
from rootsopt.view.pages.session import FromRest, NewMotion, Progress, Searched

if TYPE_CHECKING:
    from rootsopt.optimize.outcome import Optimization


# Folder with the templates, styles and scripts of the report and of the explorer.
_FOLDER = Path(__file__).parent

# Captions of the figures by file name; other figures are named after their file.
_CAPTIONS = {
    "profiles.png": "Rotor profile, and its flank",
    "meshing.png": "The pair at six rotations of one lobe pitch",
    "conjugacy.png": "Gap between the flanks of the outline in perfect rolling",
    "force.png": "Contact force over time",
    "spectrum.png": "Spectrum of the contact force",
    "gap.png": "Gap of the flanks over time",
    "comparison.png": "Forces together, and departure of the flanks",
    "history.png": "Objective and design over the search",
    "speeds.png": "Contact force over speed",
    "basins.png": "Initial states and the motion that each leads to",
    "front.png": "Best compromises",
    "identified.png": "Record and fit, orders, and regions of the quantities",
    "tolerances.png": "Forces in fresh scenes that scatter",
    "feasible.png": "Designs that satisfy all limits",
    "assumptions.png": "Objective over what is assumed about the scene",
}
_CODE = re.compile(r"`([^`]*)`")

# Spaces between a number and its unit, where a line must not break.
_UNIT = re.compile(r"(?<=\d) (?=(?:N·m|N|%|mm|µm|ms|rpm|bar|Pa|kPa|mrad|l/min)(?![\w/]))")


@functools.cache
def _environment() -> jinja2.Environment:
    made = jinja2.Environment(
        loader=jinja2.FileSystemLoader(_FOLDER / "report"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    made.filters |= {
        "anchor": gather.anchor, "coded": _coded, "command": _command, "linked": gather.linked
    }  # fmt: skip
    made.policies["json.dumps_kwargs"] = {}  # Bokeh reads its models in the order of writing.
    return made


def _coded(text: str) -> Markup:
    """Return a sentence with `commands` set as code, and numbers beside their units."""
    text = _UNIT.sub("\N{NO-BREAK SPACE}", text)
    return Markup(_CODE.sub(lambda match: _command(Markup(match[1])), str(escape(text))))


def _command(text: str) -> Markup:
    """Return the HTML of a command, whose options are not divided at their hyphens."""
    parts = str(escape(text)).split(" ")
    kept = (f'<span class="word">{x}</span>' if x.startswith("-") else x for x in parts)
    return Markup(f"<code>{' '.join(kept)}</code>")


def table_html(table: Table | None) -> str:
    """Return a table as HTML; "" for None."""
    made: Any = _environment().get_template("table.html.j2").module
    return "" if table is None else str(made.table(table))


def part(*names: str) -> str:
    """Return files of the folders `report` and `explore`, one after the other, as they are."""
    return "\n".join((_FOLDER / name).read_text("utf-8") for name in names)


def report_text(run: gather.Run) -> str:
    """Return the HTML of the report of a `run`. Characters that UTF-8 lacks become `?`."""
    drawn = _charts(run)
    items = [json_item(one, f"chart-{k}", charts.THEME) for k, (*_, one) in enumerate(drawn)]
    status = tables.status_cell(str(run.result.get("status", "")))
    animation = charts.animations(run.cases)
    page = _environment().get_template("page.html.j2")
    text = page.render(
        data={"charts": items, "animation": animation},
        style=Markup(part("report/page.css", "report/pair.css")),
        script=Markup(part(*(f"report/{name}.js" for name in ("charts", "pair", "page")))),
        bokeh=Markup(Resources("inline", components=["bokeh"]).js_raw[0]) if items else "",
        title=gather.title(run),
        run=run,
        command_line=f"rootsopt {run.command} {run.source}",
        version=rootsopt.__version__,
        day=datetime.date.today().isoformat(),
        status=status,
        good=run.usable and status.good is not False,
        asked=gather.asked(run),
        end=run.end,
        conflict=tables.conflict_table(run.result),
        sections=tables.sections(run.result, run.rows),
        charts=[(title, note) for title, note, _ in drawn],
        animation=animation,
        pair=Markup(part("report/pair.html")),
        figures=[
            {
                "caption": _CAPTIONS.get(name, in_words(name.removesuffix(".png")).capitalize()),
                "data": base64.b64encode(data).decode(),
            }
            for name, data in run.figures.items()
        ],
        statuses=tables.status_table(run.result, run.config),
        effort=tables.effort_table(run.result),
        glossary=gather.glossary(),
    )
    return text.encode("utf-8", "replace").decode("utf-8")


def _charts(run: gather.Run) -> list[tuple[str, str, Any]]:
    """Return (title, explanation, chart) of each interactive chart of a run."""
    hover = "Hover over a point to see its design."
    entries = [(title, hover, made) for title, made in charts.front_charts(run.result)]
    note = (
        "Hover for values, drag to zoom; a button at the right zooms out. A click moves the rotors "
        "below to that time."
    )
    entries.append(("Contact force over time", note, charts.force_chart(run.cases)))
    return [one for one in entries if one[2] is not None]


# The models of Bokeh accept more than their annotations say.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportCallIssue=false


class ProfilePicture:
    """The outline of a rotor over the one at the start."""

    def __init__(self) -> None:
        ranges = [DataRange1d(range_padding=0.03) for _ in range(2)]
        self.figure = charts.chart(
            "x (mm)", "y (mm)", 285, tools="", toolbar_location=None, match_aspect=True,
            x_range=ranges[0], y_range=ranges[1], title="Profile, start dashed",
        )  # fmt: skip
        empty: dict[str, list[float]] = {"x": [], "y": []}
        self.now = ColumnDataSource(empty, name="outline_now")
        self.before, self.pitch = ColumnDataSource(empty), ColumnDataSource(empty)
        self.ends = ColumnDataSource({"x": [-1.0, 1.0], "y": [-1.0, 1.0]})
        self._reach = 0.0
        line = {"line_color": "#111111", "line_width": 1.5}
        self.figure.patch("x", "y", source=self.now, fill_color=SKY, fill_alpha=0.35, **line)
        dashes = {"line_dash": [5, 3], "line_width": 1.2}
        self.figure.line("x", "y", source=self.before, line_color=VERMILION, **dashes)
        self.figure.line("x", "y", source=self.pitch, line_color=GREY, line_dash=[2, 3])
        frame = self.figure.scatter("x", "y", source=self.ends, alpha=0)
        for one in ranges:
            one.renderers = [frame]

    def draw(self, shape: Shape) -> None:
        """Draw the outline of a shape with its pitch circle. The first one is that of the start."""
        outer, radius = shape.pair["rotor"]["outer"], shape.pair["rotor"]["pitch"]
        if not 0.7 * self._reach < outer <= self._reach:  # Small changes do not move the axes.
            self._reach = 1.08 * outer
            self.ends.data = {"x": [-self._reach, self._reach], "y": [-self._reach, self._reach]}
        self.now.data = _points(shape.outline)
        if not len(self.before.data["x"]):
            self.before.data = _points(shape.outline)
        turn = np.linspace(0, 2 * np.pi, 181)
        self.pitch.data = _points(radius * np.stack([np.cos(turn), np.sin(turn)], -1))


def _points(outline: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
    return {"x": outline[:, 0], "y": outline[:, 1]}


class ForcePicture:
    """The contact force over time, over that at the start."""

    def __init__(self) -> None:
        self.figure = charts.chart(
            "time (ms)", "contact force (N)", 265, tools="xpan,xwheel_zoom,reset",
            x_range=Range1d(0, 1), y_range=Range1d(0, 1), title="Contact force over time",
        )  # fmt: skip
        empty: dict[str, list[float]] = {"time": [], "drive": [], "coast": [], "total": []}
        self.now = ColumnDataSource(empty, name="force_now")
        self.before = ColumnDataSource(empty)
        for name, color in (("drive", BLUE), ("coast", VERMILION)):
            style = {"line_color": color, "line_width": 1.8, "legend_label": f"{name} flank"}
            line = self.figure.line("time", name, source=self.now, **style)
            if name == "drive":
                fields = {"time": "@time{0.00} ms"}
                fields |= {side: f"@{side}{{0.0}} N" for side in ("drive", "coast")}
                charts.hover(self.figure, [line], fields, mode="vline")
        style = {"line_color": GREY, "line_width": 1.2, "line_dash": [5, 3]}
        self.figure.line("time", "total", source=self.before, level="underlay",
                         legend_label="at start, both flanks", **style)  # fmt: skip
        self.mean = Span(location=0, dimension="width", line_color="#111111", line_dash=[2, 3],
                         visible=False)  # fmt: skip
        self.cursor = Span(location=0, dimension="height", line_color="#8a9aa5", name="cursor",
                           syncable=False, visible=False)  # fmt: skip
        for span in (self.mean, self.cursor):
            self.figure.add_layout(span)

    def draw(self, series: Series, response: Mapping[str, float], start: bool) -> None:
        """Draw the forces of a motion, and their mean (dotted); `start`: that of the start."""
        time = 1e3 * (series.time - series.time[0])
        data = {"time": time, "drive": series.drive_force, "coast": series.coast_force,
                "total": series.force}  # fmt: skip
        if start:
            self.before.data = data
        self.now.data = data
        shown = [source.data for source in (self.now, self.before) if len(source.data["time"])]
        self.figure.x_range.end = max(float(one["time"][-1]) for one in shown)
        self.figure.y_range.end = 1.06 * max(float(np.max(one["total"])) for one in shown) or 1.0
        mean = response.get("mean_force_N")
        self.mean.location = 0.0 if mean is None else mean
        self.mean.visible, self.cursor.visible = mean is not None, True
        self.figure.title.text = "Contact force over time (dotted: mean)"

    def clear(self, words: str) -> None:
        """Remove the forces; `words`: why there are none."""
        self.now.data = {name: [] for name in self.now.data}
        self.mean.visible = self.cursor.visible = False
        self.figure.title.text = f"Contact force over time: {words}"


# Numbers on the kind of motion that the page shows.
_STEADY = "period", "floquet_multiplier", "lyapunov_exponent_per_mesh_period"


def numbers_table(now: Mapping[str, Any], first: Mapping[str, Any]) -> str:
    """Return the table of forces, geometry and kind of motion, at the start and now.

    `now`, `first`: records as in the result file, perhaps without some entries: their numbers are
    dashes."""
    table = tables.numbers_table({"baseline": _shown(first), "optimized": _shown(now)})
    heads = "", "at start", "now", "change"
    return table_html(table and dataclasses.replace(table, title="Numbers", heads=heads))


def _shown(record: Mapping[str, Any]) -> dict[str, Any]:
    steady = {key: record.get("steady_state", {}).get(key) for key in _STEADY}
    shown = {key: record[key] for key in ("geometry", "response", "status") if key in record}
    return {"design": {}, "steady_state": {key: x for key, x in steady.items() if x}} | shown


def gradient_table(config: Config, evaluation: Evaluation | None) -> str:
    """Return the table of the derivatives of the forces, per unit of each design parameter."""
    if not config.design_keys:
        words = f"The family {html.escape(config.profile.family)} has no design parameters."
        return f'<p><b>Gradient</b></p><p class="note">{words}</p>'
    unknown = dict.fromkeys(config.design_keys)
    known = None if evaluation is None else evaluation.gradient
    gradient = known or {name: unknown for name in RESPONSES}
    return table_html(next(tables.gradient_tables({"design": unknown, "gradient": gradient})))


def status_line(word: str, kind: str, words: str, note: str = "") -> str:
    """Return the line with a status: its `word`, `kind` (good, bad, wait), advice and a note."""
    text = f'<span class="word {kind}">{html.escape(word)}</span><span>{html.escape(words)}</span>'
    more = f'<span class="note">{html.escape(note)}</span>' if note else ""
    return f'<div class="status">{text}{more}</div>'


def notes_lines(notes: Iterable[str]) -> str:
    """Return the `notes` on values that are not usual, one to a line."""
    return "".join(f'<div class="note">{html.escape(note)}</div>' for note in notes)


def motion_line(motion: NewMotion, rest: FromRest | None) -> str:
    """Return the status of a motion, with whether it is the one that starts at rest.

    `rest`: the motion from rest; `None`: not known yet."""
    evaluation = motion.evaluation
    if not motion.final:
        words = "Near the motion of the last values, no steady motion was found."
        return status_line("searching", "wait", words, "Simulating from rest …")
    if not motion.near:
        note = "Reached from rest."
    elif rest is None:
        note = "Reached from the motion of the last values; from rest: being computed."
    elif rest.same:
        note = "Reached from the motion of the last values; from rest, the motion is the same."
    else:
        note = f"From rest, another motion is reached: {_summary(rest.evaluation)}."
    kind = "good" if evaluation.usable else "bad"
    words = evaluation.message
    if not evaluation.usable and evaluation.response and evaluation.status is not Status.IDLE:
        words += " The numbers below are those of this motion, without a gradient."
    return status_line(in_words(evaluation.status.label), kind, words, note)


def _summary(evaluation: Evaluation) -> str:
    mean, peak = (evaluation.response.get(key) for key in ("mean_force_N", "peak_force_N"))
    word = in_words(evaluation.status.label)
    if mean is None or peak is None:
        return word
    return f"{word}, mean {brief(mean, 4)} N, peak {brief(peak, 4)} N"


def progress_line(progress: Progress | None) -> str:
    """Return the state of a search that is running; `None`: nothing is simulated yet."""
    if progress is None:
        return status_line("optimising", "wait", "Simulating the baseline …")
    best = f"; best objective {progress.best:.4f}" if progress.best == progress.best else ""
    words = f"{progress.done} of at most {progress.expected} designs simulated{best}."
    return status_line("optimising", "wait", words)


def searched_line(ended: Searched) -> str:
    """Return the outcome of a search: improvement and certificate."""
    outcome = ended.outcome
    if outcome is None:
        return status_line("not optimised", "bad", ended.words)
    word = in_words(outcome.status.label)
    if outcome.optimized is None:
        reason = outcome.status.value if outcome.infeasible is None else outcome.infeasible.message
        return status_line(word, "bad", reason)
    if outcome.status is Status.PERIODIC:
        word = "optimum"
    gains = outcome.improvement.items()
    changes = (f"{name_and_unit(key)[0]} {percent(1, 1 - gain)}" for key, gain in gains)
    words = f"Against the start of the search: {', '.join(changes)}."
    return status_line(word, "good", words, _certified(outcome))


def _certified(outcome: "Optimization") -> str:
    """Return the certificate of an optimum: first-order conditions and active limits."""
    if outcome.optimality is None:
        return "Without a certificate."
    held = [in_words(row["name"]) for row in outcome.constraints if row.get("active")]
    limits = f" Limits that hold it: {', '.join(held)}." if held else ""
    return outcome.optimality.record()["message"] + limits


def knob_label(knob: Knob) -> str:
    """Return the label of a knob: name and unit, with its meaning as a tooltip."""
    tip = f"{knob.key}: {knob.help}" if knob.help else knob.key
    unit = f' <span class="unit">({html.escape(knob.unit)})</span>' if knob.unit else ""
    return f'<div class="label" title="{html.escape(tip)}">{html.escape(knob.name)}{unit}</div>'
