"""Entries of the result file for one evaluation, and advice on flanks that never touch."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rootsopt.config import Config
from rootsopt.config.units import MM
from rootsopt.dynamics.orbit import Orbit
from rootsopt.dynamics.pair import RotorPair
from rootsopt.dynamics.steady import Steady
from rootsopt.dynamics.window import Window
from rootsopt.profiles import Geometry
from rootsopt.pump.loads import OrbitLoads
from rootsopt.response.series import Series, window_series
from rootsopt.response.terms import EQUIVALENT
from rootsopt.scene import Scene
from rootsopt.status import Status

RESPONSES = ("mean_force_N", "peak_force_N", "rms_force_N")
"""Keys of the mean, peak and RMS force in a response."""
_KINDS = {Status.CHAOTIC: "chaotic", Status.IDLE: "idle"}
"""Kinds of motions without an orbit, by status; all others are transient."""


def bearing_record(loads: OrbitLoads) -> dict[str, tuple[float, NDArray[np.float64]]]:
    """Return the result file's entries for the loads on the bearings over an orbit.

    Each is (value, its derivatives (d,)): those of the most loaded bearing or rotor."""
    greatest, slopes = loads.greatest, loads.greatest_slopes
    groups = {
        EQUIVALENT: (loads.equivalent, loads.slopes),
        "bearing_load_max_N": (greatest[:4], slopes[:4]),
        "axial_force_max_N": (greatest[4:6], slopes[4:6]),
        "tilting_moment_max_N_m": (greatest[6:], slopes[6:]),
    }
    record = {}
    for name, (values, rows) in groups.items():
        if len(values):
            worst = int(np.argmax(values))
            record[name] = float(values[worst]), np.asarray(rows[worst], np.float64)
    return record


def geometry_record(scene: Scene, shape: Geometry) -> dict[str, float]:
    """Return the geometry as a dict with the keys and units of the result file."""
    return {
        "outer_radius_mm": float(shape.outer_radius) / MM,
        "root_radius_mm": float(shape.root_radius) / MM,
        "area_mm2": float(shape.area) / MM**2,
        "area_efficiency": float(shape.area_efficiency),
        "polar_inertia_kg_m2": float(scene.inertia(shape)),
        "undercut_margin_mm": float(shape.undercut_margin) / MM,
        "seal_width_mm": float(shape.seal_width) / MM,
    }


def orbit_record(orbit: Orbit, period: int) -> dict[str, Any]:
    """Return the result file's entries for a closed orbit."""
    return {
        "period": period,
        "floquet_multiplier": float(orbit.multiplier),
        "floquet_multipliers": floquet(orbit.monodromy),
        "residual": float(orbit.residual),
    }


def floquet(monodromy) -> list[list[float]]:
    """Return the Floquet multipliers as a list of [real, imaginary], greatest modulus first.

    `monodromy` (n, n): its eigenvalues are the Floquet multipliers."""
    values = np.linalg.eigvals(np.asarray(monodromy, np.float64))
    ordered = sorted(values, key=lambda z: (-abs(z), -z.imag))
    return [[float(z.real), float(z.imag)] for z in ordered]


def orbit_statistics(found: Steady) -> dict[str, int | float]:
    """Return the result file's statistics of a closed orbit: effort and accuracy."""
    orbit = found.orbit
    statistics: dict[str, int | float] = {
        "newton_steps": int(orbit.newton_steps),
        "orbit_steps": int(orbit.flow.steps),
        "orbit_rtol": float(found.rtol),
        "orbit_defect": float(orbit.defect),
        "force_rounding": float(found.verdict.rounding),
    }
    if bool(found.collocated):
        statistics["collocated"] = 1
        if not int(found.used):
            statistics["from_neighbour"] = 1
    if np.isfinite(orbit.disagreement):  # Infinite: there was no room for a comparison.
        statistics["gradient_disagreement"] = float(orbit.disagreement)
    return statistics


def window_record(window: Window) -> dict[str, Any]:
    """Return the result file's entries for a window."""
    known = bool(np.all(np.isfinite(window.response)) and np.isfinite(window.exponent))
    return {
        "lyapunov_exponent_per_mesh_period": float(window.exponent) if known else None,
        "lyapunov_standard_error": float(window.error) if known else None,
        "window_mesh_periods": int(window.done),
    }


def unsettled(
    pair: RotorPair, status: Status, window: Window, series: bool
) -> tuple[dict[str, Any], dict[str, float], Series | None]:
    """Return `steady_state`, `response` and `series` for the `Evaluation` of a motion without an
    orbit.

    `status` of the motion; `window`: a window of the motion; `series`: whether to compute the
    series. Otherwise, the series is None."""
    steady = {"kind": _KINDS.get(status, "transient")} | window_record(window)
    if status not in (Status.CHAOTIC, Status.NOT_SETTLED, Status.IDLE):
        return steady, {}, None
    mean, square, peak = np.asarray(window.forces, np.float64)
    values = map(float, (mean, peak, np.sqrt(square)))
    response: dict[str, float] = dict(zip(RESPONSES, values, strict=True))
    return steady, response, window_series(pair, window) if series else None


def idle_hint(config: Config, depth: float) -> str:
    """Return advice for flanks that never touch: which clearance or backlash would let them touch.

    `depth` (m): greatest penetration, the negative of the least gap. The motion does not depend on
    the clearance as long as nothing touches. Therefore, the flanks touch if the clearance is
    reduced by more than the least gap. The advice is empty if the gap is not known or too large."""
    gap, clearance = -depth / MM, config.contact.clearance_mm
    if not (np.isfinite(gap) and 0 < gap < 0.9 * config.profile.pitch_radius_mm):
        return ""
    found = f" The least gap of the flanks is {gap:.4g} mm"
    if gap < clearance:
        return f"{found}: they touch with contact.clearance_mm below {clearance - gap:.4g}."
    if config.scene.timing_gear is not None:
        backlash = config.scene.timing_gear.backlash_mm
        return (
            f"{found}, and the timing gear holds them apart: they touch only with "
            f"scene.timing_gear.backlash_mm above {backlash + 2 * gap:.4g}."
        )
    return f"{found}."
