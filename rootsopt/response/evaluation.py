"""One design in one scene, from design vector to steady state, response and gradient."""

import dataclasses
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from rootsopt.config import Config
from rootsopt.config.units import RPM
from rootsopt.dynamics.closed import Start, seen, steady_motion
from rootsopt.dynamics.integrator import Solver
from rootsopt.dynamics.maxima import local_maxima, prepare_maxima
from rootsopt.dynamics.pair import RotorPair
from rootsopt.dynamics.reserve import GEAR, RESERVES, apart
from rootsopt.dynamics.steady import CLOSED, OPEN, SAMPLES, Steady, varied, window_status
from rootsopt.dynamics.window import BLOCK, PERIODS, integrated_difference, lyapunov
from rootsopt.errors import InputError
from rootsopt.profiles import Geometry
from rootsopt.pump.loads import BEARING, orbit_loads
from rootsopt.pump.rattle import rattle_record, silent_limit, silent_record
from rootsopt.response.records import (
    RESPONSES,
    Series,
    apart_message,
    apart_record,
    bearing_record,
    contact_series,
    fading_note,
    geometry_record,
    message_of,
    orbit_record,
    orbit_series,
    orbit_statistics,
    sampled,
    unsettled,
    window_record,
    window_series,
)
from rootsopt.response.reducers import (
    HERE,
    IN_TURN,
    Point,
    Runs,
    evaluate_many,
    over_scenes,
    over_speeds,
    parts_at,
    shares,
)
from rootsopt.response.result import Evaluation, Part, Seed, Seeds, begun
from rootsopt.response.scatter import Shift, draw, shifts
from rootsopt.response.terms import OF_MOTION, terms_of, values_of
from rootsopt.runtime.environment import check_precision
from rootsopt.runtime.programs import CachedFunction
from rootsopt.scene import Scene, check_geometry, design_keys, design_vector, fault_of
from rootsopt.status import Status

# Difference between an orbit closed by collocation and an integration over its period (see
# `integrated_difference`) above which the orbit is rejected: the first number, at least the second
# times the tolerance of orbits.
_APART = 1e-4, 1e3
# Greatest tolerance of this integration.
_FINE = 1e-8


@dataclasses.dataclass(frozen=True)
class Motions:
    """Which steady motions of a design count: base class, for the motion that a start leads to."""

    def evaluated(
        self, evaluator: "Evaluator", design: Any, start: Any, series: bool
    ) -> Evaluation:
        """Evaluate a design at one speed in one scene. Arguments: see `Evaluator.__call__`."""
        return evaluator.reached(design, start, series)

    def prepare(self, evaluator: "Evaluator", design: Any, series: bool, maxima: bool) -> None:
        """Compile the programs in the background. Arguments: see `Evaluator.prepare`."""
        evaluator.prepare_reached(design, series, maxima)


