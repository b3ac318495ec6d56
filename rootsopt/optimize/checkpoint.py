"""Stores the evaluations of a search in a file, so that a killed search can be resumed.

A search is deterministic: the same evaluations lead to the same points. A resumed search starts
from the beginning, but reads stored evaluations from the file instead of simulating them. It then
continues with the same numbers, to the last bit, as an uninterrupted search.

The file has one JSON object per line. JSON preserves every float exactly. The first line, the
header, states the config and the versions on which the evaluations depend. An incomplete last line
is ignored."""

import contextlib
import dataclasses
import json
import os
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rootsopt.dynamics.maxima import Maxima
from rootsopt.errors import InputError
from rootsopt.response.evaluation import Evaluation
from rootsopt.response.speeds import AtSpeed, SpeedsEvaluation
from rootsopt.response.tolerances import AtSample, ToleranceEvaluation
from rootsopt.status import Status

_SHOWN = 5
"""Maximum number of differences that an error message lists."""
Key = tuple[int, int]
"""Key of an evaluation: (index of the local search, index of the evaluation in it). The screening
is search -1."""


class Checkpoint:
    """A file with the evaluations of one search.

    `path`: path of the file. `header`: everything on which the evaluations depend, as nested
    mappings of plain values. `resume`: whether to reuse the evaluations in the file; otherwise,
    start a new file.

    With `resume`, raises `InputError` if the file does not exist or has another header.
    Raises `OSError` if the file cannot be opened for writing."""

    def __init__(self, path: Path, header: Mapping[str, Any], resume: bool = False):
        self.path = path
        self._lock = threading.Lock()
        self._known: dict[Key, tuple[list[float], Evaluation]] = {}
        self.reused, self._added = 0, False
        plain = json.loads(json.dumps(header))
        kept = self._read(plain) if resume else 0
        self._file = open(path, "r+b" if kept else "wb")  # noqa: SIM115
        self._file.truncate(kept)
        self._file.seek(kept)
        if not kept:
            self._write(plain)

    def _read(self, header: Mapping[str, Any]) -> int:
        """Read the evaluations, and return the size (bytes) of the complete lines.

        Raises `InputError` if the file cannot be read or if its header differs from `header`."""
        try:
            data = self.path.read_bytes()
        except OSError:
            raise InputError(
                f"`--resume` needs the checkpoint of an interrupted run, but there is no "
                f"{str(self.path)!r}; leave out `--resume`, or name that run's folder with --output"
            ) from None
        kept, first = 0, True
        for line in data.splitlines(keepends=True):
            try:
                found = json.loads(line) if line.endswith(b"\n") else None
            except ValueError:
                found = None
            if found is None:
                break
            if first:
                self._compare(found, header)
            else:
                key = int(found["key"][0]), int(found["key"][1])
                self._known[key] = found["point"], _evaluation(found["evaluation"])
            first = False
            kept += len(line)
        return kept

    def _compare(self, found: Any, header: Mapping[str, Any]) -> None:
        """Raise `InputError` if the header `found` in the file differs from `header`."""
        old, new = _flat(found), _flat(header)
        keys = [key for key in sorted({*old, *new}) if old.get(key) != new.get(key)]
        if keys:
            changes = [f"{k} (then {old.get(k)}, now {new.get(k)})" for k in keys[:_SHOWN]]
            more = f" and {len(keys) - _SHOWN} more" if len(keys) > _SHOWN else ""
            raise InputError(
                f"`--resume` needs the config and versions of the interrupted run, but these "
                f"differ: {', '.join(changes)}{more}; restore them, or leave out `--resume`"
            )

    def known(self, key: Key, point: NDArray[np.float64]) -> Evaluation | None:
        """Return the evaluation stored under `key`, or `None` unless it belongs to `point` (d,).

        Only evaluations that were read from a resumed file are found."""
        with self._lock:
            found = self._known.get(key)
            if found is None or found[0] != point.tolist():
                return None
            self.reused += 1
            return found[1]

    def add(self, key: Key, point: NDArray[np.float64], evaluation: Evaluation) -> None:
        """Append the `evaluation` of a `point` (d,) to the file, and flush it to the disk.

        An `OSError`, such as a full disk, is ignored."""
        self._added = True
        row = {"key": [*key], "point": point.tolist(), "evaluation": _plain(evaluation)}
        self._write(row)

    @property
    def empty(self) -> bool:
        """Whether no evaluation has been read or added."""
        return not self._known and not self._added

    def _write(self, row: Mapping[str, Any]) -> None:
        line = json.dumps(row, default=_item).encode() + b"\n"
        with self._lock:
            # A search that was stopped may still finish an evaluation.
            if self._file.closed:
                return
            # If the disk is full, the run continues without a checkpoint.
            with contextlib.suppress(OSError):
                self._file.write(line)
                self._file.flush()
                os.fsync(self._file.fileno())

    def close(self, remove: bool = True) -> None:
        """Close the file. Also delete it if `remove` is true: a finished run no longer needs it."""
        with self._lock:
            self._file.close()
        if remove:
            self.path.unlink(missing_ok=True)


