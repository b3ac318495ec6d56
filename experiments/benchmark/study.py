"""Measures speed and memory of rootsopt and two competitors, in one run on one machine.

The scene is the shipped CIC scene. Every tool runs at its cheapest setting with mean and peak force
accurate to 1e-3:
(a) SciPy with node-to-segment contact and central differences;
(b) the pair compiled by Numba, with central differences;
(c) rootsopt, one design and batches;
(d) cost over revolutions and batch size;
(e) the main job from a cold process, without and with cached programs;
(f) large batches on a GPU.

Each part runs in its own process (`--part NAME`, which writes JSON), so that peak memory is
measured for each part. No module here loads JAX before a part needs it. Build, compile and run are
timed separately, and the error reached is listed next to the time.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from experiments._common.driver import NoResultError
from experiments._common.scenes import CIC
from experiments._common.timing import MB
from experiments.benchmark.competitors import part_numba, part_scipy
from experiments.benchmark.designs import part_batch, part_reference, part_single
from experiments.benchmark.job import BATCH_SECONDS, Job, Row, row
from experiments.benchmark.pieces import part_orbit, part_revolutions

Say = Callable[[str], None]
SIZES = (16, 256, 1024)
GPU_SIZES = (256, 4096, 16384, 65536)
MODULE = "experiments.benchmark"
"""Name of the module that the process of a part runs."""
RESULT = "part.json"
"""Name of the file with a part's findings, in the result folder of its process."""

PARTS: dict[str, Callable[[Job], dict[str, Any]]] = {
    "reference": part_reference,
    "scipy": part_scipy,
    "numba": part_numba,
    "single": part_single,
    "batch": part_batch,
    "orbit": part_orbit,
    "revolutions": part_revolutions,
    "gpu": part_batch,
}


def timed_child(
    command: list[str], environment: dict[str, str], log: Path
) -> tuple[float, float, int]:
    """Run a process; return wall time (s), peak memory (MB) and exit code."""
    began = time.perf_counter()
    with open(log, "wb") as sink:
        child = subprocess.Popen(command, env=environment, stdout=sink, stderr=sink)
        _, status, usage = os.wait4(child.pid, 0)
    # wait4 has collected the exit status, which Popen does not know.
    child.returncode = os.waitstatus_to_exitcode(status)
    return time.perf_counter() - began, usage.ru_maxrss * 1024 * MB, child.returncode


class Parts:
    """Runs the parts one after the other and collects their rows and findings."""

    def __init__(self, quick: bool, scratch: Path, say: Say):
        self.quick, self.scratch, self.say = quick, scratch, say
        self.rows: list[Row] = []
        self.known: dict[str, Any] = {}
        self.failed: dict[str, str] = {}

    def part(self, name: str, size: int = 0) -> bool:
        """Run a part in its own process; return whether it gave a result."""
        said = name + (f" {size}" if size else "")
        state, log, folder = (self.scratch / one for one in ("known.json", "log.txt", "part"))
        out = folder / RESULT
        state.write_text(json.dumps(self.known))
        out.unlink(missing_ok=True)
        command = [sys.executable, "-m", MODULE, "--part", name, "--size", str(size)]
        command += ["--known", str(state), "-o", str(folder)] + ["--quick"] * self.quick
        seconds, memory, code = timed_child(command, dict(os.environ), log)
        if code != 0 or not out.exists():
            tail = log.read_text(errors="replace").strip().splitlines()
            self.failed[said] = tail[-1] if tail else f"exit code {code}"
            self.say(f"{said} failed after {seconds:.0f} s: {self.failed[said]}")
            return False
        found = json.loads(out.read_text())
        for one in found.pop("rows", []):
            self.rows.append({"part": said, **one, "peak_memory_MB": memory})
        self.known |= found
        self.say(f"{said}: {seconds:.0f} s")
        return True

    def batches(self, name: str, sizes: Sequence[int]) -> None:
        """Run batches from small to large, while they are expected to end in time."""
        for size in sizes:
            before = [r for r in self.rows if r["part"].startswith(f"{name} ")]
            # Each batch is run at least twice.
            expected = sum(2e-3 * r["per_design_ms"] * size for r in before[-2:])
            if expected > BATCH_SECONDS:
                self.failed[f"{name} {size}"] = f"not run: {expected:.0f} s expected"
                self.say(f"{name} {size} {self.failed[f'{name} {size}']}")
            elif not self.part(name, size):
                break

    def main_job(self) -> None:
        """Run the main job from a cold process: without cache, with an empty and a filled one."""
        job, options = "rootsopt.optimize", []
        cases = ["cold", "filling the cache", "cached"]
        if self.quick:
            job, cases, options = "rootsopt.profile", cases[2:], ["--no-figures"]
        environment = os.environ | {"ROOTSOPT_CACHE": str(self.scratch / "cache")}
        for case in cases:
            folder = self.scratch / case.split()[0]
            command = [sys.executable, "-m", job, CIC, "-o", str(folder), *options]
            command += ["--no-cache"] * (case == "cold")
            seconds, memory, code = timed_child(command, environment, self.scratch / "log.txt")
            one = row("rootsopt", f"{job.split('.')[1]}, {case}", seconds, note=f"exit {code}")
            self.rows.append({"part": "main job", **one, "peak_memory_MB": memory})
            if code != 0:
                self.failed[f"main job, {case}"] = f"exit code {code}"
            self.say(f"main job, {case}: {seconds:.1f} s")


def run(quick: bool, gpu: bool = False, say: Say = lambda text: None) -> Parts:
    """Run all parts. Raises `NoResultError` if the reference cannot be computed.

    A reduced run uses small sizes, and omits the longest parts.
    """
    with tempfile.TemporaryDirectory() as scratch:
        parts = Parts(quick, Path(scratch), say)
        if not parts.part("reference"):
            raise NoResultError(f"there is no reference: {parts.failed['reference']}")
        for name in ("scipy", "numba", "single"):
            parts.part(name)
        if "choice" in parts.known:
            parts.batches("batch", (4,) if quick else SIZES)
        parts.part("revolutions")
        if quick:
            parts.failed["orbit"] = "omitted in a reduced run"
        else:
            parts.part("orbit")
        parts.main_job()
        if gpu and "choice" in parts.known:
            parts.batches("gpu", GPU_SIZES)
    return parts


def run_part(name: str, quick: bool, size: int, known: dict[str, Any]) -> dict[str, Any]:
    """Run one part in this process; return its findings, with its rows under `rows`."""
    return PARTS[name](Job(name, quick, size, known))
