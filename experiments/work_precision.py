"""What accuracy costs: error of mean and peak force against run time.

    python experiments/work_precision.py [-o DIR] [--quick]

Three scenes: the shipped CIC and EE pairs, and a lively CIC pair (more backlash, less damping,
lower speed). A curve is one choice of contact, solver and precision; along it the tolerance
of transient and orbit runs from coarse to fine. Timed is one whole evaluation of a design, warm:
transient, closed orbit, forces and gradient. The reference is the search at every call with
dopri8 at a tolerance of 1e-11; its own error is taken from other tolerances and another solver.

What rounding the corners of contact law and timing gear costs is another study:
experiments/smoothing.py.

Writes work_precision.csv, work_precision.json and work_precision.png.
"""

import argparse
import dataclasses
import itertools
import math
import os
import statistics
import sys
import time
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

# As the commands do, before equinox is first imported.
os.environ.setdefault("EQX_ON_ERROR", "off")

from rootsopt.cli import use_float64

use_float64()

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from matplotlib.axes import Axes  # noqa: E402
from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: E402
from matplotlib.figure import Figure  # noqa: E402
from matplotlib.ticker import LogLocator, NullFormatter  # noqa: E402
from rich.console import Console  # noqa: E402
from rich.table import Table  # noqa: E402

from rootsopt import files  # noqa: E402
from rootsopt.config import load  # noqa: E402
from rootsopt.evaluate import Evaluation, Evaluator  # noqa: E402

SCENES: dict[str, tuple[str, tuple[str, ...]]] = {
    "cic": ("configs/cic.yaml", ()),
    "ee": ("configs/ee.yaml", ()),
    "lively": (
        "configs/cic.yaml",
        (
            "scene.timing_gear.backlash_mm=0.2",
            "scene.timing_gear.damping_ratio=0.2",
            "scene.speed_rpm=2000",
        ),
    ),
}
TITLES = {
    "contact": "CIC: contact (tsit5)",
    "solver": "CIC: solver and precision",
    "ee": "EE: contact (tsit5)",
    "lively": "lively CIC: contact (tsit5)",
}
FORCES = {"mean": "mean_force_N", "peak": "peak_force_N"}
REPEATS = 5
FINE = tuple(10.0**-k for k in range(3, 11))
ROUGH = FINE[:5]
"""Tolerances of contacts whose own error is far greater."""
NODES = FINE[:4]
"""Nodes leave steps in the force, at which a finer tolerance gets stuck."""
PERIODS = 64
"""Mesh periods the transient may last: all scenes settle within a few; what does not is recorded
as such."""
PATIENCE = 3.0
"""Seconds after which a run is not repeated again."""
SINGLE = (1e-3, 1e-4, 1e-5, 2e-6)
"""Tolerances of single precision: it holds none finer."""
REFERENCE_RTOL = 1e-11
FLOOR = 1e-12
"""Least error drawn."""
OTHER_ORBIT = 0.3
"""Distance (scaled) from the reference's orbit at φ = 0 beyond which it is another one."""
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
MARKS = "osD^vPX"


def contact(name: str) -> tuple[str, ...]:
    """Overrides of a contact: search, linear, map ROLLSxRELATIVES, nodes COUNT."""
    kind, _, size = name.partition(" ")
    choice = (f"solver.fidelity={kind}",)
    if kind == "map":
        rolls, relatives = size.split("x")
        return (*choice, f"solver.map_rolls={rolls}", f"solver.map_relatives={relatives}")
    return (*choice, f"solver.nodes={size}") if kind == "nodes" else choice


