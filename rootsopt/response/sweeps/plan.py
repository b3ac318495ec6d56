"""The points of a sweep: axes crossed, zipped or sampled.

An axis holds the values that a sweep gives to one key, as a user writes them: lists, ranges and
intervals."""

import dataclasses
import itertools
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rootsopt.config.document import read_document
from rootsopt.config.explain import is_whole, tree
from rootsopt.config.reading import Config
from rootsopt.config.units import near, shown
from rootsopt.errors import InputError
from rootsopt.response.scatter import draw
from rootsopt.scene.space import sobol as sobol_points

_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_RANGE = re.compile(rf"({_NUMBER}):({_NUMBER})(?::(\d+))?(:log)?")
# Pattern of texts that the user means as a range.
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
        values = space(self.low, self.high, self.points).tolist()
        # Values between whole ends may not be whole; the config rejects these.
        return [int(x) if self.whole and x.is_integer() else x for x in values]

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


Axis = Interval | tuple[Any, ...]
"""Values of a key, or the interval to draw them from."""


def drawn(axis: Axis, levels: NDArray[np.float64]) -> list[Any]:
    """Return the values (n,) of an axis at `levels` (n,) from 0 to 1."""
    if isinstance(axis, Interval):
        return axis.at(levels)
    count = len(axis)
    picked = np.minimum(np.floor(np.asarray(levels) * count).astype(int), count - 1)
    return [axis[k] for k in picked]


def axis_of(key: str, given: Any) -> Axis:
    """Return the axis of a `key`.

    `given`: an axis; a sequence, an array or an iterator of values; or a text as after `--over
    KEY=`: values separated by commas, and ranges `from:to:count`, with `:log` at the end for a
    logarithmic scale. A text `from:to` is an interval to draw samples from.

    Raises `InputError` if there are no values or more than `MOST`, or if a range is not valid."""
    if isinstance(given, Interval):
        return given
    if not isinstance(given, str):
        return _values(key, given)
    items = _items(key, given)
    spans = [item for item in items if isinstance(item, Interval) and item.points is None]
    if spans and len(items) == 1:
        return spans[0]
    if spans:
        raise InputError(
            f"`{key}`: an interval from:to cannot be mixed with other values, but the values are "
            f"{shown(given)}; write from:to:count for a range"
        )
    parts = (item.range() if isinstance(item, Interval) else [item] for item in items)
    return _taken(key, itertools.chain.from_iterable(parts))


def _values(key: str, given: Any) -> tuple[Any, ...]:
    """Return the values of a `key` that are `given` as a sequence, an array or an iterator."""
    if (getattr(given, "size", None) or 0) > MOST:
        raise _too_many(key)
    values: Any = given.tolist() if hasattr(given, "tolist") else given
    axis_values = _taken(key, values) if isinstance(values, Sequence | Iterator) else ()
    if not axis_values:
        raise InputError(
            f"`{key}` must have at least one value, as a list or as text such as "
            f"'300:6000:39', but is {shown(given)}"
        )
    return tuple(x.item() if hasattr(x, "item") else x for x in axis_values)


def _taken(key: str, values: Iterable[Any]) -> tuple[Any, ...]:
    """Return the `values`, but take no more of them than an axis may have."""
    first_values = tuple(itertools.islice(values, MOST + 1))
    if len(first_values) > MOST:
        raise _too_many(key)
    return first_values


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
    items = read_document(f"[{text}]", name)
    return [_interval(key, item) if isinstance(item, str) else item for item in items]


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


@dataclasses.dataclass(frozen=True)
class Dimension:
    """A dimension of a sweep: keys that change together.

    `name`: name of the dimension; `columns`: values of each key along it, all of one length."""

    name: str
    columns: dict[str, tuple[Any, ...]]

    @property
    def size(self) -> int:
        """Number of values along the dimension."""
        return len(next(iter(self.columns.values())))


