"""Measures speed and memory of rootsopt and two competitors, in one run on one machine.

The scene is the shipped CIC scene. Every tool runs at its cheapest setting with mean and peak force
accurate to 1e-3:
(a) SciPy with node-to-segment contact and central differences;
(b) the pair compiled by Numba, with central differences;
(c) rootsopt, one design and batches;
(d) cost over revolutions and batch size;
(e) the main job from a cold process, without and with cached programs.

Each part runs in its own process, so that peak memory is measured for each part. This module does
not load JAX. Compilation and runs are timed separately, and the error reached is listed next to
the time.
"""

import dataclasses
import importlib
import multiprocessing
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from experiments._common.driver import NoResultError, Run, start_process
from experiments._common.scenes import CIC
from experiments._common.style import BLUE, ORANGE, sheet
from experiments._common.tables import Row, print_record, show
from experiments._common.timing import MB, peak_memory
from experiments.benchmark.job import ACCURACY, BATCH_SECONDS, Job, row

SIZES = (16, 256, 1024)

# Parts without rootsopt.
COMPETITORS = "scipy", "numba"


def points_of(
    rows: Sequence[Row], part: str, what: str, size: str = "designs"
) -> list[tuple[float, float]]:
    """Return (size, seconds) of the rows of a part with the task `what`, or with any."""
    return [
        (row[size], row["run_s"])
        for row in rows
        if row["part"].startswith(part) and what in ("", row["what"])
    ]


def figure_of(rows: list[Row]) -> Figure:
    """Draw the time per design by tool, and the times over revolutions and over batch size."""
    figure, ((bars, turns, batches),) = sheet(15, 5.6, 1, 3, width_ratios=(1.5, 1, 1))
    timed = [r for r in rows if r["what"] in ("value", "value+gradient")]
    names = list(dict.fromkeys(r["tool"] for r in timed))
    for shift, (what, color) in enumerate((("value", ORANGE), ("value+gradient", BLUE))):
        chosen = [r for r in timed if r["what"] == what]
        place = [names.index(r["tool"]) + 0.38 * (shift - 0.5) for r in chosen]
        label, times = what.replace("+", " + "), [r["per_design_ms"] for r in chosen]
        drawn = bars.barh(place, times, 0.36, color=color, label=label)
        bars.bar_label(drawn, fmt=short, padding=3, fontsize=7)
    bars.set_yticks(range(len(names)), names, fontsize=8)
    bars.invert_yaxis()
    bars.margins(x=0.15)
    bars.set(xscale="log", xlabel="time per design, warm (ms)")
    bars.legend(fontsize=8, loc="lower right")
    turned = points_of(rows, "revolutions", "", "revolutions")
    draw_power(turns, turned, "from rest, no statistics", BLUE, "o")
    for what, color, mark in (("value", ORANGE, "s"), ("value+gradient", BLUE, "o")):
        draw_power(batches, points_of(rows, "batch ", what), what.replace("+", " + "), color, mark)
    for ax, size, time_of in (
        (turns, "revolutions", "time"), (batches, "designs in a batch", "time of the batch"),
    ):  # fmt: skip
        ax.set(xscale="log", yscale="log", xlabel=size, ylabel=f"{time_of} (s)")
        for axis in (ax.xaxis, ax.yaxis):
            axis.set(major_formatter="{x:g}", minor_formatter=NullFormatter())
        if ax.lines:
            ax.legend(fontsize=8)
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
    if len(points) > 1:
        x, y = np.log(points).T
        label += f": exponent {np.polyfit(x, y, 1)[0]:.2f}"
    if points:
        ax.plot(*zip(*points, strict=True), marker=mark, color=color, lw=1.4, label=label)


# Columns of the table, in order.
COLUMNS = (
    *("part", "tool", "what", "designs", "per_design_ms", "run_s", "compile_s"),
    *("value_error", "gradient_error", "peak_memory_MB", "settings", "note"),
)


def measured(part: Job) -> tuple[dict[str, Any], float]:
    """Run one part in this process; return its findings, and the peak memory (MB).

    Only the parts of rootsopt load JAX."""
    if part.part not in COMPETITORS:
        start_process()
    module = "competitors" if part.part in COMPETITORS else "designs"
    work = getattr(importlib.import_module(f"experiments.benchmark.{module}"), f"part_{part.part}")
    return work(part), peak_memory()


