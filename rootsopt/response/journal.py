"""Keeps the results of a run in a file as they are computed, so that a killed run can be resumed.

The first line of the file, the header, states everything on which the results depend. Each further
line holds one result under its key. A line is a checksum and JSON, which preserves every float
exactly. The checksum of a result covers the header too, so that a damaged line and a line of
another run are both recognised. Such lines are dropped, and their results are computed again."""

import contextlib
import dataclasses
import hashlib
import json
import os
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter

from rootsopt.config.reading import Config
from rootsopt.config.sources import FILES, reason, regular_file
from rootsopt.config.units import shown
from rootsopt.dynamics.maxima import Maxima
from rootsopt.errors import InputError
from rootsopt.response.reducers import Point
from rootsopt.response.result import Evaluation, Part, plain, read
from rootsopt.runtime.environment import versions
from rootsopt.status import Status

# Maximum number of differences that an error message lists.
_SHOWN = 5
_ABSENT = "absent"


class Journal:
    """Results of one run by their key, `rows`, and the file in which they are kept.

    A key is a number, or a tuple of numbers and texts.

    `header`: everything on which the results depend, as nested mappings of plain values; `path`:
    path of the file, `None` to keep the results in memory only; `resume`: whether to begin with the
    results in the file. Threads can share an instance, but only one process may use the file.
    `resumed`: keys of the results that were in the file; `dropped`: number of its lines that were
    damaged or not valid.

    With `resume`, raises `InputError` if the file does not exist or has another header. Raises
    `OSError` if the file cannot be opened for writing."""

    def __init__(self, header: Mapping[str, Any], path: Path | None, resume: bool = False):
        self.path, self.dropped = path, 0
        self.rows: dict[Any, Any] = {}
        self.resumed: frozenset[Any] = frozenset()
        self._lock, self._file = threading.Lock(), None
        if path is None:
            if resume:
                raise InputError(
                    "`resume` needs `checkpoint`, the file of the interrupted run, but there is "
                    "none; give its path, or leave out `resume`"
                )
            return
        head = _line(header, b"")
        self._seal = head.split(b" ")[0]
        lines = self._kept(path, head) if resume else []
        self.resumed = frozenset(self.rows)
        fresh = path.with_name(path.name + ".new")
        fresh.write_bytes(b"".join([head, *lines]))
        fresh.replace(path)
        self._file = open(path, "ab")  # noqa: SIM115

    def read(self, key: Any, value: Any) -> Any:
        """Return the result whose plain value is `value`.

        Raises `ValueError`, `LookupError` or `TypeError` if it is not valid."""
        return value

    def plain(self, result: Any) -> Any:
        """Return a result as a plain value for JSON, the inverse of `read`."""
        return result

    def add(self, results: Iterable[tuple[Any, Any]]) -> None:
        """Add results (key, result) and flush them to the disk; known keys are ignored.

        An `OSError`, such as a full disk, is ignored: the run continues without the file."""
        with self._lock:
            new = {key: result for key, result in results if key not in self.rows}
            self.rows |= new
            # A search that was stopped may still finish an evaluation.
            if self._file is None or self._file.closed:
                return
            lines = (_line([key, self.plain(one)], self._seal) for key, one in new.items())
            with contextlib.suppress(OSError):
                self._file.write(b"".join(lines))
                self._file.flush()
                os.fsync(self._file.fileno())

    def close(self) -> None:
        """Close the file, and remove it if it holds no results; a second call does nothing."""
        with self._lock:
            if self._file is None or self._file.closed:
                return
            with contextlib.suppress(OSError):
                self._file.close()
            if self.path is not None and not self.rows:
                self.path.unlink(missing_ok=True)

    @property
    def damage(self) -> str:
        """Message about dropped lines; empty if there are none."""
        if not self.dropped:
            return ""
        lines = "1 line is" if self.dropped == 1 else f"{self.dropped} lines are"
        kept = f"{len(self.rows)} results are kept" if len(self.rows) != 1 else "1 result is kept"
        return (
            f"{str(self.path)!r}: {lines} damaged or of another run, and dropped; {kept}, and the "
            "others are computed again"
        )

    def _kept(self, path: Path, head: bytes) -> list[bytes]:
        """Read the results, and return their lines.

        `head`: first line of the file if it is of this run. Raises `InputError` if the file cannot
        be read, or if its header is a different one."""
        try:
            first, *others = path.read_bytes().split(b"\n")
        except OSError:
            raise InputError(
                f"`--resume` needs the checkpoint of an interrupted run, but there is no "
                f"{str(path)!r}; leave out `--resume`, or name that run's folder with --output"
            ) from None
        try:
            stored_header = _content(first, b"")
        except ValueError:
            self.dropped += bool(first)
        else:
            _compare(stored_header, _content(head[:-1], b""))
        kept = []
        for line in filter(None, others):
            try:
                key, value = _content(line, self._seal)
                key = tuple(key) if isinstance(key, list) else key
                if key not in self.rows:
                    self.rows[key] = self.read(key, value)
                    kept.append(line + b"\n")
            except (ValueError, LookupError, TypeError):
                self.dropped += 1
        return kept


