"""Interactive charts of a report, as figures that plotly's script draws in the browser."""

import html
import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rootsopt.figures.force import amplitude_spectrum
from rootsopt.figures.style import BLUE, COLORS, GREY, VERMILION
from rootsopt.output.names import brief, in_words, label, stated
from rootsopt.report.gather import Case, Run, varied
from rootsopt.response.series import Series

_MOST_TURNS = 4
"""Number of revolutions above which the chart of a motion shows only a part at first."""
_MOST_SAMPLES = 20_000
"""Number of samples above which a chart of a motion shows only the extremes of each interval."""
_HARMONICS = 40
"""Highest multiple of the mesh frequency in a spectrum."""
_LINES = 400
"""Number of spectral lines above which a spectrum is drawn as a curve."""
_FLOOR = 1e-4
"""Smallest amplitude in a spectrum, as a fraction of the largest."""
_MOST_CURVES = 8
"""Number of lines above which a chart of a sweep shows single points instead."""
_SYMBOLS = {True: "circle", False: "x"}
_MARKS = "circle", "diamond", "square", "triangle-up"
_MEANS = "mean_force_N", "rms_force_N"
"""Forces that are drawn as dotted lines, to tell them from the peak."""
_DASHES = "solid", "dash", "dot", "dashdot"


def force_chart(cases: Sequence[Case]) -> dict[str, Any] | None:
    """Return the chart of the contact force over time, or None if no case has a motion.

    A single case shows the force on each flank. Several cases show the sum of both."""
    moving = _moving(cases)
    if not moving:
        return None
    traces: list[dict[str, Any]] = []
    for k, (case, series) in enumerate(moving):
        shown = _thinned(series.force)
        time = 1e3 * (series.time[shown] - series.time[0])
        name, color = html.escape(case.name), COLORS[k % len(COLORS)]
        dash = _DASHES[k % len(_DASHES)]
        curves = [(name, color, dash, series.force)]
        if len(moving) == 1:
            name, color = "", GREY
            curves = [
                ("drive flank", BLUE, "solid", series.drive_force),
                ("coast flank", VERMILION, "solid", series.coast_force),
            ]
        traces += [_line(time, force[shown], *style) for *style, force in curves]
        mean = case.record.get("response", {}).get("mean_force_N")
        if mean is not None:
            words = f"mean, {name}" if name else "mean"
            line = _line(time[[0, -1]], [mean, mean], words, color, "dot")
            traces.append(line | {"hoverinfo": "skip", "hovertemplate": None})
    layout = _layout("time (ms)", "contact force (N)")
    layout["hovermode"] = "x unified"
    layout["yaxis"]["rangemode"] = "tozero"
    turns = max(float(np.ptp(series.rotation)) / (2 * np.pi) for _, series in moving)
    if turns > 1.5 * _MOST_TURNS:
        longest = max(1e3 * float(np.ptp(series.time)) for _, series in moving)
        layout["xaxis"]["range"] = [0, longest * _MOST_TURNS / turns]
    return {"data": traces, "layout": layout, "cursor": True}


def _moving(cases: Sequence[Case]) -> list[tuple[Case, Series]]:
    """Return the cases that have a motion, each with its series."""
    return [(case, case.series) for case in cases if case.series is not None]


def spectrum_chart(cases: Sequence[Case]) -> dict[str, Any] | None:
    """Return the chart of the force's spectrum, or None if no case has a force that varies.

    The samples are uniform in rotation, so that the lines are multiples of the mesh frequency even
    if the speed varies."""
    spectra = []
    for case, series in _moving(cases):
        pitches = series.rotation * case.config.profile.lobes / (2 * np.pi)
        step = float(pitches[1] - pitches[0])
        order, amplitude = amplitude_spectrum(series.force, step)
        shown = order <= _HARMONICS + 0.5
        frequency = step / float(np.mean(np.diff(series.time)))
        spectra.append((html.escape(case.name), order[shown], amplitude[shown], frequency))
    top = max((float(np.max(one[2], initial=0.0)) for one in spectra), default=0.0)
    if top <= 0:
        return None
    traces: list[dict[str, Any]] = []
    for k, (name, order, amplitude, frequency) in enumerate(spectra):
        marks = _spectrum(name, order, amplitude, frequency, k)
        stems = [_stems(marks, _FLOOR * top)] if marks["mode"] == "markers" else []
        traces += [*stems, marks]
    layout = _layout("multiple of the mesh frequency", "force amplitude (N)")
    ends = [float(np.log10(_FLOOR * top)), float(np.log10(2 * top))]
    layout["yaxis"] |= {"type": "log", "range": ends, "exponentformat": "power"}
    return {"data": traces, "layout": layout}


