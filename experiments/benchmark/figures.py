"""Figure of a finished benchmark."""

from typing import Any

from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from experiments._common.style import BLUE, GREEN, ORANGE, grid_below, sheet
from experiments.benchmark.job import ACCURACY, Row
from experiments.benchmark.targets import Lookup, exponent


def figure_of(rows: list[Row]) -> Figure:
    """Draw the time per design by tool, and the times over revolutions and over batch size."""
    figure, axes = sheet(15, 5.6, 1, 3, width_ratios=(1.5, 1, 1))
    bars, turns, batches = axes[0]
    look = Lookup(rows)
    timed = [r for r in rows if r["what"] in ("value", "value+gradient")]
    names = list(dict.fromkeys(r["tool"] for r in timed))
    for shift, (what, color) in enumerate((("value", ORANGE), ("value+gradient", BLUE))):
        chosen = [r for r in timed if r["what"] == what]
        place = [names.index(r["tool"]) + 0.38 * (shift - 0.5) for r in chosen]
        label = what.replace("+", " + ")
        bars.barh(place, [r["per_design_ms"] for r in chosen], 0.36, color=color, label=label)
        for y, r in zip(place, chosen, strict=True):
            bars.annotate(
                short(r["per_design_ms"]), (r["per_design_ms"], y), (3, 0),
                textcoords="offset points", va="center", fontsize=7,
            )  # fmt: skip
    bars.set_yticks(range(len(names)), names, fontsize=8)
    bars.invert_yaxis()
    bars.margins(x=0.15)
    bars.set(xscale="log", xlabel="time per design, warm (ms)")
    bars.legend(fontsize=8, loc="lower right")
    draw_power(turns, look.revolutions(), "from rest, no statistics", BLUE, "o")
    turns.set(xlabel="revolutions", ylabel="time (s)")
    for what, color, mark in (("value", ORANGE, "s"), ("value+gradient", BLUE, "o")):
        draw_power(batches, look.batches(what), what.replace("+", " + "), color, mark)
        draw_power(batches, look.batches(what, "gpu"), f"{what}, GPU", GREEN, mark)
    batches.set(xlabel="designs in a batch", ylabel="time of the batch (s)")
    for ax in (turns, batches):
        ax.set(xscale="log", yscale="log")
        for axis in (ax.xaxis, ax.yaxis):
            axis.set_major_formatter("{x:g}")
            axis.set_minor_formatter(NullFormatter())
        if ax.lines:
            ax.legend(fontsize=8)
    for ax in (bars, turns, batches):
        grid_below(ax, axis="x" if ax is bars else "both", color="0.9")
    figure.suptitle(f"Shipped CIC scene; mean and peak force to {ACCURACY:g}", fontsize=11)
    return figure


def short(value: float) -> str:
    """Format `value` with two significant digits, without a power of ten."""
    return f"{value:.0f}" if value >= 100 else f"{value:.2g}"


def draw_power(
    ax: Any, points: list[tuple[float, float]], label: str, color: str, mark: str
) -> None:
    """Draw (size, seconds) points on logarithmic axes, with the exponent of a power law in the
    label.
    """
    if not points:
        return
    slope = exponent(points)
    name = label if slope is None else f"{label}: exponent {slope:.2f}"
    ax.plot(*zip(*points, strict=True), marker=mark, color=color, lw=1.4, label=name)