def header_of(
    command: str,
    config: Config,
    imports: Sequence[str] = (),
    others: Sequence[str | None] = (),
    **more: Any,
) -> dict[str, Any]:
    """Return everything on which the results of a `command` depend, as plain values.

    `imports`: names of the files and modules that were imported first; `others`: paths of files
    that replace the config's own; `more`: further entries. Raises `InputError` if a file cannot be
    read."""
    files = {path for path in (*map(config.value, FILES), *others) if path is not None} | {
        name for name in imports if os.path.isfile(name)
    }
    return {
        "command": command,
        "config": config.model_dump(mode="json"),
        "versions": versions(),
        "imports": [*imports],
        "files": {path: _file_digest(path) for path in sorted(files)},
        **more,
    }


def aside(path: Path) -> Path:
    """Return the path to which `set_aside` moves the file `path`."""
    return path.with_name(path.name + ".old")


def set_aside(path: Path) -> Path | None:
    """Move the file `path` of an interrupted run to `aside(path)`, and return that path.

    An older file of that name is replaced. Return `None` if there is no file. Raises `OSError` if
    the file cannot be moved."""
    return path.replace(aside(path)) if path.is_file() else None


def _digest(*parts: bytes) -> bytes:
    return hashlib.blake2b(b" ".join(parts), digest_size=8).hexdigest().encode()


def _line(content: Any, seal: bytes) -> bytes:
    """Return a line of the file; `seal`: checksum of the header, empty for the header itself."""
    text = json.dumps(content, default=lambda value: value.tolist()).encode()
    return b"%s %s\n" % (_digest(seal, text), text)


def _content(line: bytes, seal: bytes) -> Any:
    """Return the content of a line without its end. Raises `ValueError` if it is damaged."""
    checksum, _, text = line.partition(b" ")
    if checksum != _digest(seal, text):
        raise ValueError("damaged")
    return json.loads(text)


def _compare(stored_header: Any, header: Any) -> None:
    """Raise `InputError` if the `stored_header` of the file differs from `header`."""
    old, new = _flat(stored_header), _flat(header)
    keys = [key for key in dict.fromkeys((*new, *old)) if old.get(key) != new.get(key)]
    if not keys:
        return
    changes = [
        f"{key} (then {shown(old.get(key, _ABSENT))}, now {shown(new.get(key, _ABSENT))})"
        for key in keys[:_SHOWN]
    ]
    more = f" and {len(keys) - _SHOWN} more" if len(keys) > _SHOWN else ""
    raise InputError(
        f"`--resume` needs the config, the files and the versions of the interrupted run, but "
        f"these differ: {', '.join(changes)}{more}; restore them, or leave out `--resume`"
    )


def _flat(tree: Any, name: str = "") -> dict[str, Any]:
    """Return the values in nested mappings as one mapping with names joined by `: `."""
    if not isinstance(tree, dict):
        return {name: tree}
    values: dict[str, Any] = {}
    for key, value in tree.items():
        values |= _flat(value, f"{name}: {key}" if name else key)
    return values


