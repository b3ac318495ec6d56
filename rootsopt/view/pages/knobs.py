"""The numbers of a config that sliders move: names, units, spans and allowed ranges."""

import math
from typing import NamedTuple

from pydantic.fields import FieldInfo

from rootsopt.config import Config
from rootsopt.config.explain import is_whole, limits_of, tree
from rootsopt.config.families import family_of
from rootsopt.config.units import unit_of, words
from rootsopt.scene.space import bounds_of

# Sections of the config that hold the design and its scene.
_SECTIONS = ("profile", "rotor", "contact", "scene")
_GROUPS = {
    "profile": "Profile",
    "rotor": "Rotor",
    "contact": "Contact",
    "contact.friction": "Friction",
    "contact.wear": "Wear",
    "scene": "Speed and mounting",
    "scene.load": "Load",
    "scene.motor": "Motor",
    "scene.timing_gear": "Timing gear",
    "scene.supports": "Elastic bearings",
    "scene.bearings": "Bearing loads",
    "scene.heat": "Heat",
}
_DESIGN = "Design"

# Groups at the top of the page; the others follow in the order of the config.
_ORDER = (_DESIGN, "Speed and mounting", "Load", "Motor", "Timing gear", "Contact")

# Keys whose default follows other keys. They have a slider only if the config sets them.
_FOLLOWS = ("contact.smoothing_mm",)

# Span of a slider as multiples of the config's own value.
_AROUND = 0.2, 2.0

# Half of the span of a slider, by unit, for a value of 0; `_ELSE` for other units.
_ZERO = {"mm": 0.2, "mrad": 1.0, "°": 60.0, "K": 60.0}
_ELSE = 1.0

# Least number of steps of a slider that is not whole.
_STEPS = 200


class Knob(NamedTuple):
    """A number of the config with its slider.

    `key`: dotted config key; an entry of a list has its number, as in `profile.coefficients_3`.
    `name`, `unit`, `help`, `group`: texts of the page. `value`: number in the config. `low`,
    `high`, `step`: span and step of the slider. `least`, `most`: allowed range, perhaps infinite.
    `whole`: whether only whole numbers are allowed."""

    key: str
    name: str
    unit: str
    help: str
    group: str
    value: float
    low: float
    high: float
    step: float
    least: float
    most: float
    whole: bool

    def with_value(self, value: float) -> "Knob":
        """Return the knob with another `value`, which lies in its span."""
        return self._replace(value=value, low=min(self.low, value), high=max(self.high, value))


def knobs_of(config: Config) -> list[Knob]:
    """Return the knobs of all design parameters and scene parameters that a `config` has.

    Design parameters span their bounds in an optimisation. Parts that the scene does not have, and
    keys that are not set, have no knobs."""
    found = _design(config)
    parameters, fields = set(config.profile.parameters), tree(Config)
    for section in _SECTIONS:
        for key, field in fields.items():
            if key.partition(".")[0] != section or "." not in key:
                continue
            name = key.rpartition(".")[2]
            if section == "profile" and name in parameters:
                continue
            if key in _FOLLOWS and name not in config.contact.model_fields_set:
                continue
            value = config.value(key)
            if isinstance(value, int | float) and not isinstance(value, bool):
                found.append(_scene(field, key, value))
    order = [*_ORDER, *dict.fromkeys(knob.group for knob in found)]
    return sorted(found, key=lambda knob: order.index(knob.group))


def _design(config: Config) -> list[Knob]:
    """Return the knobs of the design parameters."""
    found = []
    values = zip(config.design_keys, config.design, bounds_of(config), strict=True)
    owners = [
        parameter
        for parameter in family_of(config.profile.family).parameters
        for _ in range(_count(getattr(config.profile, parameter.key)))
    ]
    for (key, value, (low, high)), owner in zip(values, owners, strict=True):
        sized = owner.limits(config.profile.pitch_radius_mm) or (owner.lowest, owner.highest)
        least, most = max(owner.lowest, sized[0]), min(owner.highest, sized[1])
        if not math.isfinite(high):
            high = _AROUND[1] * float(value)
        low, high = max(low, least), min(high, most)
        name = words(owner.key)
        if key != owner.key:
            name = f"{name.removesuffix('s')} {key.rpartition('_')[2]}"
        found.append(
            Knob(
                f"profile.{key}", name, unit_of(owner.key), owner.help, _DESIGN, float(value),
                low, high, _step(high - low), least, most, False,
            ).with_value(float(value))
        )  # fmt: skip
    return found


def _count(value: object) -> int:
    return len(value) if isinstance(value, tuple) else 1


def _scene(field: FieldInfo, key: str, value: float) -> Knob:
    """Return the knob of any other number of the config."""
    (least, most), whole = limits_of(field).ends, is_whole(field)
    low, high = _span(key, float(value), least < 0)
    if whole:
        low, high = least, most
    low, high = max(low, least), min(high, most)
    section, _, name = key.rpartition(".")
    return Knob(
        key, words(name), unit_of(name), field.description or "",
        _GROUPS.get(section, section), float(value), low, high,
        1.0 if whole else _step(high - low), least, most, whole,
    ).with_value(float(value))  # fmt: skip


def _span(key: str, value: float, signed: bool) -> tuple[float, float]:
    """Return the span of a slider around a `value`, before the key's limits are applied.

    `signed`: whether the key may be negative; its slider then reaches as far below 0 as above."""
    reach = max(2 * abs(value), _ZERO.get(unit_of(key), _ELSE) * (signed or not value))
    if signed:
        return -reach, reach
    if not value:
        return 0.0, reach
    return _AROUND[0] * value, _AROUND[1] * value


def _step(width: float) -> float:
    """Return the greatest step 1, 2 or 5 × 10^k of which at least `_STEPS` fit into `width`."""
    if width <= 0:
        return 1.0
    power = 10.0 ** math.floor(math.log10(width / _STEPS))
    return max(one * power for one in (1, 2, 5) if one * power * _STEPS <= width * (1 + 1e-9))
