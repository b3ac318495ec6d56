"""The result folder of one run of a command: first temporary, then moved to its final path.

The target is the folder that the user names. A run writes into its own temporary folder beside the
target, `.NAME.PROCESS-XXXXXXXX.rootsopt`. When all files are written, this folder takes the
target's name in one step. The target therefore never contains a mixture of two runs. A lock file
beside the target, `.NAME.rootsopt`, keeps other processes out. The temporary folder and the lock
file disappear when the run ends. If a run is killed, the next run removes what it left behind.

What happens depends on the content of the target:

- nothing: the new run takes its place;
- an earlier run: it is moved to `NAME.1`, `NAME.2` …; with `overwrite` it is replaced, unless it
  contains files that are not its own;
- anything else: the target is refused.

The earlier run is moved away first. If the process is killed at that moment, the next run moves the
finished folder to the target."""

import contextlib
import hashlib
import json
import os
import re
import secrets
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from rootsopt.config import sources
from rootsopt.errors import InputError
from rootsopt.response.journal import aside
from rootsopt.view import files
from rootsopt.view.files import Lock, ResultFolder, TakenError, plain

RESULT = "result.json"
"""Name of the file that lists all files of a run and is written last."""
_SUFFIX = ".rootsopt"
_STAGE = re.compile(r"(\..+)\.\d+-[0-9a-f]{8}" + re.escape(_SUFFIX))

# Length (bytes) of a folder's name above which temporary names contain a digest of the name
# instead of the name itself.
_LONGEST = 150

# Time (s) after a request to stop above which the temporary folder is left behind. This happens
# if a write is still in progress.
_PATIENCE = 10.0