def _file_digest(path: str) -> str:
    try:
        return hashlib.sha256(regular_file(path, "an outline").read_bytes()).hexdigest()
    except OSError as error:
        raise InputError(f"{path!r}: cannot be read: {reason(error)}") from None


_POINT = TypeAdapter(list[float])
_NUMBERS = TypeAdapter(dict[str, float])
# Types of the fields of an evaluation that are plain values.
_KINDS = {
    "design": _NUMBERS,
    "geometry": _NUMBERS,
    "response": _NUMBERS,
    "gradient": TypeAdapter(dict[str, dict[str, float]]),
    "steady_state": TypeAdapter(dict[str, Any]),
    "statistics": TypeAdapter(dict[str, Any]),
    "message": TypeAdapter(str),
}


class Checkpoint(Journal):
    """A journal whose results are (point (d,) in the unit box as a list, evaluation).

    `reused`: number of evaluations that were taken from a resumed file."""

    reused = 0

    def evaluated(
        self,
        run: Callable[[Point], Evaluation],
        key: Any,
        asked: Point,
        point: NDArray[np.float64],
    ) -> Evaluation:
        """Return `run(asked)` and keep it under `key`, or return what a resumed file holds there.

        `point` (d,): the design in the unit box, to which a stored evaluation must belong."""
        with self._lock:
            if key in self.resumed and self.rows[key][0] == point.tolist():
                self.reused += 1
                return self.rows[key][1]
        evaluation = run(asked)
        self.add([(key, (point.tolist(), evaluation))])
        return evaluation

    def read(self, key: Any, value: Any) -> tuple[list[float], Evaluation]:
        point, evaluation = value
        if not isinstance(key, tuple):
            raise TypeError("an evaluation has a key of several parts")
        return _POINT.validate_python(point, strict=True), read_evaluation(evaluation)

    def plain(self, result: tuple[list[float], Evaluation]) -> Any:
        return result[0], plain_evaluation(result[1])


def plain_evaluation(evaluation: Evaluation) -> dict[str, Any]:
    """Return an evaluation as plain values for JSON, without its time series."""
    values = {
        field.name: getattr(evaluation, field.name) for field in dataclasses.fields(Evaluation)
    }
    speeds, scenes = values.pop("speeds"), values.pop("scenes")
    maxima = evaluation.maxima
    values |= {
        "series": None,
        "status": evaluation.status.name,
        "start": plain(evaluation.start),
        "maxima": None if maxima is None else [part.tolist() for part in maxima],
        "rivals": [plain_evaluation(one) for one in evaluation.rivals],
    }
    if scenes:
        values["scenes"] = [[part.values, plain_evaluation(part.evaluation)] for part in scenes]
    elif speeds:
        values["parts"] = [[p.speed_rpm, p.share, plain_evaluation(p.evaluation)] for p in speeds]
    return values


def read_evaluation(plain_values: Mapping[str, Any]) -> Evaluation:
    """Return the evaluation from the plain values that `plain_evaluation` returned.

    Raises `ValueError`, `LookupError` or `TypeError` if they are not valid."""
    values = dict(plain_values)
    parts, scenes = values.pop("parts", ()), values.pop("scenes", ())
    for name, kind in _KINDS.items():
        kind.validate_python(values[name], strict=True)
    values["start"] = read(values["start"])
    if values["maxima"] is not None:
        times, forces, slopes = (np.asarray(part, np.float64) for part in values["maxima"])
        values["maxima"] = Maxima(times, forces, slopes.reshape(len(times), len(values["design"])))
    values["status"] = Status[values["status"]]
    values["rivals"] = tuple(read_evaluation(one) for one in values["rivals"])
    values["scenes"] = tuple(Part(numbers, read_evaluation(one)) for numbers, one in scenes)
    speeds = (Part({"speed_rpm": rpm}, read_evaluation(one), share) for rpm, share, one in parts)
    values["speeds"] = values["scenes"][0].evaluation.speeds if scenes else tuple(speeds)
    return Evaluation(**values)
