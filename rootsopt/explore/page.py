"""The page of the explorer: a Bokeh document that shows a session, one per browser tab."""

# The models of Bokeh accept more than their annotations say.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportCallIssue=false

import functools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from bokeh.core.templates import get_env
from bokeh.document import Document
from bokeh.models import Button, CustomJS, Div, NumericInput, Row, Slider
from bokeh.models.layouts import Column, LayoutDOM

import rootsopt
from rootsopt.explore import texts
from rootsopt.explore.engine import Engine, cut
from rootsopt.explore.knobs import Knob, knobs_of
from rootsopt.explore.pictures import ForcePicture, PairPicture, ProfilePicture
from rootsopt.explore.session import (
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

_TEMPLATE = Path(__file__).with_name("template")
_SLOW = 1.0
"""Time (s) of a computation above which the page says how long it has been running."""
_QUICK = 0.2
"""Time (s) of an evaluation below which the pair is drawn once, with its forces."""
_TICK = 250
"""Interval (ms) at which the page looks for slow computations, and fades numbers that are late."""
_FRESH, _FADED = {"opacity": "1"}, {"opacity": "0.35"}
"""Styles of numbers that belong to the present values, and of those that are late."""
_FIELD = ":host { font-size: 13px; } .bk-input { padding: 1px 6px; height: 24px; min-height: 0; }"
_BUTTON = ".bk-btn { padding: 3px 9px; font-size: 13px; }"
_DIGITS = 12
"""Significant digits of a value that a slider sets."""


def script(name: str, /, **arguments: Any) -> CustomJS:
    """Return the script `name` of the template folder, as a callback with these `arguments`."""
    return CustomJS(args=arguments, code=(_TEMPLATE / f"{name}.js").read_text("utf-8"))


@functools.cache
def _style() -> str:
    return (_TEMPLATE / "widgets.css").read_text("utf-8")


def text(content: str = "", name: str | None = None, **options: Any) -> Div:
    """Return an element that shows HTML, in the style of the page."""
    options = {"sizing_mode": "stretch_width", "margin": 0} | options
    return Div(text=content, name=name, stylesheets=[_style()], **options)


class Page:
    """Connects a Bokeh `document` with a session of its own.

    `engine`: shared by all pages; `source`: name of the config. Methods that change the document
    run in the thread of the server."""

    def __init__(self, document: Document, engine: Engine, source: str):
        self.document = document
        self.engine = engine
        self.source = source
        self.config = engine.given
        self.knobs = knobs_of(self.config)
        self.first: tuple[dict[str, float], Any] = ({}, None)
        self.motion: NewMotion | None = None
        self.rest: FromRest | None = None
        self.shape: NewShape | None = None
        self.problem: Problem | None = None
        self.progress: Progress | None = None
        self.cancelled = self.setting = self.closed = self.late = False
        self.before = -1  # number of the motion shown at the last tick
        self.saved = 0  # number of configs handed to the browser
        self.drawn = -1  # number of the shape of the pair that is drawn
        self._build()
        self.session = Session(engine, self.post)
        document.add_periodic_callback(self._tick, _TICK)

    def close(self) -> None:
        """End the session, when its tab has been closed."""
        self.closed = True
        self.session.close()

    def post(self, message: Message) -> None:
        """Show a message of the session; other threads call this."""
        if not self.closed:
            self.document.add_next_tick_callback(functools.partial(self._receive, message))

    # The models of the page

    def _build(self) -> None:
        self.status = text(name="status_text")
        self.notes = text(name="notes_text")
        self.search = text(name="search_text", visible=False)
        self.latency = text(name="latency_text", syncable=False)
        self.mark = Div(text="", visible=False, name="mark")
        self.file = Div(text="", visible=False, name="file")
        self.sliders: dict[str, Slider] = {}
        self.fields: dict[str, NumericInput] = {}
        self.profile, self.pair, self.force = ProfilePicture(), PairPicture(), ForcePicture()
        self.document.js_on_event("document_ready", self.pair.connect(self.force.cursor))
        self.geometry, self.forces = text(name="geometry_text"), text(name="force_text")
        self.gradient = text(name="gradient_text")
        stretch: dict[str, Any] = {"sizing_mode": "stretch_width", "margin": 0}
        roots: dict[str, LayoutDOM] = {
            "status": Column(self.status, self.notes, self.search, self.latency, **stretch),
            "buttons": self._buttons(),
            "controls": self._controls(),
            "profile": self.profile.root,
            "pair": self.pair.root,
            "force": self.force.root,
            "numbers": Column(self.geometry, self.forces, self.mark, self.file, **stretch),
            "gradient": Column(self.gradient, **stretch),
        }
        for name, root in roots.items():
            root.name = name
            self.document.add_root(root)
        self.mark.js_on_change("text", script("shown", mark=self.mark, latency=self.latency))
        name = f"{Path(self.source).stem}-explored.yaml"
        self.file.js_on_change("tags", script("save", file=self.file, name=name))
        heading = f"rootsopt explore {self.source}"
        self.document.title = heading
        self.document.template = get_env().from_string(
            (_TEMPLATE / "page.html.j2").read_text("utf-8")
        )
        self.document.template_variables.update(
            heading=heading,
            version=rootsopt.__version__,
            style=(_TEMPLATE / "page.css").read_text("utf-8"),
        )
        self._say(texts.status_line("preparing", "wait", "Computing the first profile …"))
        self._show_numbers()

    def _buttons(self) -> Row:
        self.optimize = Button(label="Optimise from here", button_type="primary", name="optimize")
        self.cancel = Button(label="Cancel", visible=False, name="cancel")
        self.save = Button(label="Save as YAML", name="save")
        self.from_rest = Button(label="Show from rest", disabled=True, name="from_rest")
        self.reset = Button(label="Back to start", name="reset")
        self.optimize.disabled = not self.config.design_keys
        self.optimize.on_click(self._optimize)
        self.cancel.on_click(self._cancel)
        self.save.on_click(lambda: self.session.save())
        self.from_rest.on_click(lambda: self.session.show_from_rest())
        self.reset.on_click(lambda: self._set({knob.key: knob.value for knob in self.knobs}))
        every = (self.optimize, self.cancel, self.save, self.from_rest, self.reset)
        for button in every:
            button.margin = (1, 2, 1, 2)
            button.stylesheets = [_BUTTON]
        return Row(*every, margin=0)

    def _controls(self) -> Column:
        rows: list[LayoutDOM] = []
        group = ""
        for knob in self.knobs:
            if knob.group != group:
                group = knob.group
                rows.append(text(f"<h2>{group}</h2>"))
            rows.append(self._row(knob))
        return Column(*rows, sizing_mode="stretch_width", margin=0)

    def _row(self, knob: Knob) -> Row:
        """Return label, slider and number field of a knob, in one row."""
        slider = Slider(
            value=knob.value, start=knob.low, end=max(knob.high, knob.low + knob.step),
            step=knob.step, title=None, show_value=False, tooltips=False, name=f"slider {knob.key}",
            sizing_mode="stretch_width", margin=(4, 10, 0, 10), bar_color="#9fc3d9",
        )  # fmt: skip
        limits = [one if np.isfinite(one) else None for one in (knob.least, knob.most)]
        field = NumericInput(
            value=int(knob.value) if knob.whole else knob.value,
            mode="int" if knob.whole else "float", low=limits[0], high=limits[1],
            width=78, margin=0, stylesheets=[_FIELD], name=f"field {knob.key}",
        )  # fmt: skip
        keep = script("knob", slider=slider, field=field)
        slider.js_on_change("value", keep)
        field.js_on_change("value", keep)
        field.on_change("value", functools.partial(self._moved, knob.key))
        self.sliders[knob.key], self.fields[knob.key] = slider, field
        label = text(texts.knob_label(knob), width=132, sizing_mode=None, align="center")
        return Row(label, slider, field, sizing_mode="stretch_width", margin=(0, 0, 1, 0))

    # What the user does

    def _moved(self, key: str, _: str, old: Any, new: Any) -> None:
        if new is None or self.setting:
            return
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
        self.progress, self.cancelled = None, False
        self.search.text = texts.progress_line(None, False)
        self.search.visible = True
        self._lock(True)
        self.session.optimize()

    def _cancel(self) -> None:
        self.cancelled = True
        self.search.text = texts.progress_line(self.progress, True)
        self.session.cancel()

    def _lock(self, locked: bool) -> None:
        """Lock the sliders during a search, whose result they take."""
        self.cancel.visible = locked
        for one in (self.optimize, self.save, self.reset):
            one.disabled = locked
        for one in (*self.sliders.values(), *self.fields.values()):
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
        if isinstance(message, Problem):
            self._take_problem(message)
        elif isinstance(message, NewShape) and not refused:
            self._take_shape(message)
        elif isinstance(message, NewMotion) and not refused:
            self._take_motion(message)
        elif isinstance(message, FromRest) and not refused:
            self.rest = message
            self.from_rest.disabled = message.same
            if self.motion is not None and self.motion.number == message.number:
                self._say(texts.motion_line(self.motion, message))
        elif isinstance(message, Progress):
            self.progress = message
            if not self.cancelled:
                self.search.text = texts.progress_line(message, False)
        elif isinstance(message, Searched):
            self._lock(False)
            self.search.text = texts.searched_line(message)
            if message.values:
                self._set(dict(message.values))
        elif isinstance(message, Saved):
            self.file.text = message.text
            self.saved += 1
            self.file.tags = [self.saved]

    def _take_problem(self, problem: Problem) -> None:
        if self.problem is not None and problem.number < self.problem.number:
            return
        self.problem, self.motion, self.rest = problem, None, None
        drawn = self.shape is not None and self.shape.number == problem.number
        if not drawn:
            self.profile.dim(True)
            self.pair.dim(True)
        self.notes.text = ""
        self.force.clear("no motion")
        self._show_numbers(drawn)
        self._fresh(True)
        self._say(texts.status_line("not valid", "bad", problem.words))
        self.mark.text = f"problem {problem.number}"

    def _take_shape(self, message: NewShape) -> None:
        self.shape, self.problem = message, None
        self.notes.text = texts.notes_lines(message.notes)
        radius = self._radius()
        if not self.first[0]:
            self.first = message.shape.record, None
            self.profile.start(message.shape.outline)
        for picture in (self.profile, self.pair):
            picture.dim(False)
        self.profile.draw(message.shape.outline, radius)
        if not self._quick:
            self._draw_pair()
        if self.motion is None:
            self.pair.move(message.shape.poses)
        self._show_geometry()

    def _take_motion(self, motion: NewMotion) -> None:
        if self.motion is not None and motion.number < self.motion.number:
            return
        self.motion = motion
        self.rest = None if self.rest and self.rest.number != motion.number else self.rest
        found = motion.evaluation
        self._draw_pair()
        if self.first[1] is None and motion.final:
            self.first = self.first[0], found
            if found.series is not None:
                self.force.start(cut(found.series))
        if motion.poses is not None:
            self.pair.move(motion.poses)
        elif self.shape is not None:
            self.pair.move(self.shape.shape.poses)
        if found.series is None:
            self.force.clear("no motion to show")
        else:
            self.force.draw(cut(found.series), found.response)
        self._show_forces()
        self._fresh(True)
        self.from_rest.disabled = True
        self._say(texts.motion_line(motion, self.rest))
        self.mark.text = f"motion {motion.number}"

    # What is shown

    @property
    def _quick(self) -> bool:
        """Whether the motion is likely to follow the shape at once, and the pair with it."""
        motion = self.motion
        return motion is not None and motion.evaluation.statistics["seconds"] < _QUICK

    def _draw_pair(self) -> None:
        shape = self.shape
        if shape is not None and shape.number != self.drawn:
            self.drawn = shape.number
            self.pair.draw(shape.shape, self._radius(), self._error())

    def _radius(self) -> float:
        key = "profile.pitch_radius_mm"
        return self.session.values.get(key, self.config.profile.pitch_radius_mm)

    def _error(self) -> float:
        key = "scene.center_distance_error_mm"
        return self.session.values.get(key, self.config.scene.center_distance_error_mm or 0.0)

    def _say(self, line: str) -> None:
        self.status.text = line

    def _show_numbers(self, drawn: bool = False) -> None:
        if not drawn:
            self.geometry.text = texts.geometry_table({}, self.first[0])
        self._show_forces()

    def _show_geometry(self) -> None:
        record = {} if self.shape is None else self.shape.shape.record
        self.geometry.text = texts.geometry_table(record, self.first[0])

    def _show_forces(self) -> None:
        now = None if self.motion is None else self.motion.evaluation
        self.forces.text = texts.force_table(now, self.first[1])
        self.gradient.text = texts.gradient_table(self.config, now, self.knobs)

    def _fresh(self, fresh: bool) -> None:
        """Fade forces and gradient unless they belong to the present values."""
        styles = _FRESH if fresh else _FADED
        faded: Sequence[LayoutDOM] = (self.forces, self.gradient, self.force.figure)
        for one in faded:
            if one.styles != styles:
                one.styles = styles

    def _tick(self) -> None:
        """Fade late numbers, and say how long a slow computation has been running."""
        seconds = self.session.seconds
        shown = self.motion.number if self.motion is not None else -1
        late = self.shape is not None and self.problem is None and shown < self.shape.number
        self._fresh(not (late and self.late and shown == self.before))
        self.late, self.before = late, shown
        if late:
            self._draw_pair()
        if self.closed or seconds < _SLOW:
            return
        if not self.engine.ready.is_set():
            words = (
                "Compiling the programs for this kind of pair. The first time takes one to several "
                f"minutes, later starts some seconds ({seconds:.0f} s so far)."
            )
            self._say(texts.status_line("preparing", "wait", words))
        else:
            words = (
                f"Computing for {seconds:.0f} s. A new number of lobes, or a twist where there was "
                "none, needs other programs, which are compiled first."
            )
            self._say(texts.status_line("computing", "wait", words))


__all__ = ["Page"]
