"""Data of the animation in a report: outlines, poses, contact points and forces."""

import re
from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike, NDArray

from rootsopt.errors import InputError
from rootsopt.export.animation import Contacts, frames_of, rolling_contacts, rolling_frames
from rootsopt.export.pieces import outline_pieces, polyline
from rootsopt.export.svg import outline_path
from rootsopt.report.gather import Case
from rootsopt.scene import Scene

_NUMBER = re.compile(r"-?\d+\.\d+")


def animations(cases: Sequence[Case]) -> dict[str, Any] | None:
    """Return the data of the animation of all `cases`, or None if no rotor can be drawn.

    Cases with the same design share a rotor. A case without a motion is shown in perfect rolling.
    """
    rotors: list[dict[str, Any]] = []
    known: dict[tuple, int | None] = {}
    shown: list[dict[str, Any]] = []
    for case in cases:
        key = (case.config.profile.family, *case.design.values())
        scene = Scene.from_config(case.config)
        profile = scene.profile(jnp.asarray(np.array([*case.design.values()], dtype=float)))
        if key not in known:
            rotor = _rotor(case, profile)
            known[key] = None if rotor is None else len(rotors)
            rotors += [] if rotor is None else [rotor]
        if (number := known[key]) is None:
            continue
        shown.append({"name": case.name, "rotor": number} | _motion(case, profile))
    return {"rotors": rotors, "cases": shown} if shown else None


def _rotor(case: Case, profile) -> dict[str, Any] | None:
    """Return the drawing of a rotor: path of its outline and sizes (mm).

    The result is None if the outline cannot be drawn."""
    config = case.config
    try:
        pieces = outline_pieces(profile)
    except InputError:
        return None
    outer = np.max(np.abs(polyline(pieces, 0.02 * config.profile.pitch_radius_mm)))
    error = config.scene.center_distance_error_mm or 0.0
    return {
        "path": _NUMBER.sub(lambda found: f"{float(found[0]):.4f}", outline_path(pieces)),
        "lobes": config.profile.lobes,
        "pitch": config.profile.pitch_radius_mm,
        "outer": round(float(outer), 6),
        "center": 2 * config.profile.pitch_radius_mm + error,
        "bore": config.rotor.bore_mm,
    }


def _motion(case: Case, profile) -> dict[str, Any]:
    """Return the frames of a case: angles (°), contacts, and forces (N) if they are known."""
    series = case.series
    if series is None:
        rotation, flanks = rolling_frames(profile)
        return {
            "rotation": _rounded(np.degrees(rotation), 3),
            "contacts": [_contacts(one) for one in flanks],
            "forces": None,
        }
    lobes = case.config.profile.lobes
    period = case.record.get("steady_state", {}).get("period")
    frames = frames_of(series, lobes, int(period or lobes))
    flanks = [rolling_contacts(profile, frames.rotation, coast) for coast in (False, True)]
    return {
        "rotation": _rounded(np.degrees(frames.rotation), 3),
        "relative": _rounded(1e3 * frames.relative, 6),
        "time": _rounded(1e3 * (frames.time - series.time[0]), 6),
        "contacts": [_contacts(one) for one in flanks],
        "forces": [_rounded(force, 4) for force in frames.forces],
    }


def _contacts(flank: Contacts) -> dict[str, list]:
    """Return the contact points (mm) and normals of a flank, and where it touches in rolling."""
    return {
        "x": _rounded(flank.point[:, 0], 4),
        "y": _rounded(flank.point[:, 1], 4),
        "nx": _rounded(flank.normal[:, 0], 5),
        "ny": _rounded(flank.normal[:, 1], 5),
        "present": [bool(one) for one in flank.present],
    }


def _rounded(values: ArrayLike | NDArray, places: int) -> list[float]:
    return [round(float(x), places) + 0.0 for x in np.asarray(values)]


__all__ = ["animations"]
