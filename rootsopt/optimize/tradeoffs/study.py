"""The terms of a trade-off, and their values and gradients at designs.

Without a term that depends on forces, nothing is simulated."""

import dataclasses
import hashlib
import json
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rootsopt.config.reading import Config
from rootsopt.config.study import BASELINE
from rootsopt.config.units import unit_of, words
from rootsopt.errors import InputError
from rootsopt.optimize.limits import (
    LIMITS,
    PEAK,
    branches_of,
    force_limits,
    limited,
    quantity_of,
    settled_by,
    term_constraints,
)
from rootsopt.optimize.local import Group
from rootsopt.optimize.problem import Problem
from rootsopt.response.evaluation import Evaluator
from rootsopt.response.journal import Checkpoint
from rootsopt.response.reducers import HERE, Point, Runs
from rootsopt.response.result import Evaluation, Seeds, plain
from rootsopt.response.still import Still
from rootsopt.response.terms import depends_on_forces, is_force, reporting, terms_of
from rootsopt.scene.build import Scene
from rootsopt.scene.space import Space

# Keys of `constraints` that can be left out. All others are floors: 0 has the same effect.
_OPTIONAL = "outer_radius_min_mm", "outer_radius_max_mm"
# Config key that names the terms.
_KEY = "pareto.terms"


class Aim(NamedTuple):
    """A term of a trade-off.

    `name`: key in the result file; `sense`: `min` if less is better, `max` if more is."""

    name: str
    sense: str

    @property
    def sign(self) -> float:
        """Factor (1 or -1) that turns the term into a quantity to be minimised."""
        return -1.0 if self.sense == "max" else 1.0

    @property
    def unit(self) -> str:
        """Unit of the term; "" if its name does not contain a unit."""
        return unit_of(self.name)

    @property
    def words(self) -> str:
        """Name in words, without the unit."""
        return words(self.name)

    @property
    def label(self) -> str:
        """Name in words with the unit in brackets, for an axis."""
        return f"{self.words} ({self.unit})" if self.unit else self.words


def aims_of(config: Config) -> tuple[Aim, ...]:
    """Return the terms of `config.pareto`.

    Raises `InputError` for a name that is neither a force nor a registered term."""

    def sense(name: str) -> str:
        return "min" if is_force(config, name, _KEY) else terms_of([name], _KEY)[0].sense

    wanted = config.pareto
    return tuple(Aim(name, wanted.senses.get(name, sense(name))) for name in wanted.terms)


def simulated(config: Config, scene: Scene) -> bool:
    """Return whether a term of `config.pareto` depends on forces.

    If one does, the forces must have a gradient and belong to one motion at one speed in one scene.
    Raises `InputError` if they do not."""
    forced = [
        name
        for names, key in ((config.pareto.terms, _KEY), (config.constraints.terms, LIMITS))
        for name in names
        if depends_on_forces(config, scene, name, key)
    ]
    if not forced:
        return False
    given, what = config.objective, f"for `pareto.terms` with forces ({forced[0]})"
    conflicts = {
        f"`objective.motion` must be reached {what}, but is {given.motion}; set it to "
        "reached": given.motion != "reached",
        f"`objective.speeds_rpm` must be empty {what}, but is {[*given.speeds_rpm]}: a front is "
        "that of one speed; set it to [] and `scene.speed_rpm` to that "
        "speed": bool(given.speeds_rpm),
        f"`objective.over` must be nominal {what}, but is {given.over}: a front is that of the "
        "nominal scene; set it to nominal": given.over != "nominal",
        f"`tolerances` must be absent {what}: a front is that of the nominal scene; remove "
        "them": config.tolerances is not None,
    }
    for message, met in conflicts.items():
        if met:
            raise InputError(message)
    return True


def reported(config: Config) -> Config:
    """Return a copy of a `config` whose evaluations report all terms of `config.pareto`."""
    return reporting(limited(config), config.pareto.terms, _KEY)


