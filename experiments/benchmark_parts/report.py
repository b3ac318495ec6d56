"""Targets, tables and the figure of a finished benchmark."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter
from rich.console import Console
from rich.table import Table

from experiments.benchmark_parts.common import (
    ACCURACY,
    GRADIENT_ACCURACY,
    Row,
)

BLUE, ORANGE, GREEN = "#0072B2", "#E69F00", "#009E73"
COLUMNS = (
    "part",
    "tool",
    "what",
    "designs",
    "per_design_ms",
    "run_s",
    "build_s",
    "compile_s",
    "value_error",
    "gradient_error",
    "peak_memory_MB",
    "settings",
    "note",
)


def exponent(points: Sequence[tuple[float, float]]) -> float | None:
    """Slope of log time over log size; None for fewer than two points."""
    if len(points) < 2:
        return None
    x, y = np.log(np.array(points)).T
    return float(np.polyfit(x, y, 1)[0])


@dataclasses.dataclass(frozen=True)
class Lookup:
    """Figures of the finished run by tool and task."""

    rows: list[Row]

    def best(self, tool: str, what: str) -> Row | None:
        """Fastest row of a tool whose name begins so, of those that are good enough."""
        rows = [r for r in self.rows if r["tool"].startswith(tool) and r["what"] == what]
        fine = [
            r
            for r in rows
            if (r.get("value_error") or 0.0) <= ACCURACY
            and (r.get("gradient_error") or 0.0) <= GRADIENT_ACCURACY
        ]
        return min(fine, key=lambda r: r["per_design_ms"], default=None)

    def ratio(self, slow: tuple[str, str], fast: tuple[str, str]) -> float | None:
        """Time of one over time of the other, a design."""
        one, other = self.best(*slow), self.best(*fast)
        return one["per_design_ms"] / other["per_design_ms"] if one and other else None

    def seconds(self, what: str) -> float | None:
        found = [r["run_s"] for r in self.rows if r["what"].endswith(what)]
        return found[0] if found else None

    def revolutions(self) -> list[tuple[float, float]]:
        rows = [r for r in self.rows if r["part"] == "revolutions"]
        return [(r["revolutions"], r["run_s"]) for r in rows]

    def batches(self, what: str, part: str = "batch") -> list[tuple[float, float]]:
        rows = [r for r in self.rows if r["part"].startswith(f"{part} ") and r["what"] == what]
        return [(r["designs"], r["run_s"]) for r in rows]


def targets(rows: list[Row]) -> list[Row]:
    """What was aimed at, with the figure reached; `reached` is None where not measured."""
    look = Lookup(rows)
    both, value, one, many = "value+gradient", "value", "rootsopt, ", "rootsopt, batch of 256"
    single = Lookup([r for r in rows if r["part"] == "single" or r["tool"].startswith("(")])
    reverse = [r for r in rows if r["part"] == "reverse"]
    orbit = next((r for r in rows if r["tool"] == "orbit"), None)
    limits = (
        ("value + gradient, times faster than (a)", ">=", 200.0,
         single.ratio(("(a)", both), (one, both)), "one design"),
        ("the same in a batch of 256", ">=", 200.0,
         look.ratio(("(a)", both), (many, both)), "per design"),
        ("value + gradient, times faster than (b)", ">=", 1.0,
         single.ratio(("(b)", both), (one, both)), "one design"),
        ("the same in a batch of 256", ">=", 1.0,
         look.ratio(("(b)", both), (many, both)), "per design"),
        ("one value, time in units of (b)'s", "<=", 3.0,
         single.ratio((one, value), ("(b)", value)), "one design"),
        ("a value in a batch of 256, in units of (b)'s", "<=", 1.0,
         look.ratio((many, value), ("(b)", value)), "per design"),
        ("value + gradient on the orbit (ms)", "<=", 50.0,
         milli(orbit["run_s"]) if orbit else None, "to 1e-6, one core"),
        ("gap table (ms)", "<", 10.0, milli(look.seconds("gap table")), "one design"),
        ("gap table and Jacobian (ms)", "<", 40.0, milli(look.seconds("Jacobian")), "one design"),
        ("exponent of cost over revolutions", "<=", 1.1,
         exponent(look.revolutions()), "1 is linear"),
        ("exponent of cost over batch size", "<=", 1.1,
         exponent(look.batches(both)), "value + gradient"),
        ("memory of reverse mode, 200 revolutions (MB)", "<", 1000.0,
         reverse[0]["peak_memory_MB"] if reverse else None, "whole process"),
        ("main job, cold process (s)", "<=", 20.0, look.seconds(", cold"), "no cache"),
        ("main job, programs cached (s)", "<=", 8.0, look.seconds(", cached"), "second run"),
    )  # fmt: skip
    compare = {">=": lambda x, y: x >= y, "<=": lambda x, y: x <= y, "<": lambda x, y: x < y}
    return [
        {
            "target": name,
            "limit": f"{sign} {limit:g}",
            "figure": figure,
            "reached": None if figure is None else bool(compare[sign](figure, limit)),
            "note": note,
        }
        for name, sign, limit, figure, note in limits
    ]


def milli(seconds: float | None) -> float | None:
    return None if seconds is None else 1e3 * seconds


def figure_of(rows: list[Row]) -> Figure:
    """Time per design by tool; time over revolutions; time over batch size."""
    figure = Figure(figsize=(15, 5.6), layout="constrained")
    FigureCanvasAgg(figure)
    bars, turns, batches = figure.subplots(1, 3, width_ratios=(1.5, 1, 1))
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
        ax.grid(True, axis="x" if ax is bars else "both", color="0.9", lw=0.6)
        ax.set_axisbelow(True)
    figure.suptitle(f"Shipped CIC scene; mean and peak force to {ACCURACY:g}", fontsize=11)
    return figure


def short(value: float) -> str:
    """Two digits, without a power of ten."""
    return f"{value:.0f}" if value >= 100 else f"{value:.2g}"


def draw_power(
    ax: Any, points: list[tuple[float, float]], label: str, color: str, mark: str
) -> None:
    """Points of a cost with the exponent of their fit."""
    if not points:
        return
    slope = exponent(points)
    name = label if slope is None else f"{label}: exponent {slope:.2f}"
    ax.plot(*zip(*points, strict=True), marker=mark, color=color, lw=1.4, label=name)


def show(title: str, rows: list[Row], columns: Sequence[str]) -> None:
    """Table on standard output."""
    table = Table(title=title)
    for key in columns:
        words = key in ("part", "tool", "what", "settings", "note", "target")
        table.add_column(key.replace("_", " "), justify="left" if words else "right")
    for one in rows:
        table.add_row(*(cell(one.get(key)) for key in columns))
    Console(width=250).print(table)


def cell(value: Any) -> str:
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return "-"
    if isinstance(value, bool):
        return "reached" if value else "missed"
    return f"{value:.3g}" if isinstance(value, float) else str(value)
