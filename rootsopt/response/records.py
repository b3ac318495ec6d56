"""The report on one evaluation: series, entries of the result file, and advice.

`reported` combines them to the evaluation of a known motion."""

import dataclasses
import functools
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import NDArray

from rootsopt.config.reading import Config
from rootsopt.config.units import MM, UM
from rootsopt.dynamics.collocation.elements import Elements
from rootsopt.dynamics.integrator import Solver
from rootsopt.dynamics.orbit import Orbit
from rootsopt.dynamics.pair import RotorPair
from rootsopt.dynamics.reserve import GEAR, RESERVES, Apart, apart
from rootsopt.dynamics.steady import CLOSED, OPEN, SAMPLES, Steady, varied
from rootsopt.dynamics.window import Window
from rootsopt.profiles import Geometry
from rootsopt.pump.loads import BEARING, EQUIVALENT, OrbitLoads, orbit_loads
from rootsopt.pump.rattle import rattle_record, silent_limit, silent_record
from rootsopt.response.result import RESPONSES, Evaluation, Seed, Series
from rootsopt.runtime.programs import CachedFunction
from rootsopt.scene.build import Scene
from rootsopt.scene.families import fault_of
from rootsopt.status import Status

if TYPE_CHECKING:
    from rootsopt.response.evaluation import Evaluator

_NO_GRADIENT = " The contact force jumps at many places, so that it has no gradient."


@CachedFunction
def contact_series(pair: RotorPair, tau, states):
    """Return (mesh period (s), relative durations (t,), (ε (rad), dε/dt (rad/s)), flank contact).

    `tau` (t,): times (mesh periods); `states` (t, n): scaled states; all results but the first have
    an axis (t,). A relative duration is that of a mesh period, divided by the mesh period."""
    lapse = pair.lapse(states) if pair.free else jnp.ones_like(tau)
    contact = jax.vmap(pair.contact_at)(tau, states)
    return pair.mesh_period, lapse, pair.motion(tau, states)[1:3], contact


def series_of(pair: RotorPair, tau, states) -> Series:
    """Return the series of a motion with scaled `states` (t, n) at `tau` (t,) in mesh periods."""
    # Reduce to one turn of the rotor: the rounding error of a late time is greater.
    turn = np.mod(tau, pair.lobes)
    period, lapse, (relative, rate), contact = contact_series(pair, turn, states)
    period = np.asarray(period)
    time = period * tau
    if pair.free:
        from scipy.integrate import cumulative_simpson  # Slow import (0.5 s), only for motors.

        time = period * cumulative_simpson(lapse, x=tau, initial=0.0)
    double = functools.partial(np.asarray, dtype=np.float64)
    return Series(
        time=double(time),
        rotation=2 * np.pi / pair.lobes * np.asarray(tau, np.float64),
        relative=double(relative),
        rate=double(rate),
        drive_force=double(contact.drive),
        coast_force=double(contact.coast),
        depth=double(contact.depth),
    )


