"""Runs that fail or end at a chosen file operation; `python -m tests.deaths` tries them all.

It needs no JAX, so that it can fork."""

import contextlib
import errno
import functools
import itertools
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest import mock

from rootsopt.errors import InputError
from rootsopt.view import files
from rootsopt.view.runs import RunFolder

WRITING = ("open", "write", "fsync", "mkdir", "rename", "replace", "ftruncate", "pwrite")
"""Operations that a full disk makes fail."""
REMOVING = ("unlink", "rmdir", "rmtree")
MEMORY = "/dev/shm" if os.access("/dev/shm", os.W_OK) else None
BEFORE = ("absent", "empty", "run", "overwritten")
"""Content of the target: nothing, an empty folder, a run to be moved aside, or one to be
replaced."""


@contextlib.contextmanager
def faulty(operations: tuple[str, ...], at: int, fail: Callable[[], Any]) -> Iterator[list]:
    """Call `fail` instead of operation number `at` of the file layer in a `with` block.

    Yield the list of the operations so far."""
    calls: list[str] = []

    def counted(real: Callable) -> Callable:
        def call(*arguments, **options):
            calls.append(real.__name__)
            return fail() if len(calls) == at else real(*arguments, **options)

        return call

    changed = {name: counted(real) for name, real in vars(os).items() if name in operations}
    rmtree = counted(shutil.rmtree) if "rmtree" in operations else shutil.rmtree
    with (
        mock.patch.object(files, "os", SimpleNamespace(**vars(os) | changed)),
        mock.patch.object(files, "shutil", SimpleNamespace(rmtree=rmtree)),
    ):
        yield calls


def full_disk() -> None:
    """Fail as on a full disk; a write fails after writing nothing."""
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def write_run(target: Path, text: str, overwrite: bool = False) -> list[str]:
    """Write a small run in which every file contains `text`."""
    with RunFolder(target, "simulate", overwrite) as folder:
        folder.write_text("config.yaml", text)
        folder.write_csv("response_design.csv", {"a": [1.0], "text": [text]})
        folder.write_json("result.json", {"text": text})
        folder.write_bytes("figures/force.png", text.encode() * 9000)
        return folder.put_in_place()


def digest(folder: Path) -> frozenset | None:
    """Return the names and contents of all files in a folder; None without a folder."""
    if not folder.is_dir():
        return None
    return frozenset(
        (path.relative_to(folder), path.read_bytes() if path.is_file() else None)
        for path in folder.rglob("*")
    )


def failures(place: Path, kind: str, before: str, at: int) -> tuple[bool, list[str]]:
    """Let operation number `at` of a run fail (`full`), or the process end before it (`dead`).

    Return whether there was such an operation, and what is wrong afterwards."""
    new, after = digest_of("new"), digest_of("next")
    target = place / "parent" / "run"
    target.parent.mkdir()
    if before == "empty":
        target.mkdir()
    elif before != "absent":
        write_run(target, "old")
    old, listing = digest(target), sorted(os.listdir(target.parent))
    hit, reported = _tried(target, kind, before, at)
    now, names = digest(target), sorted(os.listdir(target.parent))
    if kind == "dead":
        fine = True
    elif reported is None:
        fine = now == new and not any(name.startswith(".") for name in names)
    else:
        fine = now == old and names == listing and "\n" not in reported
        fine &= "no space left" in reported
    write_run(target, "next")
    left = os.listdir(target.parent)
    kept = {digest(target.parent / name) for name in left}
    faults = {
        "the folder is neither the old run nor the new one": now not in (old, new, None),
        f"reported as {reported!r}, {names} and {now == new=}": not fine,
        "the next run is not whole": digest(target) != after,
        f"the next run leaves {left}": any(name.startswith(".") for name in left),
        "the older run is lost": before == "run" and old not in kept,
        "the new run is lost": now == new and new not in kept,
        "a folder aside is no whole run": kept - {old, new, after},
    }
    return hit, [fault for fault, is_so in faults.items() if is_so]


def _tried(target: Path, kind: str, before: str, at: int) -> tuple[bool, str | None]:
    """Return whether the operation was reached, and the message of the run that failed."""
    overwrite, reported = before == "overwritten", None
    if kind == "full":
        with faulty(WRITING, at, full_disk) as calls:
            try:
                write_run(target, "new", overwrite)
            except InputError as error:
                reported = str(error)
        return len(calls) >= at, reported
    child = os.fork()
    if not child:
        try:
            # The process ends without any clean-up, before the operation.
            with faulty((*WRITING, *REMOVING), at, functools.partial(os._exit, 9)):
                write_run(target, "new", overwrite)
        finally:
            os._exit(0)
    _, status = os.waitpid(child, 0)
    return os.waitstatus_to_exitcode(status) == 9, None


@functools.cache
def digest_of(text: str) -> frozenset | None:
    with tempfile.TemporaryDirectory() as place:
        write_run(Path(place) / "run", text)
        return digest(Path(place) / "run")


def every_operation(kind: str) -> tuple[int, list[str]]:
    """Try each operation of each kind of run; return the number of tries, and what went wrong."""
    tried, wrong = 0, []
    for before in BEFORE:
        for at in itertools.count(1):
            # In memory if possible, because thousands of files are synchronised.
            with tempfile.TemporaryDirectory(dir=MEMORY) as place:
                hit, found = failures(Path(place), kind, before, at)
            wrong += [f"{kind} at operation {at}, target {before}: {text}" for text in found]
            if not hit:
                break
            tried += 1
    return tried, wrong


if __name__ == "__main__":
    for kind in ("full", "dead"):
        tried, wrong = every_operation(kind)
        print(f"{kind}: {tried} operations, {len(wrong)} wrong", *wrong, sep="\n")
        assert tried > 40
