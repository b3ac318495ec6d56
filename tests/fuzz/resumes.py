"""Searches killed (SIGKILL) at random instants and resumed, against one that was not killed.

Each case is a whole `optimize`, killed between its start and its end. It is resumed if there is a
checkpoint, and otherwise run again. Optimum, history and certificate must then equal those of the
uninterrupted run to the last bit, and no checkpoint may be left. Some are killed twice.
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

from rootsopt.output.runs import RESULT
from tests.fuzz.report import Report

ROOT = Path(__file__).parents[2]
_SCENE = [
    "optimizer.screening=4",
    "optimizer.starts=2",
    "optimizer.iterations=12",
    "solver.max_mesh_periods=64",
]


def run(report: Report, seed: int) -> None:
    """Kill until the report is over."""
    chance = random.Random(seed)
    place = Path(tempfile.mkdtemp(prefix="resumes-"))
    os.environ["ROOTSOPT_CACHE"] = str(place / "cache")
    try:
        for name in ("first", "whole"):  # The first one also compiles.
            began = time.monotonic()
            subprocess.run(_arguments(place / name), cwd=ROOT, check=True, capture_output=True)
            seconds = time.monotonic() - began
        known = _outcome(place / "whole")
        while not report.over:
            _case(report, chance, place / f"run-{report.total}", seconds, known)
    finally:
        shutil.rmtree(place, ignore_errors=True)


def _arguments(folder: Path, *more: str) -> list[str]:
    start = [sys.executable, "-m", "rootsopt.optimize", "configs/cic.yaml", "-o", str(folder)]
    overrides = [part for text in _SCENE for part in ("--set", text)]
    return [*start, *overrides, "--no-figures", *more]


def _case(report: Report, chance: random.Random, folder: Path, seconds: float, known: str) -> None:
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "cwd": ROOT}
    checkpoint = folder.with_name(f".{folder.name}.checkpoint")
    kills, shares, resumed = chance.choice([1, 1, 2]), [], 0
    for _ in range(kills):
        more = ["--resume"] if checkpoint.exists() else []
        resumed += bool(more)
        process = subprocess.Popen(_arguments(folder, *more), **quiet)
        shares.append(chance.uniform(0.2, 1.05))
        time.sleep(shares[-1] * seconds)
        process.kill()
        if process.wait() == 0:
            break
    else:
        more = ["--resume"] if checkpoint.exists() else []
        resumed += bool(more)
        # A run killed after its folder was in place is moved aside by this one.
        done = subprocess.run(_arguments(folder, *more), cwd=ROOT, capture_output=True, text=True)
        wrong = [] if done.returncode == 0 else [f"exit {done.returncode}: {done.stderr[-200:]}"]
        if not wrong and _outcome(folder) != known:
            wrong.append("the result differs")
        if checkpoint.exists():
            wrong.append("the checkpoint is left")
        shown = ", ".join(f"{share:.3f}" for share in shares)
        text = f"at {shown} of {seconds:.1f} s: {'; '.join(wrong)}"
        report.add(f"{kills} killed, {resumed} resumed", text if wrong else None)
    shutil.rmtree(folder, ignore_errors=True)


def _outcome(folder: Path) -> str:
    """Everything a search finds, without times, statistics of the process, and names of files."""
    result = json.loads((folder / RESULT).read_bytes())
    kept = {name: result[name] for name in ("improvement", "constraints", "optimality", "status")}
    for name in ("baseline", "optimized"):
        kept[name] = {k: v for k, v in result[name].items() if k != "statistics"}
    return json.dumps(kept, sort_keys=True) + (folder / "history.csv").read_text()
