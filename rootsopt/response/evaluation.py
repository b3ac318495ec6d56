"""One design in one scene, from design vector to steady state, response and gradient."""

import dataclasses
import time
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from rootsopt.config.reading import Config
from rootsopt.config.units import RPM
from rootsopt.dynamics.closed import Start, seen, steady_motion
from rootsopt.dynamics.integrator import Solver
from rootsopt.dynamics.maxima import local_maxima, prepare_maxima
from rootsopt.dynamics.pair import RotorPair
from rootsopt.dynamics.steady import CLOSED, OPEN, SAMPLES, Steady, varied, window_status
from rootsopt.dynamics.window import BLOCK, PERIODS, integrated_difference, lyapunov
from rootsopt.errors import InputError
from rootsopt.pump.loads import orbit_loads
from rootsopt.response.records import (
    apart_program,
    contact_series,
    geared,
    loaded,
    reported,
    sampled,
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
from rootsopt.response.terms import OF_MOTION, terms_of, values_of, with_terms
from rootsopt.runtime.environment import check_precision
from rootsopt.runtime.programs import CachedFunction
from rootsopt.scene.build import Scene
from rootsopt.scene.check import check_geometry
from rootsopt.scene.reading import design_vector
from rootsopt.status import Status

# Difference between an orbit closed by collocation and an integration over its period (see
# `integrated_difference`) above which the orbit is rejected: the greater of the first number and
# the second times the tolerance of orbits.
_APART = 1e-4, 1e3
# Greatest tolerance of this integration.
_FINE = 1e-8


@dataclasses.dataclass(frozen=True)
class Motions:
    """The steady motions of a design to evaluate; base class, for the motion from a start."""

    def evaluated(
        self, evaluator: "Evaluator", design: Any, start: Any, series: bool
    ) -> Evaluation:
        """Evaluate a design at one speed in one scene. Arguments: see `Evaluator.__call__`."""
        return evaluator.reached(design, start, series)

    def prepare(self, evaluator: "Evaluator", design: Any, series: bool, maxima: bool) -> None:
        """Compile the programs in the background. Arguments: see `Evaluator.prepare`."""
        pair, tangents, _ = build.result_shape(evaluator.scene, design)
        dtype, solver = pair.angle_scale.dtype, evaluator.solver
        rest = jax.ShapeDtypeStruct((pair.states,), dtype)
        begin = eqx.filter_eval_shape(Start.at, pair, rest, solver.max_orbit)

        def then(motion: Steady) -> None:
            orbit = varied(motion)
            if loaded(evaluator, series):
                orbit_loads.prepare(evaluator.scene, design, orbit)
            if geared(evaluator, series):
                apart_program.prepare(pair, tangents, orbit)
            rows = np.zeros((motion.orbit.response.shape[0], 1))
            forces = solver.measures.named(rows, 1)
            added = [
                name
                for name in evaluator.config.objective.terms
                if name not in (*forces, *OF_MOTION)
            ]
            if added:
                values, slopes = (jax.ShapeDtypeStruct((3, *d), float) for d in ((), design.shape))
                values_of.prepare(evaluator.scene, terms_of(added), design, values, slopes)
            if series:
                sampled.prepare(motion.known.elements)
            if series and evaluator.confirm:
                known = motion.orbit.state, motion.orbit.response
                _integrated.prepare(pair, known, motion.period, solver.orbit)
            if maxima or evaluator.maxima:
                prepare_maxima(pair, tangents, orbit)

        # The slowest compilation starts first.
        _motion.prepare(pair, tangents, begin, evaluator.scene.pitch_radius, solver, then=then)
        build.prepare(evaluator.scene, design)
        if series:
            count = pair.lobes * SAMPLES
            times = jax.ShapeDtypeStruct((count,), float)
            contact_series.prepare(pair, times, jax.ShapeDtypeStruct((count, pair.states), dtype))


@dataclasses.dataclass(frozen=True)
class Evaluator:
    """Evaluates designs of one config in its `scene`. All designs share compiled programs.

    An evaluator is immutable. Methods that return "another evaluator" do not change the evaluator
    on which they are called.

    `motions`: the motions of a design that are evaluated; `speeds`: pairs (speed in rpm, its share
    in the objective), including the scene's own speed; empty: only the latter; `shifts`: scenes of
    a sample, in addition to the nominal one; `runs`: where the sample is evaluated.

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
        evaluator, motion = cls.of(config), config.objective.motion
        if motion == "ensemble":
            from rootsopt.response.ensemble import Ensemble

            evaluator = dataclasses.replace(evaluator, motions=Ensemble())
        elif motion in ("worst", "weighted"):
            from rootsopt.response.attractors import Coexisting

            evaluator = dataclasses.replace(evaluator, motions=Coexisting())
        speeds = tuple(shares(config).items()) if config.objective.speeds_rpm else ()
        return dataclasses.replace(evaluator, speeds=speeds)

    @property
    def single(self) -> bool:
        """Whether an evaluation covers one motion at one speed in one scene."""
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
        speed = jnp.asarray(speed_rpm * RPM)
        scene = eqx.tree_at(lambda scene: scene.speed, self.scene, speed)
        return dataclasses.replace(self, scene=scene, speeds=())

    def shifted(self, shift: Scene | None) -> "Evaluator":
        """Return another evaluator whose scene's arrays are moved by those of `shift`.

        `shift`: change in SI units, as a `Scene` with None in place of unchanged fields; None: no
        change."""
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
        return self.config.design_keys

    def __call__(
        self, design: ArrayLike | None = None, start: Seeds = None, series: bool = True
    ) -> Evaluation:
        """Evaluate `design` (config units; default: the config's own) at all speeds and scenes.

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
            evaluations = evaluate_many(self.in_scenes(self.shifts, design, begins), self.runs)
            parts += [Part(s.values, one) for s, one in zip(self.shifts, evaluations, strict=True)]
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
        points = []
        for number, ((speed, _), begin) in enumerate(zip(self.speeds, begins, strict=True)):
            references = self.references[number : number + 1]
            alone = dataclasses.replace(self.at_speed(speed), references=references)
            points.append(Point(alone, design, begin, series and speed == own))
        # Designs run side by side, so that their speeds need no threads.
        return over_speeds(parts_at(self.speeds, evaluate_many(points, IN_TURN)), own)

    def reached(
        self, design: Any, start: Seed | ArrayLike | None = None, series: bool = True
    ) -> Evaluation:
        """Evaluate the motion to which `start` leads, at the scene's speed.

        `design` (d,): in config units. For the other arguments, see `__call__`."""
        began = time.perf_counter()
        pair, tangents, shape = build(self.scene, design)
        begin = begun(pair, start, self.solver.max_orbit)
        motion = self.motion(pair, tangents, begin)
        if series and self.confirm:
            motion = self._confirmed(pair, tangents, begin, motion)
        report = self.evaluation(design, (pair, tangents, shape), motion, began, series)
        if self.maxima and report.usable:
            maxima = local_maxima(pair, tangents, varied(motion))
            report = dataclasses.replace(report, maxima=maxima)
        return report

    @property
    def solver(self) -> Solver:
        """Settings of the solver; orbits have their variation, from which all else follows."""
        return dataclasses.replace(self.scene.solver, variation=True)

    def motion(self, pair: RotorPair, tangents: RotorPair, start: Start) -> Steady:
        """Return the steady motion of `pair` to which `start` leads, in arrays of NumPy.

        It has derivatives along `tangents`; `start`: result of `starts.begun`."""
        motion = _motion(pair, tangents, start, self.scene.pitch_radius, self.solver)
        motion = jax.device_get(motion)  # Fetching a hundred arrays one by one takes a millisecond.
        return self._examined(pair, motion)

    def _examined(self, pair: RotorPair, motion: Steady) -> Steady:
        """Return the `motion`, with the status that `closed.examined` would give it.

        The window has a separate program, which few motions need."""
        if Status.of(motion.status) not in OPEN:
            return motion
        window = None
        if float(self.scene.solver.probe_chaos) > 0:
            state, integrator = motion.settled.state, self.scene.solver.transient
            window = jax.device_get(lyapunov_program(pair, state, PERIODS, integrator))
        return _seen(pair, motion, window)

    def _confirmed(
        self, pair: RotorPair, tangents: RotorPair, start: Start, motion: Steady
    ) -> Steady:
        """Return the `motion` from `start`, if an integration over its period confirms it.

        An orbit closed from a known one may lack a touch of the flanks. If so, search once more
        without the known orbit. An orbit that is still not confirmed is NOT_CLOSED."""
        if Status.of(motion.status) not in CLOSED:
            return motion
        orbit, integrator = motion.orbit, self.scene.solver.orbit
        # A coarse integration would say nothing about the orbit.
        # NumPy's minimum: that of JAX, outside of a program, would be compiled.
        rtol = jax.device_put(np.minimum(integrator.rtol, _FINE))
        fine = dataclasses.replace(integrator, rtol=rtol)
        apart = float(_integrated(pair, (orbit.state, orbit.response), motion.period, fine))
        least, tolerances = _APART
        if apart <= max(least, tolerances * float(integrator.rtol)):
            return motion
        if start.known.sound and not int(motion.used):
            alone = dataclasses.replace(start, known=start.known._replace(sound=np.zeros((), bool)))
            return self._confirmed(pair, tangents, alone, self.motion(pair, tangents, alone))
        status = np.asarray(Status.NOT_CLOSED.code)
        return self._examined(pair, motion._replace(status=status))

    def pair(self, design: ArrayLike) -> RotorPair:
        """Return the rotor pair of `design` (config units)."""
        return build(self.scene, jnp.asarray(design))[0]

    def prepare(
        self, design: ArrayLike | None = None, series: bool = True, maxima: bool = False
    ) -> None:
        """Compile the programs for evaluating `design` (config units) in the background.

        `series`: whether the evaluations will compute the series; `maxima`: whether evaluators
        `with_maxima` will follow."""
        design = design_vector(self.config) if design is None else jnp.asarray(design)
        self.motions.prepare(self, design, series, maxima)

    def evaluation(self, design: Any, *known: Any) -> Evaluation:
        """Return the evaluation of a `design` (config units) with a known motion.

        `known`: the further arguments of `reported`."""
        return with_terms(
            reported(self, design, *known), self.scene, design, [*self.config.objective.terms]
        )


def motion_from(pair: RotorPair, tangents: RotorPair, start: Start, radius, solver) -> Steady:
    """Return the steady motion to which a `start` with a scaled state leads."""
    start = eqx.tree_at(lambda start: start.state, start, pair.in_si(start.state))
    return steady_motion(pair, tangents, start, radius, solver)


build = CachedFunction(Scene.pair_and_tangents)
_motion = CachedFunction(motion_from)
_integrated = CachedFunction(integrated_difference)
lyapunov_program = CachedFunction(lyapunov)
unsettled_status = CachedFunction(window_status)
_seen = CachedFunction(seen)


def evaluate(config: Config, design: ArrayLike | Sequence[float] | None = None) -> Evaluation:
    """Evaluate one design of a config: response, gradient, steady state and series.

    `design` (d,): in config units; by default the config's own.

    Raises `InputError` for a scene that cannot be simulated or a profile that is not sound;
    `RuntimeError` if JAX is not set to double precision.

    >>> import jax
    >>> import rootsopt
    >>> jax.config.update("jax_enable_x64", True)
    >>> config = rootsopt.load_config("cic")
    >>> evaluation = rootsopt.evaluate(config)
    >>> print(f"{evaluation.response['mean_force_N']:.1f} N")
    26.8 N
    """
    check_precision()
    check_geometry(config, design)
    evaluation = Evaluator.of(config)(None if design is None else jnp.asarray(design, float))
    if evaluation.status is Status.UNSOUND:
        raise InputError(evaluation.message)
    return evaluation
