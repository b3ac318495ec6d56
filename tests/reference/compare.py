"""How far two results of one config are apart, quantity by quantity."""

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
"""Greatest relative difference allowed, by quantity. `of the peak`: its gradient, which rounding of
the forces beside it changes by some 1e-7. `average`: means over an ensemble."""
LOOSE = 1.0
"""The same for forces of a motion that magnifies every difference, until it is another motion."""
ROUNDING = 10.0
"""Differences allowed in units of those that a change of the speed by rounding makes."""
_SMALL = 1e-3
"""Share of the greatest number beside it below which a number is compared with that share."""
_MULTIPLIER = "floquet_multiplier"


class ChangedError(Exception):
    """Two results that differ in kind; the message says in what."""


def is_loose(result: dict[str, Any]) -> bool:
    """Whether a result is that of a chaotic motion, or of a window of one that has not settled."""
    return result["steady_state"].get("kind") == "chaotic" or result["status"] == "not_settled"


def differences(found: dict[str, Any], kept: dict[str, Any]) -> dict[str, float]:
    """Greatest relative difference of each quantity that both results have.

    Raises `ChangedError` where status, kind of motion, period or the names of the numbers differ.
    """
    _same("status", found["status"], kept["status"])
    here, there = found["steady_state"], kept["steady_state"]
    for key in ("kind", "period"):
        _same(key, here.get(key), there.get(key))
    for key in ("design", "geometry", "response", "gradient"):
        _same(f"the names in {key}", list(found[key]), list(kept[key]))
    averaged = kept["status"] == "averaged"
    result = {
        "geometry": _worst(found["geometry"], kept["geometry"], _lengths(kept["geometry"])),
        "average" if averaged else "response": _worst(
            found["response"], kept["response"], _forces(kept["response"])
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
    """Difference allowed for each quantity of a kept result, with what rounding does to it."""
    rounding = kept.get("rounding", {})
    found = {name: max(LIMITS[name], ROUNDING * rounding.get(name, 0.0)) for name in LIMITS}
    if is_loose(kept):
        for name in ("response", "average"):
            found[name] = max(LOOSE, found[name])
    return found


def _same(what: str, found: Any, kept: Any) -> None:
    if found != kept:
        raise ChangedError(f"{what}: {found} instead of {kept}")


def _worst(found: dict[str, float], kept: dict[str, float], scales: dict[str, float]) -> float:
    return max((abs(found[key] - kept[key]) / scales[key] for key in kept), default=0.0)


def _lengths(kept: dict[str, float]) -> dict[str, float]:
    """Scales of a geometry: each number itself, but small lengths by the rotor's size."""
    least = _SMALL * kept["outer_radius_mm"]
    return {k: max(abs(v), least if k.endswith("_mm") else 1e-300) for k, v in kept.items()}


def _forces(kept: dict[str, float]) -> dict[str, float]:
    """Scales of a response: each force itself, but small ones by the greatest."""
    least = max(_SMALL * max(map(abs, kept.values()), default=0.0), 1e-300)
    return {key: max(abs(value), least) for key, value in kept.items()}


def _row(found: dict[str, float], kept: dict[str, float]) -> float:
    """Difference of a gradient relative to its greatest entry."""
    _same("the parameters of a gradient", list(found), list(kept))
    size = max(map(abs, kept.values()), default=0.0)
    return max((abs(found[k] - kept[k]) / max(size, 1e-300) for k in kept), default=0.0)