class RunFolder(ResultFolder, contextlib.AbstractContextManager["RunFolder"]):
    """A `ResultFolder` that appears at its final path only when it is complete.

    `path`: the final path; `place`: temporary folder into which files are written until the run is
    complete; `command`: name of the command, for the result file; `overwrite`: whether to replace
    an earlier run. Use it as a context manager and call `put_in_place` at the end; otherwise the
    folder is removed.

    Raises `InputError` if the path cannot be used. Examples: another process is writing there, it
    contains files that belong to no run, it is not a folder, or its parent is not writable."""

    def __init__(self, path: str | os.PathLike, command: str = "", overwrite: bool = False):
        name = os.fspath(path)
        if not name:
            raise InputError(
                "`--output` must name a folder, but is empty; give a path, or leave it out"
            )
        self.path = Path(path)
        self.command, self.overwrite = command, overwrite
        self.placed = False
        self._written: set[str] = set()
        self._spent: list[Path] = []
        self._result: Mapping[str, Any] = {}
        self._made: list[Path] = []
        self._lock: Lock | None = None
        self._busy = threading.RLock()
        try:
            self.target = Path(os.path.realpath(self.path))
            self._refuse_places()
            files.make_folders(self.target.parent, self._made)
            self._base = self.target.parent / _base(self.target.name)
            self.place = self._temporary()
            self._claim()
            files.make_folders(self.place, [])
        except BaseException as error:
            self.close()
            if isinstance(error, InputError) or not isinstance(error, OSError | ValueError):
                raise
            raise InputError(
                f"{str(self.path)!r}: cannot be used as output folder: {sources.reason(error)}; "
                "choose another folder or make its parent folder writable"
            ) from None

    def _refuse_places(self) -> None:
        """Raise `InputError` if a finished run could not replace the target.

        Such a target is a mount point, the current folder or one above it, or something that is not
        a folder."""
        target = self.target
        if os.path.lexists(target) and not target.is_dir():
            raise InputError(f"{str(self.path)!r}: is not a folder; choose another output folder")
        here = Path.cwd()
        kinds = {
            "the current folder or one above it": target in (here, *here.parents),
            "a mount point": os.path.ismount(target) or str(target) in _mount_points(),
        }
        met = [name for name, holds in kinds.items() if holds]
        if met:
            inside = self.path / (self.command or "run")
            raise InputError(
                f"{str(self.path)!r}: is {met[0]}, which a finished run cannot replace; name a "
                f"folder inside it, for example {str(inside)!r}"
            )

    def _claim(self) -> None:
        """Take the lock, remove the remains of killed runs, and check the target.

        Raises `InputError` if the lock is taken or the target contains other files."""
        try:
            self._lock = Lock(self._base.with_name(self._base.name + _SUFFIX))
        except TakenError as taken:
            raise InputError(
                f"{str(self.path)!r}: {taken} is writing into this folder; wait for it, stop it, "
                "or choose another folder with --output"
            ) from None
        if self._lock.held:
            self._clear()
        if self._state() == "foreign":
            some = sorted(os.listdir(self.target))
            shown = ", ".join(some[:3]) + (", …" if len(some) > 3 else "")
            raise InputError(
                f"{str(self.path)!r}: holds files that do not belong to an earlier run ({shown}); "
                "choose another folder, or empty this one (--overwrite replaces earlier runs only)"
            )

    def _clear(self) -> None:
        """Remove or complete the temporary folders of killed runs in the parent folder.

        A complete run of this target is moved to the target if the target does not exist. Complete
        runs of other targets are kept. All other folders of killed runs are removed."""
        for name in sorted(os.listdir(self.target.parent)):
            match = _STAGE.fullmatch(name)
            if match is None:
                continue
            left = self.target.parent / name
            if match[1] != self._base.name:
                with contextlib.suppress(InputError, OSError):  # belongs to a run in progress
                    other = Lock(self.target.parent / (match[1] + _SUFFIX))
                    if other.held and not _complete(left):
                        files.discard_tree(left)
                    other.release()
            elif _complete(left) and not os.path.lexists(self.target):
                files.move(left, self.target)
            else:
                files.discard_tree(left)

    def _state(self) -> Literal["absent", "empty", "ours", "more", "foreign"]:
        """Return what is at the target's path.

        `absent`: nothing; `empty`: an empty folder; `ours`: only an earlier run; `more`: an earlier
        run and other files; `foreign`: anything else."""
        if not os.path.lexists(self.target):
            return "absent"
        if not self.target.is_dir():
            return "foreign"
        if not os.listdir(self.target):
            return "empty"
        if not all((self.target / name).is_file() for name in (RESULT, "config.yaml")):
            return "foreign"
        return "ours" if _files_in(self.target) <= _listed(self.target / RESULT) else "more"

    def _temporary(self) -> Path:
        unique = f".{os.getpid()}-{secrets.token_hex(4)}{_SUFFIX}"
        return self._base.with_name(self._base.name + unique)

    @property
    def checkpoint(self) -> Path:
        """Path of the file from which an interrupted run can be resumed.

        The file lies beside the result folder and is not part of the run."""
        return self._base.with_name(self._base.name + ".checkpoint")

    def write_bytes(self, name: str, data: bytes) -> Path:
        """Write `data` to the file `name`, which may include a subfolder (`figures/force.png`).

        Return the final path of the file. Raises `InputError` if the file cannot be written."""
        with self._busy, self._failing(name):
            file = self.place / name
            files.make_folders(file.parent, [])
            if name in self._written:
                files.discard(file)
            files.create(file, data)
            self._written.add(name)
        return self.path / name

    def write_json(self, name: str, data: Any) -> Path:
        """Write `data` as strict JSON to the file `name`; return the final path of the file.

        The file `result.json` is written later by `put_in_place`, which adds a list of all files.
        Raises `InputError` if the file cannot be written."""
        if name != RESULT:
            return super().write_json(name, data)
        self._result = data
        return self.path / name

    @property
    def result(self) -> dict[str, Any]:
        """Content of the file `result.json` as it will be written, without the list of files."""
        return plain({**self._result, "run": {"command": self.command}})

    def remove_afterwards(self, file: Path) -> None:
        """Remove `file`, which is not part of the run, as soon as the run is in place.

        So is an older one that was set aside. If the run ends before that, the files stay."""
        self._spent += [file, aside(file)]

    def put_in_place(self) -> list[str]:
        """Write `result.json` and move the finished folder to its final path.

        Return messages for the user, for example the new path of an earlier run. Raises
        `InputError` if this fails; the target is then unchanged."""
        with self._busy:
            names = sorted(self._written | {RESULT})
            run = {"run": {"command": self.command, "files": names}}
            super().write_json(RESULT, {**self._result, **run})
            with self._failing():
                for folder in {(self.place / name).parent for name in names} | {self.place}:
                    files.sync_folder(folder)
                notes = self._take_place()
            self.placed = True
            for file in self._spent:
                files.discard(file)
            with contextlib.suppress(OSError):
                files.sync_folder(self.target.parent)
        return notes

    def _take_place(self) -> list[str]:
        state = self._state()
        if state == "foreign":
            # The target was different at the start of the run. Do not throw away a long run.
            self.target = self.path = self._free()
            files.move(self.place, self.target)
            return [f"the requested folder now holds other files; this run is in {self.path}"]
        files.adopt_mode(self.place, self.target)
        if state in ("absent", "empty"):
            files.move(self.place, self.target)
            return []
        replaced = self.overwrite and state == "ours"
        older = self._temporary() if replaced else self._free()
        self._swap_by(older)
        if replaced:
            files.discard_tree(older)
            return []
        why = ", because it holds files that are not its own" if self.overwrite else ""
        return [f"the earlier run is now in {self.path.with_name(older.name)}{why}"]

    def _swap_by(self, older: Path) -> None:
        """Move the earlier run to `older`, then this run to the target's path.

        If the second step fails, undo the first."""
        files.move(self.target, older)
        try:
            files.move(self.place, self.target)
        except BaseException:
            files.move(older, self.target)
            raise

    def _free(self) -> Path:
        """Return the first path of `NAME.1`, `NAME.2` … that does not exist."""
        number = 1
        while os.path.lexists(path := self.target.with_name(f"{self.target.name}.{number}")):
            number += 1
        return path

    def close(self) -> None:
        """Release the lock. Remove the temporary folder unless it has been moved to its final path.

        A second call does nothing."""
        with self._busy:
            if not self.placed and hasattr(self, "place"):
                files.discard_tree(self.place)
            if self._lock is not None:
                self._lock.release()
            if not self.placed:
                for folder in reversed(self._made):
                    files.discard(folder)

    def abandon(self) -> str:
        """Close the folder, and prevent the run from writing any further files.

        Call this method from a thread other than the run's. Return a message that says whether the
        final folder is complete or unchanged."""
        if self._busy.acquire(timeout=_PATIENCE):
            self.close()
        return f"{self.path} is {'complete' if self.placed else 'unchanged'}"

    def __exit__(self, *error: object) -> None:
        self.close()