@dataclasses.dataclass(frozen=True)
class Evaluator:
    """Evaluates designs of one config in its `scene`. All designs share compiled programs.

    An evaluator is immutable. Methods that return "another evaluator" do not change the evaluator
    on which they are called.

    `motions`: which motions of a design count; `speeds`: pairs (speed in rpm, its share in the
    objective), including the scene's own speed; empty: only the latter; `shifts`: scenes of a
    sample, in addition to the nominal one; `runs`: where the sample is evaluated.

    `survey`: whether the evaluator is for a search over many designs (see `surveying`);
    `references`: for each speed, the response by which forces are divided when coexisting motions
    are compared; `maxima`: whether to compute all local maxima of the force, with their gradients;
    `confirm`: whether an orbit that is reported with its series is confirmed by an integration over
    its period; `differentiate`: whether to compute a gradient that takes most of the time.

    """

    config: Config
    scene: Scene
    motions: Motions = Motions()
    speeds: tuple[tuple[float, float], ...] = ()
    shifts: tuple[Shift, ...] = ()
    runs: Runs = dataclasses.field(default=HERE, compare=False, repr=False)
    survey: bool = False
    references: tuple[dict[str, float], ...] = ()
    maxima: bool = False
    confirm: bool = True
    differentiate: bool = True

    @classmethod
    def of(cls, config: Config) -> "Evaluator":
        """Return the evaluator of a `config`, for the motion from rest at the scene's own speed.

        Raises InputError for an unknown objective term or a scene that cannot be simulated."""
        terms_of([*config.objective.terms])
        return cls(config, Scene.from_config(config))

    @classmethod
    def of_objective(cls, config: Config) -> "Evaluator":
        """Return the evaluator of a `config`, for the motions and speeds that its objective counts.

        Raises InputError as `of` does."""
        found, motion = cls.of(config), config.objective.motion
        if motion == "ensemble":
            from rootsopt.response.ensemble import Ensemble

            found = dataclasses.replace(found, motions=Ensemble())
        elif motion in ("worst", "weighted"):
            from rootsopt.response.attractors import Coexisting

            found = dataclasses.replace(found, motions=Coexisting())
        speeds = tuple(shares(config).items()) if config.objective.speeds_rpm else ()
        return dataclasses.replace(found, speeds=speeds)

    @property
    def single(self) -> bool:
        """Whether an evaluation is that of one motion at one speed in one scene."""
        return self.motions == Motions() and not (self.speeds or self.shifts)

    @property
    def nominal(self) -> "Evaluator":
        """The evaluator in the nominal scene alone; it can travel to another process."""
        return dataclasses.replace(self, shifts=(), runs=HERE)

    def scattered(self, runs: Runs = HERE) -> "Evaluator":
        """Return another evaluator, over the fixed sample of the config's `tolerances`.

        The response is reported in the nominal scene. A design is usable only if it is usable in
        every scene. `runs`: where the sample is evaluated."""
        assert self.config.tolerances is not None
        sample = draw(self.config, self.config.tolerances.samples)
        return dataclasses.replace(self, shifts=shifts(self.config, sample), runs=runs)

    def at_tolerance(self, rtol: float) -> "Evaluator":
        """Return another evaluator with the orbit tolerance `rtol`."""
        return self._solving(lambda solver: solver.orbit.rtol, jnp.asarray(rtol))

    def surveying(self, probe: bool = False) -> "Evaluator":
        """Return another evaluator for a search over many designs.

        Motions have only a quarter of the allowed transient in which to settle, but at least 32
        mesh periods. With `probe`, a design that does not settle is examined for chaos."""
        least = max(self.config.solver.max_mesh_periods // 4, 8 * BLOCK)
        hasty = self._solving(
            lambda solver: (solver.max_periods, solver.probe_chaos),
            (jnp.asarray(float(least)), jnp.asarray(float(probe))),
        )
        return dataclasses.replace(hasty, survey=True)

    def _solving(self, where, value) -> "Evaluator":
        scene = eqx.tree_at(lambda scene: where(scene.solver), self.scene, value)
        return dataclasses.replace(self, scene=scene)

    def relative_to(self, baseline: Evaluation) -> "Evaluator":
        """Return another evaluator that compares coexisting motions, at each speed, by their forces
        relative to those of the `baseline` in the nominal scene."""
        references = tuple(part.evaluation.response for part in baseline.by_speed)
        return dataclasses.replace(self, references=references)

    def at_speed(self, speed_rpm: float) -> "Evaluator":
        """Return another evaluator at the speed `speed_rpm` alone."""
        scene = at_speed(self.scene, speed_rpm)
        return dataclasses.replace(self, scene=scene, speeds=())

    def shifted(self, shift: Scene | None) -> "Evaluator":
        """Return another evaluator whose scene's arrays are moved by those of `shift`.

        `shift`: change in SI units, as a `Scene` with None in place of all that is not moved; None:
        no change."""
        if shift is None:
            return self
        moved = eqx.apply_updates(self.scene, jax.tree.map(jnp.asarray, shift))
        return dataclasses.replace(self, scene=moved)

    def with_maxima(self) -> "Evaluator":
        """Return another evaluator that adds all local maxima of the force to an evaluation."""
        return dataclasses.replace(self, maxima=True)

    def unconfirmed(self) -> "Evaluator":
        """Return another evaluator, which reports the series of an orbit without confirming it by
        an integration."""
        return dataclasses.replace(self, confirm=False)

    def without_gradient(self) -> "Evaluator":
        """Return another evaluator that skips the gradient, if computing it takes most of the time:
        that of an ensemble."""
        return dataclasses.replace(self, differentiate=False)

    @property
    def keys(self) -> tuple[str, ...]:
        """Names of the design parameters."""
        return design_keys(self.config)

    def __call__(
        self, design: ArrayLike | None = None, start: Seeds = None, series: bool = True
    ) -> Evaluation:
        """Evaluate `design` (config units; default: the config's own) at all points that count.

        `start`: where to begin, the `start` of a neighbouring design's evaluation, or a scaled
        state (n,) at φ1 = 0; by default at rest (ε = 0, dε/dt = 0). `series`: whether to compute
        the series, at the scene's own speed in the nominal scene. Without a usable motion in the
        nominal scene, no sample is simulated.
        """
        design = design_vector(self.config) if design is None else jnp.asarray(design)
        if self.shifts:
            return self._over_scenes(design, start, series)
        if self.speeds:
            return self._over_speeds(design, start, series)
        return self.motions.evaluated(self, design, start, series)

    def _over_scenes(self, design: Any, start: Any, series: bool) -> Evaluation:
        begin, *begins = start or (None,) * (1 + len(self.shifts))
        head = self.nominal(design, begin, series)
        parts = [Part({}, head)]
        if head.usable:
            found = evaluate_many(self.in_scenes(self.shifts, design, begins), self.runs)
            parts += [Part(s.values, one) for s, one in zip(self.shifts, found, strict=True)]
        return over_scenes(parts)

    def in_scenes(
        self, shifts: Iterable[Shift], design: Any, starts: Iterable[Seeds]
    ) -> Iterator[Point]:
        """Yield the points of a `design` (d,) in scenes that differ from the nominal one.

        `shifts`: differences of the scenes; `starts`: where to begin in each of them."""
        for shift, start in zip(shifts, starts, strict=False):
            yield Point(self.nominal.shifted(shift.scene), design + shift.design, start)

    def _over_speeds(self, design: Any, start: Any, series: bool) -> Evaluation:
        own, begins = self.config.scene.speed_rpm, start or (None,) * len(self.speeds)
        points = [
            Point(self._at(number), design, begin, series and self.speeds[number][0] == own)
            for number, begin in enumerate(begins)
        ]
        # Designs run side by side, so that their speeds need no threads.
        return over_speeds(parts_at(self.speeds, evaluate_many(points, IN_TURN)), own)

    def _at(self, number: int) -> "Evaluator":
        references = self.references[number : number + 1]
        alone = self.at_speed(self.speeds[number][0])
        return dataclasses.replace(alone, references=references)

    def swept(
        self,
        speeds_rpm: Sequence[float],
        design: ArrayLike | None = None,
        progress: Callable[[int], None] = lambda done: None,
    ) -> tuple[Part, ...]:
        """Evaluate `design` (config units; default: the config's own) at each of the speeds, from
        rest.

        `progress` is called with the number of speeds done. All parts have equal shares.
        """
        points = [Point(self.at_speed(speed), design) for speed in speeds_rpm]
        found = evaluate_many(points, progress=progress)
        return parts_at([(speed, 1 / len(speeds_rpm)) for speed in speeds_rpm], found)

    def reached(
        self,
        design: ArrayLike | None = None,
        start: Seed | ArrayLike | None = None,
        series: bool = True,
    ) -> Evaluation:
        """Evaluate the motion of `design` (config units; default: the config's own) that `start`
        leads to, at the scene's speed. Arguments: see `__call__`."""
        began = time.perf_counter()
        design = design_vector(self.config) if design is None else jnp.asarray(design)
        pair, tangents, shape = _build(self.scene, design)
        solver = self.solver
        begin = begun(pair, start, solver.max_orbit)
        found = self.motion(pair, tangents, begin)
        if series and self.confirm:
            found = self._confirmed(pair, tangents, begin, found)
        report = self._report(design, (pair, tangents, shape), found, began, series)
        if self.maxima and report.usable:
            maxima = local_maxima(pair, tangents, varied(found))
            report = dataclasses.replace(report, maxima=maxima)
        return report

    @property
    def solver(self) -> Solver:
        """Settings of the solver; orbits have their variation, from which all else follows."""
        return dataclasses.replace(self.scene.solver, variation=True)

    def motion(self, pair: RotorPair, tangents: RotorPair, start: Start) -> Steady:
        """Return the steady motion of `pair` that `start` leads to, in arrays of NumPy.

        It has derivatives along `tangents`; `start`: result of `starts.begun`."""
        found = _motion(pair, tangents, start, self.scene.pitch_radius, self.solver)
        found = jax.device_get(found)  # To fetch a hundred arrays one by one takes a millisecond.
        return self._examined(pair, found)

    def _examined(self, pair: RotorPair, found: Steady) -> Steady:
        """Return the motion `found`, with the status that `closed.examined` would give it.

        The window has a program of its own, which few motions need."""
        if Status.of(found.status) not in OPEN:
            return found
        window = None
        if float(self.scene.solver.probe_chaos) > 0:
            state, integrator = found.settled.state, self.scene.solver.transient
            window = jax.device_get(lyapunov_program(pair, state, PERIODS, integrator))
        return _seen(pair, found, window)

    def _confirmed(
        self, pair: RotorPair, tangents: RotorPair, start: Start, found: Steady
    ) -> Steady:
        """Return the motion `found` from `start`, if an integration over its period confirms it.

        An orbit near a known one may lack a touch of the flanks. It is searched for once more,
        without the known orbit. Any other that is not confirmed is NOT_CLOSED."""
        if Status.of(found.status) not in CLOSED:
            return found
        orbit, integrator = found.orbit, self.scene.solver.orbit
        # A coarse integration would say nothing about the orbit.
        # NumPy's minimum: that of JAX, outside of a program, would be compiled.
        rtol = jax.device_put(np.minimum(integrator.rtol, _FINE))
        fine = dataclasses.replace(integrator, rtol=rtol)
        apart = float(_integrated(pair, (orbit.state, orbit.response), found.period, fine))
        least, tolerances = _APART
        if apart <= max(least, tolerances * float(integrator.rtol)):
            return found
        if start.known.sound and not int(found.used):
            alone = dataclasses.replace(start, known=start.known._replace(sound=np.zeros((), bool)))
            return self._confirmed(pair, tangents, alone, self.motion(pair, tangents, alone))
        status = np.asarray(Status.NOT_CLOSED.code)
        return self._examined(pair, found._replace(status=status))

    def pair(self, design: ArrayLike) -> RotorPair:
        """Return the rotor pair of `design` (config units)."""
        return _build(self.scene, jnp.asarray(design))[0]

    def prepare(
        self, design: ArrayLike | None = None, series: bool = True, maxima: bool = False
    ) -> None:
        """Compile the programs for evaluating `design` (config units) in the background.

        `series`: whether the evaluations will compute the series; `maxima`: whether evaluators
        `with_maxima` will follow."""
        design = design_vector(self.config) if design is None else jnp.asarray(design)
        self.motions.prepare(self, design, series, maxima)

    def prepare_reached(self, design: Any, series: bool, maxima: bool) -> None:
        """Compile the programs of `reached` in the background. Arguments: see `prepare`."""
        pair, tangents, _ = _build.result_shape(self.scene, design)
        dtype, solver = pair.angle_scale.dtype, self.solver
        begin = eqx.filter_eval_shape(_at_rest, pair, solver.max_orbit)

        def then(found: Steady) -> None:
            orbit = varied(found)
            if self._loaded(series):
                orbit_loads.prepare(self.scene, design, orbit)
            if self._geared(series):
                apart_program.prepare(pair, tangents, orbit)
            rows = np.zeros((found.orbit.response.shape[0], 1))
            forces = solver.measures.named(rows, 1)
            added = [name for name in self._names if name not in (*forces, *OF_MOTION)]
            if added:
                values, slopes = (jax.ShapeDtypeStruct((3, *d), float) for d in ((), design.shape))
                values_of.prepare(self.scene, terms_of(added), design, values, slopes)
            if series:
                sampled.prepare(found.known.elements)
            if series and self.confirm:
                known = found.orbit.state, found.orbit.response
                _integrated.prepare(pair, known, found.period, solver.orbit)
            if maxima or self.maxima:
                prepare_maxima(pair, tangents, orbit)

        # The slowest compilation starts first.
        _motion.prepare(pair, tangents, begin, self.scene.pitch_radius, solver, then=then)
        _build.prepare(self.scene, design)
        if series:
            count = pair.lobes * SAMPLES
            times = jax.ShapeDtypeStruct((count,), float)
            contact_series.prepare(pair, times, jax.ShapeDtypeStruct((count, pair.states), dtype))

    def assembled(self) -> tuple[RotorPair, RotorPair, Geometry]:
        """Return the pair of the config's own design, its derivatives along the design, and its
        geometry."""
        return _build(self.scene, design_vector(self.config))

    def evaluation(
        self, built: tuple[RotorPair, RotorPair, Geometry], found: Steady, began: float
    ) -> Evaluation:
        """Return the evaluation, without series, of the config's own design with a known motion.

        `built`: result of `assembled`; `found`: its motion; `began`: time at the start (s,
        `perf_counter`)."""
        return self._report(design_vector(self.config), built, found, began, False)

    def _report(self, design, built, found: Steady, began: float, series: bool) -> Evaluation:
        """Return the evaluation of the motion `found`.

        `built`: rotor pair, its derivatives along the design, and geometry; `began`: time at the
        start of the evaluation (s, `perf_counter`); `series`: whether to compute the series."""
        seconds, design = time.perf_counter() - began, np.asarray(design, np.float64)
        (pair, tangents, shape), status = built, Status.of(found.status)
        statistics: dict[str, int | float] = {
            "transient_mesh_periods": int(found.used),
            "solver_steps": int(found.steps),
        }
        idle, held = status is Status.IDLE, bool(found.held)
        known = (status is Status.PERIODIC and pair.smooth) or idle
        named = self._forces(found) if status in CLOSED or idle else {}
        steady: dict[str, Any] = {"kind": "idle" if idle else "transient"}
        said, hint, motion, start = message_of(self.config, status), "", None, None
        if status in CLOSED or held:
            steady = {"kind": "idle" if idle else "periodic"}
            steady |= orbit_record(found.orbit, int(found.period))
            statistics |= orbit_statistics(found, self.solver)
            motion, further = self._along(design, (pair, tangents), found, series)
            named, start = named | further, Seed.of(found, pair)
            hint = "" if pair.smooth else _NO_GRADIENT
            if status is Status.PERIODIC:
                hint += fading_note(float(found.orbit.multiplier), int(found.period))
        elif idle and found.window is not None:
            steady |= window_record(found.window)
            motion = window_series(pair, found.window) if series else None
        response = {name: value for name, (value, _) in named.items()}
        gradient = self._named({name: row for name, (_, row) in named.items()}) if known else {}
        if status in CLOSED or idle:
            terms, slopes = self._terms(design, response, gradient)
            response |= terms
            gradient |= slopes if known else {}
        elif status is Status.UNSOUND and pair.soundness is not None:
            hint = f" Here, {fault_of(pair.soundness)}."
        elif found.window is not None:
            steady, response, motion = unsettled(pair, status, found.window, series)
        elif status is Status.SOLVER_FAILED and pair.timescales is not None:
            swings = pair.mesh_period / (2 * np.pi * pair.timescales.swing)
            statistics["swings_per_mesh_period"] = float(swings)
        if idle:
            depth = found.orbit.depth if found.window is None else found.window.depth
            said = apart_message(self.config, float(depth), response.get(RESERVES[1]))
        if pair.gear is not None and pair.gear.errors is not None:
            steady |= rattle_record(pair, found)
            if series:
                limit = jax.device_get(silent_limit(self.scene, jnp.asarray(design)))
                silent = silent_record(limit)
                response |= {name: value for name, (value, _) in silent.items()}
                gradient |= self._named({name: row for name, (_, row) in silent.items()})
        return Evaluation(
            design=dict(zip(self.keys, map(float, design), strict=True)),
            geometry=geometry_record(self.scene, shape),
            response=response,
            gradient=gradient,
            steady_state=steady,
            status=status,
            message=said + hint,
            statistics=statistics | {"seconds": seconds},
            series=motion,
            start=start,
        )

    def _forces(self, found: Steady) -> dict[str, tuple[float, Any]]:
        """Return the forces of an orbit and their derivatives (d,), by name; 0 without contact."""
        rows = np.column_stack([found.orbit.response, found.orbit.sensitivity])
        if Status.of(found.status) is Status.IDLE:
            rows = np.zeros_like(rows)
        return self.scene.solver.measures.named(rows, int(found.period))

    def _along(
        self, design, built, found: Steady, series: bool
    ) -> tuple[Series | None, dict[str, tuple[float, Any]]]:
        """Return the series of an orbit, and what else is computed along it: values and derivatives
        (d,) by name.

        `built`: rotor pair, and its derivatives along the `design`."""
        pair, further = built[0], {}
        motion = orbit_series(pair, found) if series else None
        if self._loaded(series):
            whole = varied(found)
            loads = jax.device_get(orbit_loads(self.scene, jnp.asarray(design), whole))
            further |= bearing_record(loads)
            if motion is not None:
                turns = len(motion.time) // len(loads.series.sizes), 1
                each = np.tile(np.asarray(loads.series.sizes, np.float64), turns)
                motion = dataclasses.replace(motion, bearing_loads=each)
        # Without contact, the reserve is the result.
        if self._geared(series or Status.of(found.status) is Status.IDLE):
            reserve = jax.device_get(apart_program(*built, varied(found)))
            further |= apart_record(reserve, float(self.scene.pitch_radius))
        return motion, further

    def _loaded(self, series: bool) -> bool:
        """Return whether an evaluation computes loads on bearings; `series`: with a series."""
        return self.scene.bearings is not None and (series or bool({*BEARING} & {*self._names}))

    def _geared(self, series: bool) -> bool:
        """Return whether an evaluation computes the reserve.

        `series`: whether it has a series, or no contact."""
        wanted = bool({*RESERVES, *GEAR} & {*self._names})
        return self.scene.gear is not None and (series or wanted)

    @property
    def _names(self) -> tuple[str, ...]:
        return tuple(self.config.objective.terms)

    def _terms(self, design, response, gradient):
        """Return the values of the objective's further terms, and their gradients.

        The gradient of a term is NaN if it depends on gradients of the forces that are not known.
        """
        names = [name for name in self._names if name not in response]
        if not names:
            return {}, {}
        forces = np.array([response[name] for name in RESPONSES])
        slopes = np.full((3, len(self.keys)), np.nan)
        if gradient:
            slopes = np.array([list(gradient[name].values()) for name in RESPONSES])
        found = values_of(self.scene, terms_of(names), design, forces, slopes)
        values, rows = map(np.asarray, found)
        return dict(zip(names, map(float, values), strict=True)), self._named(
            dict(zip(names, rows, strict=True))
        )

    def _named(self, rows: dict[str, Any]) -> dict[str, dict[str, float]]:
        """Return derivatives (d,) by name with the keys of the result file; {} without keys."""
        keys = self.keys
        named = {name: dict(zip(keys, map(float, row), strict=True)) for name, row in rows.items()}
        return named if keys else {}


def at_speed(scene: Scene, speed_rpm: float) -> Scene:
    """Return the `scene` at the speed `speed_rpm`."""
    speed = jnp.asarray(speed_rpm * RPM)
    return eqx.tree_at(lambda scene: scene.speed, scene, speed)


def _at_rest(pair: RotorPair, longest: int) -> Start:
    """Return a start at rest; `longest`: longest period of an orbit (mesh periods)."""
    return Start.at(pair, jnp.zeros(pair.states, pair.angle_scale.dtype), longest)


def motion_from(pair: RotorPair, tangents: RotorPair, start: Start, radius, solver) -> Steady:
    """Return the steady motion that a `start` with a scaled state leads to."""
    start = eqx.tree_at(lambda start: start.state, start, pair.in_si(start.state))
    return steady_motion(pair, tangents, start, radius, solver)


_build = CachedFunction(Scene.pair_and_tangents)
_motion = CachedFunction(motion_from)
_integrated = CachedFunction(integrated_difference)
apart_program = CachedFunction(apart)
lyapunov_program = CachedFunction(lyapunov)
unsettled_status = CachedFunction(window_status)
_seen = CachedFunction(seen)


_NO_GRADIENT = " The contact force jumps at many places, so that it has no gradient."


def evaluate(config: Config, design: ArrayLike | Sequence[float] | None = None) -> Evaluation:
    """Evaluate one design of a config: response, gradient, steady state and series.

    `design` (d,): in config units; by default the config's own.

    Raises `InputError` for a scene that cannot be simulated or a profile that is not sound;
    `RuntimeError` if JAX is not set to double precision.

    >>> import jax
    >>> import rootsopt
    >>> jax.config.update("jax_enable_x64", True)
    >>> config = rootsopt.load_config("cic")
    >>> found = rootsopt.evaluate(config)
    >>> print(f"{found.response['mean_force_N']:.1f} N")
    26.8 N
    """
    check_precision()
    check_geometry(config, design)
    found = Evaluator.of(config)(None if design is None else jnp.asarray(design, float))
    if found.status is Status.UNSOUND:
        raise InputError(found.message)
    return found
