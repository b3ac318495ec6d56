"""Interactive charts of a report, as figures that Bokeh's script draws in the browser."""

import itertools
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from bokeh.models import HoverTool, Legend, Span
from bokeh.plotting import figure
from bokeh.themes import Theme
from numpy.typing import ArrayLike, NDArray

from rootsopt.config.reading import Config
from rootsopt.config.units import MM
from rootsopt.profiles import Profile, outline
from rootsopt.response.result import Series
from rootsopt.scene.build import Scene
from rootsopt.view.figures.animation import Contacts, frames_of
from rootsopt.view.figures.comparisons import kinds
from rootsopt.view.figures.style import BLUE, COLORS, GREY, ORANGE, VERMILION
from rootsopt.view.names import in_words, label, value
from rootsopt.view.pages.gather import Case

# The models of Bokeh accept more than their annotations say.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportCallIssue=false

_INK = "#1a1a1a"
_TEXT = {"text_font_size": "12px", "text_color": _INK, "text_font_style": "normal"}
THEME = Theme(json={"attrs": {
    "Plot": {"background_fill_color": None, "border_fill_color": None, "margin": 0,
             "outline_line_color": "#cfd6da", "min_border_left": 52, "min_border_right": 8},
    "Title": {"text_font_size": "13px", "text_color": _INK},
    "Axis": {"axis_label_standoff": 3, "minor_tick_line_color": None}
    | {f"{part}_{key}": x for part in ("axis_label", "major_label") for key, x in _TEXT.items()},
    "Grid": {"grid_line_color": "#e6eaec"},
    "Legend": {"border_line_color": None, "background_fill_color": None, "margin": 0, "padding": 2,
               "label_text_font_size": "12px", "label_text_color": _INK},
    "Toolbar": {"logo": None},
}})  # fmt: skip
"""Style of all charts on pages, for a Bokeh document."""

# Number of revolutions above which the chart of a motion shows only a part at first.
_MOST_TURNS = 4

# Number of samples above which a chart of a motion shows only the extremes of each interval.
_MOST_SAMPLES = 20_000

_HOLLOW: dict[str, Any] = {"fill_color": None, "line_width": 2}

# Look of each kind of point of a front.
_LOOKS: dict[str, dict[str, Any]] = {
    "certified": {"size": 11, "color": BLUE},
    "not certified": {"size": 11, "line_color": BLUE} | _HOLLOW,
    "best in one term": {"size": 15, "marker": "square", "line_color": BLUE} | _HOLLOW,
    "dominated": {"size": 8, "marker": "x", "color": GREY},
    "side of a gap": {"size": 19, "line_color": ORANGE} | _HOLLOW,
    "baseline": {"size": 15, "marker": "star", "color": VERMILION},
}
_DASHES = "solid", "dashed", "dotted", "dashdot"


def chart(across: str, up: str, height: int = 360, **options: Any) -> Any:
    """Return an empty figure with labels of its axes, and a legend above it that hides lines."""
    usual = {"tools": "box_zoom,pan,wheel_zoom,reset,save", "active_drag": "box_zoom"}
    options |= {} if "tools" in options else usual
    made = figure(height=height, x_axis_label=across, y_axis_label=up,
                  sizing_mode="stretch_width", **options)  # fmt: skip
    made.add_layout(Legend(orientation="horizontal", click_policy="hide"), "above")
    return made


def hover(made: Any, renderers: Sequence[Any], tips: Mapping[str, str], **options: Any) -> None:
    """Show `tips`, (name, field of the data), beside the pointer over some lines or points."""
    made.add_tools(HoverTool(tooltips=[*tips.items()], renderers=[*renderers], **options))


def force_chart(cases: Sequence[Case]) -> Any | None:
    """Return the chart of the contact force over time, or None if no case has a motion.

    A single case shows the force on each flank. Several cases show the sum of both. A line marks
    the instant that the page's animation shows."""
    moving = [(case, case.series) for case in cases if case.series is not None]
    if not moving:
        return None
    longest = max(1e3 * float(np.ptp(series.time)) for _, series in moving)
    turns = max(float(np.ptp(series.rotation)) / (2 * np.pi) for _, series in moving)
    shown = longest * (_MOST_TURNS / turns if turns > 1.5 * _MOST_TURNS else 1)
    made = chart("time (ms)", "contact force (N)", x_range=(0, shown))
    made.y_range.start = 0
    looks = zip(itertools.cycle(COLORS), itertools.cycle(_DASHES))
    curves = [(case.name, *look, case, run, run.force)
              for (case, run), look in zip(moving, looks, strict=False)]  # fmt: skip
    if len(moving) == 1:
        case, run = moving[0]
        curves = [("drive flank", BLUE, "solid", case, run, run.drive_force),
                  ("coast flank", VERMILION, "solid", case, run, run.coast_force)]  # fmt: skip
    for name, color, dash, case, run, force in curves:
        kept = _thinned(run.force)
        time = 1e3 * (run.time[kept] - run.time[0])
        style = {"color": color, "legend_label": name}
        line = made.line(time, force[kept], line_dash=dash, line_width=1.6, **style)
        tips = {name: "@y{%.5g} N", "time": "@x{%.5g} ms"}
        hover(made, [line], tips, mode="vline", formatters={"@x": "printf", "@y": "printf"})
        mean = case.record.get("response", {}).get("mean_force_N")
        if mean is not None and (len(moving) > 1 or name == "drive flank"):
            style |= {"legend_label": "mean", "color": GREY} if len(moving) == 1 else {}
            made.line(time[[0, -1]], [mean, mean], line_dash="dotted", line_width=1.6, **style)
    made.add_layout(Span(location=0, dimension="height", line_color="#111", name="cursor"))
    return made


