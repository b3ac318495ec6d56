"""The quantities to fit: config keys with bounds, and the scale on which a search moves them."""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rootsopt.config.explain import limits_of, tree
from rootsopt.config.reading import Config
from rootsopt.config.tolerances import scatterable, unknown_key
from rootsopt.config.units import NAMES
from rootsopt.errors import InputError
from rootsopt.response.sweeps.plan import Interval, axis_of
from rootsopt.response.sweeps.points import configured
from rootsopt.scene.space import bounds_of

OFFSET = "rotation_offset_deg"
"""The quantity of a record whose rotation is measured from an unknown angle: its reading minus the
rotation of rotor 1 (°)."""

# Ratio of bounds above which a search moves on a logarithmic scale.
_WIDE = 30.0

# Range in which a search begins without bounds. The config's value is divided and multiplied by the
# first number. For a value of 0, the range is the second number, a share of the allowed range.
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
        """Name of the quantity in words."""
        return NAMES.get(self.key) or self.key.rpartition(".")[2].replace("_", " ")


def fitted(
    config: Config, keys: Mapping[str, Any] | Iterable[str], given: Iterable[str]
) -> tuple[Config, list[Fitted]]:
    """Return (config that has all quantities, the quantities to fit).

    `keys`: see `identify`; `given`: keys whose values the record holds. Raises `InputError` for a
    key that cannot be fitted, or for bounds outside its range."""
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
