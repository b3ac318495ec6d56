"""Figures: profiles, meshing, contact force over time and frequency, optimisation history.

The `plot_*` functions draw on the axes they are given and return them; `figure` makes a
figure without pyplot, so that nothing here is global, needs a display or a main thread.
"""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.markers import CARETDOWN
from numpy.typing import ArrayLike, NDArray

from rootsopt.config import DESIGN_KEYS, FAMILY_KEYS, Config
from rootsopt.config.families import is_list
from rootsopt.contact.nodes import place_pair
from rootsopt.files import ResultFolder
from rootsopt.model import design_keys, outline_mm
from rootsopt.response.evaluation import Evaluation, Series

# Okabe and Ito's palette, told apart with any colour vision and in grey.
BLUE, VERMILION, GREEN = "#0072B2", "#D55E00", "#009E73"
ORANGE, SKY, PURPLE, GREY = "#E69F00", "#56B4E9", "#CC79A7", "#808080"
_CYCLE = (BLUE, VERMILION, GREEN, PURPLE, ORANGE, SKY)
_MARKERS = "os^Dvp"
_DASHES = ("-", (0, (5, 1.5)), (0, (1, 1)), "-.")
_MOST_TURNS = 4  # revolutions of a force panel
_LINES = 400  # spectral lines drawn one by one
_NOTHING = 1e-300  # stands for 0 on a logarithmic axis


def figure(
    width: float, height: float, rows: int = 1, columns: int = 1, **options: Any
) -> tuple[Figure, NDArray]:
    """A headless figure (sizes in inches) and its (rows, columns) array of axes."""
    made = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(made)
    return made, made.subplots(rows, columns, squeeze=False, **options)


def plot_profiles(
    ax: Axes, outlines: Mapping[str, NDArray[np.float64]], pitch_radius_mm: float
) -> Axes:
    """Closed outlines (n, 2) in mm, overlaid, with the pitch circle."""
    _overlay(ax, outlines, pitch_radius_mm)
    reach = 1.06 * max(np.max(np.hypot(*points.T)) for points in outlines.values())
    ax.plot(0, 0, "+", color="black", markersize=9)
    ax.set(xlim=(-reach, reach), ylim=(-reach, reach), title="Rotor")
    return ax


def plot_flank(
    ax: Axes, outlines: Mapping[str, NDArray[np.float64]], lobes: int, pitch_radius_mm: float
) -> Axes:
    """One flank from tip (+x axis) to root, enlarged: all there is, the rest is symmetry."""
    _overlay(ax, outlines, pitch_radius_mm)
    flanks = []
    for points in outlines.values():
        angle = np.arctan2(points[:, 1], points[:, 0])
        flanks.append(points[(angle >= 0) & (angle <= np.pi / lobes + 1e-9)])
    low, high = np.min(np.vstack(flanks), axis=0), np.max(np.vstack(flanks), axis=0)
    margin = 0.06 * np.max(high - low)
    ax.set(xlim=(low[0] - margin, high[0] + margin), ylim=(low[1] - margin, high[1] + margin))
    ax.set_title("One flank, tip to root, enlarged")
    return ax


def _overlay(ax, outlines, pitch_radius_mm):
    for (name, points), color, dashes in zip(outlines.items(), _CYCLE, _DASHES * 2, strict=False):
        ax.plot(*points.T, color=color, linestyle=dashes, linewidth=1.6, label=name)
    _circle(ax, (0, 0), pitch_radius_mm, f"pitch circle, {pitch_radius_mm:g} mm")
    ax.set_aspect("equal")
    ax.set(xlabel="x (mm)", ylabel="y (mm)")
    ax.grid(color="0.92", linewidth=0.6)
    ax.set_axisbelow(True)


def _circle(ax, center, radius, label=None):
    turn = np.linspace(0, 2 * np.pi, 361)
    x, y = center[0] + radius * np.cos(turn), center[1] + radius * np.sin(turn)
    ax.plot(x, y, "--", color=GREY, linewidth=0.9, label=label)


