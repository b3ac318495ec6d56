"""One design in one scene, from design vector to steady state, response and gradient."""

import dataclasses
import functools
import time
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike, NDArray

from rootsopt.config import Config
from rootsopt.contact.size import size_map
from rootsopt.dynamics.flow import Flow, Integrator
from rootsopt.dynamics.measures import PEAK_NORM, Measures, line_name
from rootsopt.dynamics.pair import RotorPair
from rootsopt.dynamics.steady import (
    BLOCK,
    SAMPLES,
    Orbit,
    Transient,
    close_orbit,
    lyapunov,
    reverse_sensitivity,
    settle,
    settled_within,
)
from rootsopt.dynamics.verdict import RESIDUAL, TOO_DEEP, UNRESOLVED, Verdict, verdict
from rootsopt.errors import InputError
from rootsopt.model import MM, Model, design_keys, design_vector, integrators, measures
from rootsopt.profiles import Geometry
from rootsopt.programs import Program
from rootsopt.status import Status

RESPONSES = ("mean_force_N", "peak_force_N", "rms_force_N")
_NEARLY = 0.05
_CLOSEST = 1e-12
"""Scaled difference below which states repeat exactly: a closer look would show no more."""
_TRUSTED = 1e-8
"""Tolerance down to which an orbit is integrated more finely than asked for, where it does not
close or its derivatives are not known."""
CHAOS_WINDOW = 128
_THINNING = 6


@dataclasses.dataclass(frozen=True)
class Series:
    """Motion, force and penetration (negative: gap) over the reported window, uniform in
    time (SI units, numpy)."""

    time: NDArray[np.float64]
    rotation: NDArray[np.float64]
    relative: NDArray[np.float64]
    rate: NDArray[np.float64]
    drive_force: NDArray[np.float64]
    coast_force: NDArray[np.float64]
    depth: NDArray[np.float64]

    @property
    def force(self) -> NDArray[np.float64]:
        """Contact force (N): sum of the normal forces."""
        return self.drive_force + self.coast_force


@dataclasses.dataclass(frozen=True)
class Evaluation:
    """Everything known about one design in one scene.

    `response` and `gradient` use the result file's keys (N, N per config unit);
    `gradient` is empty where there is none to trust. `steady_state` says what kind of
    motion it is. `series` covers whole orbits, at least one revolution.
    """

    design: dict[str, float]
    geometry: dict[str, float]
    response: dict[str, float]
    gradient: dict[str, dict[str, float]]
    steady_state: dict[str, Any]
    status: Status
    message: str
    statistics: dict[str, int | float]
    series: Series | None
    state: NDArray[np.float64] | None = None

    @property
    def usable(self) -> bool:
        return self.status.usable

    def record(self) -> dict[str, Any]:
        """The record of the result file."""
        return {
            "design": self.design,
            "geometry": self.geometry,
            "response": self.response,
            "gradient": self.gradient,
            "steady_state": self.steady_state,
            "status": self.status.label,
            "message": self.message,
            "statistics": self.statistics,
        }


