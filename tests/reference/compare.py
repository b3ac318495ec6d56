"""Differences between two results of one config, quantity by quantity."""

from collections.abc import Callable
from typing import Any

import numpy as np

LIMITS = {
    "geometry": 1e-10,
    "response": 1e-9,
    "gradient": 1e-7,
    "of the peak": 1e-6,
    "multiplier": 1e-7,
    "average": 1e-7,
    "share": 1e-9,
}
"""Relative difference of each quantity above which a result counts as changed.

`of the peak`: the peak's gradient, which rounding of nearby forces changes by some 1e-7. `average`:
means over an ensemble."""
LOOSE = 1.0
"""Relative difference of forces above which a chaotic result counts as changed.

Such a motion magnifies every difference, until it is another motion."""
ROUNDING = 10.0
"""Allowed difference, as a multiple of the one that rounding of the speed causes."""
# Share of the greatest number beside it below which a number is compared with that share.
_SMALL = 1e-3
_MULTIPLIER = "floquet_multiplier"


class ChangedError(Exception):
    """Raised for two results that differ in kind; the message says in what."""


def is_loose(result: dict[str, Any]) -> bool:
    """Return whether a result is chaotic, or a window of a motion that has not settled."""
    return result["steady_state"].get("kind") == "chaotic" or result["status"] == "not_settled"


def differences(found: dict[str, Any], kept: dict[str, Any]) -> dict[str, float]:
    """Return the greatest relative difference of each quantity that both results have.

    Raises `ChangedError` where status, kind of motion, period or the names of the numbers
    differ."""
    here, there = found["steady_state"], kept["steady_state"]
    _same("status", found["status"], kept["status"])
    for key in ("kind", "period"):
        _same(key, here.get(key), there.get(key))
    for key in ("design", "geometry", "response", "gradient"):
        _same(f"the names in {key}", list(found[key]), list(kept[key]))
    averaged = kept["status"] == "averaged"
    # The rotor's size is the scale of small lengths, the greatest force that of small forces.
    length = _SMALL * kept["geometry"]["outer_radius_mm"]
    force = _SMALL * _greatest(kept["response"])
    result = {
        "geometry": _worst(
            found["geometry"], kept["geometry"], lambda key: length * key.endswith("_mm")
        ),
        "average" if averaged else "response": _worst(
            found["response"], kept["response"], lambda _: force
        ),
    }
    if not is_loose(kept):
        slopes = {
            name: _row(found["gradient"][name], row) for name, row in kept["gradient"].items()
        }
        result["of the peak"] = slopes.pop("peak_force_N", 0.0)
        result["gradient"] = max(slopes.values(), default=0.0)
    if there.get(_MULTIPLIER) is not None:
        result["multiplier"] = abs(here[_MULTIPLIER] - there[_MULTIPLIER]) / max(
            1.0, abs(there[_MULTIPLIER])
        )
    if "attractors" in there:
        ours, theirs = ([row["share"] for row in one["attractors"]] for one in (here, there))
        _same("the number of motions", len(ours), len(theirs))
        result["share"] = float(np.max(np.abs(np.subtract(ours, theirs))))
    return result


def limits(kept: dict[str, Any]) -> dict[str, float]:
    """Return the allowed difference of each quantity of a stored result.

    The effect of rounding is included."""
    rounding = kept.get("rounding", {})
    least = LIMITS | (dict.fromkeys(("response", "average"), LOOSE) if is_loose(kept) else {})
    return {name: max(least[name], ROUNDING * rounding.get(name, 0.0)) for name in LIMITS}


def _same(what: str, found: Any, kept: Any) -> None:
    if found != kept:
        raise ChangedError(f"{what}: {found} instead of {kept}")


def _greatest(numbers: dict[str, float]) -> float:
    return max(map(abs, numbers.values()), default=0.0)


def _worst(found: dict[str, float], kept: dict[str, float], least: Callable[[str], float]) -> float:
    """Return the greatest difference relative to the number itself, or to `least` of its name."""
    scales = {key: max(abs(value), least(key), 1e-300) for key, value in kept.items()}
    return max((abs(found[key] - kept[key]) / scales[key] for key in kept), default=0.0)


def _row(found: dict[str, float], kept: dict[str, float]) -> float:
    """Return the difference of a gradient relative to its greatest entry."""
    _same("the parameters of a gradient", list(found), list(kept))
    return _worst(found, kept, lambda _: _greatest(kept))
