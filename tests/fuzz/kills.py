"""Runs killed (SIGKILL) at random instants while they write into a folder with an older run.

Each case writes the files of a real command again, with the same file layer, in a forked process.
Cases differ: on a disk or in memory, with or without `--overwrite`, moving or exchanging folders.
Some cases are whole commands, killed at any instant after their start. Afterwards the folder must
be the complete older run or the complete new one. The next run must leave complete runs and nothing
else."""

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

from rootsopt.output.runs import RESULT, RunFolder
from tests.deaths import digest, faulty, scratch
from tests.fuzz.report import Report

ROOT = Path(__file__).parents[2]
COMMANDS = {
    "profile": ["--export", "dxf,svg"],
    "simulate": ["--no-figures"],
}
_WHOLE = 60
"""Number of cases of which one is a whole command."""


class Recorded(NamedTuple):
    """Files that a command has written, by name, and the content of its result."""

    command: str
    files: dict[str, bytes]
    result: dict

    def write(self, folder: Path, overwrite: bool = False) -> None:
        """Write the same run into another folder."""
        with RunFolder(folder, self.command, overwrite) as run:
            for name, data in self.files.items():
                run.write_bytes(name, data)
            run.write_json(RESULT, self.result)
            run.put_in_place()


def run(report: Report, seed: int) -> None:
    """Kill processes until the report is over."""
    chance = random.Random(seed)
    disk, memory = Path(tempfile.mkdtemp(prefix="kills-")), scratch()
    os.environ["ROOTSOPT_CACHE"] = str(disk / "cache")
    try:
        known, seconds = _recorded(disk)
        count = 0
        while not report.over:
            count += 1
            place = Path(tempfile.mkdtemp(dir=chance.choice([disk, memory])))
            if count % _WHOLE == 0:
                _whole(report, chance, place, seconds)
            else:
                _replayed(report, chance, place, known)
            shutil.rmtree(place)
    finally:
        shutil.rmtree(disk, ignore_errors=True)
        shutil.rmtree(memory, ignore_errors=True)


def _arguments(command: str, folder: Path, *more: str) -> list[str]:
    module = f"rootsopt.{command}"
    start = [sys.executable, "-m", module, "configs/cic.yaml", "-o", str(folder)]
    return [*start, *COMMANDS[command], *more]


def _recorded(place: Path) -> tuple[list[Recorded], float]:
    """Return two different runs of each command, and the time (s) that one takes."""
    found = []
    for command in COMMANDS:
        for design in ("30.0", "33.0"):
            folder = place / f"{command}-{design}"
            more = ["--set", f"profile.pressure_angle_deg={design}"]
            more += ["--set", "profile.involute_length_mm=7.0"]
            began = time.monotonic()
            arguments = _arguments(command, folder, *more)
            subprocess.run(arguments, cwd=ROOT, check=True, capture_output=True)
            seconds = time.monotonic() - began
            paths = [path for path in sorted(folder.rglob("*")) if path.is_file()]
            files = {path.relative_to(folder).as_posix(): path.read_bytes() for path in paths}
            result = json.loads(files.pop(RESULT))
            del result["run"]
            found.append(Recorded(command, files, result))
    return found, seconds


def _replayed(report: Report, chance: random.Random, place: Path, known: list[Recorded]) -> None:
    older, new, after = chance.sample(known, 3)
    overwrite, exchanges = chance.random() < 0.5, chance.random() < 0.8
    whole = {}
    for one in (older, new, after):
        began = time.monotonic()
        one.write(place / "alone")
        span = time.monotonic() - began
        whole[id(one)] = digest(place / "alone")
        shutil.rmtree(place / "alone")
    folder = place / "run"
    older.write(folder)
    reading, writing = os.pipe()
    child = os.fork()
    if not child:
        try:
            with faulty((), 0, None, exchanges):
                os.write(writing, b"x")
                new.write(folder, overwrite)
        finally:
            os._exit(0)
    os.close(writing)
    os.read(reading, 1)
    share = chance.uniform(0.0, 1.2)
    time.sleep(share * span)
    os.kill(child, signal.SIGKILL)
    _, status = os.waitpid(child, 0)
    os.close(reading)
    now = digest(folder)
    wrong = []
    missing = now is None and not exchanges  # between two renames; the next run finishes it
    if now not in (whole[id(older)], whole[id(new)]) and not missing:
        wrong.append("the folder is neither the older run nor the new one")
    after.write(folder)
    wrong += _afterwards(place, set(whole.values()))
    if digest(folder) != whole[id(after)]:
        wrong.append("the next run is not whole")
    kept = {digest(path) for path in place.iterdir()}
    if not overwrite and whole[id(older)] not in kept:
        wrong.append("the older run is lost")
    killed = os.waitstatus_to_exitcode(status) == -signal.SIGKILL
    kind = f"{new.command} over {older.command}" + (", --overwrite" if overwrite else "")
    kind += "" if exchanges else ", no exchange"
    if killed or wrong:  # else the run was over
        text = f"at {share:.3f} of {span:.3f} s: {'; '.join(wrong)}"
        report.add(kind, text if wrong else None)


def _afterwards(place: Path, whole: set[str | None]) -> list[str]:
    """Return what is wrong with the files left by a kill and by the next run."""
    names = os.listdir(place)
    wrong = [f"the next run leaves {name}" for name in names if name.startswith(".")]
    if any(digest(place / name) not in whole for name in names):
        wrong.append("a folder aside is no whole run")
    return wrong


def _whole(report: Report, chance: random.Random, place: Path, seconds: float) -> None:
    """Kill a command at a random instant after its start."""
    command = chance.choice(list(COMMANDS))
    arguments = _arguments(command, place / "run")
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "cwd": ROOT}
    subprocess.run(arguments, check=True, **quiet)
    older = digest(place / "run")
    process = subprocess.Popen(arguments, **quiet)
    share = chance.uniform(0.3, 1.1)
    time.sleep(share * seconds)
    process.kill()
    process.wait()
    wrong = []
    if digest(place / "run") != older and not _consistent(place / "run"):
        wrong.append("the folder is neither the older run nor the new one")
    if subprocess.run(arguments, check=False, **quiet).returncode:
        wrong.append("the next run fails")
    wrong += [f"the next run leaves {name}" for name in os.listdir(place) if name.startswith(".")]
    if not all(_consistent(path) for path in place.iterdir()):
        wrong.append("a folder is no whole run")
    if process.returncode < 0 or wrong:
        text = f"at {share:.3f} of {seconds:.1f} s: {'; '.join(wrong)}"
        report.add(f"whole {command}", text if wrong else None)


def _consistent(folder: Path) -> bool:
    """Return whether a folder contains the files that its result lists and no others."""
    try:
        listed = json.loads((folder / RESULT).read_bytes())["run"]["files"]
    except (OSError, ValueError):
        return False
    files = {p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()}
    return files == set(listed)
