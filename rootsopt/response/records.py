"""Entries of the result file for one evaluation, and advice that fits its scene."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rootsopt.config import Config
from rootsopt.config.units import MM, UM
from rootsopt.dynamics.orbit import Orbit
from rootsopt.dynamics.pair import RotorPair
from rootsopt.dynamics.reserve import Apart
from rootsopt.dynamics.steady import OPEN, Solver, Steady
from rootsopt.dynamics.window import Window
from rootsopt.profiles import Geometry
from rootsopt.pump.loads import OrbitLoads
from rootsopt.response.series import Series, window_series
from rootsopt.response.terms import EQUIVALENT, GEAR, RESERVES
from rootsopt.scene import Scene
from rootsopt.status import Status

RESPONSES = ("mean_force_N", "peak_force_N", "rms_force_N")
"""Keys of the mean, peak and RMS force in a response."""
# Floquet multiplier above which a message says how slowly disturbances fade.
_SLOW = 0.999
# Fraction of itself to which a disturbance is said to fade.
_FADED = 0.01
# Kinds of motions without an orbit, by status; all others are transient.
_KINDS = {Status.CHAOTIC: "chaotic", Status.IDLE: "idle"}


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


def apart_record(held: Apart, radius: float) -> dict[str, tuple[float, NDArray[np.float64]]]:
    """Return the result file's entries for reserve and timing gear over an orbit.

    Each is (value, its derivatives (d,)); `radius`: pitch radius (m)."""
    unit = [1 / UM, 2 * radius / MM, *[1.0] * 3, *[1 / radius] * 3]
    rows = np.column_stack([held.values, held.slopes])
    rows = np.concatenate([rows, rows[2:]]) * np.array(unit)[:, None]
    return {
        name: (float(row[0]), row[1:])
        for name, row in zip((*RESERVES, *GEAR), rows, strict=True)
        if np.isfinite(row[0])
    }


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


def orbit_statistics(found: Steady, solver: Solver) -> dict[str, int | float]:
    """Return the result file's statistics of an orbit that `solver` closed: effort and accuracy."""
    orbit = found.orbit
    statistics: dict[str, int | float] = {
        "newton_steps": int(orbit.newton_steps),
        "orbit_rtol": float(solver.orbit.rtol),
        "force_rounding": float(found.verdict.rounding),
        "orbit_elements": int(found.known.elements.mesh.used),
    }
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
    if status not in (*OPEN, Status.IDLE):
        return steady, {}, None
    mean, square, peak = np.asarray(window.forces, np.float64)
    values = map(float, (mean, peak, np.sqrt(square)))
    response: dict[str, float] = dict(zip(RESPONSES, values, strict=True))
    return steady, response, window_series(pair, window) if series else None


def message_of(config: Config, status: Status) -> str:
    """Return what a `status` means, and advice that fits the scene of a `config`.

    The advice names only what the scene has or lacks: no timing gear where there is one, and no
    value to lower that is 0."""
    if status not in _WAYS:
        return status.value
    first, *others = _WAYS[status](config)
    return f"{status.meaning} {', or '.join([first[0].upper() + first[1:], *others])}."


def fading_note(multiplier: float, period: int) -> str:
    """Return a note on an orbit whose disturbances fade slowly, else "".

    `multiplier`: greatest modulus of its Floquet multipliers; `period`: mesh periods."""
    if not _SLOW < abs(multiplier) < 1:
        return ""
    count = period * np.log(_FADED) / np.log(abs(multiplier))
    return (
        f" But a disturbance fades to {100 * _FADED:g} % only within {count:.3g} mesh periods "
        f"(Floquet multiplier {multiplier:.7f}): a pump that is disturbed more often does not keep "
        "this motion."
    )


def _way(verb: str, key: str, value: float | None) -> list[str]:
    """Return the advice to change a key; empty if there is no `value`, or 0, to change."""
    return [f"{verb} {key} ({value:g})"] if value else []


def _load(config: Config, verb: str = "lower") -> list[str]:
    """Return the advice to change the load."""
    load = config.scene.load
    for key in ("torque_N_m", "pressure_difference_Pa"):
        if (value := getattr(load, key)) is not None:
            if verb == "raise" and not value:
                return [f"raise scene.load.{key} above 0"]
            return _way(verb, f"scene.load.{key}", value)
    return []


def _backlash(config: Config, verb: str = "lower") -> list[str]:
    """Return the advice to change the backlash of the timing gear, if there is one."""
    gear = config.scene.timing_gear
    if gear is not None and verb == "raise":
        return [f"raise scene.timing_gear.backlash_mm ({gear.backlash_mm:g})"]
    return [] if gear is None else _way(verb, "scene.timing_gear.backlash_mm", gear.backlash_mm)