def _base(name: str) -> str:
    """Return the prefix that all temporary names for the folder `name` share."""
    if len(os.fsencode(name)) > _LONGEST:
        name = hashlib.sha256(os.fsencode(name)).hexdigest()
    return f".{name}"


def _files_in(folder: Path) -> set[str]:
    """Return the relative paths of all files, links and empty folders inside a folder."""
    paths: set[str] = set()
    for place, folders, inner in os.walk(folder):
        inside = Path(place).relative_to(folder)
        names = inner if inner or folders else [""]
        names += [name for name in folders if os.path.islink(os.path.join(place, name))]
        paths |= {(inside / name).as_posix() for name in names}
    return paths


def _listed(result: Path) -> set[str]:
    """Return the names of a run's files, as its file `result` lists them.

    Return an empty set if this file cannot be read or has no list."""
    try:
        names = json.loads(result.read_bytes())["run"]["files"]
        return {name for name in names if isinstance(name, str)}
    except (OSError, ValueError, LookupError, TypeError, RecursionError):
        return set()


def _complete(stage: Path) -> bool:
    """Return whether a killed run had written all its files into its temporary folder `stage`."""
    listed = _listed(stage / RESULT)
    return bool(listed) and _files_in(stage) == listed


def _mount_points() -> set[str]:
    """Return the mount points on Linux, including bind mounts; empty on other systems."""
    try:
        lines = Path("/proc/self/mountinfo").read_bytes().splitlines()
        places = [line.split()[4] for line in lines]
    except (OSError, IndexError):
        return set()
    octal = re.compile(rb"\\([0-7]{3})")
    return {os.fsdecode(octal.sub(lambda m: bytes([int(m[1], 8)]), place)) for place in places}
