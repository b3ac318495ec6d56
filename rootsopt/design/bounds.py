"""Bounds of the design parameters, from the config or by default."""

from rootsopt.config import Config
from rootsopt.config.families import Parameter, family_of


def bounds_of(config: Config) -> list[tuple[float, float]]:
    """Return the bounds (low, high) of each design parameter of a config, in config units.

    Raises `InputError` if a bound is impossible, such as a tip land wider than the lobe."""
    found = []
    for parameter in family_of(config.profile.family).parameters:
        values = getattr(config.profile, parameter.key)
        count = len(values) if isinstance(values, tuple) else 1
        found += [_pair(config, parameter)] * count
    return found


def _pair(config: Config, parameter: Parameter) -> tuple[float, float]:
    given = getattr(config.optimizer.bounds, parameter.key)
    if given is None:
        return parameter.bounds(config.profile)
    parameter.check_bounds(given, config.profile.lobes)
    return given