def _damping(config: Config) -> list[str]:
    """Return the advice to add damping where the scene has it."""
    gear, most = config.scene.timing_gear, config.contact.max_damping_N_s_per_mm
    if gear is not None:
        return [f"raise scene.timing_gear.damping_ratio ({gear.damping_ratio:g})"]
    return [f"raise contact.max_damping_N_s_per_mm ({most:g})"]


def _passed_through(config: Config) -> list[str]:
    gear, phase = config.scene.timing_gear, config.scene.phase_error_mrad
    held = ["add a scene.timing_gear"]
    if gear is not None:
        stiffness = gear.stiffness_N_m_per_rad
        held = _way("raise", "scene.timing_gear.stiffness_N_m_per_rad", stiffness)
    phased = _way("bring closer to 0", "scene.phase_error_mrad", phase)
    return [*held, *_load(config), *_backlash(config), *phased]


def _too_deep(config: Config) -> list[str]:
    """Return advice: what presses the rotors into each other comes first."""
    error, wear = config.scene.center_distance_error_mm or 0.0, config.contact.wear
    close = _way("raise", "scene.center_distance_error_mm", min(error, 0.0))
    coated = _way("raise", "contact.wear.offset_mm", min(wear.offset_mm, 0.0) if wear else None)
    tight = ["raise contact.clearance_mm"] if close or coated else []
    stiffness = config.contact.stiffness_N_per_mm_e
    stiffer = _way("raise", "contact.stiffness_N_per_mm_e", stiffness)
    return [*close, *coated, *tight, *stiffer, *_load(config)]


def _stalled(config: Config) -> list[str]:
    motor = config.scene.motor
    torque = None if motor is None else motor.torque_N_m
    given = _way("raise", "scene.motor.torque_N_m", torque) or ["set scene.motor.torque_N_m"]
    return [*given, "raise scene.motor.slope_N_m_s_per_rad", *_load(config)]


def _chaotic(config: Config) -> list[str]:
    averaged = "set objective.motion to ensemble to optimise averages over an ensemble of motions"
    slower = _way("lower", "scene.speed_rpm", config.scene.speed_rpm)
    return [averaged, *slower, *_load(config), *_backlash(config), *_damping(config)]


def _not_settled(config: Config) -> list[str]:
    longer = _way("raise", "solver.max_mesh_periods", config.solver.max_mesh_periods)
    return [*longer, *_damping(config)]


def _tolerance(config: Config) -> tuple[str, float]:
    """Return the key that sets the tolerance of orbits, and its value."""
    solver = config.solver
    if solver.rtol is None:
        return "solver.accuracy", solver.accuracy
    return "solver.rtol", solver.rtol


def _unresolved(config: Config) -> list[str]:
    return _way("tighten", *_tolerance(config))


def _inaccurate(config: Config) -> list[str]:
    most = config.solver.max_steps_per_period
    steps = _way("raise", "solver.max_steps_per_period", most)
    return [*_unresolved(config), "raise contact.smoothing_mm", *steps]


def _solver_failed(config: Config) -> list[str]:
    most = f"{config.solver.max_steps_per_period:g}"
    need = "ten are needed for each of statistics.swings_per_mesh_period"
    looser = _way("loosen", *_tolerance(config))
    return [f"raise solver.max_steps_per_period ({most}; {need})", *looser]


# Statuses whose advice depends on the scene, each with a function that returns it.
_WAYS = {
    Status.PASSED_THROUGH: _passed_through,
    Status.TOO_DEEP: _too_deep,
    Status.STALLED: _stalled,
    Status.CHAOTIC: _chaotic,
    Status.NOT_SETTLED: _not_settled,
    Status.UNRESOLVED: _unresolved,
    Status.INACCURATE: _inaccurate,
    Status.SOLVER_FAILED: _solver_failed,
}


def apart_message(config: Config, depth: float, backlash: float | None = None) -> str:
    """Return what it means that no flank touches, and how far the flanks are from it.

    `depth` (m): greatest penetration, the negative of the least gap; `backlash` (mm) by which that
    of the timing gear may grow, `None` if it is not known. Without it, the clearance is named: the
    motion does not depend on it as long as nothing touches."""
    geared = config.scene.timing_gear is not None
    said = Status.IDLE.value
    if geared:
        said = "The timing gear keeps the flanks apart: the contact force is zero."
    gap, clearance = -depth / MM, config.contact.clearance_mm
    if not (np.isfinite(gap) and 0 < gap < 0.9 * config.profile.pitch_radius_mm):
        return said
    said += f" Their least gap is {gap * MM / UM:.4g} µm"
    if backlash is not None:
        assert config.scene.timing_gear is not None
        most = config.scene.timing_gear.backlash_mm + backlash
        return f"{said}; they touch with scene.timing_gear.backlash_mm above {most:.4g}."
    if gap < clearance:
        return f"{said}; they touch with contact.clearance_mm below {clearance - gap:.4g}."
    return f"{said}."
