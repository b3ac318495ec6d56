"""Bounds of the design parameters where the config sets none."""

import math

from rootsopt.config import FAMILY_KEYS, Config
from rootsopt.errors import InputError
from rootsopt.families import keys_of

_SHARES = {
    "arc_center_mm": (0.5, 0.999),
    "tip_arc_radius_mm": (0.05, 0.8),
    "outer_radius_mm": (1.1, 1.7),
    "ellipse_center_mm": (0.0, 0.99),
    "ellipse_height_mm": (0.2, 1.5),
}
"""Lengths, in pitch radii."""
_FIXED = {"tip_arc_turn_deg": (1.0, 90.0), "coefficients": (-1.0, 1.0)}
"""Those that do not go with the size."""
_ANY_LENGTH, _ANY_ANGLE, _ANY_NUMBER = (0.01, 1.5), (0.0, 90.0), (0.0, 2.0)
"""For a key that is not listed; lengths in pitch radii."""
_AROUND = (0.5, 1.5)
"""Of the config's own value, for any other parameter."""


def bounds_of(config: Config) -> list[tuple[float, float]]:
    """(low, high) of every design parameter of a config, in its units.

    Raises `InputError` where a tip land could be wider than the lobe."""
    found = []
    for name in keys_of(config.profile):
        key = next(key for key in FAMILY_KEYS[config.profile.family] if name.startswith(key))
        found.append(_pair(config, key))
    return found


def _pair(config: Config, key: str) -> tuple[float, float]:
    given = getattr(config.optimizer.bounds, key)
    profile = config.profile
    if key == "tip_arc_angle_deg":
        half = 90.0 / profile.lobes
        if given[1] >= half:
            raise InputError(
                f"`optimizer.bounds.tip_arc_angle_deg` must stay below {half:g} (a quarter of "
                f"the lobe pitch), but is {list(given)}"
            )
    if given is not None:
        return given
    if key == "involute_length_mm":
        return 0.0, math.inf
    if key in _FIXED or key in _SHARES:
        return around(key, profile.pitch_radius_mm, profile.lobes)
    value = abs(getattr(profile, key))
    return _AROUND[0] * value, _AROUND[1] * value


def around(key: str, pitch_radius_mm: float, lobes: int) -> tuple[float, float]:
    """(low, high) between which a parameter of a rotor of this size usually lies."""
    if key in _FIXED:
        return _FIXED[key]
    if key == "pressure_angle_deg":
        return 15.0, 60.0
    if key == "tip_arc_angle_deg":
        return 0.0, 45.0 / lobes
    known = _SHARES.get(key)
    if known is not None or key.endswith("_mm"):
        low, high = known or _ANY_LENGTH
        return low * pitch_radius_mm, high * pitch_radius_mm
    return _ANY_ANGLE if key.endswith("_deg") else _ANY_NUMBER
