"""The points of a sweep: axes crossed, zipped or sampled."""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from rootsopt.config import Config
from rootsopt.config.explain import tree
from rootsopt.config.words import near, shown
from rootsopt.errors import InputError
from rootsopt.response.scatter import draw
from rootsopt.response.sweeps.axes import MOST, Axis, Interval, axis_of
from rootsopt.scene.space import sobol as sobol_points


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

    `axes`: for each dotted key, its values, an `Axis`, or a text (see `axis_of`); `zipped`: `True`
    to advance all keys together, or groups of keys that do so; `sample`, `sobol`: number of
    pseudo-random or Sobol samples instead of a grid; `seed` of the samples.

    Raises `InputError` for axes that cannot be combined in this way."""
    if not axes:
        raise InputError("a sweep needs at least one key; give one with `--over KEY=VALUES`")
    found = {
        key: given if isinstance(given, Axis) else axis_of(key, given)
        for key, given in axes.items()
    }
    _refuse_overlaps([*found])
    if sample is not None and sobol is not None:
        raise InputError("`--sample` and `--sobol` exclude each other; remove one of them")
    count = sample if sample is not None else sobol
    if count is not None:
        if zipped:
            raise InputError("`--zip` does not go with samples, which zip all keys; remove it")
        method = "random" if sample is not None else "sobol"
        return Plan((_sampled(found, count, method, seed),), method, seed)
    for key, axis in found.items():
        if isinstance(axis.values, Interval):
            low, high = axis.values.low, axis.values.high
            raise InputError(
                f"`{key}`: an interval needs a number of values, as in {low:g}:{high:g}:11, or "
                "`--sample N` or `--sobol N`"
            )
    plan = Plan(_dimensions(found, zipped))
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
    """Return the values that stand for all others in a check.

    They are the extremes of the numbers, and all texts."""
    found: list[Any] = []
    for kind in (int, float):
        numbers = [value for value in values if type(value) is kind]
        odd = [value for value in numbers if value != value]
        found += [min(numbers), max(numbers), *odd[:1]] if numbers else []
        found += [value for value in numbers if not float(value).is_integer()][:1]
    return found + [value for value in values if type(value) not in (int, float)]


def _meant(key: str, message: str) -> str:
    """Return the end of a message: the known key that is most similar to an unknown one."""
    if "is not a known key" not in message or "did you mean" in message:
        return ""
    known = {one.rpartition(".")[2]: one for one in reversed([*tree(Config)])}
    guess = near(key, [*known.values()]) or known.get(near(key.rpartition(".")[2], [*known]), "")
    return f"; did you mean `{guess}`?" if guess else ""


def _refuse_overlaps(keys: Sequence[str]) -> None:
    for one in keys:
        for other in keys:
            if one != other and f"{other}.".startswith(f"{one}."):
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
    columns = {key: tuple(axis.drawn(levels[:, k])) for k, (key, axis) in enumerate(axes.items())}
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
    found, used = [], set()
    for key in axes:
        if key in used:
            continue
        number = next((k for k, group in enumerate(groups) if key in group), None)
        members = [key] if number is None else [one for one in axes if one in groups[number]]
        used |= {*members}
        columns = {one: tuple(axes[one].values) for one in members}  # pyright: ignore
        sizes = {one: len(values) for one, values in columns.items()}
        if len({*sizes.values()}) > 1:
            counts = ", ".join(f"`{one}` has {size}" for one, size in sizes.items())
            raise InputError(f"zipped keys must have equally many values, but {counts}")
        _refuse_repetitions(columns)
        found.append(Dimension(key if number is None else names[number], columns))
    return tuple(found)


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
