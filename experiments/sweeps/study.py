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
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from experiments._common.scenes import CIC
from rootsopt.config import Config, load
from rootsopt.sweeps.local import divided
from rootsopt.sweeps.plan import Plan, plan_of
from rootsopt.sweeps.points import simulated_together
from rootsopt.sweeps.scenes import Points, Run, complete, runner

Row = dict[str, Any]
ROUNDS = 2
"""Number of times that everything is measured; the fastest round counts."""
SPEED, ANGLE = "scene.speed_rpm", "profile.pressure_angle_deg"
TOGETHER = 16
"""Number of points that are stepped together as arrays (`vmap`), to compare with one by one."""
INVALID = (5.0, 10.0)
"""Pressure angles (°) with which the shipped CIC profile is not sound."""


def run(quick: bool, say: Callable[[str], None]) -> tuple[list[Row], list[Row]]:
    """Measure points with a simulation, and points without one; return a row for each way."""
    config = load(CIC)
    workers = (None, 1) if quick else (None, 1, 2)
    points = 8 if quick else 96
    _timed(config, plan_of({SPEED: "1000:1001:2"}), None)
    ways = []
    for count in workers:
        plan = plan_of({SPEED: f"1000:4000:{points}"})
        best = _best(config, plan, count, 1 if quick else ROUNDS)
        ways.append({"way": _name(count)} | best)
        say(f"{_name(count)}: {best['points_per_second']:.3g} points per second")
    if not quick:
        plan = plan_of({SPEED: f"1000:4000:{4 * TOGETHER}"})
        name = f"this process, {TOGETHER} at a time (vmap)"
        ways.append({"way": name} | _timed(config, plan, None, _together))
        say(f"{name}: {ways[-1]['points_per_second']:.3g} points per second")
    first = ways[0]["points_per_second"]
    for row in ways:
        row["relative_to_one_process"] = row["points_per_second"] / first
    collector = []
    for count in workers:
        plan = plan_of({ANGLE: f"{INVALID[0]}:{INVALID[1]}:{64 if quick else 1000}"})
        best = _best(config, plan, count, 1 if quick else ROUNDS)
        collector.append({"way": _name(count)} | best)
        say(f"collector, {_name(count)}: {best['points_per_second']:.4g} points per second")
    return ways, collector


def _name(workers: int | None) -> str:
    if workers is None:
        return "this process"
    return f"{workers} worker{'s' if workers > 1 else ''}"


def _best(config: Config, plan: Plan, workers: int | None, rounds: int) -> Row:
    """Return the fastest of several measurements."""
    found = [_timed(config, plan, workers) for _ in range(rounds)]
    return max(found, key=lambda row: row["points_per_second"])


def _together(config: Config, plan: Plan, numbers: Sequence[int], stop: threading.Event) -> Any:
    """Simulate points as an accelerator would: those of a chunk are stepped together."""
    del stop
    for some in divided([*numbers], TOGETHER):
        rows = simulated_together(config, [plan.at(number) for number in some])
        yield [*zip(some, rows, strict=True)]


def _timed(config: Config, plan: Plan, workers: int | None, run: Run | None = None) -> Row:
    """Run a sweep with its file; return start-up time (s), total time (s) and rate.

    `run`: how to simulate the points, by default as a sweep does with this number of `workers`.
    `cpu_ms_per_point` is the processor time of this process alone: with workers, that of scheduler
    and collector."""
    arrivals: list[tuple[float, float, int]] = []
    began = time.perf_counter()

    def progress(done: int, expected: int) -> None:
        arrivals.append((time.perf_counter() - began, time.process_time(), done))

    with tempfile.TemporaryDirectory() as folder:
        journal = Points(config, plan, (), Path(folder) / "points")
        way = run or runner(workers)
        rows = complete(config, plan, way, journal, progress, threading.Event())
        journal.close()
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