@dataclasses.dataclass
class Parts:
    """Runs the parts one after the other and collects their rows and findings."""

    job: Run
    rows: list[Row]
    known: dict[str, Any]
    failed: dict[str, str]

    def part(self, name: str, size: int = 0) -> bool:
        """Run a part in its own process; return whether it gave a result."""
        said = name + (f" {size}" if size else "")
        context = multiprocessing.get_context("spawn")
        try:
            with ProcessPoolExecutor(1, mp_context=context) as pool:
                task = Job(name, self.job.quick, size, self.known)
                found, memory = pool.submit(measured, task).result()
        except Exception as error:  # The other parts can still be measured.
            self.failed[said] = f"{type(error).__name__}: {error}"
            self.job.say(f"{said} failed: {self.failed[said]}")
            return False
        about = {"part": said, "peak_memory_MB": memory}
        self.rows += [about | one for one in found.pop("rows", [])]
        self.known |= found
        self.job.say(said)
        return True

    def batches(self, sizes: Sequence[int]) -> None:
        """Run batches from small to large, while they are expected to end in time."""
        for size in sizes:
            before = [r for r in self.rows if r["part"].startswith("batch ")]
            # Each batch is run at least twice.
            expected = sum(2e-3 * r["per_design_ms"] * size for r in before[-2:])
            if expected > BATCH_SECONDS:
                self.failed[f"batch {size}"] = f"not run: {expected:.0f} s expected"
            elif not self.part("batch", size):
                break

    def main_job(self, scratch: Path) -> None:
        """Run the main job from a cold process: without cache, with an empty and a filled one."""
        job, options = "rootsopt.optimize", []
        cases = ["cold", "filling the cache", "cached"]
        if self.job.quick:
            job, cases, options = "rootsopt.profile", cases[2:], ["--no-figures"]
        environment = os.environ | {"ROOTSOPT_CACHE": str(scratch / "cache")}
        for case in cases:
            folder = scratch / case.split()[0]
            command = [sys.executable, "-m", job, CIC, "-o", str(folder), *options]
            command += ["--no-cache"] * (case == "cold")
            began = time.perf_counter()
            child = subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL)
            _, status, usage = os.wait4(child.pid, 0)
            seconds, memory = time.perf_counter() - began, usage.ru_maxrss * 1024 * MB
            # wait4 has collected the exit status, which Popen does not know.
            child.returncode = os.waitstatus_to_exitcode(status)
            note = f"exit {child.returncode}"
            more = {"note": note, "part": "main job", "peak_memory_MB": memory}
            self.rows.append(row("rootsopt", f"{job.split('.')[1]}, {case}", seconds, **more))
            if child.returncode != 0:
                self.failed[f"main job, {case}"] = note
            self.job.say(f"main job, {case}: {seconds:.1f} s")


def run(job: Run) -> None:
    """Run all parts; write and print their rows.

    A reduced run uses small sizes, and omits the longest part. Raises `NoResultError` if the
    reference cannot be computed.
    """
    parts = Parts(job, [], {}, {})
    if not parts.part("reference"):
        raise NoResultError(f"there is no reference: {parts.failed['reference']}")
    for name in ("scipy", "numba", "single"):
        parts.part(name)
    parts.batches((4,) if job.quick else SIZES)
    for name in ("revolutions",) if job.quick else ("revolutions", "orbit"):
        parts.part(name)
    with tempfile.TemporaryDirectory() as scratch:
        parts.main_job(Path(scratch))
    rows = parts.rows
    # Columns in their usual order; those that only some rows have come last.
    job.csv("benchmark.csv", rows, dict.fromkeys([*COLUMNS, *(key for one in rows for key in one)]))
    record = {"rows": rows, "not_measured": parts.failed}
    job.json("benchmark.json", record | {"reference": parts.known, "processors": os.cpu_count()})
    job.figure("benchmark.png", figure_of(rows))
    show("Benchmark", rows, COLUMNS)
    print_record({f"not measured: {name}": reason for name, reason in parts.failed.items()})
