"""Searches killed (SIGKILL) at random instants and resumed, against one that was not killed.

Each case is a whole `optimize`, killed between its start and its end. It is resumed if there is a
checkpoint, and otherwise run again. Optimum, history and certificate must then equal those of the
uninterrupted run to the last bit, and no checkpoint may be left. Some are killed twice. Every other
search is one under tolerances.
"""

import json
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from rootsopt.output.runs import RESULT
from tests.fuzz.report import Report

ROOT = Path(__file__).parents[2]
_FEW = [
    "optimizer.screening=4",
    "optimizer.starts=2",
    "optimizer.iterations=12",
    "solver.max_mesh_periods=64",
]
_SEARCHES = {
    "nominal": _FEW,
    "robust": [
        *_FEW,
        "tolerances.over.scene.load.torque_N_m.relative_normal=0.05",
        "tolerances.samples=4",
        "tolerances.check_samples=8",
    ],
}
"""Overrides of `configs/cic.yaml`, by name."""
_OWN = "compile_seconds", "run_seconds", "seconds", "statistics", "run", "versions"
"""Entries of the result file that differ between runs of the same search."""


def run(report: Report, seed: int) -> None:
    """Kill searches until the report is over."""
    chance = random.Random(seed)
    place = Path(tempfile.mkdtemp(prefix="resumes-"))
    os.environ["ROOTSOPT_CACHE"] = str(place / "cache")
    try:
        known: dict[str, tuple[float, str]] = {}
        while not report.over:
            name = [*_SEARCHES][report.total % len(_SEARCHES)]
            if name not in known:
                known[name] = _whole(place / name, name)
            _case(report, chance, place / f"run-{report.total}", name, *known[name])
    finally:
        shutil.rmtree(place, ignore_errors=True)


def _whole(folder: Path, name: str) -> tuple[float, str]:
    """Return the time (s) of a search that is not killed, its programs cached, and its outcome."""
    for more in ([], ["--overwrite"]):  # The first one also compiles.
        began = time.monotonic()
        command = _arguments(folder, name, *more)
        subprocess.run(command, cwd=ROOT, check=True, capture_output=True)
        seconds = time.monotonic() - began
    return seconds, _outcome(folder)


def _arguments(folder: Path, name: str, *more: str) -> list[str]:
    start = [sys.executable, "-m", "rootsopt.optimize", "configs/cic.yaml", "-o", str(folder)]
    overrides = [part for text in _SEARCHES[name] for part in ("--set", text)]
    return [*start, *overrides, "--no-figures", *more]


def _case(
    report: Report, chance: random.Random, folder: Path, name: str, seconds: float, known: str
) -> None:
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "cwd": ROOT}
    checkpoint = folder.with_name(f".{folder.name}.checkpoint")
    kills, shares, resumed = chance.choice([1, 1, 2]), [], 0
    for _ in range(kills):
        more = ["--resume"] if checkpoint.exists() else []
        resumed += bool(more)
        process = subprocess.Popen(_arguments(folder, name, *more), **quiet)
        shares.append(chance.uniform(0.2, 1.05))
        time.sleep(shares[-1] * seconds)
        process.kill()
        if process.wait() == 0:
            break
    else:
        more = ["--resume"] if checkpoint.exists() else []
        resumed += bool(more)
        # A run killed after its folder was in place is moved aside by this one.
        done = subprocess.run(
            _arguments(folder, name, *more), cwd=ROOT, capture_output=True, text=True
        )
        wrong = [] if done.returncode == 0 else [f"exit {done.returncode}: {done.stderr[-200:]}"]
        if not wrong and _outcome(folder) != known:
            wrong.append("the result differs")
        if checkpoint.exists():
            wrong.append("the checkpoint is left")
        shown = ", ".join(f"{share:.3f}" for share in shares)
        text = f"at {shown} of {seconds:.1f} s: {'; '.join(wrong)}"
        report.add(f"{name}, {kills} killed, {resumed} resumed", text if wrong else None)
    shutil.rmtree(folder, ignore_errors=True)


def _outcome(folder: Path) -> str:
    """Return everything a search finds, without times and statistics of the process."""
    result = _without_own(json.loads((folder / RESULT).read_bytes()))
    texts = (folder / "history.csv", folder / "optimized.yaml")
    return json.dumps(result, sort_keys=True) + "".join(path.read_text() for path in texts)


def _without_own(tree: Any) -> Any:
    """Return a copy of `tree` without the entries `_OWN`."""
    if isinstance(tree, dict):
        return {key: _without_own(value) for key, value in tree.items() if key not in _OWN}
    return [*map(_without_own, tree)] if isinstance(tree, list) else tree
