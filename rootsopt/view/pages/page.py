"""The page of the explorer: a Bokeh document that shows a session, one per browser tab."""

# The models of Bokeh accept more than their annotations say.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportCallIssue=false

import functools
import itertools
import json
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from bokeh.core.templates import get_env
from bokeh.document import Document
from bokeh.models import Button, CustomJS, Div, NumericInput, Row, Slider
from bokeh.models.layouts import Column, LayoutDOM

from rootsopt.view.pages import html
from rootsopt.view.pages.charts import THEME
from rootsopt.view.pages.knobs import Engine, Knob, cut, knobs_of
from rootsopt.view.pages.session import (
    FromRest,
    Message,
    NewMotion,
    NewShape,
    Problem,
    Progress,
    Saved,
    Searched,
    Session,
)

# Time (s) of a computation above which the page says how long it has been running.
_SLOW = 1.0

# Interval (ms) at which the page looks for slow computations, and fades numbers that are late.
_TICK = 250
_FIELD = ":host { font-size: 13px; } .bk-input { padding: 1px 6px; height: 24px; min-height: 0; }"
_BUTTON = ".bk-btn { padding: 3px 9px; font-size: 13px; }"

# Significant digits of a value that a slider sets.
_DIGITS = 12


def script(name: str, /, **arguments: Any) -> CustomJS:
    """Return the script `name` of the page, as a callback with these `arguments`."""
    return CustomJS(args=arguments, code=html.part(f"explore/{name}.js"))


def text(content: str = "", name: str | None = None, **options: Any) -> Div:
    """Return an element that shows HTML, in the style of the page."""
    options = {"sizing_mode": "stretch_width", "margin": 0} | options
    return Div(text=content, name=name, stylesheets=[html.part("explore/widgets.css")], **options)


def fade(models: Sequence[LayoutDOM], faded: bool) -> None:
    """Fade elements that do not belong to the present values, or show them again."""
    styles = {"opacity": "0.35" if faded else "1"}
    for one in models:
        if one.styles != styles:
            one.styles = styles