def orbit_series(pair: RotorPair, motion: Steady) -> Series:
    """Return the series of a closed orbit, repeated to cover at least one revolution of rotor 1."""
    period = int(motion.period)
    cycles = -(-pair.lobes // period)
    tau = period * np.arange(cycles * SAMPLES) / SAMPLES
    return series_of(pair, tau, np.tile(np.asarray(sampled(motion.known.elements)), (cycles, 1)))


def window_series(pair: RotorPair, window: Window) -> Series:
    """Return the series of a window of a motion that does not settle."""
    states = np.asarray(window.states)
    periods, samples, count = states.shape
    return series_of(pair, np.arange(periods * samples) / samples, states.reshape(-1, count))


@CachedFunction
def sampled(elements: Elements) -> Float[Array, "samples n"]:
    """Return `SAMPLES` uniform samples of the scaled states of an orbit, from φ1 = 0 on."""
    return elements.motion(elements.mesh.period * jnp.arange(SAMPLES) / SAMPLES)


# Floquet multiplier above which a message says how slowly disturbances fade.
_SLOW = 0.999
# Fraction to which a disturbance fades in the time that the message states.
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


def orbit_statistics(motion: Steady, solver: Solver) -> dict[str, int | float]:
    """Return the result file's statistics of an orbit that `solver` closed: effort and accuracy."""
    orbit = motion.orbit
    statistics: dict[str, int | float] = {
        "newton_steps": int(orbit.newton_steps),
        "orbit_rtol": float(solver.orbit.rtol),
        "force_rounding": float(motion.verdict.rounding),
        "orbit_elements": int(motion.known.elements.mesh.used),
    }
    if not int(motion.used):
        statistics["from_neighbour"] = 1
    errors = {"force_error": motion.known.error, "gradient_disagreement": orbit.disagreement}
    # Infinite: there was no room for a comparison.
    return statistics | {name: float(x) for name, x in errors.items() if np.isfinite(x)}


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
    """Return the meaning of a `status`, with advice that fits the scene of a `config`.

    The advice never recommends a timing gear that the scene already has, or lowering a value that
    is 0."""
    ways = _ways(config).get(status)
    if ways is None:
        return status.value
    first, *others = ways
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


def _ways(config: Config) -> dict[Status, list[str]]:
    """Return the advice for statuses whose advice depends on the scene of a `config`."""

    def change(verb: str, key: str, when: Callable[[float], bool] = bool) -> list[str]:
        value = config.value(key)
        return [f"{verb} {key} ({value:g})"] if value is not None and when(value) else []

    load = change("lower", "scene.load.torque_N_m")
    load += change("lower", "scene.load.pressure_difference_Pa")
    backlash = change("lower", "scene.timing_gear.backlash_mm")
    damping = change("raise", "scene.timing_gear.damping_ratio", lambda _: True)
    damping = damping or change("raise", "contact.max_damping_N_s_per_mm", lambda _: True)
    held = change("raise", "scene.timing_gear.stiffness_N_m_per_rad")
    phased = change("bring closer to 0", "scene.phase_error_mrad")
    # Causes that press the rotors into each other come first.
    near = change("raise", "scene.center_distance_error_mm", lambda error: error < 0)
    near += change("raise", "contact.wear.offset_mm", lambda offset: offset < 0)
    near += ["raise contact.clearance_mm"] if near else []
    near += change("raise", "contact.stiffness_N_per_mm_e")
    torque = change("raise", "scene.motor.torque_N_m") or ["set scene.motor.torque_N_m"]
    averaged = "set objective.motion to ensemble to optimise averages over an ensemble of motions"
    tolerance = "solver.accuracy" if config.solver.rtol is None else "solver.rtol"
    finer = change("tighten", tolerance)
    steps = change("raise", "solver.max_steps_per_period")
    need = "ten are needed for each of statistics.swings_per_mesh_period"
    more = [f"{steps[0][:-1]}; {need})"]
    return {
        Status.PASSED_THROUGH: [*(held or ["add a scene.timing_gear"]), *load, *backlash, *phased],
        Status.TOO_DEEP: [*near, *load],
        Status.STALLED: [*torque, "raise scene.motor.slope_N_m_s_per_rad", *load],
        Status.CHAOTIC: [averaged, *change("lower", "scene.speed_rpm"), *load, *backlash, *damping],
        Status.NOT_SETTLED: [*change("raise", "solver.max_mesh_periods"), *damping],
        Status.UNRESOLVED: finer,
        Status.INACCURATE: [*finer, "raise contact.smoothing_mm", *steps],
        Status.SOLVER_FAILED: [*more, *change("loosen", tolerance)],
    }


def apart_message(config: Config, depth: float, backlash: float | None = None) -> str:
    """Return the message for flanks that never touch, with their distance from touching.

    `depth` (m): greatest penetration, the negative of the least gap; `backlash` (mm) by which that
    of the timing gear may grow, `None` if it is not known. Without it, the message names the
    clearance, because the motion does not depend on the clearance as long as nothing touches."""
    geared = config.scene.timing_gear is not None
    kept = "The timing gear keeps the flanks apart: the contact force is zero."
    said = kept if geared else Status.IDLE.value
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


apart_program = CachedFunction(apart)


def reported(
    evaluator: "Evaluator", design, built, steady_motion: Steady, began: float, series: bool
) -> Evaluation:
    """Return the evaluation of a `steady_motion`.

    `built`: rotor pair, its derivatives along the design, and geometry; `began`: time at the
    start of the evaluation (s, `perf_counter`); `series`: whether to compute the series."""
    seconds, design = time.perf_counter() - began, np.asarray(design, np.float64)
    (pair, tangents, shape), status = built, Status.of(steady_motion.status)
    statistics: dict[str, int | float] = {
        "transient_mesh_periods": int(steady_motion.used),
        "solver_steps": int(steady_motion.steps),
    }
    idle, held = status is Status.IDLE, bool(steady_motion.held)
    known = (status is Status.PERIODIC and pair.contact.smooth) or idle
    named = _forces(evaluator, steady_motion) if status in CLOSED or idle else {}
    steady: dict[str, Any] = {"kind": "idle" if idle else "transient"}
    said, hint, motion, start = message_of(evaluator.config, status), "", None, None
    if status in CLOSED or held:
        steady = {"kind": "idle" if idle else "periodic"} | orbit_record(
            steady_motion.orbit, int(steady_motion.period)
        )
        statistics |= orbit_statistics(steady_motion, evaluator.solver)
        motion, further = _along(evaluator, design, (pair, tangents), steady_motion, series)
        named, start = named | further, Seed.of(steady_motion, pair)
        hint = "" if pair.contact.smooth else _NO_GRADIENT
        if status is Status.PERIODIC:
            hint += fading_note(float(steady_motion.orbit.multiplier), int(steady_motion.period))
    elif idle and steady_motion.window is not None:
        steady |= window_record(steady_motion.window)
        motion = window_series(pair, steady_motion.window) if series else None
    response = {name: value for name, (value, _) in named.items()}
    gradient = _named(evaluator, {name: row for name, (_, row) in named.items()}) if known else {}
    if status is Status.UNSOUND and pair.soundness is not None:
        hint = f" Here, {fault_of(pair.soundness)}."
    elif steady_motion.window is not None and not idle and status not in CLOSED:
        steady, response, motion = unsettled(pair, status, steady_motion.window, series)
    elif status is Status.SOLVER_FAILED and pair.timescales is not None:
        swings = pair.mesh_period / (2 * np.pi * pair.timescales.swing)
        statistics["swings_per_mesh_period"] = float(swings)
    if idle:
        depth = (
            steady_motion.orbit.depth
            if steady_motion.window is None
            else steady_motion.window.depth
        )
        said = apart_message(evaluator.config, float(depth), response.get(RESERVES[1]))
    if pair.gear is not None and pair.gear.errors is not None:
        steady |= rattle_record(pair, steady_motion)
        if series:
            limit = jax.device_get(silent_limit(evaluator.scene, jnp.asarray(design)))
            silent = silent_record(limit)
            response |= {name: value for name, (value, _) in silent.items()}
            gradient |= _named(evaluator, {name: row for name, (_, row) in silent.items()})
    return Evaluation(
        design=dict(zip(evaluator.keys, map(float, design), strict=True)),
        geometry=geometry_record(evaluator.scene, shape),
        response=response,
        gradient=gradient,
        steady_state=steady,
        status=status,
        message=said + hint,
        statistics=statistics | {"seconds": seconds},
        series=motion,
        start=start,
    )


def _forces(evaluator: "Evaluator", motion: Steady) -> dict[str, tuple[float, Any]]:
    """Return the forces of an orbit and their derivatives (d,), by name; 0 without contact."""
    rows = np.column_stack([motion.orbit.response, motion.orbit.sensitivity])
    if Status.of(motion.status) is Status.IDLE:
        rows = np.zeros_like(rows)
    return evaluator.scene.solver.measures.named(rows, int(motion.period))


def _along(
    evaluator: "Evaluator", design, built, steady_motion: Steady, series: bool
) -> tuple[Series | None, dict[str, tuple[float, Any]]]:
    """Return the series of an orbit, and what else is computed along it: values and derivatives
    (d,) by name.

    `built`: rotor pair, and its derivatives along the `design`."""
    pair, further = built[0], {}
    motion = orbit_series(pair, steady_motion) if series else None
    if loaded(evaluator, series):
        whole = varied(steady_motion)
        loads = jax.device_get(orbit_loads(evaluator.scene, jnp.asarray(design), whole))
        further |= bearing_record(loads)
        if motion is not None:
            turns = len(motion.time) // len(loads.series.sizes), 1
            each = np.tile(np.asarray(loads.series.sizes, np.float64), turns)
            motion = dataclasses.replace(motion, bearing_loads=each)
    # Without contact, the reserve is the result.
    if geared(evaluator, series or Status.of(steady_motion.status) is Status.IDLE):
        reserve = jax.device_get(apart_program(*built, varied(steady_motion)))
        further |= apart_record(reserve, float(evaluator.scene.pitch_radius))
    return motion, further


def loaded(evaluator: "Evaluator", series: bool) -> bool:
    """Return whether an evaluation computes loads on bearings; `series`: with a series."""
    return evaluator.scene.bearings is not None and (
        series or bool({*BEARING} & {*evaluator.config.objective.terms})
    )


def geared(evaluator: "Evaluator", series: bool) -> bool:
    """Return whether an evaluation computes the reserve.

    `series`: whether it has a series, or no contact."""
    wanted = bool({*RESERVES, *GEAR} & {*evaluator.config.objective.terms})
    return evaluator.scene.gear is not None and (series or wanted)


def _named(evaluator: "Evaluator", rows: dict[str, Any]) -> dict[str, dict[str, float]]:
    """Return derivatives (d,) by name with the keys of the result file; {} without keys."""
    keys = evaluator.keys
    named = {name: dict(zip(keys, map(float, row), strict=True)) for name, row in rows.items()}
    return named if keys else {}