@dataclasses.dataclass(frozen=True)
class Plan:
    """All points of a sweep, numbered from 0 in row-major order.

    `dimensions`: the sweep's dimensions, in the order given; `method`: `grid`, `random`, `sobol` or
    `tolerances`; `seed` of the samples, `None` for a grid."""

    dimensions: tuple[Dimension, ...]
    method: str = "grid"
    seed: int | None = None

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of values along each dimension."""
        return tuple(one.size for one in self.dimensions)

    @property
    def count(self) -> int:
        """Number of points."""
        return math.prod(self.shape)

    @property
    def keys(self) -> tuple[str, ...]:
        """Dotted keys that the sweep changes."""
        return tuple(key for one in self.dimensions for key in one.columns)

    def at(self, number: int) -> dict[str, Any]:
        """Return the values of all keys at the point with this `number`."""
        places = np.unravel_index(number, self.shape)
        return {
            key: values[int(place)]
            for one, place in zip(self.dimensions, places, strict=True)
            for key, values in one.columns.items()
        }

    def mapped(self, change: Callable[[str, Any], Any]) -> "Plan":
        """Return the plan with `change(key, value)` in place of every value."""
        dimensions = (
            Dimension(
                one.name, {k: tuple(change(k, v) for v in vs) for k, vs in one.columns.items()}
            )
            for one in self.dimensions
        )
        return dataclasses.replace(self, dimensions=tuple(dimensions))

    def record(self) -> dict[str, Any]:
        """Return the plan as plain values for files."""
        dimensions = {
            one.name: {key: list(values) for key, values in one.columns.items()}
            for one in self.dimensions
        }
        return {"method": self.method, "seed": self.seed, "dimensions": dimensions}


def plan_of(
    axes: Mapping[str, Any],
    zipped: bool | Sequence[Sequence[str]] = False,
    sample: int | None = None,
    sobol: int | None = None,
    seed: int = 0,
) -> Plan:
    """Return the points of a sweep over `axes`.

    `axes`: for each dotted key, its values or a text (see `axis_of`); `zipped`: `True` to
    advance all keys together, or groups of keys that do so; `sample`, `sobol`: number of
    pseudo-random or Sobol samples instead of a grid; `seed` of the samples.

    Raises `InputError` for axes that cannot be combined in this way."""
    if not axes:
        raise InputError("a sweep needs at least one key; give one with `--over KEY=VALUES`")
    parsed_axes = {key: axis_of(key, given) for key, given in axes.items()}
    _refuse_overlaps([*parsed_axes])
    if sample is not None and sobol is not None:
        raise InputError("`--sample` and `--sobol` exclude each other; remove one of them")
    count = sample if sample is not None else sobol
    if count is not None:
        if zipped:
            raise InputError("`--zip` does not go with samples, which zip all keys; remove it")
        method = "random" if sample is not None else "sobol"
        return Plan((_sampled(parsed_axes, count, method, seed),), method, seed)
    for key, axis in parsed_axes.items():
        if isinstance(axis, Interval):
            raise InputError(
                f"`{key}`: an interval needs a number of values, as in {axis.low:g}:{axis.high:g}"
                ":11, or `--sample N` or `--sobol N`"
            )
    plan = Plan(_dimensions(parsed_axes, zipped))
    if plan.count > MOST:
        raise InputError(
            f"a sweep must have at most {MOST} points, but the axes have {plan.count} "
            "combinations; give fewer values, or draw samples with `--sobol N`"
        )
    return plan


def scattered(config: Config, count: int) -> tuple[Config, Plan]:
    """Return `count` fresh scenes of the `tolerances` of a config, and the config without them.

    `optimize` judges a robust optimum in scenes of the same distribution. Raises `InputError` if
    the config has no `tolerances`."""
    if config.tolerances is None:
        raise InputError(
            "`--tolerances` needs the section `tolerances` in the config, which says what "
            "scatters; add it, or draw samples over keys with `--over` and `--sobol N`"
        )
    if not 1 <= count <= MOST:
        raise InputError(f"`--tolerances` must be from 1 to {MOST}, but is {count}")
    values = draw(config, count, fresh=True)
    columns = {one.key: tuple(values[:, k].tolist()) for k, one in enumerate(config.scatters)}
    plan = Plan((Dimension("sample", columns),), "tolerances", config.optimizer.seed)
    return config.model_copy(update={"tolerances": None}), plan


def check_values(config: Config, plan: Plan) -> None:
    """Raise `InputError` if a key of the plan is unknown or cannot have one of its values.

    Values that merely do not fit each other are accepted: they make single points invalid. The
    limits of a key form an interval, so that only the ends of its numbers are checked."""
    for one in plan.dimensions:
        for key, values in one.columns.items():
            try:
                for value in _telling(values):
                    config.check_values({key: value})
            except InputError as error:
                raise InputError(f"{error}{_meant(key, str(error))}") from None


def _telling(values: Sequence[Any]) -> list[Any]:
    """Return the values to check in place of all: the extremes of the numbers, and all texts."""
    selection: list[Any] = []
    for kind in (int, float):
        numbers = [value for value in values if type(value) is kind]
        odd = [value for value in numbers if value != value]
        selection += [min(numbers), max(numbers), *odd[:1]] if numbers else []
        selection += [value for value in numbers if not float(value).is_integer()][:1]
    return selection + [value for value in values if type(value) not in (int, float)]


def _meant(key: str, message: str) -> str:
    """Return the known key that is most similar to an unknown one, as the end of a message."""
    if "is not a known key" not in message or "did you mean" in message:
        return ""
    known = {one.rpartition(".")[2]: one for one in reversed([*tree(Config)])}
    guess = near(key, [*known.values()]) or known.get(near(key.rpartition(".")[2], [*known]), "")
    return f"; did you mean `{guess}`?" if guess else ""


def _refuse_overlaps(keys: Sequence[str]) -> None:
    for one, other in itertools.permutations(keys, 2):
        if f"{other}.".startswith(f"{one}."):
            raise InputError(
                f"`{other}` is inside `{one}`, so that both cannot be swept; give `{one}` "
                "whole sections as values, or remove it"
            )


def _sampled(axes: Mapping[str, Axis], count: int, method: str, seed: int) -> Dimension:
    option = "--sample" if method == "random" else "--sobol"
    if not 1 <= count <= MOST:
        raise InputError(f"`{option}` must be from 1 to {MOST}, but is {count}")
    if not 0 <= seed < 2**63:
        raise InputError(f"`--seed` must be a whole number from 0 to 2^63 - 1, but is {seed}")
    if method == "sobol":
        levels = sobol_points(count, seed, len(axes))
    else:
        levels = np.random.default_rng(seed).random((count, len(axes)))
    columns = {key: tuple(drawn(axis, levels[:, k])) for k, (key, axis) in enumerate(axes.items())}
    return Dimension("sample", columns)


def _dimensions(
    axes: Mapping[str, Axis], zipped: bool | Sequence[Sequence[str]]
) -> tuple[Dimension, ...]:
    """Return one dimension for each group of zipped keys, and one for each other key."""
    groups = ([[*axes]] if zipped else []) if isinstance(zipped, bool) else [[*g] for g in zipped]
    for key in (key for group in groups for key in group):
        if key not in axes:
            guess = near(key, [*axes])
            meant = f"; did you mean `{guess}`?" if guess else ""
            raise InputError(f"`{key}` is zipped, but it is not among the keys of the sweep{meant}")
        if sum(key in group for group in groups) > 1:
            raise InputError(f"`{key}` is in two groups of zipped keys; name it once")
    names = ["point"] if len(groups) == 1 else [f"point_{k + 1}" for k in range(len(groups))]
    dimensions, used = [], set()
    for key in axes:
        if key in used:
            continue
        number = next((k for k, group in enumerate(groups) if key in group), None)
        members = [key] if number is None else [one for one in axes if one in groups[number]]
        used |= {*members}
        columns = {one: tuple(axes[one]) for one in members}  # pyright: ignore
        sizes = {one: len(values) for one, values in columns.items()}
        if len({*sizes.values()}) > 1:
            counts = ", ".join(f"`{one}` has {size}" for one, size in sizes.items())
            raise InputError(f"zipped keys must have equally many values, but {counts}")
        _refuse_repetitions(columns)
        dimensions.append(Dimension(key if number is None else names[number], columns))
    return tuple(dimensions)


def _refuse_repetitions(columns: Mapping[str, Sequence[Any]]) -> None:
    """Raise `InputError` if two points along a dimension have the same values of all its keys."""
    seen: set[str] = set()
    for values in zip(*columns.values(), strict=True):
        # As text, because a value may be a section; 1 and 1.0 are the same to a config.
        text = repr([float(x) if type(x) is int and abs(x) < 2**53 else x for x in values])
        if text in seen:
            keys = " and ".join(f"`{key}`" for key in columns)
            twice = ", ".join(map(shown, values))
            raise InputError(f"{keys}: values must differ, but {twice} is given twice; remove one")
        seen.add(text)
