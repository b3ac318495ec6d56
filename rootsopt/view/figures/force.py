"""Figures of the contact force over time and over frequency, and of a fit to a record."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.markers import CARETDOWN
from matplotlib.patches import Ellipse
from numpy.typing import ArrayLike, NDArray

from rootsopt.response.result import Series
from rootsopt.view.comparison import label_of
from rootsopt.view.figures.style import BLUE, COLORS, GREY, VERMILION, beside, figure, write
from rootsopt.view.names import label, name_and_unit

if TYPE_CHECKING:
    from rootsopt.identification.answer import Identification
    from rootsopt.view.files import ResultFolder


_MOST_TURNS = 4  # revolutions in a force panel, at most
_LINES = 400  # spectral lines above which a curve is drawn instead of single lines
_NOTHING = 1e-300  # amplitude drawn for 0 on a logarithmic axis


def plot_force(
    axes: Sequence[Axes] | NDArray,
    series: Mapping[str, Series],
    responses: Mapping[str, Mapping[str, float]],
) -> None:
    """Draw the contact force over time, one panel per design, all on one scale.

    `axes`: one for each design; `series`, `responses`: simulated motion and response of each
    design, keyed by its name. Mean and peak are taken from the response (`mean_force_N`,
    `peak_force_N`), which is more accurate than the samples. All panels cover the same number of
    revolutions, at most a few, and each includes the largest force of its design. Time is 0 at the
    start of each panel.
    """
    turns = min(_MOST_TURNS, *(np.ptp(run.rotation) / (2 * np.pi) for run in series.values()))
    for ax, (name, run) in zip(axes, series.items(), strict=True):
        shown = _around_peak(run, turns)
        force = run.force[shown]
        step = (run.time[1] - run.time[0]) * 1e3
        time = step * np.arange(len(force))
        plot_flank_force(ax, time, run.drive_force[shown], BLUE, "drive flank")
        plot_flank_force(ax, time, run.coast_force[shown], VERMILION, "coast flank")
        mean, peak = responses[name]["mean_force_N"], responses[name]["peak_force_N"]
        ax.axhline(
            mean, color="black", linestyle="--", linewidth=1.1, label=f"mean {number(mean)} N"
        )
        first = time[np.argmax(force >= 0.999 * np.max(force))]
        ax.plot(
            first, peak, color="black", marker=CARETDOWN, ls="", markersize=9,
            label=f"peak {number(peak)} N",
        )  # fmt: skip
        ax.set(title=name, ylabel="contact force (N)", xlim=(0, len(force) * step))
        beside(ax)
    top = max(max(responses[k]["peak_force_N"], np.max(series[k].force)) for k in series)
    for ax in axes:
        ax.set_ylim(0, 1.12 * top if top > 0 else 1)
    axes[-1].set_xlabel("time (ms)")


def plot_gap(axes: Sequence[Axes] | NDArray, series: Mapping[str, Series]) -> None:
    """Draw the gap of flanks that never touch over one revolution, one panel per design.

    `axes`: one for each design; `series`: simulated motion of each design, keyed by its name."""
    for ax, (name, run) in zip(axes, series.items(), strict=True):
        turn = run.rotation <= run.rotation[0] + 2 * np.pi
        time, gap = (run.time[turn] - run.time[0]) * 1e3, -1e6 * run.depth[turn]
        ax.plot(time, gap, color=BLUE, linewidth=1.2, label="gap of the nearer flanks")
        least = float(np.min(gap))
        ax.axhline(
            least, color="black", linestyle="--", linewidth=1.1,
            label=f"least gap {number(least)} µm",
        )  # fmt: skip
        # Between two lobes, the gap is as wide as the rotors. Only its narrow part is informative.
        high = min(1.12 * float(np.max(gap)), 4 * least)
        ax.set(title=name, ylabel="gap (µm)", xlim=(0, time[-1]), ylim=(0, high))
        beside(ax)
    axes[-1].set_xlabel("time (ms)")


def plot_flank_force(ax: Axes, time: NDArray, force: NDArray, color: str, label: str) -> None:
    """Draw the force on a flank over time or rotation, with a shade below it."""
    if not np.any(force > 0):
        label += " (no contact)"
    ax.fill_between(time, force, color=color, alpha=0.15, linewidth=0)
    ax.plot(time, force, color=color, linewidth=1.2, label=label)


def number(value: float) -> str:
    """Format `value` with four significant digits, keeping final zeros."""
    return f"{value:#.4g}".rstrip(".")


def _around_peak(run: Series, turns: float) -> slice:
    """Return the slice of `run`'s samples that covers `turns` revolutions around the largest force.

    Near an end of the run, the slice is shifted to lie within the run."""
    count = len(run.time)
    shown = min(count, round(count * turns * 2 * np.pi / np.ptp(run.rotation)))
    start = int(np.clip(np.argmax(run.force) - shown // 2, 0, count - shown))
    return slice(start, start + shown)


def amplitude_spectrum(
    signal: ArrayLike, step: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return (frequencies above 0, one-sided amplitudes at these frequencies) of a `signal` (n,).

    The samples must be a constant `step` apart and cover whole periods, without repeating the first
    sample at the end. No window function is used: a cosine of amplitude a gives one line of height
    a. The unit of frequency is 1 / (unit of `step`).
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
) -> None:
    """Draw the amplitude spectrum of the contact force, one panel per design, all on one scale.

    `axes`: one for each design; `series`: simulated motion of each design, keyed by its name;
    `mesh_frequency_Hz`: mesh frequency (Hz); `harmonics`: number of multiples of the mesh frequency
    on the frequency axis. The mean (0 Hz) is omitted.
    """
    limit = (harmonics + 0.5) * mesh_frequency_Hz
    top = 0.0
    for ax, (name, run), color in zip(axes, series.items(), COLORS, strict=False):
        frequency, amplitude = amplitude_spectrum(run.force, run.time[1] - run.time[0])
        shown = frequency <= limit
        frequency, amplitude = frequency[shown] / 1e3, np.maximum(amplitude[shown], _NOTHING)
        top = max(top, float(np.max(amplitude, initial=0)))
        if len(frequency) <= _LINES:
            ax.vlines(frequency, _NOTHING, amplitude, color=color, linewidth=2)
        else:
            ax.plot(frequency, amplitude, color=color, linewidth=0.7)
        ax.set(title=name, ylabel="force amplitude (N)", xlim=(0, limit / 1e3))
    for ax in axes:
        ax.set_yscale("log")
        ax.set_ylim(*((1e-4 * top, 2 * top) if top > 0 else (1e-4, 1)))
    for ax in axes:  # Panels that share an axis get its ticks back with the scale of each.
        ax.minorticks_off()  # Minor ticks would take a third of the time.
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


# Maximum number of measured columns that are drawn.
_MOST = 3

# Highest order of the rotation that is drawn.
_ORDERS = 24

# Least amplitude that is drawn, as a share of the greatest sample.
_FLOOR = 1e-5

# Half axes (standard deviations) of the 95 % confidence region of two quantities: root of the
# quantile of χ².
_INSIDE = 2.448


def plot_record(ax: Axes, place: NDArray, measured: NDArray, fitted: NDArray) -> None:
    """Draw the measured and the fitted values over their `place`."""
    order = np.argsort(place, kind="stable")
    ax.plot(place, measured, ".", color=GREY, markersize=3, label="record")
    ax.plot(place[order], fitted[order], color=BLUE, linewidth=1, label="fit")


def plot_orders(ax: Axes, turned: NDArray, measured: NDArray, fitted: NDArray) -> None:
    """Draw the amplitudes of samples at rotations `turned` (°) over their order, the number of
    cycles in a turn."""
    orders = np.arange(1, _ORDERS + 1)
    waves = np.exp(-1j * np.radians(turned) * orders[:, None])
    for values, color, mark in ((measured, GREY, "o"), (fitted, BLUE, "x")):
        sizes = 2 * np.abs(waves @ (values - np.mean(values))) / len(turned)
        ax.plot(orders, sizes, mark, color=color)
    ax.set(yscale="log", xlabel="order (cycles per turn)")
    ax.set_ylim(bottom=_FLOOR * np.max(np.abs(measured)))


def plot_region(ax: Axes, fit: "Identification", first: int, second: int) -> None:
    """Draw the 95 % confidence region of two quantities."""
    keys, one = [*fit.parameters], fit.covariance[np.ix_([first, second], [first, second])]
    sizes, axes = np.linalg.eigh(one)
    middle = [fit.parameters[keys[k]]["value"] for k in (first, second)]
    wide, tall = 2 * _INSIDE * np.sqrt(np.maximum(sizes, 0.0))
    turned = np.degrees(np.arctan2(axes[1, 0], axes[0, 0]))
    ax.add_patch(
        Ellipse((middle[0], middle[1]), wide, tall, angle=turned, color=VERMILION, alpha=0.3)
    )
    ax.plot(*middle, "+", color=VERMILION)
    ax.autoscale_view()
    ax.locator_params(nbins=5, steps=[1, 2, 2.5, 5, 10])
    ax.ticklabel_format(useOffset=False, style="plain")
    ax.set(xlabel=label_of(keys[first]), ylabel=label_of(keys[second]), title="95 % region")


def drawn(fit: "Identification") -> Figure:
    """Return the figure of a fit: columns of the record, orders of the first, and a region."""
    table = {key: np.asarray(column) for key, column in fit.residuals.items()}
    turned = table["rotation_deg"].astype(float)
    names = [*dict.fromkeys(table["column"].tolist())][:_MOST]
    count = len(names) + 1 + (len(fit.parameters) > 1)
    made, axes = figure(4.2 * count, 4.2, 1, count)
    for ax, name in zip(axes[0], names, strict=False):
        mine = table["column"] == name
        sampled = bool(np.isfinite(turned[mine]).all())
        place = turned[mine] if sampled else table["line"][mine]
        plot_record(ax, place, table["measured"][mine], table["fitted"][mine])
        ax.set(xlabel="rotation (°)" if sampled else "line of the record", title=label(name))
        if name == names[0]:
            made.legend(loc="outside lower left", ncols=2, frameon=False)
            beside, (called, unit) = axes[0, len(names)], name_and_unit(name)
            if sampled:
                plot_orders(beside, place, table["measured"][mine], table["fitted"][mine])
                beside.set(title=f"orders of the {called}", ylabel=f"amplitude ({unit})")
            else:
                beside.plot(table["line"], table["residual"], "o", color=GREY)
                beside.set(xlabel="line of the record", title="difference / its error")
    if len(fit.parameters) > 1:
        away = np.abs(np.triu(fit.correlation, 1))
        plot_region(axes[0, -1], fit, *divmod(int(np.argmax(away)), len(away)))
    return made


def identified_figure(folder: "ResultFolder", fit: "Identification") -> None:
    """Write `figures/identified.png` into `folder`."""
    write(folder, "identified", drawn(fit), "Record and fit")