class Evaluator:
    """Evaluates designs of one config; compiled programs are shared between designs.

    `rtol` overrides the orbit tolerance of the config. `reference`: the response that the forces
    in the objective are relative to, where evaluators compare motions. With `survey`, a design that
    does not settle within a quarter of the allowed transient is given up without asking
    what else its motion is: for a search over many designs.
    """

    reference: dict[str, float] | None = None

    def __init__(self, config: Config, rtol: float | None = None, survey: bool = False):
        self.config = config
        self.survey = survey
        self.fitted = self.sized = self.prepared = False
        self.map_error = float("nan")
        limit = config.solver.max_mesh_periods
        self.max_periods = max(limit // 4, 8 * BLOCK) if survey else limit
        self.model = Model.of(config)
        self.keys = design_keys(config)
        transient, orbit = integrators(config)
        if rtol is not None:
            orbit = dataclasses.replace(orbit, rtol=jnp.asarray(rtol))
        self.transient, self.orbit = transient, orbit
        self.measures = measures(config)

    def relate(self, baseline: Evaluation) -> None:
        """Take the forces of motions that are compared relative to those of the `baseline`."""
        self.reference = baseline.response

    def __call__(
        self,
        design: Float[Array, " d"] | None = None,
        start: NDArray[np.float64] | None = None,
        series: bool = True,
    ) -> Evaluation:
        """Evaluate `design` (config units; default: the config's own).

        `start` is the scaled state to begin from, such as the orbit of a neighbouring
        design; by default the contract's ε = 0, dε/dt = 0 at φ = 0.
        """
        design = design_vector(self.config) if design is None else jnp.asarray(design)
        began = time.perf_counter()
        if self.prepared:
            self._size(design)
        else:
            self.prepare(design, series)
        outcome = self._fitted(design, lambda: self._attempt(design, start))
        return self._report(design, outcome, began, series)

    def pair(self, design: Float[Array, " d"]) -> RotorPair:
        """The rotor pair of `design` (config units), as last evaluated."""
        return _build(self.model, design)[0]

    def prepare(self, design: Float[Array, " d"], series: bool = True) -> None:
        """Compile, in the background, what evaluating `design` (config units) takes."""
        self.prepared = True
        self._size(design)
        pair, tangents, _ = _build.outline(self.model, design)
        dtype = pair.angle_scale.dtype
        state = jax.ShapeDtypeStruct((pair.states,), dtype)
        number = jax.ShapeDtypeStruct((), dtype)
        whole = jax.ShapeDtypeStruct((), int)
        # The one that takes longest first.
        _close.prepare(pair, tangents, state, whole, self.orbit, self.measures)
        most = self.config.solver.max_orbit_periods
        sizes = pair.states, len(design), SAMPLES, self.orbit.max_steps, self.measures
        orbit = jax.eval_shape(
            lambda state: Orbit.empty(state, len(design), Flow.empty(*sizes, dtype)), state
        )
        _verdict.prepare(orbit, state, number, (number, number), number, self._scales(pair))
        _settle.prepare(pair, state, self.transient, number, whole, most)
        _build.prepare(self.model, design)
        if series:
            count = pair.lobes * SAMPLES
            times = jax.ShapeDtypeStruct((count,), float)
            _contact_series.prepare(pair, times, jax.ShapeDtypeStruct((count, pair.states), dtype))

    def _size(self, design) -> None:
        """Make the contact map large enough for `design`, where the config leaves it open.

        It only grows, so that neighbouring designs share a program. A survey keeps the size
        it was given.
        """
        solver = self.config.solver
        fixed = solver.map_rolls is not None and solver.map_relatives is not None
        if self.model.fidelity != "map" or self.survey or fixed:
            return
        depth = self.model.static_depth
        found = size_map(
            self.model.profile(design), float(self.model.deepest), solver.map_error * depth
        )
        rolls, relatives = self.model.map_size
        if not self.sized:
            rolls = relatives = 0
        self.sized = True
        self.map_error = found.error / depth
        size = (
            solver.map_rolls or max(rolls, found.rolls),
            solver.map_relatives or max(relatives, found.relatives),
        )
        self.model = dataclasses.replace(self.model, map_size=size)

    def _fitted(self, design, attempt: Callable[[], Any]) -> Any:
        """The outcome of `attempt`, again as long as it asks for another contact map.

        An outcome has the `pair`, a `status`, and the largest |ε| `reached` (rad); the map is made
        fine enough for `design`.
        """
        for _ in range(5):
            outcome = attempt()
            covered = float(self.model.deepest)
            if not self._refit(outcome):
                break
            if float(self.model.deepest) < covered:
                self._size(design)
        return outcome

    def _refit(self, outcome: Any) -> bool:
        """Fit the contact map to the motion; whether the design must be evaluated again.

        A motion that left the map is not described by it; one that uses a small part of
        it wastes its resolution (done once, so that neighbouring designs share a map).
        """
        reached, covered = outcome.reached, -float(self.model.deepest)
        if self.model.fidelity != "map" or not np.isfinite(reached):
            return False
        wasteful = outcome.status is Status.PERIODIC and not self.fitted
        if not (reached > covered or (wasteful and reached < 0.6 * covered)):
            return False
        self.fitted = True
        deepest = -min(1.3 * reached, float(outcome.pair.angle_limit))
        if deepest == -covered:
            return False
        self.model = eqx.tree_at(lambda m: m.deepest, self.model, jnp.asarray(deepest))
        return True

    def _attempt(self, design, start) -> Any:
        """What comes of `design` with the contact map as it is."""
        pair, tangents, shape = _build(self.model, design)
        dtype = pair.angle_scale.dtype
        state = np.zeros(pair.states, dtype) if start is None else np.asarray(start, dtype)
        how, closing, used, steps = self.transient, self.orbit, 0, 0
        tolerance = float(settled_within(how.rtol))
        while True:
            transient = jax.device_get(
                _settle(
                    pair,
                    state,
                    how,
                    np.asarray(tolerance, dtype),
                    np.asarray(self.max_periods - used),
                    self.config.solver.max_orbit_periods,
                )
            )
            used += int(transient.periods)
            steps += int(transient.steps)
            state = transient.state
            orbit, found, status = None, None, self._transient_status(pair, transient)
            if status is Status.NOT_SETTLED and float(transient.spread) < _NEARLY:
                # Time is out, but the motion nearly repeats: noise of the coarse transient
                # may be all that is left. Newton's method tells.
                tolerance = float(transient.spread)
                transient = transient._replace(period=transient.nearest)
            elif status is not None:
                break
            transient, orbit, found, status = self._close(
                pair, tangents, transient, closing, tolerance
            )
            steps += int(orbit.flow.steps)
            late = used >= self.max_periods or tolerance < _CLOSEST
            if status not in (Status.NOT_SETTLED, Status.INACCURATE) or late:
                break
            # Newton left the neighbourhood or found an unstable orbit, or one whose derivatives
            # are not known: it was not the steady state yet, or too coarse an image of it. Go on,
            # and look more closely.
            tolerance /= 10
            least = jnp.minimum(self.orbit.rtol, _TRUSTED)
            closing = dataclasses.replace(closing, rtol=jnp.maximum(closing.rtol / 100, least))
            how = dataclasses.replace(how, rtol=jnp.maximum(how.rtol / 10, closing.rtol))
        return _Outcome(pair, shape, transient, orbit, closing, found, status, used, steps)

    def _close(self, pair, tangents, transient: Transient, how: Integrator, tolerance: float):
        """Orbit the transient leads to, of the least period, integrated as `how` says, the verdict
        on it and its status."""
        settings = how, self.measures
        orbit = jax.device_get(_close(pair, tangents, transient.state, transient.period, *settings))
        found, status = self._judged(pair, orbit, transient, how, tolerance)
        if status is not Status.PERIODIC:
            return transient, orbit, found, status
        # Noise of the transient can hide that a motion repeats sooner.
        for shorter in _divisors(int(transient.period)):
            again = np.asarray(orbit.flow.states)[shorter * SAMPLES // int(transient.period)]
            if np.max(np.abs(again - np.asarray(orbit.state))) < _NEARLY:
                period = np.asarray(shorter)
                simpler = jax.device_get(_close(pair, tangents, orbit.state, period, *settings))
                reduced = transient._replace(period=period, state=orbit.state)
                other, its_status = self._judged(pair, simpler, reduced, how, tolerance)
                # One whose derivatives are not known is the motion all the same.
                if its_status in (Status.PERIODIC, Status.INACCURATE):
                    return reduced, simpler, other, its_status
        return transient, orbit, found, status

    @staticmethod
    def _transient_status(pair: RotorPair, transient: Transient) -> Status | None:
        if not bool(transient.solved):
            return Status.SOLVER_FAILED
        if not np.all(np.isfinite(transient.state)):
            return Status.NON_FINITE
        if bool(transient.lost):
            return lost_status(pair, transient.state)
        return None if int(transient.period) > 0 else Status.NOT_SETTLED

    def _judged(
        self,
        pair: RotorPair,
        orbit: Orbit,
        transient: Transient,
        closing: Integrator,
        tolerance: float,
    ) -> tuple[Verdict, Status]:
        """The verdict on an orbit integrated as `closing` says, and its status as a motion; whether
        its forces are known is asked in the report."""
        dtype = orbit.state.dtype
        rtols = tuple(np.asarray(how.tolerance(dtype)) for how in (self.transient, closing))
        within, limit = (np.asarray(x, dtype) for x in (tolerance, RESIDUAL[self.model.precision]))
        scales = self._scales(pair)
        found = jax.device_get(_verdict(orbit, transient.state, within, rtols, limit, scales))
        numbers = np.concatenate([orbit.response, orbit.state])
        if not orbit.flow.solved:
            status = Status.SOLVER_FAILED
        elif found.idle:
            status = Status.IDLE
        elif not np.all(np.isfinite(numbers)):
            status = Status.NON_FINITE
        elif not found.steady:  # Of what multiplies errors no derivative is known either.
            status = Status.NOT_SETTLED
        else:
            slopes = np.all(np.isfinite(orbit.sensitivity))
            status = Status.PERIODIC if slopes else Status.NON_FINITE
            if slopes and not found.certain:
                status = Status.INACCURATE
        return found, status

    def _scales(self, pair: RotorPair):
        """The `scales` of a verdict."""
        return self.model.law.exponent, self.model.pitch_radius, pair.force_scale

    def _report(self, design, outcome: Any, began: float, with_series: bool) -> Evaluation:
        """The evaluation that an attempt which `began` then has come to."""
        seconds = time.perf_counter() - began
        pair, orbit, status = outcome.pair, outcome.orbit, outcome.status
        response: dict[str, float] = {}
        gradient: dict[str, dict[str, float]] = {}
        steady: dict[str, Any] = {"kind": "transient"}
        series, state, hint = None, None, ""
        statistics: dict[str, int | float] = {
            "transient_mesh_periods": outcome.used,
            "solver_steps": outcome.steps,
        }
        if self.model.fidelity == "map":
            rolls, relatives = self.model.map_size
            statistics |= {"map_rolls": rolls, "map_relatives": relatives}
            if self.sized:
                statistics["map_error"] = self.map_error
        if status in (Status.PERIODIC, Status.INACCURATE) and orbit is not None:
            period = int(outcome.transient.period)
            response, gradient = self._response(design, orbit, period)
            steady = {"kind": "periodic"} | _closed(orbit, period)
            state = np.asarray(orbit.state, np.float64)
            statistics |= {
                "newton_steps": int(orbit.newton_steps),
                "orbit_steps": int(orbit.flow.steps),
                "orbit_rtol": float(outcome.closing.rtol),
                "orbit_defect": float(orbit.defect),
            }
            if np.isfinite(orbit.disagreement):  # else there was no room for a comparison
                statistics["gradient_disagreement"] = float(orbit.disagreement)
            series = _orbit_series(pair, orbit, period) if with_series else None
            found = outcome.found
            assert found is not None
            statistics["force_rounding"] = float(found.rounding)
            if float(orbit.flow.depth) > TOO_DEEP * float(self.model.pitch_radius):
                status = Status.TOO_DEEP
            elif found.rounding > UNRESOLVED or not found.consistent:
                status = Status.UNRESOLVED
        elif status is Status.IDLE and orbit is not None:
            steady, hint = {"kind": "idle"}, idle_hint(self.config, float(orbit.flow.depth))
            rows = np.zeros((len(orbit.response), 1))
            response = {name: 0.0 for name in self.measures.named(rows, 1)}
            if outcome.found is not None and outcome.found.steady:
                # Held by the timing gear; a pair that floats can rest anywhere.
                period = int(outcome.transient.period)
                steady |= _closed(orbit, period)
                state = np.asarray(orbit.state, np.float64)
                series = _orbit_series(pair, orbit, period) if with_series else None
        elif status is Status.NOT_SETTLED and not self.survey:
            window = lyapunov_program(pair, outcome.transient.state, CHAOS_WINDOW, self.transient)
            status, steady, response, series = unsettled(pair, window, with_series)
            if status is Status.IDLE:
                hint = idle_hint(self.config, float(np.max(window.flows.depth)))
        elif status is Status.SOLVER_FAILED and pair.pace is not None:
            swings = pair.mesh_period / (2 * np.pi * pair.pace.swing)
            statistics["swings_per_mesh_period"] = float(swings)
        if status is not Status.PERIODIC:
            gradient = {}
        statistics["seconds"] = seconds
        return Evaluation(
            design=dict(zip(self.keys, map(float, design), strict=True)),
            geometry=geometry_record(self.model, outcome.shape),
            response=response,
            gradient=gradient,
            steady_state=steady,
            status=status,
            message=status.value + hint,
            statistics=statistics,
            series=series,
            state=state,
        )

    def _response(self, design, orbit: Orbit, period: int):
        """Response and gradient of a closed orbit in the result file's keys."""
        sensitivity = orbit.sensitivity
        if self.config.solver.gradient == "reverse" and self.keys:
            settings = self.orbit, self.measures
            sensitivity = _reverse(self.model, design, orbit, np.asarray(period), *settings)
        rows = np.column_stack([orbit.response, sensitivity])
        found = self.measures.named(rows, period)
        response = {name: value for name, (value, _) in found.items()}
        if not self.keys:
            return response, {}
        slopes = {name: map(float, slope) for name, (_, slope) in found.items()}
        return response, {k: dict(zip(self.keys, v, strict=True)) for k, v in slopes.items()}


def _closed(orbit: Orbit, period: int) -> dict[str, Any]:
    """What the result file says of a closed orbit."""
    return {
        "period": period,
        "floquet_multiplier": float(orbit.multiplier),
        "floquet_multipliers": floquet(orbit.monodromy),
        "residual": float(orbit.residual),
    }


def idle_hint(config: Config, depth: float) -> str:
    """Advice for flanks that never touch: which clearance brings them together.

    `depth` (m): greatest penetration, less than 0 by the least gap. The motion does not depend on
    the clearance as long as nothing touches, so that the flanks touch where the clearance falls by
    more than the least gap."""
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


@dataclasses.dataclass(frozen=True)
class _Outcome:
    pair: RotorPair
    shape: Geometry
    transient: Transient
    orbit: Orbit | None
    closing: Integrator
    found: Verdict | None
    status: Status
    used: int
    steps: int

    @property
    def reached(self) -> float:
        """Largest |ε| (rad) of the steady motion, as far as known."""
        scale = float(self.pair.angle_scale)
        if self.orbit is not None:
            return scale * float(np.max(np.abs(self.orbit.flow.states[:, 0])))
        return scale * abs(float(self.transient.state[0]))


def lost_status(pair: RotorPair, state: ArrayLike) -> Status:
    """What has become of a pair that is lost in the scaled `state`."""
    stalled = bool(pair.stalled(jnp.asarray(state)))
    return Status.STALLED if stalled else Status.PASSED_THROUGH


def geometry_record(model: Model, shape: Geometry) -> dict[str, float]:
    """Geometry in the result file's keys and units."""
    return {
        "outer_radius_mm": float(shape.outer_radius) / MM,
        "root_radius_mm": float(shape.root_radius) / MM,
        "area_mm2": float(shape.area) / MM**2,
        "area_efficiency": float(shape.area_efficiency),
        "polar_inertia_kg_m2": float(model.inertia(shape)),
        "undercut_margin_mm": float(shape.undercut_margin) / MM,
        "seal_width_mm": float(shape.seal_width) / MM,
    }


def _response(mean, square, peak) -> dict[str, float]:
    return {
        "mean_force_N": float(mean),
        "peak_force_N": float(peak),
        "rms_force_N": float(np.sqrt(square)),
    }


_build = Program(Model.pair_and_tangents)
_settle = Program(settle)
_close = Program(close_orbit)
_verdict = Program(verdict)
lyapunov_program = Program(lyapunov)


def _divisors(period: int) -> list[int]:
    """Proper divisors, ascending."""
    return [k for k in range(1, period) if period % k == 0]


def objective_weights(config: Config) -> dict[str, float]:
    """Weights of the responses in the objective, by name; they add up to 1."""
    wanted = config.objective
    peak = PEAK_NORM if wanted.peak_norm is not None else "peak_force_N"
    shares = {
        "mean_force_N": wanted.mean_weight,
        peak: wanted.peak_weight,
        "rms_force_N": wanted.rms_weight,
        **{line_name(order): weight for order, weight in wanted.line_weights.items()},
    }
    total = sum(shares.values())
    return {name: share / total for name, share in shares.items() if share}


def floquet(monodromy) -> list[list[float]]:
    """Floquet multipliers, the eigenvalues of a monodromy matrix (n, n), as [real, imaginary] and
    greatest first."""
    values = np.linalg.eigvals(np.asarray(monodromy, np.float64))
    ordered = sorted(values, key=lambda z: (-abs(z), -z.imag))
    return [[float(z.real), float(z.imag)] for z in ordered]


@Program
def _reverse(model: Model, design, orbit: Orbit, period, how: Integrator, measures: Measures):
    grid, peak = orbit.flow.grid, orbit.flow.peak
    return reverse_sensitivity(
        model.pair, design, orbit.state, period, how, grid, measures, jnp.maximum(peak, 1e-30)
    )


@Program
def _contact_series(pair: RotorPair, tau, states):
    lapse = pair.lapse(states) if pair.drive.free else jnp.ones_like(tau)
    contact = jax.vmap(pair.contact_at)(tau, states)
    return pair.mesh_period, lapse, pair.physical(tau, states)[1:], contact


def _series(pair: RotorPair, tau, states) -> Series:
    # Within a turn of the rotor: single precision resolves late times as well as early ones.
    turn = np.mod(tau, pair.lobes)
    period, lapse, (relative, rate), contact = _contact_series(pair, turn, states)
    time = period * tau
    if pair.drive.free:
        from scipy.integrate import cumulative_simpson  # Half a second, for motors alone.

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


def _orbit_series(pair: RotorPair, orbit: Orbit, period: int) -> Series:
    """The orbit repeated over at least one revolution, in whole cycles."""
    samples = orbit.flow.states.shape[0]
    cycles = -(-pair.lobes // period)
    tau = period * np.arange(cycles * samples) / samples
    return _series(pair, tau, np.tile(np.asarray(orbit.flow.states), (cycles, 1)))


def unsettled(pair, window, with_series):
    """Status, steady state, response and series of a motion that has not settled."""
    exponent, error = float(window.exponent), float(window.error)
    flows = window.flows
    finite = np.isfinite(np.asarray(flows.peak)).all() and np.isfinite(exponent)
    lost = bool(pair.lost(jnp.asarray(window.state)))
    kind = "transient"
    if lost:
        status = lost_status(pair, window.state)
    elif not finite:
        status = Status.NON_FINITE
    elif not np.all(flows.solved):
        status = Status.SOLVER_FAILED
    elif np.max(flows.peak) <= np.finfo(window.state.dtype).eps * float(pair.force_scale):
        status, kind = Status.IDLE, "idle"
    elif exponent > 3 * error:
        status, kind = Status.CHAOTIC, "chaotic"
    else:
        status = Status.NOT_SETTLED
    steady = {
        "kind": kind,
        "lyapunov_exponent_per_mesh_period": exponent if finite else None,
        "lyapunov_standard_error": error if finite else None,
        "window_mesh_periods": CHAOS_WINDOW,
    }
    if status not in (Status.CHAOTIC, Status.NOT_SETTLED, Status.IDLE):
        return status, steady, {}, None
    response = _response(
        np.mean(np.asarray(flows.mean)),
        np.mean(np.asarray(flows.mean_square)),
        np.max(np.asarray(flows.peak)),
    )
    series = None
    if with_series:
        states = np.asarray(flows.states)[:, ::_THINNING]
        periods, samples, _ = states.shape
        tau = np.arange(periods * samples) / samples
        series = _series(pair, tau, states.reshape(-1, states.shape[-1]))
    return status, steady, response, series


def evaluate(config: Config, **options) -> Evaluation:
    """Evaluate the config's own design; see `Evaluator`."""
    return Evaluator(config)(**options)


__all__ = ["BLOCK", "RESPONSES", "Evaluation", "Evaluator", "InputError", "Series", "evaluate"]
