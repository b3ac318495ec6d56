"""Points of a sweep: their configs, their evaluations, and the records that are kept of them.

Points of the same structure share compiled programs. On a CPU, a thread per core works through them
one by one: as arrays, all motions would take as many steps as the longest. On an accelerator, they
are stepped together as arrays."""

import threading
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from rootsopt.config.families import families, family_of, parameters
from rootsopt.config.reading import Config
from rootsopt.config.section import bare
from rootsopt.config.sources import FILES, find_installed
from rootsopt.config.units import sentence
from rootsopt.errors import InputError
from rootsopt.response.evaluation import Evaluator
from rootsopt.response.reducers import HERE
from rootsopt.response.result import Evaluation
from rootsopt.response.together import evaluate_together, pays
from rootsopt.scene.check import check_geometry
from rootsopt.status import Status

Row = dict[str, Any]
"""Record of one point as plain values: `status` (label), `message`, `response`, `gradient`,
`steady_state`, `geometry`. Dictionaries are empty if nothing is known."""
Numbered = tuple[int, dict[str, Any]]
"""Number of a point, and its values by dotted key."""
_FAMILY = "profile.family"
# Number of points that an accelerator steps together.
_BATCH = 256


def prepared(key: str, value: Any) -> Any:
    """Return a value of an axis in the form that a config on any worker needs.

    The path of a file becomes absolute: workers may run in another folder. If the value is
    a family of an installed package, the package is loaded."""
    if not isinstance(value, str):
        return value
    if key in FILES:
        return str(Path(value).absolute())
    if key == _FAMILY and bare(value) not in map(bare, families()):
        find_installed(value)
    return value


def configured(config: Config, values: Mapping[str, Any]) -> Config:
    """Return the `config` of a point, with `values` by dotted key.

    If the values change the family, parameters of other families are left out, both those of the
    config and those among the values. Raises `InputError` if the values do not fit each other."""
    given = dict(values)
    name = given.get(_FAMILY)
    word = {bare(known): known for known in families()}.get(bare(str(name)), "")
    if word:
        family = family_of(word)
        foreign = [key for key in parameters() if key not in family.keys]
        if family.maker is not None:
            foreign += [key for key in type(config.profile).model_fields if "outline_" in key]
        given |= {f"profile.{key}": None for key in foreign}
    return config.replaced(given)


def simulated(config: Config, values: Mapping[str, Any]) -> Row:
    """Return the record of the point with these `values`, even if the point fails.

    An invalid config or an error of the program becomes the point's status."""
    try:
        return row_of(_evaluator(config, values)(series=False))
    except InputError as error:
        return lost(Status.INVALID, str(error))
    except Exception as error:
        return lost(Status.FAILED, f"{type(error).__name__}: {error}")


def at_once(config: Config, points: Sequence[Numbered]) -> list[tuple[int, Row]]:
    """Return (number, record) of all `points`, in this thread."""
    numbers, every = zip(*points, strict=True)
    rows = (simulated(config, values) for values in every)
    return [*zip(numbers, simulated_together(config, every) if pays() else rows, strict=True)]


class InProcess:
    """Simulates points of a sweep in this process."""

    def __init__(self) -> None:
        self.slots = 1 if pays() else HERE.slots

    def share(self, count: int) -> int:
        """Return the number of points in a chunk, for a sweep of `count` points."""
        return min(count, _BATCH) if pays() else 1

    def simulated(
        self, config: Config, points: Sequence[Numbered], stop: threading.Event
    ) -> list[tuple[int, Row]]:
        """Return (number, record) of `points`; `stop` has no effect on a chunk."""
        del stop
        return at_once(config, points)


def _evaluator(config: Config, values: Mapping[str, Any]) -> Evaluator:
    one = configured(config, values)
    check_geometry(one)
    return Evaluator.of_objective(one)


def simulated_together(config: Config, points: Sequence[Mapping[str, Any]]) -> list[Row]:
    """Return the records of several points, each given as values by dotted key.

    Points of the same structure are simulated as one batch, and all others one by one."""
    rows: dict[int, Row] = {}
    batch: dict[int, Evaluator] = {}
    for number, values in enumerate(points):
        with suppress(Exception):  # `simulated` reports it.
            evaluator = _evaluator(config, values)
            if evaluator.single:
                batch[number] = evaluator
    with suppress(Exception):  # Memory may not suffice, for example.
        evaluations = evaluate_together([*batch.values()])
        rows = {n: row_of(one) for n, one in zip(batch, evaluations, strict=True)}
    return [
        rows[number] if number in rows else simulated(config, values)
        for number, values in enumerate(points)
    ]


def row_of(evaluation: Evaluation) -> Row:
    """Return the record of an evaluation, without its series and statistics."""
    return {
        "status": evaluation.status.label,
        "message": evaluation.message,
        "response": evaluation.response,
        "gradient": evaluation.gradient,
        "steady_state": evaluation.steady_state,
        "geometry": evaluation.geometry,
    }


class _Record(BaseModel, strict=True, extra="forbid"):
    status: str
    message: str
    response: dict[str, float | None]
    gradient: dict[str, dict[str, float | None]]
    steady_state: dict[str, Any]
    geometry: dict[str, float | None]


def check_row(row: Any) -> Row:
    """Return a record that was read from a file.

    Raises `ValueError` or `LookupError` if it is not valid."""
    _Record.model_validate(row)
    Status[row["status"].upper()]
    return row


def lost(status: Status, why: str = "") -> Row:
    """Return the record of a point without an evaluation, with its `status`; `why`: what happened
    there."""
    message = f"{status.value} {sentence(why)}" if why else status.value
    none: Row = {name: {} for name in ("response", "gradient", "steady_state", "geometry")}
    return {"status": status.label, "message": message, **none}