@dataclasses.dataclass(frozen=True)
class Curve:
    """One choice of contact, solver and precision in a scene, over its tolerances.

    `panels`: where it is drawn; `transient`: tolerance of the transient, where it is not that
    of the orbit; `compiled` names what shares a compiled program.
    """

    scene: str
    panels: tuple[str, ...]
    contact: str
    method: str = "tsit5"
    precision: str = "float64"
    transient: float | None = None
    tolerances: tuple[float, ...] = FINE

    @property
    def compiled(self) -> tuple[str, str, str, bool]:
        return self.contact, self.method, self.precision, self.scene == "ee"

    def label(self, panel: str) -> str:
        """Name in a legend."""
        parts = [self.contact]
        if panel == "solver" or self.method != "tsit5":
            parts.append(self.method)
        if self.precision != "float64":
            parts.append(self.precision)
        if self.transient is not None:
            parts.append(f"transient {self.transient:.0e}")
        return ", ".join(parts)

    def evaluator(self) -> Evaluator:
        """At the config's tolerances."""
        choice = (f"solver.method={self.method}", f"solver.precision={self.precision}")
        return evaluator(self.scene, *contact(self.contact), *choice)


def evaluator(scene: str, *overrides: str) -> Evaluator:
    """Evaluator of a scene with more overrides."""
    path, settings = SCENES[scene]
    return Evaluator(load(path, [*settings, f"solver.max_mesh_periods={PERIODS}", *overrides]))


def at(evaluator: Evaluator, rtol: float, transient: float | None = None) -> Evaluator:
    """The same evaluator at other tolerances; nothing is compiled anew."""
    coarse = rtol if transient is None else transient
    evaluator.orbit = dataclasses.replace(evaluator.orbit, rtol=jnp.asarray(rtol))
    evaluator.transient = dataclasses.replace(evaluator.transient, rtol=jnp.asarray(coarse))
    return evaluator


FULL = (
    Curve("cic", ("contact",), "map 768x24"),
    Curve("cic", ("contact",), "map 192x12"),
    Curve("cic", ("contact",), "linear", tolerances=ROUGH),
    Curve("cic", ("contact",), "nodes 100", tolerances=NODES),
    Curve("cic", ("contact",), "nodes 400", tolerances=NODES),
    Curve("cic", ("contact", "solver"), "search"),
    Curve("cic", ("contact", "solver"), "map 384x16"),
    Curve("cic", ("solver",), "search", "dopri5"),
    Curve("cic", ("solver",), "search", "dopri8"),
    Curve("cic", ("solver",), "search", "kvaerno5", tolerances=FINE[:5]),
    Curve("cic", ("solver",), "search", transient=1e-6),
    Curve("cic", ("solver",), "map 384x16", precision="float32", tolerances=SINGLE),
    Curve("ee", ("ee",), "search", "dopri8"),
    Curve("ee", ("ee",), "search"),
    Curve("ee", ("ee",), "map 384x16"),
    Curve("ee", ("ee",), "linear", tolerances=ROUGH),
    Curve("ee", ("ee",), "nodes 400", tolerances=NODES),
    Curve("lively", ("lively",), "search", "dopri8"),
    Curve("lively", ("lively",), "search"),
    Curve("lively", ("lively",), "map 384x16"),
    Curve("lively", ("lively",), "map 192x12"),
    Curve("lively", ("lively",), "linear", tolerances=ROUGH),
    Curve("lively", ("lively",), "nodes 400", tolerances=NODES),
)
QUICK = (Curve("cic", ("contact",), "linear", tolerances=(1e-3, 1e-7, 1e-9)),)


def say(text: str) -> None:
    """Progress."""
    print(text, file=sys.stderr, flush=True)


def warm_up(curves: Iterable[Curve]) -> float:
    """Compile every program, two at a time; seconds."""
    began = time.perf_counter()
    different = {curve.compiled: curve for curve in curves}
    count = itertools.count(1)

    def one(curve: Curve) -> None:
        curve.evaluator()(series=False)
        taken = time.perf_counter() - began
        say(f"compiled {next(count)}/{len(different)} ({taken:.0f} s): {curve.compiled}")

    with ThreadPoolExecutor(2) as pool:
        list(pool.map(one, different.values()))
    return time.perf_counter() - began


@dataclasses.dataclass(frozen=True)
class Reference:
    """Evaluation of the reference and its own relative error, by force."""

    found: Evaluation
    error: dict[str, float]


def errors(found: Evaluation, truth: Evaluation) -> dict[str, float]:
    """Relative error of mean and peak force."""
    return {
        name: abs(found.response[key] / truth.response[key] - 1) for name, key in FORCES.items()
    }


