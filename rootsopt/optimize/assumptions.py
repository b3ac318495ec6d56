"""Compares an optimum with the baseline over ranges of assumed values of the scene.

Both are simulated in the scenes of `assumptions`: at the ends of each range alone, and in random
scenes. A local search then looks for a better design in the scene where the optimum is worst. This
design is simulated in all scenes as well.

Motions begin at rest. Beginning on the orbit of the config's own scene took three times as long:
the scenes are too far apart. Motions that need more than a quarter of the allowed transient to
settle are left out, because one of them takes as long as a hundred others."""

import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from rootsopt.config.reading import Config
from rootsopt.config.tolerances import Span
from rootsopt.optimize.limits import limited
from rootsopt.optimize.local import FEASIBLE
from rootsopt.optimize.outcome import (
    BASELINE,
    OPTIMIZED,
    RIVAL,
    WINS,
    Assumed,
    Optimization,
    Piece,
    Scenes,
    apart,
)
from rootsopt.optimize.problem import Problem
from rootsopt.optimize.sqp import Stops, descend
from rootsopt.response.reducers import HERE, Point, Runs, evaluate_many
from rootsopt.response.result import Evaluation
from rootsopt.response.scatter import NOMINAL, Shift, assumed, draw, in_conditions, scene_of, shifts
from rootsopt.response.still import Still, needed_motion
from rootsopt.status import Status

# Number of designs of the search from which the best in the optimum's worst scene is taken.
_TRIED = 4

# Distance in the unit box below which two of these designs, or two optima, count as the same.
_FAR, _NEAR = 0.15, 0.02

# Least tolerance of orbits in a first simulation.
_RTOL = 1e-6

# Greatest number of other designs that are compared.
_RIVALS = 2

# Number of values tried in the search for the last value at which a design has a usable motion.
_HALVINGS = 4

# Accuracy of the value at which a design becomes better or worse, as a share of its range.
_FINE = 0.02


class _StoppedError(Exception):
    """Raised if the search is asked to end."""