class Page:
    """Connects a Bokeh `document` with a session of its own.

    `engine`: shared by all pages; `source`: name of the config. Methods that change the document
    run in the thread of the server."""

    def __init__(self, document: Document, engine: Engine, source: str):
        self.document = document
        self.engine = engine
        self.knobs = knobs_of(engine.given)
        self.start: dict[str, Any] = {}  # record of the first values
        self.shape: NewShape | None = None
        self.motion: NewMotion | None = None
        self.rest: FromRest | None = None
        self.problem: Problem | None = None
        self.cancelled = self.setting = self.closed = self.late = False
        self.before = -1  # number of the motion shown at the last tick
        self._build(source)
        self.session = Session(engine, self.post)
        document.add_periodic_callback(self._tick, _TICK)
        document.on_session_destroyed(lambda _: self.close())

    def close(self) -> None:
        """End the session, when its tab has been closed."""
        self.closed = True
        self.session.close()

    def post(self, message: Message) -> None:
        """Show a message of the session; other threads call this."""
        if not self.closed:
            self.document.add_next_tick_callback(functools.partial(self._receive, message))

    # The models of the page

    def _build(self, source: str) -> None:
        self.status, self.notes, self.numbers, self.gradient = (
            text(name=f"{name}_text") for name in ("status", "notes", "numbers", "gradient")
        )
        self.search = text(name="search_text", visible=False)
        latency = text(name="latency_text", syncable=False)
        self.mark, self.file, self.pair = (
            Div(text="", visible=False, name=name) for name in ("mark", "file", "pair")
        )
        self.facts: dict[str, Any] = {}  # what `pair` holds
        self.sliders: dict[str, Slider] = {}
        self.fields: dict[str, NumericInput] = {}
        self.profile, self.force = html.ProfilePicture(), html.ForcePicture()
        stretch: dict[str, Any] = {"sizing_mode": "stretch_width", "margin": 0}
        hidden = (self.mark, self.file, self.pair)
        roots: dict[str, LayoutDOM] = {
            "status": Column(self.status, self.notes, self.search, latency, **stretch),
            "buttons": self._buttons(),
            "controls": Column(*self._controls(), **stretch),
            "profile": self.profile.figure,
            "force": self.force.figure,
            "numbers": Column(self.numbers, *hidden, **stretch),
            "gradient": Column(self.gradient, **stretch),
        }
        for name, root in roots.items():
            root.name = name
            self.document.add_root(root)
        draw = script("pair", data=self.pair, cursor=self.force.cursor)
        self.pair.js_on_change("text", draw)
        self.document.js_on_event("document_ready", draw)
        self.force.figure.js_on_event("tap", CustomJS(code="rootsoptView.seek(cb_obj.x)"))
        self.mark.js_on_change("text", script("shown", mark=self.mark, latency=latency))
        name = f"{Path(source).stem}-explored.yaml"
        self.file.js_on_change("tags", script("save", file=self.file, name=name))
        self.document.title = f"rootsopt explore {source}"
        self.document.theme = THEME
        self.document.template = get_env().from_string(html.part("explore/page.html.j2"))
        self.document.template_variables.update(
            heading=self.document.title,
            style=html.part("explore/page.css", "report/pair.css"),
            pair=html.part("report/pair.html"),
            script=html.part("report/pair.js"),
        )
        self.status.text = html.status_line("preparing", "wait", "Computing the first profile …")
        self._show_numbers()

    def _buttons(self) -> Row:
        self.optimize = Button(label="Optimise from here", button_type="primary", name="optimize")
        self.cancel = Button(label="Cancel", visible=False, name="cancel")
        self.save = Button(label="Save as YAML", name="save")
        self.from_rest = Button(label="Show from rest", disabled=True, name="from_rest")
        self.reset = Button(label="Back to start", name="reset")
        self.optimize.disabled = not self.engine.given.design_keys
        for button, work in (
            (self.optimize, self._optimize),
            (self.cancel, self._cancel),
            (self.save, lambda: self.session.save()),
            (self.from_rest, lambda: self.session.show_from_rest()),
            (self.reset, lambda: self._set({knob.key: knob.value for knob in self.knobs})),
        ):
            button.on_click(work)
            button.margin = (1, 2, 1, 2)
            button.stylesheets = [_BUTTON]
        return Row(self.optimize, self.cancel, self.save, self.from_rest, self.reset, margin=0)

    def _controls(self) -> Iterator[LayoutDOM]:
        """Yield the headings of the groups, and the knobs of each."""
        for group, knobs in itertools.groupby(self.knobs, key=lambda knob: knob.group):
            yield text(f"<h2>{group}</h2>")
            yield from map(self._row, knobs)

    def _row(self, knob: Knob) -> Row:
        """Return label, slider and number field of a knob, in one row."""
        slider = Slider(
            value=knob.value, start=knob.low, end=max(knob.high, knob.low + knob.step),
            step=knob.step, title=None, show_value=False, tooltips=False, name=f"slider {knob.key}",
            sizing_mode="stretch_width", margin=(4, 10, 0, 10), bar_color="#9fc3d9",
        )  # fmt: skip
        limits = [one if math.isfinite(one) else None for one in (knob.least, knob.most)]
        field = NumericInput(
            value=int(knob.value) if knob.whole else knob.value,
            mode="int" if knob.whole else "float", low=limits[0], high=limits[1],
            width=78, margin=0, stylesheets=[_FIELD], name=f"field {knob.key}",
        )  # fmt: skip
        keep = script("knob", slider=slider, field=field)
        for one in (slider, field):
            one.js_on_change("value", keep)
        field.on_change("value", functools.partial(self._moved, knob.key))
        self.sliders[knob.key], self.fields[knob.key] = slider, field
        label = text(html.knob_label(knob), width=132, sizing_mode=None, align="center")
        return Row(label, slider, field, sizing_mode="stretch_width", margin=(0, 0, 1, 0))

    # What the user does

    def _moved(self, key: str, _: str, old: Any, new: Any) -> None:
        if new is not None and not self.setting:
            self.session.move({key: float(f"{new:.{_DIGITS}g}")})

    def _set(self, values: dict[str, float]) -> None:
        """Set sliders and fields to `values`, and compute once."""
        self.setting = True
        for key, value in values.items():
            if key in self.sliders:
                slider = self.sliders[key]
                slider.start, slider.end = min(slider.start, value), max(slider.end, value)
                slider.value = self.fields[key].value = value
        self.setting = False
        self.session.move(values)

    def _optimize(self) -> None:
        self.cancelled = False
        self.search.text = html.progress_line(None)
        self.search.visible = True
        self._lock(True)
        self.session.optimize()

    def _cancel(self) -> None:
        self.cancelled = True
        self.search.text = html.status_line(
            "stopping", "wait", "Checking the best design found so far …"
        )
        self.session.cancel()

    def _lock(self, locked: bool) -> None:
        """Lock the sliders during a search, whose optimum then sets them."""
        self.cancel.visible = locked
        buttons = self.optimize, self.save, self.reset
        for one in (*buttons, *self.sliders.values(), *self.fields.values()):
            one.disabled = locked

    # What the session says

    def _receive(self, message: Message) -> None:
        if self.closed:
            return
        self.document.hold("combine")
        try:
            self._take(message)
        finally:
            self.document.unhold()

    def _take(self, message: Message) -> None:
        refused = self.problem is not None and message.number < self.problem.number
        match message:
            case Progress():
                if not self.cancelled:
                    self.search.text = html.progress_line(message)
            case Searched():
                self._lock(False)
                self.search.text = html.searched_line(message)
                if message.values:
                    self._set(dict(message.values))
            case Saved():
                self.file.text = message.text
                self.file.tags = [*self.file.tags, message.number]
            case Problem() if not refused:
                self._take_problem(message)
            case NewShape() if not refused:
                self._take_shape(message)
            case NewMotion() if not refused:
                self._take_motion(message)
            case FromRest() if not refused:
                self.rest = message
                self.from_rest.disabled = message.same
                if self.motion is not None and self.motion.number == message.number:
                    self.status.text = html.motion_line(self.motion, message)

    def _take_problem(self, problem: Problem) -> None:
        self.problem, self.motion, self.rest = problem, None, None
        if self.shape is None or self.shape.number != problem.number:
            self.shape = None
            fade([self.profile.figure], True)
            self._tell_pair(dim=True)
        self.notes.text = ""
        self.force.clear("no motion")
        self._show_numbers()
        self.status.text = html.status_line("not valid", "bad", problem.words)
        self.mark.text = f"problem {problem.number}"

    def _take_shape(self, message: NewShape) -> None:
        self.shape, self.problem = message, None
        self.notes.text = html.notes_lines(message.notes)
        self.start.setdefault("geometry", message.shape.record)
        fade([self.profile.figure], False)
        self.profile.draw(message.shape)
        pair = message.shape.pair
        self._tell_pair(dim=False, **(pair if self.motion is None else {"rotor": pair["rotor"]}))
        self._show_numbers(self.late)

    def _take_motion(self, motion: NewMotion) -> None:
        if self.motion is not None and motion.number < self.motion.number:
            return
        self.motion = motion
        self.rest = self.rest if self.rest and self.rest.number == motion.number else None
        evaluation = motion.evaluation
        first = motion.final and "response" not in self.start
        if first:
            self.start |= evaluation.record()
        self._tell_pair(motion=motion.frames)
        if evaluation.series is None:
            self.force.clear("no motion to show")
        else:
            self.force.draw(cut(evaluation.series), evaluation.response, first)
        self._show_numbers()
        self.from_rest.disabled = True
        self.status.text = html.motion_line(motion, self.rest)
        self.mark.text = f"motion {motion.number}"

    # What is shown

    def _tell_pair(self, **facts: Any) -> None:
        """Send new `facts` (rotor, motion, dim) to the script that draws the pair."""
        self.facts |= facts
        self.pair.text = json.dumps(self.facts)

    def _show_numbers(self, faded: bool = False) -> None:
        now = None if self.motion is None else self.motion.evaluation
        record = {} if now is None else now.record()
        record |= {} if self.shape is None else {"geometry": self.shape.shape.record}
        self.numbers.text = html.numbers_table(record, self.start)
        self.gradient.text = html.gradient_table(self.engine.given, now)
        fade([self.numbers, self.gradient, self.force.figure], faded)

    def _tick(self) -> None:
        """Fade late numbers, and say how long a slow computation has been running."""
        seconds = self.session.seconds
        number = self.motion.number if self.motion is not None else -1
        late = self.shape is not None and self.problem is None and number < self.shape.number
        faded = late and self.late and number == self.before
        fade([self.numbers, self.gradient, self.force.figure], faded)
        self.late, self.before = late, number
        if self.closed or seconds < _SLOW:
            return
        if not self.engine.ready.is_set():
            words = (
                "Compiling the programs for this kind of pair. The first time takes one to several "
                f"minutes, later starts some seconds ({seconds:.0f} s so far)."
            )
            self.status.text = html.status_line("preparing", "wait", words)
        else:
            words = (
                f"Computing for {seconds:.0f} s. A new number of lobes, or a twist where there was "
                "none, needs other programs, which are compiled first."
            )
            self.status.text = html.status_line("computing", "wait", words)
