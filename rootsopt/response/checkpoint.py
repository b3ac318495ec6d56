"""Keeps the evaluations of a search in a journal, so that a killed search can be resumed.

A search is deterministic: the same evaluations lead to the same points. A resumed search starts
from the beginning, but takes stored evaluations from the file instead of simulating them. It then
continues with the same numbers, to the last bit, as an uninterrupted search."""

import dataclasses
import hashlib
import json
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter

from rootsopt.dynamics.maxima import Maxima
from rootsopt.response.many import Point
from rootsopt.response.result import Evaluation, Part
from rootsopt.response.starts import plain, read
from rootsopt.runtime.journal import Journal
from rootsopt.status import Status

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
        stage: str,
        asked: Point,
        point: NDArray[np.float64],
    ) -> Evaluation:
        """Return `run(asked)`, or the evaluation stored for the same arguments.

        `stage`: name of the evaluator; `point` (d,): the design in the unit box."""
        begun = json.dumps(plain(asked.start)).encode()
        key = stage, hashlib.sha256(point.tobytes() + begun).hexdigest()[:16]
        known = self.known(key, point)
        if known is not None:
            return known
        found = run(asked)
        self.keep(key, point, found)
        return found

    def known(self, key: Any, point: NDArray[np.float64]) -> Evaluation | None:
        """Return the evaluation stored under `key`, or `None` unless it belongs to `point` (d,).

        Only evaluations that were read from a resumed file are found."""
        with self._lock:
            if key not in self.resumed or self.rows[key][0] != point.tolist():
                return None
            self.reused += 1
            return self.rows[key][1]

    def keep(self, key: Any, point: NDArray[np.float64], evaluation: Evaluation) -> None:
        """Add the `evaluation` of a `point` (d,)."""
        self.add([(key, (point.tolist(), evaluation))])

    def read(self, key: Any, value: Any) -> tuple[list[float], Evaluation]:
        point, evaluation = value
        if not isinstance(key, tuple):
            raise TypeError("an evaluation has a key of several parts")
        return _POINT.validate_python(point, strict=True), read_evaluation(evaluation)

    def plain(self, result: tuple[list[float], Evaluation]) -> Any:
        return result[0], plain_evaluation(result[1])


def plain_evaluation(evaluation: Evaluation) -> dict[str, Any]:
    """Return an evaluation as plain values for JSON, without its time series."""
    found = {
        field.name: getattr(evaluation, field.name) for field in dataclasses.fields(Evaluation)
    }
    speeds, scenes = found.pop("speeds"), found.pop("scenes")
    maxima = evaluation.maxima
    found |= {
        "series": None,
        "status": evaluation.status.name,
        "start": plain(evaluation.start),
        "maxima": None if maxima is None else [part.tolist() for part in maxima],
        "rivals": [plain_evaluation(one) for one in evaluation.rivals],
    }
    if scenes:
        found["scenes"] = [[part.values, plain_evaluation(part.evaluation)] for part in scenes]
    elif speeds:
        found["parts"] = [[p.speed_rpm, p.share, plain_evaluation(p.evaluation)] for p in speeds]
    return found


def read_evaluation(found: Mapping[str, Any]) -> Evaluation:
    """Return the evaluation from the plain values that `plain_evaluation` returned.

    Raises `ValueError`, `LookupError` or `TypeError` if they are none."""
    values = dict(found)
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
