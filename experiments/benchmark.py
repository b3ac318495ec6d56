"""Speed and memory beside two competitors, in one run on one machine.

    python experiments/benchmark.py [-o DIR] [--quick] [--gpu]

The shipped CIC scene, every tool at the cheapest setting that gives mean and peak force to 1e-3:
(a) SciPy with node-to-segment contact, (b) the pair compiled by Numba, both with
central differences, (c) rootsopt, one design and batches; (d) gap table and its Jacobian,
(e) cost over revolutions and batch size, memory of a long reverse-mode gradient, (f) the main
job from a cold process, without compiled programs and with them, (g) large batches on a GPU.

Each part runs in a process of its own (`--part NAME`, which prints JSON), so that its peak memory
is its own. Build, compile and run are timed apart, and the error reached stands beside the time.
Writes benchmark.csv, benchmark.json and benchmark.png, and ends with the table of targets.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

# As the commands do, before equinox is first imported.
os.environ.setdefault("EQX_ON_ERROR", "off")

from experiments.benchmark_parts.common import BATCH_SECONDS, CONFIG, MB, Job, Row, row
from experiments.benchmark_parts.competitors import part_numba, part_scipy
from experiments.benchmark_parts.designs import part_batch, part_reference, part_single
from experiments.benchmark_parts.pieces import (
    part_orbit,
    part_reverse,
    part_revolutions,
    part_table,
)
from experiments.benchmark_parts.report import COLUMNS, figure_of, show, targets
from rootsopt import files

SIZES = (16, 256, 1024)
GPU_SIZES = (256, 4096, 16384, 65536)

PARTS: dict[str, Callable[[Job], dict[str, Any]]] = {
    "reference": part_reference,
    "scipy": part_scipy,
    "numba": part_numba,
    "single": part_single,
    "batch": part_batch,
    "orbit": part_orbit,
    "table": part_table,
    "revolutions": part_revolutions,
    "reverse": part_reverse,
    "gpu": part_batch,
}


# The run


def say(text: str) -> None:
    """Progress."""
    print(text, file=sys.stderr, flush=True)


def timed_child(
    command: list[str], environment: dict[str, str], log: Path
) -> tuple[float, float, int]:
    """Wall seconds, peak memory (MB) and exit code of a process."""
    began = time.perf_counter()
    with open(log, "wb") as sink:
        child = subprocess.Popen(command, env=environment, stdout=sink, stderr=sink)
        _, status, usage = os.wait4(child.pid, 0)
    # wait4 has reaped it behind Popen's back.
    child.returncode = os.waitstatus_to_exitcode(status)
    return time.perf_counter() - began, usage.ru_maxrss * 1024 * MB, child.returncode


class Run:
    """Runs the parts one after the other and gathers their rows and findings."""

    def __init__(self, quick: bool, scratch: Path):
        self.quick, self.scratch = quick, scratch
        self.rows: list[Row] = []
        self.known: dict[str, Any] = {"deepest": {}}
        self.failed: dict[str, str] = {}
        self.began = time.perf_counter()

    def part(self, name: str, size: int = 0) -> bool:
        """Run a part in its own process; whether it gave a result."""
        said = name + (f" {size}" if size else "")
        state, out, log = (self.scratch / one for one in ("known.json", "out.json", "log.txt"))
        state.write_text(json.dumps(self.known))
        out.unlink(missing_ok=True)
        command = [sys.executable, __file__, "--part", name, "--size", str(size)]
        command += ["--known", str(state), "--result", str(out)] + ["--quick"] * self.quick
        seconds, memory, code = timed_child(command, dict(os.environ), log)
        if code != 0 or not out.exists():
            tail = log.read_text(errors="replace").strip().splitlines()
            self.failed[said] = tail[-1] if tail else f"exit code {code}"
            say(f"{said} failed after {seconds:.0f} s: {self.failed[said]}")
            return False
        found = json.loads(out.read_text())
        for one in found.pop("rows", []):
            self.rows.append({"part": said, **one, "peak_memory_MB": memory})
        self.known |= found
        say(f"{said}: {seconds:.0f} s ({time.perf_counter() - self.began:.0f} s in all)")
        return True

    def batches(self, name: str, sizes: Sequence[int]) -> None:
        """Batches from small to large, as long as they can be expected to end in time."""
        for size in sizes:
            before = [r for r in self.rows if r["part"].startswith(f"{name} ")]
            # Each is run at least twice.
            expected = sum(2e-3 * r["per_design_ms"] * size for r in before[-2:])
            if expected > BATCH_SECONDS:
                self.failed[f"{name} {size}"] = f"not run: {expected:.0f} s expected"
                say(f"{name} {size} {self.failed[f'{name} {size}']}")
            elif not self.part(name, size):
                break

    def main_job(self) -> None:
        """The main job from a cold process: no cache, an empty one, a filled one."""
        job, options = "rootsopt.optimize", []
        cases = ["cold", "filling the cache", "cached"]
        if self.quick:
            job, cases, options = "rootsopt.profile", cases[2:], ["--no-figures"]
        environment = os.environ | {"ROOTSOPT_CACHE": str(self.scratch / "cache")}
        for case in cases:
            folder = self.scratch / case.split()[0]
            command = [sys.executable, "-m", job, CONFIG, "-o", str(folder), *options]
            command += ["--no-cache"] * (case == "cold")
            seconds, memory, code = timed_child(command, environment, self.scratch / "log.txt")
            one = row("rootsopt", f"{job.split('.')[1]}, {case}", seconds, note=f"exit {code}")
            self.rows.append({"part": "main job", **one, "peak_memory_MB": memory})
            if code != 0:
                self.failed[f"main job, {case}"] = f"exit code {code}"
            say(f"main job, {case}: {seconds:.1f} s")


def whole(options: argparse.Namespace) -> int:
    """Run all parts, write and print."""
    folder = files.ResultFolder(options.output)
    with tempfile.TemporaryDirectory() as scratch:
        run = Run(options.quick, Path(scratch))
        if not run.part("reference"):
            return 3
        for name in ("scipy", "numba", "single"):
            run.part(name)
        if "choice" in run.known:
            run.batches("batch", (4,) if options.quick else SIZES)
        for name in ("table", "revolutions"):
            run.part(name)
        for name in ("orbit", "reverse"):
            if options.quick:
                run.failed[name] = "left out of a quick run"
            else:
                run.part(name)
        run.main_job()
        if options.gpu and "choice" in run.known:
            run.batches("gpu", GPU_SIZES)
    goals = targets(run.rows)
    # Columns in their usual order; what only some rows have comes last.
    keys = dict.fromkeys([*COLUMNS, *(key for one in run.rows for key in one)])
    folder.write_csv("benchmark.csv", files.row_columns(run.rows, keys))
    folder.write_json(
        "benchmark.json",
        {
            "rows": run.rows,
            "targets": goals,
            "not_measured": run.failed,
            "reference": run.known,
            "quick": options.quick,
            "processors": os.cpu_count(),
            "versions": files.versions(),
        },
    )
    folder.write_figure("benchmark.png", figure_of(run.rows))
    show("Benchmark", run.rows, COLUMNS)
    for name, reason in run.failed.items():
        print(f"not measured: {name}: {reason}")
    show("Targets", goals, ("target", "limit", "figure", "reached", "note"))
    print(f"{time.perf_counter() - run.began:.0f} s; written to {options.output}")
    return 0


def main() -> int:
    arguments = argparse.ArgumentParser(description="Speed and memory beside two competitors.")
    arguments.add_argument("-o", "--output", type=Path, default=Path("results/benchmark"))
    arguments.add_argument(
        "--quick", action="store_true", help="coarse contact, small sizes, as in the tests"
    )
    arguments.add_argument("--gpu", action="store_true", help="large batches on a GPU as well")
    inner = arguments.add_argument_group("used by the script itself, for one part's process")
    inner.add_argument("--part", choices=PARTS)
    inner.add_argument("--size", type=int, default=0)
    inner.add_argument("--known", type=Path)
    inner.add_argument("--result", type=Path)
    options = arguments.parse_args()
    if options.part is None:
        return whole(options)
    known = json.loads(options.known.read_text())
    result = PARTS[options.part](Job(options.part, options.quick, options.size, known))
    files.ResultFolder(options.result.parent).write_json(options.result.name, result)
    return 0


if __name__ == "__main__":
    sys.exit(main())
