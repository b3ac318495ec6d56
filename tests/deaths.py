"""Runs that fail or end at a chosen file operation; `python -m tests.deaths` tries them all.

It needs no JAX, so that it can fork."""

import errno
import functools
import hashlib
import itertools
import os
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from rootsopt.errors import InputError
from rootsopt.view import files
from rootsopt.view.runs import RunFolder

WRITING = ("open", "write", "fsync", "mkdir", "rename", "replace", "ftruncate", "pwrite")
"""Operations that a full disk makes fail."""
REMOVING = ("unlink", "rmdir")
BEFORE = ("absent", "empty", "run", "overwritten")
"""Content of the target: nothing, an empty folder, a run to be moved aside, or one to be
replaced."""


class _System:
    """The `os` of a module, in which operation number `at` is passed to `fail`."""

    def __init__(self, operations: tuple[str, ...], at: int, fail: Callable[[str, Any], Any]):
        self.operations, self.at, self.fail, self.count = operations, at, fail, 0

    def __getattr__(self, name: str) -> Any:
        real = getattr(os, name)
        return self.counted(name, real) if name in self.operations else real

    def counted(self, name: str, real: Callable) -> Callable:
        def call(*arguments, **options):
            self.count += 1
            if self.count == self.at:
                return self.fail(name, lambda: real(*arguments, **options))
            return real(*arguments, **options)

        return call


class faulty:  # noqa: N801
    """Pass operation number `at` of the file layer to `fail(name, operation)` in a `with` block."""

    def __init__(self, operations, at: int, fail):
        self.system = _System(operations, at, fail)

    def __enter__(self) -> _System:
        self.before = files.os, files.shutil
        files.os = self.system  # type: ignore[assignment]
        if "unlink" in self.system.operations:
            removed = self.system.counted("rmtree", shutil.rmtree)
            files.shutil = SimpleNamespace(rmtree=removed)  # type: ignore[assignment]
        return self.system

    def __exit__(self, *_) -> None:
        files.os, files.shutil = self.before


def full_disk(name: str, do: Callable[[], Any]) -> None:
    """Fail as on a full disk; a write fails after writing nothing."""
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def die(name: str, do: Callable[[], Any]) -> None:
    """End the process without any clean-up, before the operation."""
    os._exit(9)


def write_run(target: Path, text: str, overwrite: bool = False) -> list[str]:
    """Write a small run in which every file contains `text`."""
    with RunFolder(target, "simulate", overwrite) as folder:
        folder.write_text("config.yaml", text)
        folder.write_csv("response_design.csv", {"a": [1.0], "text": [text]})
        folder.write_json("result.json", {"text": text})
        folder.write_bytes("figures/force.png", text.encode() * 9000)
        return folder.put_in_place()


def digest(folder: Path) -> str | None:
    """Return a digest of the names and contents of all files in a folder; None without a folder."""
    if not folder.is_dir():
        return None
    found = hashlib.sha256()
    for path in sorted(folder.rglob("*")):
        found.update(os.fsencode(path.relative_to(folder)) + b"\0")
        if path.is_file():
            found.update(hashlib.sha256(path.read_bytes()).digest())
    return found.hexdigest()


def prepared(parent: Path, before: str) -> Path:
    """Return a target with the state `before` in an empty folder `parent`."""
    target = parent / "run"
    if before == "empty":
        target.mkdir()
    elif before in ("run", "overwritten"):
        write_run(target, "old")
    return target


def scratch() -> Path:
    """Return a new folder, in memory if possible, because thousands of files are synchronised."""
    memory = "/dev/shm"
    usable = os.path.isdir(memory) and os.access(memory, os.W_OK)
    return Path(tempfile.mkdtemp(prefix="deaths-", dir=memory if usable else None))


def failures(place: Path, kind: str, before: str, at: int):
    """Let operation number `at` of a run fail (`full`), or the process end before it (`dead`).

    Return whether there was such an operation, and what is wrong afterwards."""
    new = digest_of("new")
    (place / "parent").mkdir()
    target = prepared(place / "parent", before)
    old, listing = digest(target), sorted(os.listdir(target.parent))
    wrong: list[str] = []
    hit, reported = _tried(target, kind, before, at)
    now = digest(target)
    if now not in (old, new, None):
        wrong.append("the folder is neither the old run nor the new one")
    if kind == "full":
        names = sorted(os.listdir(target.parent))
        if reported is None:
            fine = now == new and not any(name.startswith(".") for name in names)
        else:
            fine = now == old and names == listing and "\n" not in reported
            fine &= "no space left" in reported
        wrong += [] if fine else [f"reported as {reported!r}, {now=}, with {names}"]
    write_run(target, "next")
    if digest(target) != digest_of("next"):
        wrong.append("the next run is not whole")
    names = os.listdir(target.parent)
    kept = {digest(target.parent / name) for name in names}
    faults = {
        f"the next run leaves {names}": any(name.startswith(".") for name in names),
        "the older run is lost": before == "run" and old not in kept,
        "the new run is lost": now == new and new not in kept,
        "a folder aside is no whole run": kept - {old, new, digest_of("next")},
    }
    return hit, wrong + [fault for fault, is_so in faults.items() if is_so]


def _tried(target: Path, kind: str, before: str, at: int):
    """Return whether the operation was reached, and the message of the run that failed."""
    overwrite = before == "overwritten"
    if kind == "full":
        with faulty(WRITING, at, full_disk) as system:
            try:
                write_run(target, "new", overwrite)
            except InputError as error:
                return system.count >= at, str(error)
        return system.count >= at, None
    child = os.fork()
    if not child:
        try:
            with faulty((*WRITING, *REMOVING), at, die):
                write_run(target, "new", overwrite)
        finally:
            os._exit(0)
    _, status = os.waitpid(child, 0)
    return os.waitstatus_to_exitcode(status) == 9, None


@functools.cache
def digest_of(text: str) -> str | None:
    """Return the digest of a complete run."""
    place = scratch()
    write_run(place / "run", text)
    found = digest(place / "run")
    shutil.rmtree(place)
    return found


def every_operation(kind: str) -> tuple[int, list[str]]:
    """Try each operation of each kind of run; return the number of tries, and what went wrong."""
    tried, wrong = 0, []
    for before in BEFORE:
        for at in itertools.count(1):
            place = scratch()
            hit, found = failures(place, kind, before, at)
            shutil.rmtree(place)
            where = f"{kind} at operation {at}, target {before}"
            wrong += [f"{where}: {text}" for text in found]
            if not hit:
                break
            tried += 1
    return tried, wrong


if __name__ == "__main__":
    for kind in ("full", "dead"):
        tried, wrong = every_operation(kind)
        print(f"{kind}: {tried} operations, {len(wrong)} wrong", *wrong, sep="\n")
        assert tried > 40
