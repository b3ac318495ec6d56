"""Measures how fast sweeps run: in this process, and over processes started by Dask.

All points are those of the shipped CIC pair over speed, with gradients. Programs are compiled
beforehand, so that each process only loads them. Two times are measured: until the first points
arrive (a process starts, imports and loads programs), and the rate from there on. The collector is
measured with points that fail before anything is simulated: what remains is reading the config,
travelling to a worker and back, and the file. Its processor time per point limits a large cluster.
"""

import os
import tempfile
import threading
import time
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from experiments._common.driver import Run
from experiments._common.scenes import CIC
from experiments._common.style import BLUE, ORANGE, grid_below, sheet
from experiments._common.tables import Row, show
from rootsopt.config import Config, load
from rootsopt.sweeps.cluster import running
from rootsopt.sweeps.plan import Plan, plan_of
from rootsopt.sweeps.points import Numbered, simulated_together
from rootsopt.sweeps.scenes import Points, complete

ROUNDS = 2
"""Number of times that everything is measured; the fastest round counts."""
SPEED, ANGLE = "scene.speed_rpm", "profile.pressure_angle_deg"
TOGETHER = 16
"""Number of points that are stepped together as arrays (`vmap`), to compare with one by one."""
INVALID = (5.0, 10.0)
"""Pressure angles (°) with which the shipped CIC profile is not sound."""


def _name(workers: int | None) -> str:
    return f"{workers} worker{'s' * (workers > 1)}" if workers else "this process"


def _best(config: Config, plan: Plan, workers: int | None, rounds: int) -> Row:
    """Return the fastest of several measurements."""
    found = [_timed(config, plan, workers) for _ in range(rounds)]
    return max(found, key=lambda row: row["points_per_second"])


class _Together:
    """Simulates points as an accelerator would: those of a chunk are stepped together."""

    slots = 1

    def share(self, count: int) -> int:
        return min(count, TOGETHER)

    def simulated(self, config: Config, points: Sequence[Numbered], _: threading.Event) -> Any:
        numbers, every = zip(*points, strict=True)
        return [*zip(numbers, simulated_together(config, every), strict=True)]


def _timed(config: Config, plan: Plan, workers: int | None, together: bool = False) -> Row:
    """Run a sweep with its file; return start-up time (s), total time (s) and rate.

    The points are simulated as a sweep does with this number of `workers`, or `together`.
    `cpu_ms_per_point` is the processor time of this process alone: with workers, that of scheduler
    and collector."""
    arrivals: list[tuple[float, float, int]] = []
    began = time.perf_counter()

    def progress(done: int, expected: int) -> None:
        arrivals.append((time.perf_counter() - began, time.process_time(), done))

    with tempfile.TemporaryDirectory() as folder:
        journal = Points(config, plan, (), Path(folder) / "points")
        with running(workers) as runs, closing(journal):
            rows = complete(config, plan, _Together() if together else runs, journal, progress)
    assert len(rows) == plan.count
    (first, used, had), (last, spent, done) = arrivals[1], arrivals[-1]
    return {
        "points": plan.count,
        "start_s": first,
        "total_s": time.perf_counter() - began,
        "points_per_second": (done - had) / (last - first) if done > had else done / last,
        "cpu_ms_per_point": 1e3 * (spent - used) / max(done - had, 1),
        "load_average": os.getloadavg()[0],
        "cores": os.cpu_count(),
    }


def throughput(ways: list[Row]) -> Figure:
    """Draw the rate of points, and the time until the first points, for each way to run them."""
    figure, axes = sheet(9, 1.4 + 0.5 * len(ways), 1, 2, sharey=True)
    shown = {
        "points_per_second": ("points per second, after the first", BLUE, "%.1f"),
        "start_s": ("time to the first points (s)", ORANGE, "%.1f"),
    }
    for ax, (key, (label, color, form)) in zip(axes[0], shown.items(), strict=True):
        bars = ax.barh(range(len(ways)), [row[key] for row in ways], 0.6, color=color)
        ax.bar_label(bars, fmt=form, padding=3, fontsize=9)
        ax.set_yticks(range(len(ways)), [row["way"] for row in ways])
        ax.margins(x=0.15)
        ax.set_xlabel(label)
        grid_below(ax, axis="x")
    axes[0, 0].invert_yaxis()
    return figure


def run(job: Run) -> None:
    """Measure points with a simulation, and points without one; write a row for each way."""
    config = load(CIC)
    workers, rounds = ((None, 1), 1) if job.quick else ((None, 1, 2), ROUNDS)
    _timed(config, plan_of({SPEED: "1000:1001:2"}), None)
    plans = {
        "sweeps": plan_of({SPEED: f"1000:4000:{8 if job.quick else 96}"}),
        "sweeps_collector": plan_of(
            {ANGLE: f"{INVALID[0]}:{INVALID[1]}:{64 if job.quick else 1000}"}
        ),
    }
    tables: dict[str, list[Row]] = {}
    for name, plan in plans.items():
        rows = tables[name] = []
        for count in workers:
            rows.append({"way": _name(count)} | _best(config, plan, count, rounds))
            job.say(
                f"{name}, {_name(count)}: {rows[-1]['points_per_second']:.3g} points per second"
            )
    ways = tables["sweeps"]
    if not job.quick:
        together = _timed(
            config, plan_of({SPEED: f"1000:4000:{4 * TOGETHER}"}), None, together=True
        )
        ways.append({"way": f"this process, {TOGETHER} at a time (vmap)"} | together)
    for name, rows in tables.items():
        job.csv(f"{name}.csv", rows)
        show(f"Points of {name}.csv", rows)
    job.figure("sweeps.png", throughput(ways))