class _Comparison:
    """Simulates designs in scenes, each of them once. Arguments: see `compared`."""

    def __init__(
        self,
        given: Config,
        result: Optimization,
        runs: Runs,
        stop: Callable[[], bool],
        tick: Callable[[int, int], None],
    ):
        whole, optimized = result.problem, result.optimized
        assert whole is not None
        assert optimized is not None
        own, given = (
            one.model_copy(update={"tolerances": None}) for one in (whole.config, limited(given))
        )
        self.problem = Problem(own, result.baseline.nominal, whole.space, whole.limits)
        self.config, self.scenes = own, assumed(own)
        self.result, self.runs, self.stop, self.tick = result, runs, stop, tick
        self.designs = {BASELINE: result.baseline.design, OPTIMIZED: optimized.design}
        # A rotor from a file, or of another family, has a separate config.
        self.shared = given.design_keys == own.design_keys
        configs = {self._varied(BASELINE): given, True: own}
        self.exact = {
            key: needed_motion(one).relative_to(self.problem.baseline)
            for key, one in configs.items()
        }
        rtol = max(_RTOL, own.solver.orbit_tolerance)
        self.fast = {
            key: one.at_tolerance(rtol).surveying(probe=True) for key, one in self.exact.items()
        }
        self._known: dict[tuple[str, str], Evaluation] = {}

    def _varied(self, name: str) -> bool:
        """Return whether a design has the parameters that the search varies."""
        return self.shared or name != BASELINE

    def evaluations(self, names: Iterable[str], scenes: Scenes) -> list[list[Evaluation]]:
        """Return the evaluations of some designs in `scenes`, from rest."""
        names = [*names]
        lacking = [(name, one) for name in names for one in scenes
                   if (name, one) not in self._known]  # fmt: skip
        where: dict[tuple[bool, str], Shift] = {}
        for kind, exact in self.exact.items():
            some = {one: scenes[one] for name, one in lacking if self._varied(name) == kind}
            moved = _shifts(exact.config, some)
            where |= {(kind, one): shift for one, shift in zip(some, moved, strict=True)}
        before, expected = len(self._known), (2 + _RIVALS) * len(self.scenes)

        def points() -> Iterator[Point]:
            for name, one in lacking:
                values = np.array([*self.designs[name].values()])
                kind = self._varied(name)
                if not self.stop():
                    yield from self.fast[kind].in_scenes([where[kind, one]], values, [None])

        def progress(done: int) -> None:
            self.tick(before + done, max(expected, before + done))

        evaluations = evaluate_many(points(), self.runs, progress)
        if self.stop():
            raise _StoppedError
        self._known |= dict(zip(lacking, evaluations, strict=True))
        return [[self._known[name, one] for one in scenes] for name in names]

    def objectives(self, names: Iterable[str], scenes: Scenes) -> list[NDArray[np.float64]]:
        """Return the objectives (n,) of designs, relative to the baseline in the same scene.

        They are NaN unless both have a usable motion, and NaN where the flanks of both stay
        apart."""
        bases, *rows = self.evaluations([BASELINE, *names], scenes)
        return [np.array([*map(self._relative, bases, row)]) for row in rows]

    def _relative(self, base: Evaluation, one: Evaluation) -> float:
        if not base.usable:
            return math.nan
        objective = self.problem.beside(base).objective(one)
        nothing = base.status is Status.IDLE and one is not base and objective == 1
        return math.nan if nothing else objective

    def pieces(self, span: Span, first: str, other: str) -> list[Piece]:
        """Return the parts of a range in which design `first` is worse than the `other` one.

        All other values are those of the config. Both ends of the range and the config's own value
        are compared, and changes between them are located. In place of an end without a usable
        motion, the last value before it that has one is compared."""
        key, own = span.key, self.config.value(span.key)

        def lead(value: float) -> float:
            scenes = {NOMINAL: {}} if value == own else {scene_of(key, value): {key: value}}
            (one,), (two,) = self.objectives((first, other), scenes)
            return float(one - two) - (WINS if other != BASELINE else 0.0)

        pieces: list[Piece] = []
        middle = [own] if span.low < own < span.high else []
        for low, high in itertools.pairwise([span.low, *middle, span.high]):
            a, b = _known(lead, low, high), _known(lead, high, low)
            one, two = lead(a), lead(b)
            if not max(one, two) > 0:
                continue
            change = _change(lead, a, b) if one * two < 0 else None
            # No statement is made beyond the last value with a known motion.
            start = a if one > 0 else b if change is None else change
            stop = b if two > 0 else a if change is None else change
            joined = bool(pieces) and pieces[-1][1] == start
            pieces.append((pieces.pop()[0] if joined else start, stop))
        return pieces

    def others(self) -> list[dict[str, float]]:
        """Return designs that may be better than the optimum in some of the scenes.

        They are the optimum of its worst scene, the nominal one, and those of other searches."""
        (values,), designs = self.objectives([OPTIMIZED], self.scenes), []
        if np.isfinite(values).any():
            designs += self._in_worst([*self.scenes][int(np.nanargmax(values))])
        robustness, optimality = self.result.robustness, self.result.optimality
        if robustness is not None and robustness.nominal.optimized is not None:
            designs.append(robustness.nominal.optimized.design)
        designs += [one.design for one in (optimality.optima if optimality else ())]
        return self._apart(designs, _RIVALS, _NEAR)

    def _apart(
        self, designs: Iterable[dict[str, float]], most: int, least: float
    ) -> list[dict[str, float]]:
        """Return the first `most` of some `designs` that are far from each other.

        They are farther than `least` in the unit box, also from the optimum."""
        return apart(designs, least, most, self._point, [self._point(self.designs[OPTIMIZED])])

    def _point(self, design: Mapping[str, float]) -> NDArray[np.float64]:
        return self.problem.point([*design.values()])

    def _in_worst(self, scene: str) -> list[dict[str, float]]:
        """Return the optimum in one scene, as a list; empty if the search fails.

        The best designs of the config's own scene are simulated in that scene. The search begins at
        the one that is best there."""
        ((base,),) = self.evaluations([BASELINE], one := {scene: self.scenes[scene]})
        problem, keys = self.problem.beside(base), self.config.design_keys
        rows = [x for x in self.result.history if x["feasible"] and math.isfinite(x["objective"])]
        rows.sort(key=lambda row: row["objective"])
        tried = self._apart(({key: row[key] for key in keys} for row in rows), _TRIED, _FAR)
        (where,) = _shifts(self.config, one)
        exact = self.exact[True].shifted(where.scene)
        evaluator = (exact.with_maxima() if problem.with_maxima else exact).surveying()
        look = problem.looks(evaluator)
        begins = [(local.objective, k) for k, x in enumerate(tried)
                  if (local := look(self._point(x))) is not None]  # fmt: skip
        if not begins:
            return []
        best = self._point(tried[min(begins)[1]])
        stops = Stops(evaluations=self.config.optimizer.iterations + 1, asked=self.stop)
        outcome = descend(look, best, stops, problem.limits_at)
        if outcome.local is None or outcome.local.violation > FEASIBLE:
            return []
        return [self.problem.named(outcome.point)]