def _spectrum(
    name: str, order: NDArray, amplitude: NDArray, frequency: float, place: int
) -> dict[str, Any]:
    """Return the trace of a spectrum: a mark per multiple, or a curve if there are many.

    `frequency`: mesh frequency (Hz); `place`: index of the spectrum in its chart."""
    color = COLORS[place % len(COLORS)]
    hover = "%{y:.4g} N at %{x:.4g} × mesh frequency, %{customdata} Hz"
    found: dict[str, Any] = {
        "x": _plain(order),
        "y": _plain(amplitude),
        "customdata": [brief(value) for value in order * frequency],
        "name": name,
        "hovertemplate": f"{hover}<extra>{name}</extra>",
    }
    if len(order) > _LINES:
        return found | {"mode": "lines", "line": {"color": color, "width": 1}}
    symbol = _MARKS[place % len(_MARKS)]
    return found | {"mode": "markers", "marker": {"color": color, "size": 7, "symbol": symbol}}


def _stems(marks: Mapping[str, Any], floor: float) -> dict[str, Any]:
    """Return the trace of a spectrum's vertical lines, from `floor` (N) up to the `marks`.

    `marks`: trace of the points at the ends of the lines."""
    across, up = [], []
    for x, y in zip(marks["x"], marks["y"], strict=True):
        across += [x, x, None]
        up += [floor, y, None]
    line = {"color": marks["marker"]["color"], "width": 1.5}
    return {
        "x": across, "y": up, "mode": "lines", "line": line,
        "showlegend": False, "hoverinfo": "skip",
    }  # fmt: skip


