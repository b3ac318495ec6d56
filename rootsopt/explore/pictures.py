"""The pictures of the explorer: profile, meshing pair, force over time."""

# The models of Bokeh accept more than their annotations say.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportCallIssue=false

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from bokeh.models import (
    ColumnDataSource,
    CustomJS,
    DataRange1d,
    Div,
    HoverTool,
    Legend,
    LegendItem,
    Range1d,
    Slider,
    Span,
    Toggle,
    VeeHead,
)
from bokeh.models.annotations import Arrow
from bokeh.models.layouts import Column, Row
from bokeh.plotting import figure
from numpy.typing import NDArray

from rootsopt.explore.engine import Poses, Shape
from rootsopt.figures.style import BLUE, GREY, ORANGE, SKY, VERMILION
from rootsopt.response.evaluation import Series

_TEMPLATE = Path(__file__).with_name("template")
_SIDES = {"drive": BLUE, "coast": VERMILION}
"""Flanks and their colours."""
_HEIGHT = 285
"""Height of the pictures of the rotors (pixels)."""
_SMALL = ".bk-btn { padding: 2px 8px; font-size: 12px; }"
_PLAY = """
window.clearInterval(window.rootsoptPlay);
cb_obj.label = cb_obj.active ? "Pause" : "Play";
if (cb_obj.active) window.rootsoptPlay = window.setInterval(() => {
  turn.value = (turn.value + 1) % poses.data.rotation.length;
}, 60);
"""


def _figure(title: str, height: int, **options: Any) -> Any:
    """Return a figure in the style of the page, without a toolbar."""
    made: Any = figure(
        title=title, height=height, sizing_mode="stretch_width", toolbar_location=None,
        margin=0, min_border_left=52, min_border_right=8, **options,
    )  # fmt: skip
    made.background_fill_color = made.border_fill_color = None
    made.outline_line_color = "#cfd6da"
    made.title.text_font_size = "13px"
    made.title.text_color = "#1a1a1a"
    for axis in made.axis:
        axis.axis_label_text_font_style = "normal"
        axis.axis_label_text_font_size = axis.major_label_text_font_size = "12px"
        axis.axis_label_text_color = axis.major_label_text_color = "#1a1a1a"
        axis.axis_label_standoff = 3
        axis.minor_tick_line_color = None
    made.grid.grid_line_color = "#e6eaec"
    return made


def _plan(title: str, ends: ColumnDataSource) -> Any:
    """Return a figure in mm with equal scales, whose ranges hold the points `ends`."""
    made = _figure(
        title, _HEIGHT, match_aspect=True, tools="",
        x_range=DataRange1d(range_padding=0.03), y_range=DataRange1d(range_padding=0.03),
        x_axis_label="x (mm)", y_axis_label="y (mm)",
    )  # fmt: skip
    frame = made.scatter("x", "y", source=ends, alpha=0)
    made.x_range.renderers = made.y_range.renderers = [frame]
    return made


def _corners(left: float, right: float, half: float) -> dict[str, list[float]]:
    return {"x": [left, right, left, right], "y": [-half, half, half, -half]}


def _circle(radius: float, x: float = 0.0) -> dict[str, NDArray]:
    angle = np.linspace(0, 2 * np.pi, 181)
    return {"x": x + radius * np.cos(angle), "y": radius * np.sin(angle)}


class _Plan:
    """Base of the pictures of the rotors: dimmed if what they show is not valid any more."""

    root: Column
    ends: ColumnDataSource
    _reach = 0.0

    def dim(self, dim: bool) -> None:
        """Fade the picture with all that belongs to it, or show it again."""
        styles = {"opacity": "0.3" if dim else "1"}
        if self.root.styles != styles:
            self.root.styles = styles

    def _hold(self, outer: float, center: float = 0.0) -> None:
        """Let the ranges hold rotors of this outer radius, without following small changes."""
        if not 0.7 * self._reach < outer + center <= self._reach:
            self._reach = 1.08 * (outer + center)
            edge = 1.08 * outer
            self.ends.data = _corners(-edge, center + edge, edge)


class ProfilePicture(_Plan):
    """The outline of a rotor over the one at the start."""

    def __init__(self) -> None:
        empty: dict[str, list[float]] = {"x": [], "y": []}
        self.ends = ColumnDataSource(_corners(-1, 1, 1))
        self.figure = _plan("Profile (dashed: at start)", self.ends)
        self.now, self.before = ColumnDataSource(empty), ColumnDataSource(empty)
        self.pitch, self._pitch_radius = ColumnDataSource(empty), 0.0
        self.now.name = "outline_now"
        line = {"line_color": "#111111", "line_width": 1.5}
        self.figure.patch("x", "y", source=self.now, fill_color=SKY, fill_alpha=0.35, **line)
        dashes = {"line_dash": [5, 3], "line_width": 1.2}
        self.figure.line("x", "y", source=self.before, line_color=VERMILION, **dashes)
        self.figure.line("x", "y", source=self.pitch, line_color=GREY, line_dash=[2, 3])
        self.root = Column(self.figure, sizing_mode="stretch_width", margin=0)

    def start(self, outline: NDArray[np.float64]) -> None:
        """Set the outline (n, 2) of the start (mm)."""
        self.before.data = {"x": outline[:, 0], "y": outline[:, 1]}

    def draw(self, outline: NDArray[np.float64], pitch_radius: float) -> None:
        """Draw an outline (n, 2) with its pitch circle (mm)."""
        self._hold(float(np.max(np.hypot(*outline.T))))
        self.now.data = {"x": outline[:, 0], "y": outline[:, 1]}
        if pitch_radius != self._pitch_radius:
            self._pitch_radius = pitch_radius
            self.pitch.data = _circle(pitch_radius)


