"""The pictures of the explorer: profile and force over time; `pair.js` draws the pair."""

# The models of Bokeh accept more than their annotations say.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportCallIssue=false

from collections.abc import Mapping

import numpy as np
from bokeh.models import ColumnDataSource, DataRange1d, Range1d, Span
from numpy.typing import NDArray

from rootsopt.explore.engine import Shape
from rootsopt.figures.style import BLUE, GREY, SKY, VERMILION
from rootsopt.report.charts import chart, hover
from rootsopt.response.evaluation import Series


class ProfilePicture:
    """The outline of a rotor over the one at the start."""

    def __init__(self) -> None:
        ranges = [DataRange1d(range_padding=0.03) for _ in range(2)]
        self.figure = chart(
            "x (mm)", "y (mm)", 285, tools="", toolbar_location=None, match_aspect=True,
            x_range=ranges[0], y_range=ranges[1], title="Profile, start dashed",
        )  # fmt: skip
        empty: dict[str, list[float]] = {"x": [], "y": []}
        self.now = ColumnDataSource(empty, name="outline_now")
        self.before, self.pitch = ColumnDataSource(empty), ColumnDataSource(empty)
        self.ends = ColumnDataSource({"x": [-1.0, 1.0], "y": [-1.0, 1.0]})
        self._reach = self._radius = 0.0
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
        if radius != self._radius:
            self._radius = radius
            turn = np.linspace(0, 2 * np.pi, 181)
            self.pitch.data = _points(radius * np.stack([np.cos(turn), np.sin(turn)], -1))


def _points(outline: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
    return {"x": outline[:, 0], "y": outline[:, 1]}


class ForcePicture:
    """The contact force over time, over that at the start."""

    def __init__(self) -> None:
        self.figure = chart(
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
                hover(self.figure, [line], fields, mode="vline")
        style = {"line_color": GREY, "line_width": 1.2, "line_dash": [5, 3]}
        self.figure.line("time", "total", source=self.before, level="underlay",
                         legend_label="at start, both flanks", **style)  # fmt: skip
        self.mean = Span(location=0, dimension="width", line_color="#111111", line_dash=[2, 3])
        self.cursor = Span(location=0, dimension="height", line_color="#8a9aa5", name="cursor",
                           syncable=False)  # fmt: skip
        for span in (self.mean, self.cursor):
            span.visible = False
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


__all__ = ["ForcePicture", "ProfilePicture"]
