"""The design problem over a sample of scenes with scattered values, and the stages of a search.

The objective in each scene is that of `Problem`, relative to the baseline in the nominal scene, or
over `assumptions` in the same scene. A rule (`rootsopt.response.reducers`) combines the scenes to
one number, which is divided by its value for the baseline. The robust objective of the baseline is
therefore 1, too. A `Stage` says which problem one stage of a search solves, and how."""

import dataclasses
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from rootsopt.config.reading import Config
from rootsopt.config.study import OptimizerConfig
from rootsopt.config.tolerances import TolerancesConfig
from rootsopt.optimize.limits import HELD, SCENE_KINDS, ForceLimit, settled_by
from rootsopt.optimize.local import Certificate, Group, Linearization
from rootsopt.optimize.optimality import Holder
from rootsopt.optimize.problem import Problem
from rootsopt.response.evaluation import Evaluator
from rootsopt.response.reducers import Combined, Runs, combine
from rootsopt.response.result import Evaluation
from rootsopt.scene.build import Scene
from rootsopt.scene.space import sobol


@dataclasses.dataclass(frozen=True)
class RobustProblem(Problem):
    """A design problem whose objective combines the scenes of a sample.

    `reference`: the combination for the baseline, by which the objective is divided. The field
    `baseline` is the evaluation in the nominal scene. Methods also accept an evaluation in the
    nominal scene alone, for which they return what `Problem` returns. `offsets`: numbers added to
    the objectives of the scenes, which are then relative to the baseline in the same scene, one of
    `bases`."""

    reference: float = 1.0
    offsets: tuple[float, ...] = ()
    bases: tuple[Evaluation, ...] = ()

    @classmethod
    def of(
        cls, config: Config, scene: Scene, baseline: Evaluation, offsets: tuple[float, ...] = ()
    ) -> "RobustProblem":
        """Return the problem of a `config` with `tolerances`, as `Problem.of` does.

        `baseline`: a usable evaluation of the config's own design over the sample; `offsets`: see
        the class."""
        problem = Problem.of(settled_by(config, baseline), scene, baseline.nominal)
        bases = tuple(part.evaluation for part in baseline.samples) if offsets else ()
        given = problem.config, problem.baseline, problem.space, problem.limits
        robust = cls(*given, offsets=offsets, bases=bases)
        return dataclasses.replace(robust, reference=robust.combined(baseline).value)

    @property
    def rule(self) -> TolerancesConfig:
        """How the scenes of the sample are combined."""
        assert self.config.tolerances is not None
        return self.config.tolerances

    def _each(self, evaluation: Evaluation) -> Iterator[tuple[Problem, Evaluation, float]]:
        """Yield (problem, evaluation, offset) of every scene of the sample."""
        for k, part in enumerate(evaluation.samples):
            if self.bases:
                yield self.beside(self.bases[k]), part.evaluation, self.offsets[k]
            else:
                yield self, part.evaluation, 0.0

    def values(self, evaluation: Evaluation) -> NDArray[np.float64]:
        """Return the objective in each scene of the sample (n,), 1 for the nominal baseline."""
        return np.array([one.objective(e) + add for one, e, add in self._each(evaluation)])

    def combined(self, evaluation: Evaluation) -> Combined:
        """Return the combination of the objectives in all scenes, with its weights.

        It is not yet divided by that of the baseline."""
        return combine(self.rule, self.values(evaluation))

    def objective(self, evaluation: Evaluation) -> float:
        """Return the robust objective of an `evaluation`, which is 1 for the baseline.

        The result is NaN without a usable steady state in every scene."""
        if not evaluation.scenes:
            return super().objective(evaluation)
        if not evaluation.usable:
            return float("nan")
        return self.combined(evaluation).value / self.reference

    def local(
        self, evaluation: Evaluation, point, shares: NDArray[np.float64] | None = None
    ) -> Linearization | None:
        """Return the robust objective and the constraints at a `point`, with gradients.

        If the worst scene counts, the scenes are branches of one maximum. Otherwise the maxima of
        each scene (for example, over the local maxima of the force) become groups, multiplied by
        `shares` (n,) ≥ 0. The shares must not change during a local search. By default, they are
        the weights of the scenes at this point, with negative ones set to 0. The rest of the
        objective becomes its smooth part, with the gradient of the greatest branch in each
        scene."""
        if not evaluation.scenes:
            return super().local(evaluation, point)
        if not evaluation.usable:
            return None
        parts = [
            local._replace(smooth=local.smooth + add)
            for one, e, add in self._each(evaluation)
            if (local := one.local(e, point)) is not None
        ]
        caps = self.caps(evaluation, self.look(point)[1]) if self.limits else ()
        if self.rule.combine == "worst":
            return self._worst(parts)._replace(caps=caps)
        value, weights = combine(self.rule, [part.objective for part in parts])
        shares = np.maximum(weights, 0.0) if shares is None else shares
        smooth, slope = value, np.zeros_like(parts[0].slope)
        groups: list[Group] = []
        for part, weight, share in zip(parts, weights, shares, strict=True):
            slope = slope + weight * top_slope(part)
            if share <= 0:
                continue
            for one in part.groups:
                smooth -= share * one.top
                slope = slope - share * one.slopes[np.argmax(one.values)]
                groups.append(Group(one.tags, share * one.values, share * one.slopes))
        scaled = tuple(self._scaled(group) for group in groups)
        limits = parts[0].slack, parts[0].normals, caps
        return Linearization(smooth / self.reference, slope / self.reference, scaled, *limits)

    def caps(self, evaluation: Evaluation, jacobian: NDArray[np.float64]) -> tuple[Group, ...]:
        """Return one cap for each of `limits`, as `Problem.caps` does.

        If limits hold for the combination of the scenes, this combination is the only branch of a
        cap. Its gradient is that of the greatest branch in each scene."""
        if not evaluation.scenes or self.rule.limits != "combined":
            return super().caps(evaluation, jacobian)
        caps = [
            super(RobustProblem, self).caps(part.evaluation, jacobian)
            for part in evaluation.samples
        ]
        return tuple(map(self._combined_cap, zip(*caps, strict=True)))

    def _combined_cap(self, groups: Sequence[Group]) -> Group:
        value, weights = combine(self.rule, [group.top for group in groups])
        slopes = np.array([group.slopes[np.argmax(group.values)] for group in groups])
        return Group(np.zeros((1, 2)), np.array([value]), (weights @ slopes)[None, :])

    def worst(self, evaluation: Evaluation, limit: ForceLimit) -> float:
        """Return the value of a limited quantity that must satisfy its `limit`.

        It is the worst of all scenes, or their combination. `evaluation`: usable."""
        if not evaluation.scenes or self.rule.limits != "combined":
            return super().worst(evaluation, limit)
        every = [super(RobustProblem, self).worst(p.evaluation, limit) for p in evaluation.samples]
        return limit.sign * combine(self.rule, limit.sign * np.array(every)).value

    def _worst(self, parts: list[Linearization]) -> Linearization:
        branches = [self._scaled(_branches(part, SCENE_KINDS * k)) for k, part in enumerate(parts)]
        group = Group(*(np.concatenate(arrays) for arrays in zip(*branches, strict=True)))
        zero = np.zeros_like(parts[0].slope)
        return Linearization(0.0, zero, (group,), parts[0].slack, parts[0].normals)

    def _scaled(self, group: Group) -> Group:
        size = self.reference
        return group._replace(values=group.values / size, slopes=group.slopes / size)

    def held_by(self, evaluation: Evaluation, certificate: Certificate) -> list[Holder]:
        """Return the scenes that are active at an evaluated optimum, if the worst scene counts.

        With any other rule, all scenes influence the optimum, and the list is empty. `evaluation`,
        `certificate`: those of the optimum."""
        if not evaluation.scenes:
            return super().held_by(evaluation, certificate)
        if self.rule.combine != "worst" or not certificate.shares:
            return []
        point = self.point(list(evaluation.design.values()))
        local = self.local(evaluation, point)
        assert local is not None
        (group,), (shares,) = local.groups, certificate.shares
        scenes = (group.tags[:, 0] // SCENE_KINDS).astype(int)
        held = []
        for scene in np.unique(scenes[shares > HELD]):
            mine = scenes == scene
            top, share = float(np.max(group.values[mine])), float(np.sum(shares[mine]))
            nothing = float("nan")
            held.append(Holder(nothing, nothing, nothing, top, share, int(scene)))
        return held


class Stage:
    """The steps in which one stage of a search differs.

    The base class is the usual search.

    `first`: index of the first local search; `apart`: distance between their starts in the unit
    box; `broad`: whether the stage searches the whole box: it screens designs, and may look for a
    lower bound."""

    first = 0
    apart = 0.15
    broad = True

    def evaluator(self, exact: Evaluator, runs: Runs) -> Evaluator:
        """Return the evaluator of the stage; `exact`: that of the config's objective."""
        return exact

    def problem(self, config: Config, scene: Scene, baseline: Evaluation) -> Problem:
        """Return the design problem, given the scene and the evaluated `baseline`."""
        return Problem.of(config, scene, baseline)

    def sample(
        self, problem: Problem, own: NDArray[np.float64], settings: OptimizerConfig
    ) -> list[NDArray[np.float64]]:
        """Return the points from which designs are chosen, moved onto the feasible set.

        They are the baseline's `own` point (d,) and a Sobol sample. Some may remain infeasible."""
        start = problem.project(own)
        sample = sobol(settings.screening, settings.seed, len(own))
        return [start, *(problem.toward(point, start) for point in sample)]

    def local(
        self, problem: Problem, start: int, evaluation: Evaluation, point: NDArray[np.float64]
    ) -> Linearization | None:
        """Return objective and constraints at a `point` (d,) of the local search `start`."""
        return problem.local(evaluation, point)


def top_slope(local: Linearization) -> NDArray[np.float64]:
    """Return the gradient (d,) of an objective, with the greatest branch of each maximum."""
    rows = (group.slopes[np.argmax(group.values)] for group in local.groups)
    return local.slope + sum(rows, np.zeros_like(local.slope))


def _branches(local: Linearization, kind: int) -> Group:
    """Return an objective as the branches of one maximum.

    `kind`: number added to the kinds of the branches. If the objective is a sum of several maxima,
    the result has one branch: the sum of their greatest branches."""
    if len(local.groups) == 1:
        (group,) = local.groups
        tags = group.tags + np.array([kind, 0.0])
        return Group(tags, local.smooth + group.values, local.slope + group.slopes)
    tags = np.array([[float(kind), 0.0]])
    return Group(tags, np.array([local.objective]), top_slope(local)[None, :])