class PairPicture(_Plan):
    """The meshing pair at a rotation that a slider chooses, with the forces on rotor 2."""

    def __init__(self) -> None:
        empty: dict[str, list[float]] = {"x": [], "y": []}
        self.ends = ColumnDataSource(_corners(-1, 1, 1))
        self.figure = _plan("Meshing pair, contact force on rotor 2", self.ends)
        self.outline, self.pitch = ColumnDataSource(empty), ColumnDataSource({"xs": [], "ys": []})
        self.facts = ColumnDataSource()
        self._facts = dict.fromkeys(("center", "lobes", "pitch", "longest"), 0.0)
        self._tell()
        self.poses = ColumnDataSource({"rotation": []}, name="poses")
        # What a script computes is not sent back to the server.
        own: dict[str, Any] = {"syncable": False}
        self.rotors = [ColumnDataSource(empty, **own) for _ in range(2)]
        for rotor, color in zip(self.rotors, (SKY, ORANGE), strict=True):
            line = {"line_color": "#111111", "line_width": 1.0}
            self.figure.patch("x", "y", source=rotor, fill_color=color, fill_alpha=0.4, **line)
        dashes = {"line_color": GREY, "line_dash": [2, 3]}
        self.figure.multi_line("xs", "ys", source=self.pitch, **dashes)
        self.arrows = {
            name: ColumnDataSource(empty | {"ex": [], "ey": []}, **own) for name in _SIDES
        }
        for name, color in _SIDES.items():
            arrow = self.arrows[name]
            self.figure.scatter("x", "y", source=arrow, color=color, size=8)
            head = VeeHead(size=11, fill_color=color, line_color=color)
            ends = {"x_start": "x", "y_start": "y", "x_end": "ex", "y_end": "ey"}
            self.figure.add_layout(
                Arrow(source=arrow, end=head, line_color=color, line_width=3, **ends)
            )
        self.turn = Slider(
            value=0, start=0, end=39, step=1, title=None, show_value=False, tooltips=False,
            sizing_mode="stretch_width", margin=(8, 10, 0, 10), name="turn", bar_color="#cfd6da",
        )  # fmt: skip
        self.play = Toggle(
            label="Play", width=64, margin=(0, 0, 0, 0), name="play", stylesheets=[_SMALL]
        )
        self.pose = Div(text="", sizing_mode="stretch_width", margin=0, name="pose", **own)
        row = Row(self.play, self.turn, sizing_mode="stretch_width", margin=0)
        self.root = Column(self.figure, row, self.pose, sizing_mode="stretch_width", margin=0)
        self._chosen = False

    def connect(self, cursor: Span) -> CustomJS:
        """Let a script draw the pair whenever the rotation or the pair changes; return the script.

        `cursor`: line that marks the time in the picture of the force."""
        code = (_TEMPLATE / "pair.js").read_text("utf-8")
        one, two = self.rotors
        arguments = {
            "turn": self.turn, "outline": self.outline, "poses": self.poses, "facts": self.facts,
            "one": one, "two": two, "pose": self.pose, "cursor": cursor, **self.arrows,
        }  # fmt: skip
        draw = CustomJS(args=arguments, code=code)
        self.turn.js_on_change("value", draw)
        self.outline.js_on_change("data", draw)
        self.poses.js_on_change("data", draw)
        self.play.js_on_change(
            "active", CustomJS(args={"turn": self.turn, "poses": self.poses}, code=_PLAY)
        )
        return draw

    def _tell(self, **facts: float) -> None:
        """Tell the script some `facts` of the pair."""
        self._facts |= facts
        self.facts.data = {key: [value] for key, value in self._facts.items()}

    def draw(self, shape: Shape, pitch_radius: float, error: float) -> None:
        """Draw the rotors of a shape, with `pitch_radius` and centre distance `error` (mm)."""
        center = 2 * pitch_radius + error
        self._hold(float(np.max(np.hypot(*shape.outline.T))), center)
        if (self._facts["center"], self._facts["pitch"]) != (center, pitch_radius):
            circles = [_circle(pitch_radius), _circle(pitch_radius, center)]
            self.pitch.data = {end: [one[end[0]] for one in circles] for end in ("xs", "ys")}
        self._tell(center=center, lobes=shape.profile.lobes, pitch=pitch_radius)
        self.outline.data = {"x": shape.outline[:, 0], "y": shape.outline[:, 1]}

    def move(self, poses: Poses) -> None:
        """Take the poses of a motion, or of perfect rolling."""
        longest = 0.0 if poses.forces is None else max(1e-30, *map(np.max, poses.forces))
        self._tell(longest=float(longest))
        data: dict[str, Any] = {
            "time": poses.time, "rotation": poses.rotation, "relative": poses.relative
        }  # fmt: skip
        for k, (name, contacts) in enumerate({"drive": poses.drive, "coast": poses.coast}.items()):
            known = np.zeros_like(poses.rotation) if poses.forces is None else poses.forces[k]
            data |= {
                f"{name}_x": contacts.point[:, 0], f"{name}_y": contacts.point[:, 1],
                f"{name}_nx": contacts.normal[:, 0], f"{name}_ny": contacts.normal[:, 1],
                f"{name}_present": contacts.present.astype(float), f"{name}_force": known,
            }  # fmt: skip
        last = len(poses.rotation) - 1
        if self.turn.end != last:
            self.turn.end = last
        if poses.forces is not None and not self._chosen:
            self._chosen = True
            self.turn.value = int(np.argmax(poses.forces[0] + poses.forces[1]))
        self.poses.data = data