def plot_meshing(
    axes: Sequence[Axes] | NDArray,
    outline_mm: NDArray[np.float64],
    lobes: int,
    pitch_radius_mm: float,
    angles_deg: Sequence[float] | NDArray[np.float64],
) -> Sequence[Axes] | NDArray:
    """The meshing pair at several angles of rotor 1, one panel each."""
    center = 2 * pitch_radius_mm
    for ax, angle in zip(axes, angles_deg, strict=True):
        turn = np.radians(angle)
        pair = place_pair(np.asarray(outline_mm), lobes, center, turn, turn)
        names = "rotor 1 ↺", "rotor 2 ↻"
        for points, color, x, name in zip(pair, (SKY, ORANGE), (0, center), names, strict=True):
            ax.fill(*points.T, facecolor=color, alpha=0.75, edgecolor="black", linewidth=0.8)
            _circle(ax, (x, 0), pitch_radius_mm)
            ax.plot(x, 0, "o", color="black", markersize=4)
            ax.annotate(name, (x, 0), (0, 7), textcoords="offset points", ha="center")
        ax.axhline(0, color="black", linewidth=0.6, linestyle="-.")
        ax.set_aspect("equal")
        ax.set_title(f"rotor 1 at {angle:g}°")
    return axes


def plot_conjugacy(ax: Axes, gaps: Mapping[str, tuple[NDArray, NDArray]]) -> Axes:
    """Gap (µm) that pairs leave in perfect rolling, over rotor 1's angle (deg) from where its tip
    passes the line of centres."""
    for (name, (angle, gap)), color, dashes in zip(gaps.items(), _CYCLE, _DASHES * 2, strict=False):
        ax.plot(angle, gap, color=color, linestyle=dashes, linewidth=1.6, label=name)
    ax.axhline(0, color="black", linewidth=0.8)
    low, high = ax.get_ylim()
    if low < 0:
        ax.axhspan(low, 0, color=VERMILION, alpha=0.08, linewidth=0, label="overlap")
    ax.set(ylim=(low, high), xlabel="angle of rotor 1 from tip on the line of centres (°)")
    ax.set(ylabel="gap at ε = 0 (µm)", title="Gap in rolling")
    ax.grid(color="0.92", linewidth=0.6)
    ax.set_axisbelow(True)
    return ax


def plot_force(
    axes: Sequence[Axes] | NDArray,
    series: Mapping[str, Series],
    responses: Mapping[str, Mapping[str, float]],
) -> Sequence[Axes] | NDArray:
    """Contact force over time, one panel per design, all on one scale.

    Mean and peak are the given responses (`mean_force_N`, `peak_force_N`), which are finer
    than the samples. Every panel is as long as the shortest window, a few revolutions at
    most, and has the largest force in it; time counts from its start.
    """
    turns = min(_MOST_TURNS, *(np.ptp(run.rotation) / (2 * np.pi) for run in series.values()))
    for ax, (name, run) in zip(axes, series.items(), strict=True):
        shown = _around_peak(run, turns)
        force = run.force[shown]
        step = (run.time[1] - run.time[0]) * 1e3
        time = step * np.arange(len(force))
        _flank_force(ax, time, run.drive_force[shown], BLUE, "drive flank")
        _flank_force(ax, time, run.coast_force[shown], VERMILION, "coast flank")
        mean, peak = responses[name]["mean_force_N"], responses[name]["peak_force_N"]
        label = f"mean {_number(mean)} N"
        ax.axhline(mean, color="black", linestyle="--", linewidth=1.1, label=label)
        first = time[np.argmax(force >= 0.999 * np.max(force))]
        label = f"peak {_number(peak)} N"
        ax.plot(first, peak, color="black", marker=CARETDOWN, ls="", markersize=9, label=label)
        ax.set(title=name, ylabel="contact force (N)", xlim=(0, len(force) * step))
        ax.grid(color="0.92", linewidth=0.6)
        ax.legend(loc="upper left", bbox_to_anchor=(1.01, 1), frameon=False)
    top = max(max(responses[k]["peak_force_N"], np.max(series[k].force)) for k in series)
    for ax in axes:
        ax.set_ylim(0, 1.12 * top if top > 0 else 1)
    axes[-1].set_xlabel("time (ms)")
    return axes


def _flank_force(ax, time, force, color, label):
    if not np.any(force > 0):
        label += " (no contact)"
    ax.fill_between(time, force, color=color, alpha=0.15, linewidth=0)
    ax.plot(time, force, color=color, linewidth=1.2, label=label)


def _number(value: float) -> str:
    """Four significant digits, final zeros kept."""
    return f"{value:#.4g}".rstrip(".")


