"""Data of the animated pair on pages: outlines, poses, contact points and forces."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from rootsopt.config import Config
from rootsopt.config.units import MM
from rootsopt.export.animation import Contacts, frames_of
from rootsopt.profiles import Profile, outline
from rootsopt.response.series import Series
from rootsopt.scene import Scene

if TYPE_CHECKING:
    from rootsopt.report.gather import Case


def animations(cases: Sequence["Case"]) -> dict[str, Any]:
    """Return the data of the animation of all `cases`.

    Cases with the same design share a rotor. A case without a motion is shown in perfect rolling.
    """
    rotors: dict[tuple, dict[str, Any]] = {}
    shown: list[dict[str, Any]] = []
    for case in cases:
        key = (case.config.profile.family, *case.design.values())
        scene = Scene.from_config(case.config)
        profile = scene.profile(jnp.asarray(np.array([*case.design.values()], dtype=float)))
        if key not in rotors:
            rotors[key] = rotor(case.config, np.asarray(outline(profile, points=240)) / MM)
        period = case.record.get("steady_state", {}).get("period")
        found = {"name": case.name, "rotor": [*rotors].index(key)}
        shown.append(found | motion(profile, case.series, period))
    return {"rotors": [*rotors.values()], "cases": shown}


def rotor(config: Config, points: ArrayLike) -> dict[str, Any]:
    """Return outline and sizes (mm) of a rotor; `points` (n, 2): its closed outline (mm)."""
    points = np.asarray(points)
    error = config.scene.center_distance_error_mm or 0.0
    return {
        "outline": np.round(points, 4).tolist(),
        "lobes": config.profile.lobes,
        "pitch": config.profile.pitch_radius_mm,
        "outer": round(float(np.max(np.hypot(*points.T))), 6),
        "center": 2 * config.profile.pitch_radius_mm + error,
        "bore": config.rotor.bore_mm,
    }


def motion(profile: Profile, series: Series | None = None, period: int | None = None):
    """Return the frames of a motion: angles (°), contacts, and forces (N) if they are known.

    `series`: the motion, None in perfect rolling; `period` (mesh periods), if it is known."""
    frames = frames_of(profile, series, period or profile.lobes)
    found: dict[str, Any] = {
        "rotation": _rounded(np.degrees(frames.rotation), 9),
        "contacts": [*map(_contacts, frames.flanks)],
        "forces": None,
    }
    if series is None or frames.forces is None:
        return found
    return found | {
        "relative": _rounded(1e3 * frames.relative, 6),
        "time": _rounded(1e3 * (frames.time - series.time[0]), 9),
        "forces": [_rounded(force, 4) for force in frames.forces],
    }


def _contacts(flank: Contacts) -> dict[str, list]:
    """Return the contact points (mm) and normals of a flank, and where it touches in rolling."""
    parts = (*flank.point.T, *flank.normal.T)
    found = {
        name: _rounded(part, 5) for name, part in zip(("x", "y", "nx", "ny"), parts, strict=True)
    }
    return found | {"present": flank.present.tolist()}


def _rounded(values: ArrayLike, places: int) -> list[float]:
    return np.round(np.asarray(values), places).tolist()


__all__ = ["animations", "motion", "rotor"]