class ForcePicture:
    """The contact force over time, over that at the start."""

    def __init__(self) -> None:
        empty: dict[str, list[float]] = {"time": [], "drive": [], "coast": [], "total": []}
        self.now = ColumnDataSource(empty, name="force_now")
        self.before = ColumnDataSource({"time": [], "total": []})
        self.figure = _figure(
            "Contact force over time", 265, tools="xpan,xwheel_zoom,reset",
            x_axis_label="time (ms)", y_axis_label="contact force (N)",
            x_range=Range1d(0, 1), y_range=Range1d(0, 1),
        )  # fmt: skip
        self.figure.toolbar_location = "right"
        self.figure.toolbar.logo = None
        self._end = self._top = 0.0
        items = []
        old = self.figure.line(
            "time", "total", source=self.before, line_color=GREY, line_width=1.2, line_dash=[5, 3]
        )
        for name, color in _SIDES.items():
            line = self.figure.line("time", name, source=self.now, line_color=color, line_width=1.8)
            items.append(LegendItem(label=f"{name} flank", renderers=[line]))
        self.mean = Span(location=0, dimension="width", line_color="#111111", line_dash=[2, 3])
        self.cursor = Span(location=0, dimension="height", line_color="#8a9aa5", syncable=False)
        for span in (self.mean, self.cursor):
            span.visible = False
            self.figure.add_layout(span)
        items.append(LegendItem(label="at start, both flanks", renderers=[old]))
        legend = Legend(
            items=items, orientation="horizontal", border_line_color=None, margin=0, padding=2,
            background_fill_color=None, label_text_font_size="12px", label_text_color="#1a1a1a",
        )  # fmt: skip
        self.figure.add_layout(legend, "above")
        tips = [("time", "@time{0.00} ms"), ("drive", "@drive{0.0} N"), ("coast", "@coast{0.0} N")]
        renderers = [item.renderers[0] for item in items[:1]]
        self.figure.add_tools(HoverTool(tooltips=tips, mode="vline", renderers=renderers))
        self.root = Column(self.figure, sizing_mode="stretch_width", margin=0)

    def start(self, series: Series) -> None:
        """Set the motion of the start."""
        time = 1e3 * (series.time - series.time[0])
        self.before.data = {"time": time, "total": series.force}
        self._end, self._top = float(time[-1]), float(np.max(series.force))

    def draw(self, series: Series, response: Mapping[str, float]) -> None:
        """Draw the forces of a motion, and their mean (dotted)."""
        time = 1e3 * (series.time - series.time[0])
        self.figure.x_range.end = max(float(time[-1]), self._end)
        self.figure.y_range.end = 1.06 * max(float(np.max(series.force)), self._top) or 1.0
        self.now.data = {
            "time": time, "drive": series.drive_force,
            "coast": series.coast_force, "total": series.force,
        }  # fmt: skip
        mean = response.get("mean_force_N")
        self.mean.location = 0.0 if mean is None else mean
        self.mean.visible = mean is not None
        self.cursor.visible = True
        self.figure.title.text = "Contact force over time (dotted: mean)"

    def clear(self, words: str) -> None:
        """Remove the forces; `words`: why there are none."""
        self.now.data = {name: [] for name in ("time", "drive", "coast", "total")}
        self.mean.visible = self.cursor.visible = False
        self.figure.title.text = f"Contact force over time: {words}"


__all__ = ["ForcePicture", "PairPicture", "ProfilePicture"]
