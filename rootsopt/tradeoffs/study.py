"""Values and gradients of the terms of a trade-off at designs, with or without a simulation."""

import dataclasses

import numpy as np
from numpy.typing import NDArray

from rootsopt.config import Config
from rootsopt.design.space import Space
from rootsopt.optimize.limits import force_limits, term_constraints
from rootsopt.optimize.local import Group
from rootsopt.optimize.problem import FEASIBLE, Problem, settled_by
from rootsopt.response.checkpoint import Checkpoint
from rootsopt.response.evaluation import Evaluation, Evaluator
from rootsopt.response.many import HERE, Point, Runs
from rootsopt.response.starts import Seeds
from rootsopt.response.still import Still
from rootsopt.scene import Scene
from rootsopt.tradeoffs.aims import Aim, aims_of, freed, reported, simulated

PEAK = "peak_force_N"
"""Key of the peak force: the greatest of several local maxima, each a smooth branch."""


@dataclasses.dataclass(frozen=True)
class Sample:
    """The k terms at one point of the unit box.

    `point` (d,): the design in the unit box; `evaluation`: evaluation of the design; `terms`: one
    group of branches per term, with the sign that makes it a term to be minimised, and with
    gradients with respect to the point; `cornered`: for each term, whether it is a maximum over
    branches; `slack` (m,), `normals` (m, d),
    `walls`: constraints, as in `rootsopt.optimize.local`."""

    point: NDArray[np.float64]
    evaluation: Evaluation
    terms: tuple[Group, ...]
    cornered: tuple[bool, ...]
    slack: NDArray[np.float64]
    normals: NDArray[np.float64]
    walls: tuple[Group, ...] = ()

    @property
    def feasible(self) -> bool:
        """Whether all constraints hold."""
        beyond = max((wall.top for wall in self.walls), default=0.0)
        return max(-float(np.min(self.slack, initial=0.0)), beyond) <= FEASIBLE

    @property
    def values(self) -> NDArray[np.float64]:
        """Values (k,) of the terms, each with the sign that makes it a term to be minimised."""
        return np.array([group.top for group in self.terms])


@dataclasses.dataclass(frozen=True)
class Study:
    """Everything that is needed to evaluate designs of one trade-off.

    `config`: config of the study; `aims`: its k terms; `problem`: unit box and constraints, with
    the evaluated baseline; `fast`, `sharp`, `exact`: evaluators for screening, search and report,
    without a motion if no term depends on forces. `runs`: where they run; `checkpoint`: file
    that stores every evaluation and supplies those of an interrupted search. `limits_dropped`:
    quantities whose limits, the baseline's values, were dropped, because they are terms."""

    config: Config
    aims: tuple[Aim, ...]
    problem: Problem
    fast: Evaluator
    sharp: Evaluator
    exact: Evaluator
    runs: Runs = HERE
    checkpoint: Checkpoint | None = None
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
        work = fast, exact.surveying(), exact, runs, checkpoint
        return cls(config, aims, problem, *work, dropped)

    @property
    def usable(self) -> bool:
        """Whether all terms are known for the baseline."""
        return self.problem.baseline.usable

    def term_values(self, evaluation: Evaluation) -> dict[str, float]:
        """Return the terms of an evaluated design by name, in their own units."""
        return {aim.name: evaluation.response[aim.name] for aim in self.aims}

    def screened(self, point: NDArray[np.float64]) -> Evaluation | None:
        """Return an evaluation of a `point` (d,) for a screening.

        Return `None` if the design has no usable steady state."""
        found = self._simulated("screening", self.fast.without_gradient(), point)
        return found if found.usable else None

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
        if self.checkpoint is None:
            return self.runs.evaluated(asked)
        return self.checkpoint.evaluated(self.runs.evaluated, stage, asked, point)

    def _moving(self, point: NDArray[np.float64], evaluation: Evaluation) -> Sample | None:
        if not evaluation.usable:
            return None
        _, jacobian, slack, normals = self.problem.look(point)
        groups = []
        for number, aim in enumerate(self.aims):
            maxima = evaluation.maxima if _is_cornered(aim) else None
            if maxima is not None and maxima.times.size:
                period = evaluation.steady_state["period"]
                kinds = np.full(maxima.times.size, float(number))
                tags = np.stack([kinds, maxima.times / period], axis=1)
                groups.append(Group(tags, maxima.forces, maxima.slopes @ jacobian))
                continue
            slope = np.array([*evaluation.gradient[aim.name].values()])
            groups.append(_single(number, aim, evaluation.response[aim.name], slope @ jacobian))
        cornered = tuple(map(_is_cornered, self.aims))
        walls = self.problem.walls(evaluation, jacobian)
        limits = slack, normals, walls
        return _finite(Sample(np.array(point), evaluation, tuple(groups), cornered, *limits))


def _is_cornered(aim: Aim) -> bool:
    """Return whether a term is a maximum over branches that is to be minimised."""
    return aim.name == PEAK and aim.sense == "min"


def _single(number: int, aim: Aim, value: float, slope: NDArray[np.float64]) -> Group:
    """Return term `number` as a group with one branch."""
    tags = np.array([[float(number), 0.0]])
    return Group(tags, aim.sign * np.array([value]), aim.sign * slope[None, :])


def _finite(sample: Sample) -> Sample | None:
    """Return `sample`, or `None` if a number in it is not finite."""
    arrays = [sample.slack, sample.normals]
    arrays += [
        array for group in (*sample.terms, *sample.walls) for array in (group.values, group.slopes)
    ]
    return sample if all(np.all(np.isfinite(array)) for array in arrays) else None