def _known(lead: Callable[[float], float], end: float, other: float) -> float:
    """Return the last value on the way from `other` to `end` at which `lead` is not NaN.

    Return `end` itself if `lead` is a number there, or at neither of the two."""
    if not math.isnan(lead(end)) or math.isnan(lead(other)):
        return end
    inside = other
    for _ in range(_HALVINGS):
        middle = (inside + end) / 2
        inside, end = (inside, middle) if math.isnan(lead(middle)) else (middle, end)
    return inside


def _change(lead: Callable[[float], float], low: float, high: float) -> float | None:
    """Return where `lead` changes its sign between two values; `None` if it is NaN on the way."""
    from scipy.optimize import brentq  # Slow import (0.3 s).

    try:
        return float(brentq(lead, low, high, xtol=_FINE * (high - low)))  # pyright: ignore[reportArgumentType]
    except ValueError:  # NaN.
        return None


def _shifts(config: Config, scenes: Scenes) -> tuple[Shift, ...]:
    at = in_conditions(config, scenes)
    return shifts(at, draw(at, len(scenes))) if scenes else ()


def compared(
    given: Config,
    result: Optimization,
    runs: Runs = HERE,
    stop: Callable[[], bool] = lambda: False,
    tick: Callable[[int, int], None] = lambda done, expected: None,
) -> Assumed | None:
    """Compare baseline and optimised design of a search in the scenes of `assumptions`.

    `given`: config of the search; `result`: its outcome; `runs`: where motions are simulated;
    `stop`: returns whether to end; `tick` is called with the numbers of motions done and expected.
    Return `None` without an optimised design, without a motion (or with an average over many), if
    nothing varies, or after `stop`."""
    if result.problem is None or result.optimized is None or given.objective.motion == "ensemble":
        return None
    work = _Comparison(given, result, runs, stop, tick)
    if not work.scenes or isinstance(work.exact[True].motions, Still):
        return None
    try:
        return _compared(work)
    except _StoppedError:
        return None


def _compared(work: _Comparison) -> Assumed:
    scenes, spans = work.scenes, work.config.spans
    objectives = dict(zip(work.designs, work.objectives(work.designs, scenes), strict=True))
    others = {f"{RIVAL} {k}": one for k, one in enumerate(work.others(), start=1)}
    work.designs |= others
    for name, values in zip(others, work.objectives(others, scenes), strict=True):
        ((own,),) = work.evaluations([name], {NOMINAL: {}})
        better = np.any(objectives[OPTIMIZED] - values > WINS)
        if better and work.problem.excess(own) <= FEASIBLE:
            objectives[name] = values
    evaluations = work.evaluations(objectives, scenes)
    return Assumed(
        spans=spans,
        scenes=scenes,
        designs={name: work.designs[name] for name in objectives},
        objectives=objectives,
        statuses={
            name: [one.status.label for one in row]
            for name, row in zip(objectives, evaluations, strict=True)
        },
        worse={one.key: work.pieces(one, OPTIMIZED, BASELINE) for one in spans},
        wins={
            name: {one.key: work.pieces(one, OPTIMIZED, name) for one in spans}
            for name in objectives if name in others
        },
    )  # fmt: skip
