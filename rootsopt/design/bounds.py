"""Bounds of the design parameters, from the config or by default."""

from rootsopt.config import TWIST, Config
from rootsopt.config.families import Parameter, family_of
from rootsopt.errors import InputError

_ROOM = 0.1
"""Distance (fraction of the width of the bounds) from a design to the bounds that are widened for
it."""


def bounds_of(config: Config) -> list[tuple[float, float]]:
    """Return the bounds (low, high) of each design parameter of a config, in config units.

    Raises `InputError` if a bound is impossible, such as a tip land wider than the lobe."""
    found = []
    for parameter in family_of(config.profile.family).parameters:
        values = getattr(config.profile, parameter.key)
        count = len(values) if isinstance(values, tuple) else 1
        found += [_pair(config, parameter)] * count
    return [*found, config.optimizer.bounds[TWIST]] if config.twist_free else found


def floors_of(config: Config) -> tuple[float, ...]:
    """Return the default lower bound of each design parameter, as a fraction of its range's end.

    It is 0 for parameters that have bounds in the config, or whose range depends on no other."""
    found: list[float] = []
    for parameter in family_of(config.profile.family).parameters:
        values = getattr(config.profile, parameter.key)
        count = len(values) if isinstance(values, tuple) else 1
        given = config.optimizer.bounds.get(parameter.key) is not None
        found += [0.0 if given else parameter.floor] * count
    return (*found, 0.0) if config.twist_free else tuple(found)


def widened(config: Config) -> tuple[Config, tuple[str, ...]]:
    """Return (config whose bounds hold its own design, keys of the widened bounds).

    Only default bounds are widened, by `_ROOM` of their width beyond the design, within the limits
    of the key. Bounds of the config that differ from the default are kept."""
    changes: dict[str, tuple[float, float]] = {}
    lobes, radius = config.profile.lobes, config.profile.pitch_radius_mm
    for parameter in family_of(config.profile.family).parameters:
        given = config.optimizer.bounds.get(parameter.key)
        if given is not None and tuple(given) != parameter.default_bounds:
            continue
        low, high = given or parameter.bounds(config.profile)
        value = getattr(config.profile, parameter.key)
        values = value if isinstance(value, tuple) else (value,)
        if low <= min(values) and max(values) <= high:
            continue
        least, most = parameter.bounds_range
        sized = parameter.limits(radius) or (least, most)
        least, most = max(least, sized[0]), min(most, sized[1])
        room = _ROOM * (high - low)
        pair = max(least, min(low, min(values) - room)), min(most, max(high, max(values) + room))
        try:
            parameter.check_bounds(pair, lobes)
        except InputError:
            pair = pair[0], max(high, *values)
        changes[parameter.key] = pair
    if not changes:
        return config, ()
    bounds = config.optimizer.bounds | changes
    return config.moved({"optimizer.bounds": bounds}), tuple(changes)


def _pair(config: Config, parameter: Parameter) -> tuple[float, float]:
    given = config.optimizer.bounds.get(parameter.key)
    if given is None:
        return parameter.bounds(config.profile)
    parameter.check_bounds(given, config.profile.lobes)
    return given