def scenes_chart(groups: Mapping[str, Sequence[Mapping[str, Any]]]) -> dict[str, Any] | None:
    """Return a chart of mean and peak force over the first quantity that varies between scenes.

    `groups`: rows of each design, one per scene, by its name. Each combination of the other
    quantities is a line of its own. Scenes without a steady state are marked by a cross. The result
    is None if there is nothing to draw."""
    traces: list[dict[str, Any]] = []
    across = ""
    for name, rows in groups.items():
        axes = varied(rows)
        if not axes:
            continue
        across = across or axes[0]
        lines: dict[tuple, list[Mapping[str, Any]]] = {}
        for row in rows:
            lines.setdefault(tuple(row.get(key) for key in axes[1:]), []).append(row)
        if len(lines) > _MOST_CURVES:  # A sample without a grid: single points.
            lines = {(): list(rows)}
        for place, (others, scenes) in enumerate(lines.items(), start=len(traces) // 2):
            pairs = zip(axes[1:], others, strict=False)
            words = [stated(key, x, named=True) for key, x in pairs]
            title = ", ".join(([name] if name else []) + words)
            joined = bool(others) or len(axes) == 1
            for key in ("mean_force_N", "peak_force_N"):
                shown = f"{title}: {label(key)}" if title else label(key)
                traces.append(_scenes(scenes, axes[0], key, shown, place, joined))
    traces = [trace for trace in traces if trace["x"]]
    if not traces:
        return None
    layout = _layout(html.escape(label(across)), "contact force (N)")
    layout["yaxis"]["rangemode"] = "tozero"
    return {"data": traces, "layout": layout}


def _scenes(
    rows: Sequence[Mapping[str, Any]], across: str, key: str, name: str, place: int, joined: bool
) -> dict[str, Any]:
    """Return the trace of the force `key` over the quantity `across`.

    `place`: index of the scenes in the chart, which chooses the colour; `joined`: whether a line
    joins its points."""
    drawn = [row for row in rows if row.get(key) is not None and row.get(across) is not None]
    if joined and all(isinstance(row[across], int | float) for row in drawn):
        drawn.sort(key=lambda row: row[across])
    color = COLORS[place % len(COLORS)]
    steady = [row.get("status") in ("periodic", "averaged", None) for row in drawn]
    return {
        "x": [row[across] for row in drawn],
        "y": [row[key] for row in drawn],
        "text": [html.escape(in_words(str(row.get("status", "")))) for row in drawn],
        "name": html.escape(name),
        "mode": "lines+markers" if joined else "markers",
        "line": {"color": color, "width": 1.5, "dash": "dot" if key in _MEANS else "solid"},
        "marker": {"color": color, "size": 8, "symbol": [_SYMBOLS[x] for x in steady]},
        "hovertemplate": "%{y:.5g} N at %{x}, %{text}<extra>%{fullData.name}</extra>",
    }


def front_charts(run: Run) -> list[tuple[str, dict[str, Any]]]:
    """Return (title, chart) of each pair of terms of a front."""
    points = run.result.get("points") or []
    aims = run.result.get("terms") or []
    if not points:
        return []
    at = {point["point"]: point["terms"] for point in points}
    charts = []
    for up, across in itertools.combinations([aim["name"] for aim in aims], 2):
        xs: list[Any] = []
        ys: list[Any] = []
        for first, second in run.result.get("edges") or ():
            xs += [at[first][across], at[second][across], None]
            ys += [at[first][up], at[second][up], None]
        line = {"color": GREY, "width": 1.2}
        traces: list[dict[str, Any]] = [
            {"x": xs, "y": ys, "mode": "lines", "line": line, "hoverinfo": "skip",
             "showlegend": False}
        ]  # fmt: skip
        for sure, name in ((True, "certified"), (False, "not certified")):
            group = [point for point in points if (point["status"] == "certified") is sure]
            if group:
                traces.append(_front_points(group, across, up, name, sure))
        base = (run.result.get("baseline") or {}).get("terms") or {}
        if base.get(across) is not None and base.get(up) is not None:
            star = {"symbol": "star", "size": 15, "color": VERMILION}
            traces.append({"x": [base[across]], "y": [base[up]], "mode": "markers",
                           "name": "baseline", "marker": star})  # fmt: skip
        layout = _layout(html.escape(label(across)), html.escape(label(up)))
        charts.append((f"{label(up)} against {label(across)}", {"data": traces, "layout": layout}))
    return charts


def _front_points(group, across: str, up: str, name: str, sure: bool) -> dict[str, Any]:
    texts = []
    for point in group:
        rows = [f"<b>point {point['point']}</b>, {in_words(point['status'])}"]
        numbers = {**point["terms"], **point["design"]}
        rows += [html.escape(stated(key, x, named=True)) for key, x in numbers.items()]
        texts.append("<br>".join(rows))
    return {
        "x": [point["terms"][across] for point in group],
        "y": [point["terms"][up] for point in group],
        "text": texts,
        "hovertemplate": "%{text}<extra></extra>",
        "mode": "markers",
        "name": name,
        "marker": {"size": 11, "color": BLUE, "symbol": "circle" if sure else "circle-open"},
    }


def _line(x: ArrayLike, y: ArrayLike, name: str, color: str, dash: str) -> dict[str, Any]:
    return {
        "x": _plain(x),
        "y": _plain(y),
        "name": name,
        "mode": "lines",
        "line": {"color": color, "width": 1.6, "dash": dash},
        "hovertemplate": "%{y:.5g} N",
    }


def _layout(across: str, up: str) -> dict[str, Any]:
    axis = {"gridcolor": "#e4e4e4", "zerolinecolor": "#bbb", "automargin": True}
    return {
        "height": 360,
        "margin": {"l": 64, "r": 16, "t": 8, "b": 48},
        "paper_bgcolor": "#fff",
        "plot_bgcolor": "#fff",
        "font": {"family": "system-ui, sans-serif", "size": 13, "color": "#1a1a1a"},
        "legend": {"orientation": "h", "y": 1.02, "yanchor": "bottom"},
        "showlegend": True,
        "hoverlabel": {"align": "left"},
        "xaxis": {"title": {"text": across}, **axis},
        "yaxis": {"title": {"text": up}, **axis},
    }


def _thinned(force: NDArray[np.float64], most: int = _MOST_SAMPLES) -> NDArray[np.intp]:
    """Return the indices of the samples to draw: all, or the extremes of each short interval."""
    count = len(force)
    if count <= most:
        return np.arange(count)
    edges = np.linspace(0, count, most // 2 + 1).astype(int)
    found = {0, count - 1}
    for a, b in itertools.pairwise(edges):
        found |= {a + int(np.argmax(force[a:b])), a + int(np.argmin(force[a:b]))}
    return np.array(sorted(found))


def _plain(values: ArrayLike) -> list[float | None]:
    """Return `values` with six significant digits, and None for those that are not finite."""
    numbers = np.asarray(values, float).tolist()
    return [float(f"{x:.6g}") if np.isfinite(x) else None for x in numbers]


__all__ = ["force_chart", "front_charts", "scenes_chart", "spectrum_chart"]
