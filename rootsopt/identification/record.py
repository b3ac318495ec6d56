"""A measured record: what was measured, at which operating points.

A record is one table or several. Columns named after config keys, such as `scene.speed_rpm`, say at
which operating point a row was measured. A table with rotations or times holds samples of a motion.
Any other one holds averages, a row per operating point."""

import dataclasses
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas
from numpy.typing import NDArray

from rootsopt.config import Config
from rootsopt.config.document import read_document
from rootsopt.config.explain import limits_of, tree
from rootsopt.config.sources import reason, regular_file
from rootsopt.config.tolerances import scatterable, unknown_key
from rootsopt.config.units import named, near, shown
from rootsopt.errors import InputError
from rootsopt.identification.model import CHANNELS
from rootsopt.measured.table import measured_number, titled
from rootsopt.response.sensitivity import NAMES
from rootsopt.response.sweeps.plan import Interval, axis_of
from rootsopt.response.sweeps.points import configured
from rootsopt.response.terms import GEAR, RESERVES, is_force
from rootsopt.scene.space import bounds_of

# Columns of a table of samples, as in `response_*.csv`; the time counts only without rotation.
_ROTATION, _TIME = "rotation_deg", "time_s"

# Ending of the names of columns with standard deviations, which `_sd` stands for, too.
_SPREAD = "_std"

# Number of samples at an operating point above which only every second, third … one is used.
_MOST = 4096

# Rotation (°) in 1 s at 1 rpm.

# Rotation (°) in 1 s at 1 rpm.
_DEGREES_PER_RPM = 6.0

# Distance (mesh periods) from an instant up to which samples show its state, and how many do.
_BESIDE, _ENOUGH = 0.1, 6
_AVERAGES = *RESERVES, *GEAR


@dataclasses.dataclass(frozen=True)
class Observed:
    """What was measured at one operating point.

    `source`: name of the table; `values`: config keys that differ from the config; `table`: numbers
    by line, with the columns `names` and their standard deviations; `sampled`: whether the lines
    are samples, with a column for the rotation (°) of rotor 1, rather than averages."""

    source: str
    values: dict[str, Any]
    table: pandas.DataFrame
    names: tuple[str, ...]
    sampled: bool

    def column(self, name: str = _ROTATION) -> NDArray[np.float64]:
        """Return a column (n,), by default the rotation; NaN where nothing was measured."""
        return np.array(self.table.get(name, np.full(len(self.table), np.nan)), float)

    @property
    def timed(self) -> bool:
        """Whether the rotation follows from the time."""
        return _TIME in self.table

    @property
    def measured(self) -> NDArray[np.float64]:
        """The measured values (n, c)."""
        return np.stack([self.column(name) for name in self.names], axis=1)

    def rows(self) -> pandas.DataFrame:
        """Return a row for each measured value: `source`, `line`, `values`, `rotation_deg`,
        `column`, `measured`, standard deviation (`given`, NaN if not known), and `sampled`."""
        measured = self.measured
        given = np.stack([self.column(name + _SPREAD) for name in self.names], axis=1)
        k, c = np.nonzero(np.isfinite(measured))
        where = {"source": self.source, "line": self.table.index[k]} | self.values
        where |= {"rotation_deg": self.column()[k], "column": np.array(self.names)[c]}
        found = {"measured": measured[k, c], "given": given[k, c], "sampled": self.sampled}
        return pandas.DataFrame(where | found)

    def state(
        self, lobes: int, turns: int, period: float, offset: float
    ) -> NDArray[np.float64] | None:
        """Return ε (rad) and dε/dt (rad/s) at a φ1 that is a multiple of `turns` mesh periods.

        They are those of cubics through the samples beside it; None unless enough of ε were
        measured. `lobes` of a rotor; `period` (s) of the mesh; `offset` (°): rotation at φ1 = 0."""
        place, relative, rate = map(self.column, (_ROTATION, *CHANNELS[:2]))
        place = (place - offset) * lobes / 360
        number = np.round(place / turns)
        away = place - turns * number
        near = np.isfinite(relative) & (np.abs(away) < _BESIDE)
        if np.count_nonzero(near) < _ENOUGH:
            return None
        most = pandas.Series(number[near]).value_counts()
        # Samples that are few in each mesh period are taken together.
        near &= (number == most.index[0]) | (most.iloc[0] < _ENOUGH)
        *_, speed, angle = np.polyfit(away[near], relative[near], 3)
        near &= np.isfinite(rate)
        if np.count_nonzero(near) >= _ENOUGH:
            return np.array([angle, np.polyfit(away[near], rate[near], 3)[-1]])
        return np.array([angle, speed / period])