def _around_peak(run: Series, turns: float) -> slice:
    """So many revolutions with the largest force in the middle, as far as there are samples."""
    count = len(run.time)
    shown = min(count, round(count * turns * 2 * np.pi / np.ptp(run.rotation)))
    start = 0 if shown == count else int(np.argmax(run.force)) - shown // 2
    start = min(max(start, 0), count - shown)
    return slice(start, start + shown)


def amplitude_spectrum(
    signal: ArrayLike, step: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Frequencies (1/unit of `step`) above 0 and one-sided amplitudes of a signal (n,).

    The samples must be uniform and cover whole periods, without the end point: then a
    cosine of amplitude a gives one line of height a and no window function is needed.
    """
    signal = np.asarray(signal)
    amplitude = 2 * np.abs(np.fft.rfft(signal)) / len(signal)
    if len(signal) % 2 == 0:
        amplitude[-1] /= 2
    frequency = np.fft.rfftfreq(len(signal), step)
    return np.asarray(frequency[1:], dtype=np.float64), np.asarray(amplitude[1:], dtype=np.float64)


def plot_spectrum(
    axes: Sequence[Axes] | NDArray,
    series: Mapping[str, Series],
    mesh_frequency_Hz: float,
    harmonics: int = 40,
) -> Sequence[Axes] | NDArray:
    """Amplitude spectrum of the contact force, one panel per design, all on one scale.

    Up to `harmonics` times the mesh frequency; the mean (0 Hz) is left out.
    """
    limit = (harmonics + 0.5) * mesh_frequency_Hz
    top = 0.0
    for ax, (name, run), color in zip(axes, series.items(), _CYCLE, strict=False):
        frequency, amplitude = amplitude_spectrum(run.force, run.time[1] - run.time[0])
        shown = frequency <= limit
        frequency, amplitude = frequency[shown] / 1e3, np.maximum(amplitude[shown], _NOTHING)
        top = max(top, float(np.max(amplitude, initial=0)))
        if len(frequency) <= _LINES:
            ax.vlines(frequency, _NOTHING, amplitude, color=color, linewidth=2)
        else:
            ax.plot(frequency, amplitude, color=color, linewidth=0.7)
        ax.set(title=name, ylabel="force amplitude (N)", xlim=(0, limit / 1e3))
        ax.grid(color="0.92", linewidth=0.6)
        ax.set_axisbelow(True)
    for ax in axes:
        ax.set_yscale("log")
        ax.set_ylim(*((1e-4 * top, 2 * top) if top > 0 else (1e-4, 1)))
    per_mesh = mesh_frequency_Hz / 1e3
    orders = axes[0].secondary_xaxis(
        "top",
        functions=(
            lambda f: np.asarray(f) / per_mesh,
            lambda order: np.asarray(order) * per_mesh,
        ),
    )
    orders.set_xlabel(f"multiple of the mesh frequency, {mesh_frequency_Hz:.4g} Hz")
    axes[-1].set_xlabel("frequency (kHz)")
    return axes


def plot_history(
    axes: Sequence[Axes] | NDArray,
    history: Sequence[Mapping[str, Any]],
    keys: Sequence[str] = DESIGN_KEYS,
) -> Sequence[Axes] | NDArray:
    """Objective with best so far, then the design parameters, over the evaluations.

    `axes` holds a panel more than there are `keys`, those of the family in the config; a list of
    parameters shares a panel, which shows the local searches only. A row without `start`, or with
    a negative one, belongs to the screening. Unusable designs (objective not finite) stand as
    crosses at the top.
    """
    keys = ("objective", *keys)
    for ax, key in zip(axes, keys, strict=True):
        for rows, style in _starts(history):
            if is_list(key):
                _traces(ax, rows, key)
            else:
                _trace(ax, rows, key, style)
        ax.set_ylabel("objective / baseline" if key == "objective" else _label(key))
        ax.grid(color="0.92", linewidth=0.6)
    axes[0].axhline(1, color="black", linewidth=0.8, linestyle=":", label="baseline")
    _best(axes, keys, history)
    _outside(axes[0], history)
    axes[0].legend(loc="upper left", bbox_to_anchor=(1.01, 1), frameon=False)
    axes[-1].set_xlabel("evaluation")
    return axes


def _label(key: str) -> str:
    """Name of a design parameter with its unit."""
    units = {"_deg": " (°)", "_mm": " (mm)"}
    unit = next((end for end in units if key.endswith(end)), "")
    return key.removesuffix(unit).replace("_", " ") + units.get(unit, "")


def _traces(ax, rows, key):
    """The entries of a list of parameters over the evaluations of a local search."""
    rows = [row for row in rows if _start(row) >= 0]
    if not rows:
        return
    names = [name for name in rows[0] if name.startswith(key)]
    x = _values(rows, "evaluation")
    for k, name in enumerate(names):
        shade = colormaps["cividis"](k / max(len(names) - 1, 1))
        label = {0: "first, at the tip", len(names) - 1: "last, at the pitch circle"}.get(k)
        ax.plot(x, _values(rows, name), color=shade, linewidth=1.2, label=label)
    if not ax.get_legend():
        ax.legend(loc="upper left", bbox_to_anchor=(1.01, 1), frameon=False)


def _starts(history) -> Iterator[tuple[list[Mapping[str, Any]], dict[str, Any]]]:
    """Rows and line style of the screening and of each start."""
    groups: dict[Any, list] = {}
    for row in history:
        groups.setdefault(_start(row), []).append(row)
    for i, (start, rows) in enumerate(sorted(groups.items())):
        if start < 0:
            style = {"color": GREY, "marker": ".", "linestyle": "", "label": "screening"}
        else:
            color = _CYCLE[start % len(_CYCLE)]
            marker = _MARKERS[(start // len(_CYCLE) + start) % len(_MARKERS)]
            style = {"color": color, "marker": marker, "linestyle": "-", "linewidth": 1}
            style["label"] = f"start {start}" if i < 10 else None
        yield rows, style


def _start(row) -> int:
    start = row.get("start")
    return int(start) if isinstance(start, int | np.integer) else -1


def _trace(ax, rows, key, style):
    """Values over evaluations; hollow where a constraint is not met."""
    x, y = _values(rows, "evaluation"), _values(rows, key)
    met = np.asarray([bool(row.get("feasible", True)) for row in rows])
    ax.plot(x, y, **(style | {"marker": "", "label": None}), alpha=0.6)
    dots = style | {"linestyle": "", "markersize": 5}
    ax.plot(x[met], y[met], **dots)
    ax.plot(x[~met], y[~met], **(dots | {"label": None}), markerfacecolor="white")


def _values(rows, key) -> NDArray[np.float64]:
    values = (row.get(key) for row in rows)
    return np.asarray([np.nan if value is None else value for value in values], dtype=float)


def _best(axes, keys, history):
    """Best objective so far as a line, and a star on the best design in every panel."""
    x, best = [row["evaluation"] for row in history], _values(history, "best_objective")
    axes[0].step(x, best, where="post", color="black", linewidth=1.8, label="best so far")
    if not np.isfinite(best).any():
        return
    last = best[np.isfinite(best)][-1]
    winner = [row for row in history if row["objective"] == last][:1]
    star = {"color": "black", "markerfacecolor": "#F0E442", "markersize": 14, "zorder": 5}
    for ax, key in zip(axes, keys, strict=True):
        if is_list(key):
            continue
        x, y = [row["evaluation"] for row in winner], _values(winner, key)
        ax.plot(x, y, "*", label=f"best, {_number(last)}", **star)


def _outside(ax, history):
    """Limits that a few bad designs cannot stretch, and marks for what lies outside them."""
    values = _values(history, "objective")
    x = _values(history, "evaluation")
    known = values[np.isfinite(values)]
    known = np.append(known, 1.0)
    high = known[known <= max(1.5, 2 * np.median(known))].max()
    low = known.min()
    margin = 0.12 * max(high - low, 0.02)
    ax.set_ylim(low - margin, high + 1.5 * margin)
    marks = ((values > high, "^", "above the axis"), (~np.isfinite(values), "x", "unusable design"))
    for mask, marker, label in marks:
        if np.any(mask):
            top = np.full(np.count_nonzero(mask), 0.96)
            over = {"transform": ax.get_xaxis_transform(), "linestyle": "", "color": "black"}
            ax.plot(x[mask], top, marker=marker, markersize=6, label=label, **over)
    if not all(bool(row.get("feasible", True)) for row in history):
        ax.plot([], [], "o", color=GREY, markerfacecolor="white", label="constraint not met")


def profile_figures(folder: ResultFolder, config: Config, record: Mapping[str, Any]) -> list[str]:
    """Write profiles.png and meshing.png of one record; return their names."""
    points = _outline(config, record.get("design", {}))
    names = [
        _write(folder, "profiles", _profiles({config.profile.family.upper(): points}, config)),
        _write(folder, "meshing", _meshing(points, config)),
    ]
    if config.profile.from_file:
        from rootsopt.outline.conjugacy import conjugacy, gaps_um
        from rootsopt.outline.source import outline_of

        made, axes = figure(8, 4.2)
        gaps = gaps_um(conjugacy(outline_of(config.profile)[0]))
        plot_conjugacy(axes[0, 0], {Path(config.profile.outline_file or "").name: gaps})
        axes[0, 0].legend(frameon=False)
        names.append(_write(folder, "conjugacy", made))
    return names


def simulation_figures(folder: ResultFolder, evaluation: Evaluation, config: Config) -> list[str]:
    """Write the figures of one evaluation; return their names."""
    names = profile_figures(folder, config, evaluation.record())
    return names + _force_figures(folder, {config.profile.family.upper(): evaluation}, config)


def optimization_figures(
    folder: ResultFolder,
    baseline: Evaluation,
    optimized: Evaluation,
    history: Sequence[Mapping[str, Any]],
    config: Config,
) -> list[str]:
    """Write the figures of an optimisation; return their names."""
    designs = {"baseline": baseline, "optimised": optimized}
    outlines = {name: _outline(config, one.design) for name, one in designs.items()}
    names = [
        _write(folder, "profiles", _profiles(outlines, config)),
        _write(folder, "meshing", _meshing(outlines["optimised"], config, "optimised rotors")),
    ]
    names += _force_figures(folder, designs, config)
    if history:
        keys = FAMILY_KEYS[config.profile.family]
        names.append(_write(folder, "history", _history(history, keys)))
    return names


def _outline(config, design):
    return outline_mm(config, np.asarray([design[key] for key in design_keys(config)]))


def _write(folder, name, made) -> str:
    file = f"figures/{name}.png"
    folder.write_figure(file, made)
    return file


def _profiles(outlines, config):
    radius = config.profile.pitch_radius_mm
    made, axes = figure(13, 5.7, 1, 2, gridspec_kw={"width_ratios": [1, 1.5]})
    plot_profiles(axes[0, 0], outlines, radius)
    plot_flank(axes[0, 1], outlines, config.profile.lobes, radius)
    lines, names = axes[0, 0].get_legend_handles_labels()
    made.legend(lines, names, loc="outside lower center", ncols=len(names), frameon=False)
    made.suptitle(f"Rotor profile{'s' if len(outlines) > 1 else ''}: {' and '.join(outlines)}")
    return made


def _meshing(points, config, what="rotors"):
    lobes = config.profile.lobes
    angles = np.arange(6) * 60 / lobes
    made, axes = figure(11, 5.6, 2, 3, sharex=True, sharey=True)
    plot_meshing(list(axes.ravel()), points, lobes, config.profile.pitch_radius_mm, angles)
    made.supxlabel("x (mm)")
    made.supylabel("y (mm)")
    made.suptitle(f"Meshing of the {what} over one lobe pitch ({360 / lobes:g}°)")
    return made


def _force_figures(folder, designs, config) -> list[str]:
    series = {name: one.series for name, one in designs.items() if one.series is not None}
    if not series:
        return []
    responses, speed = {k: designs[k].response for k in series}, config.scene.speed_rpm
    count, shared = len(series), {"sharex": True, "sharey": True}
    made, axes = figure(10, 1.2 + 2.6 * count, count, 1, **shared)
    plot_force(list(axes[:, 0]), series, responses)
    made.suptitle(f"Contact force over time at {speed:g} rpm")
    names = [_write(folder, "force", made)]
    made, axes = figure(10, 1.4 + 2.6 * count, count, 1, **shared)
    plot_spectrum(list(axes[:, 0]), series, config.profile.lobes * speed / 60)
    made.suptitle(f"Spectrum of the contact force at {speed:g} rpm")
    return [*names, _write(folder, "spectrum", made)]


def _history(history, keys):
    heights = [2.2, *(1.8 if is_list(key) else 1 for key in keys)]
    tall = 9 * sum(heights) / 5.2
    made, axes = figure(
        10, tall, len(heights), 1, sharex=True, gridspec_kw={"height_ratios": heights}
    )
    plot_history(list(axes[:, 0]), history, keys)
    made.suptitle("Optimisation history")
    return made