def reference(scene: str, curve: Curve, check: Curve) -> Reference:
    """Tightest evaluation of a scene with `curve`'s program, against itself at ten times the
    tolerance and against `check`'s solver."""
    found = at(curve.evaluator(), REFERENCE_RTOL)(series=False)
    if not found.usable:
        raise SystemExit(f"the reference of scene {scene} ended as {found.status.label}")
    others = [at(curve.evaluator(), 1e-10), at(check.evaluator(), REFERENCE_RTOL)]
    off = [errors(other(series=False), found) for other in others]
    worst = {name: max(e[name] for e in off) for name in FORCES}
    say(f"reference of {scene}: {found.response}, good to {worst}")
    return Reference(found, worst)


def verdict(found: Evaluation, truth: Evaluation) -> str:
    """Status of an evaluation, or that it is another orbit than the reference's."""
    if not found.usable:
        return found.status.label
    same = found.steady_state["period"] == truth.steady_state["period"]
    assert found.state is not None
    assert truth.state is not None
    far = np.max(np.abs(np.asarray(found.state, float) - truth.state)) > OTHER_ORBIT
    return "periodic" if same and not far else "other orbit"


def measure(curve: Curve, truth: Evaluation, repeats: int) -> list[dict[str, Any]]:
    """A row for every tolerance of a curve."""
    rows = []
    tool = curve.evaluator()
    for rtol in curve.tolerances:
        run = at(tool, rtol, curve.transient)
        found = run(series=False)  # fits the map to the motion
        times: list[float] = []
        while not times or (found.usable and len(times) < repeats and sum(times) < PATIENCE):
            began = time.perf_counter()
            found = run(series=False)
            times.append(time.perf_counter() - began)
        status = verdict(found, truth)
        off = errors(found, truth) if status == "periodic" else dict.fromkeys(FORCES, math.nan)
        rows.append(
            {
                "scene": curve.scene,
                "contact": curve.contact,
                "method": curve.method,
                "precision": curve.precision,
                "rtol": rtol,
                "transient_rtol": curve.transient or rtol,
                "status": status,
                "seconds": statistics.median(times),
                "mean_error": off["mean"],
                "peak_error": off["peak"],
                "transient_mesh_periods": found.statistics["transient_mesh_periods"],
                "solver_steps": found.statistics["solver_steps"],
                "orbit_steps": found.statistics.get("orbit_steps"),
                "newton_steps": found.statistics.get("newton_steps"),
            }
        )
    return rows


# Figures and tables


def sheet(width: float, height: float) -> Figure:
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def work_precision_figure(
    measured: list[tuple[Curve, list[dict[str, Any]]]], references: dict[str, Reference]
) -> Figure:
    """Error of mean (above) and peak (below) against run time, a column for each panel."""
    panels = [p for p in TITLES if any(p in curve.panels for curve, _ in measured)]
    figure = sheet(4.2 * len(panels) + 0.4, 9.6)
    axes = figure.subplots(2, len(panels), squeeze=False, sharex="col", sharey="row")
    for column, panel in enumerate(panels):
        drawn = [(curve, rows) for curve, rows in measured if panel in curve.panels]
        own = references[drawn[0][0].scene].error
        for row, name in enumerate(FORCES):
            ax: Axes = axes[row, column]
            for number, (curve, rows) in enumerate(drawn):
                style = number if panel == "solver" else style_of(curve)
                draw_curve(ax, style, curve.label(panel), rows, name)
            ax.axhspan(FLOOR / 3, max(own[name], FLOOR), color="0.88", lw=0)
            ax.axhline(1e-3, color="0.5", lw=0.8, ls=":")
            ax.set(xscale="log", yscale="log")
            ax.set_ylim(FLOOR / 3, 0.5)
            plain_ticks(ax.xaxis)
            ax.grid(True, which="major", color="0.9", lw=0.6)
            ax.set_axisbelow(True)
            if row == 0:
                ax.set_title(TITLES[panel], fontsize=11)
            else:
                ax.set_xlabel("one evaluation with gradient, warm (ms)")
                below = {"loc": "upper center", "bbox_to_anchor": (0.5, -0.14)}
                ax.legend(fontsize=8, frameon=False, **below)
    for row, name in enumerate(FORCES):
        axes[row, 0].set_ylabel(f"relative error of the {name} force")
    figure.suptitle(
        "Each mark is a tolerance, ten times finer from one to the next; grey: error of the "
        "reference itself; dotted: 1e-3; not shown: runs that end elsewhere (table)",
        fontsize=10,
    )
    return figure