def freed(config: Config) -> tuple[Config, tuple[str, ...]]:
    """Return a copy of a `config` without the limits that would cut off a side of the front.

    These are limits of terms of `config.pareto` with the value `baseline`. A limit that is a number
    is kept. Also return the names of the quantities that lost a limit."""
    limits = config.constraints
    keys = [key for key, limit in limits if limit == BASELINE]
    keys = [key for key in keys if quantity_of(key) in config.pareto.terms]
    values: dict[str, Any] = {key: None if key in _OPTIONAL else 0.0 for key in keys}
    kept = {}
    for name, sides in limits.terms.items():
        lost = BASELINE if name in config.pareto.terms else None
        if left := {side: limit for side, limit in sides.items() if limit != lost}:
            kept[name] = left
    names = {quantity_of(key) for key in keys}
    names |= {name for name, sides in limits.terms.items() if sides != kept.get(name)}
    if not names:
        return config, ()
    limits = limits.model_copy(update=values | {"terms": kept})
    return config.model_copy(update={"constraints": limits}), tuple(sorted(names))


@dataclasses.dataclass(frozen=True)
class Sample:
    """The k terms at one point of the unit box.

    `point` (d,): the design in the unit box; `evaluation`: evaluation of the design; `terms`: one
    group of branches per term, with the sign that makes it a term to be minimised, and with
    gradients with respect to the point; `cornered`: for each term, whether it is a maximum over
    branches; `slack` (m,), `normals` (m, d),
    `caps`: constraints, as in `rootsopt.optimize.local`."""

    point: NDArray[np.float64]
    evaluation: Evaluation
    terms: tuple[Group, ...]
    cornered: tuple[bool, ...]
    slack: NDArray[np.float64]
    normals: NDArray[np.float64]
    caps: tuple[Group, ...] = ()

    @property
    def values(self) -> NDArray[np.float64]:
        """Values (k,) of the terms, each with the sign that makes it a term to be minimised."""
        return np.array([group.top for group in self.terms])