def observed(config: Config, data: Any) -> list[Observed]:
    """Return what was measured at each operating point.

    `data`: path of a CSV file, columns by name (a mapping or an `xarray.Dataset`), or a list of
    these. Raises `InputError` if a table cannot be read, or if a column or a value is wrong."""
    tables = data if isinstance(data, list | tuple) else [data]
    found = []
    for number, one in enumerate(tables, 1):
        found += _points(config, *_table(one, f"table {number} of the record"))
    if not found:
        raise InputError("the record must hold measured values, but has none; add rows")
    return found


def _table(data: Any, name: str) -> tuple[str, pandas.DataFrame]:
    """Return the name and the cells of a table, as text with line numbers."""
    if not isinstance(data, str | Path):
        columns = data.variables if hasattr(data, "variables") else data
        cells = {str(key): np.atleast_1d(np.asarray(data[key])).tolist() for key in columns}
        if len({len(column) for column in cells.values()}) > 1:
            raise InputError(f"{name}: must have columns of one length; correct them")
        return name, pandas.DataFrame(cells, dtype=object).map(
            lambda x: "" if x is None else str(x)
        )
    path = Path(data)
    try:
        content = regular_file(path, "a table").read_bytes()
    except (OSError, ValueError) as error:
        why = reason(error)
        raise InputError(
            f"{named(str(path))}: must be a file that can be read: {why}; give the path of a CSV "
            "file"
        ) from None
    titles, rows = titled(content, path.name, "of the record")
    if len({*titles}) < len(titles):
        twice = next(title for title in titles if titles.count(title) > 1)
        raise InputError(f"{path.name}: must name each column once, but has {twice!r} twice")
    rows = {n: (cells + [""] * len(titles))[: len(titles)] for n, cells in rows.items()}
    return path.name, pandas.DataFrame.from_dict(rows, orient="index", columns=titles)