STYLES = ("search", "map 384x16", "map 192x12", "map 768x24", "linear", "nodes 100", "nodes 400")


def style_of(curve: Curve) -> int:
    """Colour and mark of a contact; search with dopri8 takes those of nodes 100, which it does
    not meet in a panel."""
    return STYLES.index(curve.contact if curve.method == "tsit5" else "nodes 100")


def plain_ticks(axis: Any) -> None:
    """Ticks of a logarithmic axis at 1, 2 and 5, without powers of ten."""
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter("{x:g}")
    axis.set_tick_params(labelsize=8)
    axis.set_minor_formatter(NullFormatter())


def draw_curve(ax: Axes, number: int, label: str, rows: list[dict[str, Any]], name: str) -> None:
    """One line; runs that did not end on the reference's orbit are left out."""
    good = [row for row in rows if row["status"] == "periodic"]
    ax.plot(
        [1e3 * row["seconds"] for row in good],
        [max(row[f"{name}_error"], FLOOR) for row in good],
        marker=MARKS[number % len(MARKS)],
        color=COLORS[number % len(COLORS)],
        lw=1.4,
        ms=5,
        label=label if len(good) == len(rows) else f"{label} ({len(rows) - len(good)} not shown)",
    )


def show(title: str, rows: list[dict[str, Any]]) -> None:
    """Table on standard output."""
    table = Table(title=title)
    for key in rows[0]:
        table.add_column(key.replace("_", " "), justify="right")
    for row in rows:
        table.add_row(*(cell(value) for value in row.values()))
    Console(width=230).print(table)


def cell(value: Any) -> str:
    if isinstance(value, float):
        return "-" if math.isnan(value) else f"{value:.3g}"
    return "-" if value is None else str(value)


def parse() -> argparse.Namespace:
    arguments = argparse.ArgumentParser(description="Error against run time.")
    arguments.add_argument("-o", "--output", type=Path, default=Path("results/work_precision"))
    arguments.add_argument(
        "--quick", action="store_true", help="one program and few tolerances, as in the tests"
    )
    return arguments.parse_args()


def main() -> int:
    options = parse()
    folder = files.ResultFolder(options.output)
    curves = QUICK if options.quick else FULL
    compiling = warm_up(curves)
    references, measured = {}, []
    for scene in dict.fromkeys(curve.scene for curve in curves):
        own = [curve for curve in curves if curve.scene == scene]
        tight = next((curve for curve in own if curve.method == "dopri8"), own[0])
        check = next((c for c in own if c.contact == tight.contact and c is not tight), tight)
        references[scene] = reference(scene, tight, check)
    for number, curve in enumerate(curves, 1):
        rows = measure(curve, references[curve.scene].found, 2 if options.quick else REPEATS)
        measured.append((curve, rows))
        say(f"{number}/{len(curves)} {curve.scene}: {curve.label('')}")
    rows = [row for _, part in measured for row in part]
    folder.write_csv("work_precision.csv", files.row_columns(rows))
    summary = {
        "references": {
            scene: {"response": r.found.response, "gradient": r.found.gradient, "error": r.error}
            for scene, r in references.items()
        },
        "compile_seconds": compiling,
        "quick": options.quick,
        "versions": files.versions(),
    }
    folder.write_json("work_precision.json", summary)
    folder.write_figure("work_precision.png", work_precision_figure(measured, references))
    show("Work and precision", rows)
    left_out = [row for row in rows if row["status"] != "periodic"]
    print(f"{len(left_out)} of {len(rows)} runs are left out of the curves; see `status`")
    print(f"written to {options.output}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