def aside(path: Path) -> Path:
    """Return the path to which `set_aside` moves the checkpoint `path`."""
    return path.with_name(path.name + ".old")


def set_aside(path: Path) -> Path | None:
    """Move the checkpoint `path` of an interrupted run to `aside(path)`, and return that path.

    An older file of that name is replaced. Return `None` if there is no checkpoint. Raises
    `OSError` if the file cannot be moved."""
    return path.replace(aside(path)) if path.is_file() else None


def _item(value: Any) -> Any:
    """Convert a NumPy number to a plain number, and an array to nested lists."""
    return np.asarray(value).tolist()


def _flat(tree: Any, name: str = "") -> dict[str, Any]:
    """Return the values in nested mappings as one mapping with dotted keys."""
    if not isinstance(tree, dict):
        return {name: tree}
    found: dict[str, Any] = {}
    for key, value in tree.items():
        found |= _flat(value, f"{name}.{key}" if name else key)
    return found


def _plain(evaluation: Evaluation) -> dict[str, Any]:
    """Return an evaluation as plain values for JSON, without its time series."""
    names = (field.name for field in dataclasses.fields(Evaluation))
    found = {name: getattr(evaluation, name) for name in names}
    maxima, state = evaluation.maxima, evaluation.state
    found |= {
        "series": None,
        "status": evaluation.status.name,
        "state": None if state is None else np.asarray(state).tolist(),
        "maxima": None if maxima is None else [part.tolist() for part in maxima],
        "rivals": [_plain(one) for one in evaluation.rivals],
    }
    if isinstance(evaluation, SpeedsEvaluation):
        parts = evaluation.parts
        found["parts"] = [[p.speed_rpm, p.share, _plain(p.evaluation)] for p in parts]
    if isinstance(evaluation, ToleranceEvaluation):
        found["scenes"] = [[part.values, _plain(part.evaluation)] for part in evaluation.parts]
    return found


def _evaluation(found: Mapping[str, Any]) -> Evaluation:
    """Return the evaluation from the plain values that `_plain` returned."""
    values = dict(found)
    parts, scenes = values.pop("parts", None), values.pop("scenes", None)
    if values["state"] is not None:
        values["state"] = np.asarray(values["state"], np.float64)
    if values["maxima"] is not None:
        times, forces, slopes = (np.asarray(part, np.float64) for part in values["maxima"])
        values["maxima"] = Maxima(times, forces, slopes)
    values["status"] = Status[values["status"]]
    values["rivals"] = tuple(_evaluation(one) for one in values["rivals"])
    if scenes is not None:
        samples = tuple(AtSample(numbers, _evaluation(one)) for numbers, one in scenes)
        return ToleranceEvaluation(**values, parts=samples)
    if parts is None:
        return Evaluation(**values)
    every = tuple(AtSpeed(speed, share, _evaluation(one)) for speed, share, one in parts)
    return SpeedsEvaluation(**values, parts=every)


__all__ = ["Checkpoint", "aside", "set_aside"]