def _points(config: Config, name: str, cells: pandas.DataFrame) -> Iterator[Observed]:
    """Yield the operating points of a table in the order of their first rows."""
    cells = cells.rename(
        columns=lambda x: x.removesuffix("_sd") + _SPREAD if x.endswith("_sd") else x
    )
    sampled, titles = bool({_ROTATION, _TIME} & {*cells}), [*cells]
    keys = [title for title in titles if title in tree(Config)]
    known = {_ROTATION, _TIME, *keys, *(title + _SPREAD for title in titles)}
    names = tuple(title for title in titles if title not in known)
    if not sampled and (samples := [title for title in names if title in CHANNELS]):
        raise InputError(
            f"{name}: the samples {samples[0]} need a column {_ROTATION} or {_TIME}; add it, or "
            "rename the one that holds it"
        )
    for title in names:
        _check(config, name, title, sampled)
    if not names:
        some = CHANNELS[0] if sampled else "mean_force_N"
        raise InputError(f"{name}: must have a measured column, such as {some}; add one")
    table = cells.drop(columns=keys).map(_number).astype(float)
    for title, column in table.items():
        wrong, what = column.abs() == np.inf, "a number"
        if str(title).endswith(_SPREAD):
            measured = table[str(title).removesuffix(_SPREAD)].notna()
            wrong, what = wrong | measured & ~(column > 0), "a number greater than 0"
        if wrong.any():
            line = wrong.idxmax()
            raise InputError(
                f"{name}, line {line}: {title} must be {what}, but is "
                f"{shown(cells.at[line, title])}; correct it, or remove the row"
            )
    groups = cells.groupby(keys or (lambda _: 0), sort=False) if sampled else cells.groupby(level=0)
    for _, rows in groups:
        values = {key: read_document(rows[key].iloc[0], name) for key in keys}
        config.check_values({key: x for key, x in values.items() if x is not None})
        part = table.loc[rows.index].dropna(how="all", subset=names)
        part = part.drop(columns=_TIME, errors="ignore") if _ROTATION in part else part
        if sampled and _ROTATION not in part:
            if config.scene.motor is not None:
                raise InputError(f"{name}: must have the column {_ROTATION}, because the speed of "
                                 "a motor varies; add it")  # fmt: skip
            speed = values.get("scene.speed_rpm") or config.scene.speed_rpm
            part = part.assign(**{_ROTATION: _DEGREES_PER_RPM * speed * part[_TIME]})
        part = part.dropna(subset=[_ROTATION]) if sampled else part
        if len(part):
            some = part.iloc[:: -(-len(part) // _MOST)]
            yield Observed(name, values, some, names, sampled)


def _number(cell: str) -> float:
    """Return the number in a cell, NaN if it is empty, infinity for another text."""
    found = measured_number(cell)
    return np.inf if found is None else found


def _check(config: Config, name: str, title: str, sampled: bool) -> None:
    """Raise `InputError` unless `title` is that of a measured column."""
    if title in (CHANNELS if sampled else _AVERAGES) or (
        not sampled and is_force(config, title, name)
    ):
        return
    told = CHANNELS if sampled else ("mean_force_N", "peak_force_N", "rms_force_N", *_AVERAGES)
    meant = near(title, [*tree(Config)] if "." in title else [*told])
    raise InputError(
        f"{name}: the column {named(title)!r} must be {'a sample' if sampled else 'an average'} "
        f"({', '.join(told)}), a config key, or one of these with {_SPREAD} for its standard "
        f"deviations; {f'did you mean {meant}?' if meant else 'rename or remove it'}"
    )


OFFSET = "rotation_offset_deg"
"""The quantity of a record whose rotation is measured from an unknown angle: its reading minus the
rotation of rotor 1 (°)."""

# Ratio of bounds above which a search moves on a logarithmic scale.
_WIDE = 30.0

# Without bounds, a search begins between the config's value over and times the first number. For
# a value of 0, it begins within this share (the second) of the allowed range.
_AROUND, _SMALL = 5.0, 0.02


class Fitted(NamedTuple):
    """A quantity to fit.

    `key` in the config, or `OFFSET`; `low`, `high`: bounds; `begin`, `end`: range in which a search
    begins, inside the bounds; `own`: the config's value; `log`: whether the scale is logarithmic.
    On this scale, the range is 0 … 1."""

    key: str
    low: float
    high: float
    begin: float
    end: float
    own: float
    log: bool

    def scaled(self, value: float) -> float:
        """Return the place of a `value` on the scale."""
        if self.log:
            return math.log(value / self.begin) / math.log(self.end / self.begin)
        return (value - self.begin) / (self.end - self.begin)

    @property
    def first(self) -> float:
        """Place where a search begins: that of the config's value, or the middle if it lies outside
        the range."""
        return self.scaled(self.own) if self.begin <= self.own <= self.end else 0.5

    def value(self, place: float) -> float:
        """Return the value at a `place` on the scale, within the bounds."""
        if self.log:
            found = self.begin * math.exp(place * math.log(self.end / self.begin))
        else:
            found = self.begin + place * (self.end - self.begin)
        return min(max(found, self.low), self.high)

    def slope(self, value: float) -> float:
        """Return the derivative of the value with respect to its place on the scale."""
        if self.log:
            return value * math.log(self.end / self.begin)
        return self.end - self.begin

    @property
    def name(self) -> str:
        """Name in words."""
        return NAMES.get(self.key) or self.key.rpartition(".")[2].replace("_", " ")


def fitted(
    config: Config, keys: Mapping[str, Any] | Iterable[str], given: Iterable[str]
) -> tuple[Config, list[Fitted]]:
    """Return (config that has all quantities, the quantities to fit).

    `keys`: see `identify`; `given`: keys whose values the record holds. Raises `InputError` for a
    key that cannot be fitted, or bounds that it cannot have."""
    wanted = {}
    for text, pair in keys.items() if isinstance(keys, Mapping) else ((key, None) for key in keys):
        key, equals, bounds = str(text).partition("=")
        key = key.strip()
        if key in wanted:
            raise InputError(f"`{key}` must be fitted once, but is named twice; remove one")
        wanted[key] = _bounds(key, bounds) if equals else pair
    if not wanted:
        raise InputError(
            "no quantity to fit is named; name one, as in scene.timing_gear.backlash_mm=0.02:0.4"
        )
    for key in {*wanted} & {*given}:
        raise InputError(
            f"`{key}` must not be fitted, because the record has a column of its values; remove "
            "one of them"
        )
    found = []
    for key, pair in wanted.items():
        config, one = _fitted(config, key, pair)
        found.append(one)
    return config, found


def _bounds(key: str, text: str) -> Any:
    """Return the bounds in a text, as in `0.02:0.4`."""
    values = axis_of(key, text).values
    if not isinstance(values, Interval):
        raise InputError(
            f"`{key}` must have two bounds, as in {key}=0.1:0.5, but has {text!r}; correct them"
        )
    return values.low, values.high


def _fitted(config: Config, key: str, pair: Any) -> tuple[Config, Fitted]:
    if pair is not None and not (np.shape(pair) == (2,) and np.all(np.isfinite(pair))):
        raise InputError(f"`{key}` must have two finite bounds, but has {pair}; correct them")
    if pair is not None and not pair[0] < pair[1]:
        raise InputError(
            f"`{key}` must have a lower bound below the upper one, but has {pair[0]:g} and "
            f"{pair[1]:g}; correct them"
        )
    if key == OFFSET:
        half = 180.0 / config.profile.lobes
        low, high = pair or (-half, half)
        return config, Fitted(key, low, high, low, high, min(max(0.0, low), high), False)
    if config.value(key) is None and key in tree(Config):
        try:
            config = configured(config, {key: sum(pair) / 2 if pair else 0.0})
        except InputError:
            if pair:
                raise
            raise InputError(
                f"`{key}` has no value in the config; give it one, or bounds as {key}=0.1:0.5"
            ) from None
    values = scatterable(config)
    if key not in values:
        raise InputError(unknown_key(key, values, tree(Config), "--fit"))
    own = values[key]
    low, high = map(float, pair or _allowed(config, key))
    for end in (low, high):
        config.check_values({key: end})
    if pair:
        log = low > 0 and high > _WIDE * low
        return config, Fitted(key, low, high, low, high, own, log)
    begin, end = sorted((own / _AROUND, own * _AROUND))
    if own == 0:
        begin, end = _SMALL * low, _SMALL * high
    begin, end = max(begin, low), min(end, high)
    return config, Fitted(key, low, high, begin, end, own, low > 0)


def _allowed(config: Config, key: str) -> tuple[float, float]:
    """Return the bounds of a design parameter, or the range that the key allows."""
    if key.startswith("profile."):
        names = [f"profile.{name}" for name in config.design_keys]
        low, high = bounds_of(config)[names.index(key)]
        own = scatterable(config)[key]
        return min(low, own), max(high, own)
    low, high = limits_of(tree(Config)[key]).ends
    if not (math.isfinite(low) and math.isfinite(high)):
        raise InputError(f"`{key}` has no usual range; give bounds, as in {key}=0.1:0.5")
    return low, high


def values_at(quantities: Sequence[Fitted], place: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the values (p,) of the quantities at a `place` (p,) on their scales."""
    return np.array([one.value(x) for one, x in zip(quantities, place, strict=True)])
