"""The values that a sweep gives to one key, as a user writes them: lists, ranges and intervals."""

import dataclasses
import itertools
import math
import re
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rootsopt.config import Config
from rootsopt.config.document import read_document
from rootsopt.config.explain import is_whole, tree
from rootsopt.config.words import shown
from rootsopt.errors import InputError

_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_RANGE = re.compile(rf"({_NUMBER}):({_NUMBER})(?::(\d+))?(:log)?")
# Texts that are meant to be a range.
_MEANT = re.compile(r"[-+\d.][-+\d.eE]*:[-+\d.eE:]*[-+\d.eE:](?:log)?")
MOST = 1_000_000
"""Number of values above which an axis is rejected, and of points above which a sweep is."""


@dataclasses.dataclass(frozen=True)
class Interval:
    """The numbers from `low` to `high`, both included.

    `points`: number of values of a range, `None` for an interval to draw samples from; `log`:
    whether the values are spaced evenly on a logarithmic scale; `whole`: whether the key takes
    whole numbers only.
    """

    low: float
    high: float
    points: int | None = None
    log: bool = False
    whole: bool = False

    def range(self) -> list[Any]:
        """Return the values of the range, ascending or descending from `low` to `high`."""
        assert self.points is not None
        space = np.geomspace if self.log else np.linspace
        found = space(self.low, self.high, self.points).tolist()
        # Whole ends may still have values in between that are not whole: the config refuses those.
        return [int(x) if self.whole and x.is_integer() else x for x in found]

    def at(self, levels: NDArray[np.float64]) -> list[Any]:
        """Return the quantiles (n,) of the interval at `levels` (n,) from 0 to 1."""
        if self.whole:
            low, high = sorted((int(self.low), int(self.high)))
            inside = np.floor(np.asarray(levels) * (high - low + 1)).astype(int)
            return np.minimum(low + inside, high).tolist()
        if self.log:
            logs = np.log(self.low) + np.asarray(levels) * np.log(self.high / self.low)
            return np.exp(logs).tolist()
        return (self.low + np.asarray(levels) * (self.high - self.low)).tolist()


@dataclasses.dataclass(frozen=True)
class Axis:
    """A dotted `key` of the config and its `values`, or an interval to draw them from."""

    key: str
    values: Interval | tuple[Any, ...]

    def drawn(self, levels: NDArray[np.float64]) -> list[Any]:
        """Return the values (n,) at `levels` (n,) from 0 to 1: of the interval, or of the list."""
        if isinstance(self.values, Interval):
            return self.values.at(levels)
        count = len(self.values)
        picked = np.minimum(np.floor(np.asarray(levels) * count).astype(int), count - 1)
        return [self.values[k] for k in picked]


def axis_of(key: str, given: Any) -> Axis:
    """Return the axis of a `key`.

    `given`: a sequence, an array or an iterator of values, or a text as after `--over KEY=`: values
    separated by commas, and ranges `from:to:count`, with `:log` at the end for a logarithmic scale.
    A text `from:to` is an interval to draw samples from.

    Raises `InputError` if there are no values or more than `MOST`, or if a range is not valid."""
    if isinstance(given, Interval) and given.points is None:
        return Axis(key, given)
    if not isinstance(given, str):
        return Axis(key, _values(key, given))
    items = _items(key, given)
    spans = [item for item in items if isinstance(item, Interval) and item.points is None]
    if spans and len(items) == 1:
        return Axis(key, spans[0])
    if spans:
        raise InputError(
            f"`{key}`: an interval from:to cannot be mixed with other values, but the values are "
            f"{shown(given)}; write from:to:count for a range"
        )
    parts = (item.range() if isinstance(item, Interval) else [item] for item in items)
    return Axis(key, _taken(key, itertools.chain.from_iterable(parts)))


def _values(key: str, given: Any) -> tuple[Any, ...]:
    """Return the values of a `key` that are `given` as a range, a sequence, an array or an
    iterator."""
    count = given.points if isinstance(given, Interval) else getattr(given, "size", None)
    if (count or 0) > MOST:
        raise _too_many(key)
    values: Any = given.range() if isinstance(given, Interval) else given
    values = values.tolist() if hasattr(values, "tolist") else values
    found = _taken(key, values) if isinstance(values, Sequence | Iterator) else ()
    if not found:
        raise InputError(
            f"`{key}` must have at least one value, as a list or as text such as "
            f"'300:6000:39', but is {shown(given)}"
        )
    return tuple(x.item() if hasattr(x, "item") else x for x in found)


def _taken(key: str, values: Iterable[Any]) -> tuple[Any, ...]:
    """Return the `values`, but take no more of them than an axis may have."""
    found = tuple(itertools.islice(values, MOST + 1))
    if len(found) > MOST:
        raise _too_many(key)
    return found


def _too_many(key: str) -> InputError:
    return InputError(
        f"`{key}` must have at most {MOST} values, but has more; give fewer, or draw samples with "
        "`--sobol N`"
    )


def parse_over(text: str) -> tuple[str, Axis]:
    """Return (key, axis) of an option `--over KEY=VALUES`.

    Raises `InputError` if the text does not have this form."""
    key, equals, values = text.partition("=")
    key = key.strip()
    if not equals or not all(key.split(".")):
        raise InputError(
            f"--over {shown(text)}: must be dotted.key=values, as in scene.speed_rpm=300:6000:39 "
            "or scene.timing_gear.backlash_mm=0.05,0.1"
        )
    return key, axis_of(key, values)


def _items(key: str, text: str) -> list[Any]:
    """Return the values in a text; ranges and intervals as `Interval`."""
    name = f"--over {shown(f'{key}={text}')}"
    if not text.strip():
        raise InputError(f"{name}: must name at least one value")
    found = read_document(f"[{text}]", name)
    return [_interval(key, item) if isinstance(item, str) else item for item in found]


def _interval(key: str, item: str) -> Any:
    """Return the interval that the text `item` describes, or `item` itself if it is another
    value."""
    match = _RANGE.fullmatch(item.replace(" ", ""))
    if match is None and _MEANT.fullmatch(item.replace(" ", "")):
        raise InputError(
            f"`{key}`: a range must be from:to:count, with :log at the end for a logarithmic "
            f"scale, but is {shown(item)}; write it as in 300:6000:39"
        )
    if match is None:
        return item
    low, high = float(match[1]), float(match[2])
    points, log = None if match[3] is None else int(match[3]), match[4] is not None
    if not (math.isfinite(low) and math.isfinite(high)) or low == high:
        raise InputError(f"`{key}`: a range must have two different finite ends, but is {item}")
    if points is not None and not 2 <= points <= MOST:
        raise InputError(
            f"`{key}`: a range must have 2 to {MOST} values, but is {item}; write "
            "from:to:count, as in 300:6000:39"
        )
    if log and min(low, high) <= 0:
        raise InputError(f"`{key}`: a logarithmic range must have positive ends, but is {item}")
    return Interval(low, high, points, log, is_whole(tree(Config).get(key)))