@dataclasses.dataclass(frozen=True)
class Study:
    """Everything that is needed to evaluate designs of one trade-off.

    `aims`: its k terms; `problem`: unit box and constraints, with the evaluated baseline; `fast`,
    `sharp`, `exact`: evaluators for screening, search and report, without a motion if no term
    depends on forces. `runs`: where they run; `checkpoint`: file that stores every evaluation and
    supplies those of an interrupted search. `limits_dropped`: quantities whose limits, the
    baseline's values, were dropped, because they are terms."""

    aims: tuple[Aim, ...]
    problem: Problem
    fast: Evaluator
    sharp: Evaluator
    exact: Evaluator
    runs: Runs
    checkpoint: Checkpoint
    limits_dropped: tuple[str, ...] = ()

    @classmethod
    def of(cls, config: Config, runs: Runs = HERE, checkpoint: Checkpoint | None = None) -> "Study":
        """Return the study of a `config`; evaluate its own design as the baseline.

        `runs`: where other designs are evaluated; `checkpoint`: see `Study`.

        Raises `InputError` for unknown terms, or for a scene that cannot be simulated."""
        aims = aims_of(config)
        config, dropped = freed(config)
        scene = Scene.from_config(config)
        moves = simulated(config, scene)
        limits = force_limits(config, scene)
        maxima = any(_is_cornered(aim) for aim in aims) or any(one.cornered for one in limits)
        exact = Evaluator.of(reported(config))
        if not moves:
            exact = dataclasses.replace(exact, motions=Still())
        exact.prepare(maxima=maxima)
        baseline = exact()
        if maxima:
            exact = exact.with_maxima()
        fast = exact.at_tolerance(max(1e-6, config.solver.orbit_tolerance)).surveying()
        config = settled_by(config, baseline)
        space = Space.of(config, exact.scene, term_constraints(config, exact.scene))
        problem = Problem(config, baseline, space, force_limits(config, exact.scene))
        work = fast, exact.surveying(), exact, runs, checkpoint or Checkpoint({}, None)
        return cls(aims, problem, *work, dropped)

    def term_values(self, evaluation: Evaluation) -> dict[str, float]:
        """Return the terms of an evaluated design by name, in their own units."""
        return {aim.name: evaluation.response[aim.name] for aim in self.aims}

    def screened(self, point: NDArray[np.float64]) -> Evaluation | None:
        """Return an evaluation of a `point` (d,) for a screening.

        Return `None` if the design has no usable steady state."""
        evaluation = self._simulated("screening", self.fast.without_gradient(), point)
        return evaluation if evaluation.usable else None

    def sample(self, point: NDArray[np.float64], orbit: Seeds = None) -> Sample | None:
        """Return the terms at a `point` (d,) during a search.

        `orbit`: first guess of the orbit. Return `None` without a usable steady state."""
        return self._moving(point, self._simulated("search", self.sharp, point, orbit))

    def verified(self, point: NDArray[np.float64]) -> Sample | None:
        """Return the terms at a `point` (d,), simulated from rest at the tight tolerance.

        Return `None` without a usable steady state."""
        return self._moving(point, self._simulated("verification", self.exact, point))

    def _simulated(
        self,
        stage: str,
        evaluator: Evaluator,
        point: NDArray[np.float64],
        orbit: Seeds = None,
    ) -> Evaluation:
        asked = Point(evaluator, self.problem.design(point), orbit)
        start = json.dumps(plain(orbit)).encode()
        key = stage, hashlib.sha256(point.tobytes() + start).hexdigest()[:16]
        return self.checkpoint.evaluated(self.runs.evaluated, key, asked, point)

    def _moving(self, point: NDArray[np.float64], evaluation: Evaluation) -> Sample | None:
        if not evaluation.usable:
            return None
        _, jacobian, slack, normals = self.problem.look(point)
        groups = []
        for number, aim in enumerate(self.aims):
            one = branches_of(evaluation, aim.name, _is_cornered(aim), number)
            slopes = aim.sign * (one.slopes @ jacobian)
            groups.append(Group(one.tags, aim.sign * one.values, slopes))
        cornered = tuple(map(_is_cornered, self.aims))
        caps = self.problem.caps(evaluation, jacobian)
        limits = slack, normals, caps
        return _finite(Sample(np.array(point), evaluation, tuple(groups), cornered, *limits))


def _is_cornered(aim: Aim) -> bool:
    """Return whether a term is a maximum over branches that is to be minimised."""
    return aim.name == PEAK and aim.sense == "min"


def _finite(sample: Sample) -> Sample | None:
    """Return `sample`, or `None` if a number in it is not finite."""
    arrays = [sample.slack, sample.normals]
    arrays += [
        array for group in (*sample.terms, *sample.caps) for array in (group.values, group.slopes)
    ]
    return sample if all(np.all(np.isfinite(array)) for array in arrays) else None


class Seen(NamedTuple):
    """A feasible design evaluated earlier.

    `point` (d,): the design in the unit box; `values` (k,): its terms; `orbit`: where the motions
    of neighbouring designs begin."""

    point: NDArray[np.float64]
    values: NDArray[np.float64]
    orbit: Seeds


class Course:
    """A course of searches, one after the other, that begins with what is `known`.

    Several courses run side by side. They do not exchange results, so that the outcome does not
    depend on their speed. `seen`: feasible designs, in the order of their evaluation;
    `evaluations`: number of designs evaluated in this course."""

    def __init__(self, known: Sequence[Seen] = ()):
        self.seen = [*known]
        self.evaluations = 0
        self._first = len(self.seen)

    def branch(self) -> "Course":
        """Return a new course that begins with what this one knows now."""
        return Course(self.seen)

    def join(self, others: Sequence["Course"]) -> None:
        """Add the designs that `others`, branches of this course, have seen, in their order."""
        for other in others:
            self.seen += other.seen[other._first :]
            self.evaluations += other.evaluations