def front_charts(result: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Yield (title, chart) of each pair of terms of a front.

    `result`: content of the result file."""
    points = result.get("points") or []
    names = [aim["name"] for aim in result.get("terms") or ()] if points else []
    for up, across in itertools.combinations(names, 2):
        made = chart(label(across), label(up), name=f"{across} {up}")
        at = {point["point"]: point["terms"] for point in points}
        lines = ([[at[k][name] for k in pair] for pair in result.get("edges") or ()]
                 for name in (across, up))  # fmt: skip
        made.multi_line(*lines, color=GREY, line_width=1.2)
        for name, group in kinds(result).items():
            data = {key: [one["terms"][key] for one in group] for key in (across, up)}
            facts = [{**one["terms"], **one.get("design", {})} for one in group]
            tips = {key: [value(one.get(key)) for one in facts] for key in facts[0]}
            data |= {f"shown {key}": shown for key, shown in tips.items()}
            data["what"] = [f"{one.get('point', '')} {in_words(one['status'])}" for one in group]
            drawn = made.scatter(across, up, source=data, legend_label=name, **_LOOKS[name])
            hover(made, [drawn], {"point": "@what"}
                  | {label(key): f"@{{shown {key}}}" for key in tips})  # fmt: skip
        yield f"{label(up)} against {label(across)}", made


def _thinned(force: NDArray[np.float64]) -> NDArray[np.intp]:
    """Return the indices of the samples to draw: all, or the extremes of each short interval."""
    count = len(force)
    if count <= _MOST_SAMPLES:
        return np.arange(count)
    edges = np.linspace(0, count, _MOST_SAMPLES // 2 + 1).astype(int)
    indices = {0, count - 1}
    for a, b in itertools.pairwise(edges):
        indices |= {a + int(np.argmax(force[a:b])), a + int(np.argmin(force[a:b]))}
    return np.array(sorted(indices))


def animations(cases: Sequence[Case]) -> dict[str, Any]:
    """Return the data of the animation of all `cases`.

    Cases with the same design share a rotor. A case without a motion is shown in perfect rolling.
    """
    rotors: dict[tuple, dict[str, Any]] = {}
    shown: list[dict[str, Any]] = []
    for case in cases:
        key = (case.config.profile.family, *case.design.values())
        scene = Scene.from_config(case.config)
        profile = scene.profile(jnp.asarray(np.array([*case.design.values()], dtype=float)))
        if key not in rotors:
            rotors[key] = rotor(case.config, np.asarray(outline(profile, points=240)) / MM)
        period = case.record.get("steady_state", {}).get("period")
        shown.append(
            {"name": case.name, "rotor": [*rotors].index(key)}
            | motion(profile, case.series, period)
        )
    return {"rotors": [*rotors.values()], "cases": shown}


def rotor(config: Config, points: NDArray[np.float64]) -> dict[str, Any]:
    """Return outline and sizes (mm) of a rotor; `points` (n, 2): its closed outline (mm)."""
    error = config.scene.center_distance_error_mm or 0.0
    return {
        "outline": np.round(points, 4).tolist(),
        "lobes": config.profile.lobes,
        "pitch": config.profile.pitch_radius_mm,
        "outer": round(float(np.max(np.hypot(*points.T))), 6),
        "center": 2 * config.profile.pitch_radius_mm + error,
        "bore": config.rotor.bore_mm,
    }


def motion(profile: Profile, series: Series | None = None, period: int | None = None):
    """Return the frames of a motion: angles (°), contacts, and forces (N) if they are known.

    `series`: the motion, None in perfect rolling; `period` (mesh periods), if it is known."""
    frames = frames_of(profile, series, period or profile.lobes)
    data: dict[str, Any] = {
        "rotation": _rounded(np.degrees(frames.rotation), 9),
        "contacts": [*map(_contacts, frames.flanks)],
        "forces": None,
    }
    if series is None or frames.forces is None:
        return data
    return data | {
        "relative": _rounded(1e3 * frames.relative, 6),
        "time": _rounded(1e3 * (frames.time - series.time[0]), 9),
        "forces": [_rounded(force, 4) for force in frames.forces],
    }


def _contacts(flank: Contacts) -> dict[str, list]:
    """Return contact points (mm), normals, and flags of contact in perfect rolling, of a flank."""
    parts = zip(("x", "y", "nx", "ny"), (*flank.point.T, *flank.normal.T), strict=True)
    return {name: _rounded(part, 5) for name, part in parts} | {"present": flank.present.tolist()}


def _rounded(values: ArrayLike, places: int) -> list[float]:
    return np.round(np.asarray(values), places).tolist()
