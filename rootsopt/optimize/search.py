"""The search: screening, local searches, and verification with a certificate.

Screening simulates a Sobol sample of feasible designs and chooses the best as starts. From each
start, a local search begins. It is either sequential quadratic programming on exact gradients
(`rootsopt.optimize.sqp`), or a descent by an optax update rule (`rootsopt.optimize.noise`). In a
local search, the last orbit is the first guess for the next.

The best design is simulated again from rest before it is reported, and its first-order conditions
are checked there (`rootsopt.optimize.verification`). A search can be stopped at any time (`stop`).
It then verifies the best design so far, unless the objective is an average over an ensemble."""

import dataclasses
import math
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rootsopt.config.families import families
from rootsopt.config.reading import Config
from rootsopt.errors import InputError
from rootsopt.optimize import noise
from rootsopt.optimize.bounding import BETTER, FIRST, MOST, PARAMETERS, QUICK, TOGETHER, Bounding
from rootsopt.optimize.infeasible import Infeasible, beginning, explain, feasible_points
from rootsopt.optimize.limits import force_limits, limited, needs_maxima
from rootsopt.optimize.local import FEASIBLE, Linearization
from rootsopt.optimize.outcome import (
    Optimization,
    Progress,
    Trial,
    apart,
    candidate,
    history_of,
    near,
    objective,
    ranked,
)
from rootsopt.optimize.robust_problem import Stage
from rootsopt.optimize.sqp import Descent, Stops, descend
from rootsopt.optimize.verification import Verification
from rootsopt.optimize.vertices import AT_VERTEX, DRAWN, VertexOptimum, vertex_optimum
from rootsopt.response.evaluation import Evaluator
from rootsopt.response.journal import Checkpoint
from rootsopt.response.reducers import HERE, Point, Runs
from rootsopt.response.result import Evaluation
from rootsopt.response.still import Still, needed_motion
from rootsopt.runtime.threads import POLL
from rootsopt.scene.space import Space

# Maximum number of points at which the search for the least violation of the limits starts if each
# point must be simulated.
_SIMULATED = 3

# Start of the trials of a lower bound, in place of the index of a local search.
_BOUND = -2

# Distances (unit box, per coordinate) from a start without a usable motion at which a local search
# begins instead.
_BESIDE = 1e-5, 1e-4, 1e-3, 1e-2


class Search:
    """One optimisation run of a config.

    `progress`: function called after each evaluation with (evaluations done, evaluations expected,
    best objective so far). `stop`: event that another thread can set to end the search early.
    `checkpoint`: file that stores every evaluation and supplies those of an interrupted search;
    `runs`: where screening and local searches evaluate designs; `stage`: what differs from the
    usual search.

    Raises `InputError` if there is no design parameter."""

    def __init__(
        self,
        config: Config,
        progress: Progress | None = None,
        stop: threading.Event | None = None,
        checkpoint: Checkpoint | None = None,
        runs: Runs = HERE,
        stage: Stage | None = None,
    ):
        self.runs, self.stage = runs, Stage() if stage is None else stage
        self.beginning = beginning(config)
        self.given = config = limited(config)
        if self.beginning is not None:
            config = limited(self.beginning.config)
            if config.objective.motion == "ensemble":
                raise InputError(
                    "`objective.motion` must not be ensemble for a rotor from a file, because it "
                    "has no design parameters; choose another motion"
                )
        if not config.design_keys:
            valid = ", ".join(name for name, family in families().items() if family.keys)
            raise InputError(
                f"`profile.family` must be one of {valid} to be optimised, but is "
                f"{config.profile.family}: it has no design parameter; use `simulate` for it, "
                "or make the twist one with `optimizer.bounds.helix_deg`"
            )
        if config.optimizer.prove is True and len(config.design_keys) > PARAMETERS:
            raise InputError(
                f"`optimizer.prove` must be auto or false for {len(config.design_keys)} design "
                f"parameters, but is true: a lower bound takes at most {PARAMETERS}"
            )
        evaluator = needed_motion(config)
        if isinstance(evaluator.motions, Still):
            # No motion is simulated, so the choice of motions has no effect.
            config = config.replaced({"objective.motion": "reached"})
            self.given = self.given.replaced({"objective.motion": "reached"})
        self.config = config
        changes = {} if self.stage.broad else {"screening": 0}
        self.settings = config.optimizer.model_copy(update=changes)
        self.progress = progress or (lambda done, expected, best: None)
        self.expected = self.settings.screening + self.settings.starts * (
            self.settings.iterations + 1
        )
        self.exact = self.stage.evaluator(evaluator, runs)
        self.noisy = config.objective.motion == "ensemble"
        self.checkpoint = checkpoint or Checkpoint({}, None)
        self.stop = threading.Event() if stop is None else stop
        self._lock, self._best = threading.Lock(), float("nan")
        self._trials: list[Trial] = []
        self._refuted: list[NDArray[np.float64]] = []
        self._descents: dict[int, Descent] = {}
        self._baseline: Evaluation | None = None
        # A baseline that violates a limit may be better than every feasible design.
        self._bar = 1.0

    def run(self) -> Optimization:
        """Evaluate the baseline, screen designs, run the local searches and verify the best design.

        If the baseline's profile is from a file, also evaluate the fitted design that begins the
        search.

        Return the outcome. If `stop` is set, the outcome is the best design so far. It is then
        verified unless the objective is an average over an ensemble.

        Raises `InputError` if the objective is not defined for the baseline."""
        return dataclasses.replace(self._run(), beginning=self.beginning)

    def _run(self) -> Optimization:
        maxima = needs_maxima(self.config, force_limits(self.config, self.exact.scene))
        exact = self.exact
        exact.prepare(maxima=maxima)
        Space.of(self.config, exact.scene).prepare()
        first = exact()
        baseline, source = first, exact
        if self.beginning is not None:
            self.beginning = dataclasses.replace(self.beginning, evaluation=first)
            source = self.stage.evaluator(needed_motion(self.given), self.runs)
            baseline = source()
        if not baseline.usable:
            return Optimization(None, baseline, None, [], {}, self.stop.is_set())
        # Forces of coexisting motions are compared relative to the baseline's.
        self.exact = exact = exact.relative_to(baseline)
        # A coarse tolerance suffices to rank designs and for a descent. The baseline may be of
        # another family, so it has an evaluator of its own (`source`).
        rtol = max(1e-6, self.config.solver.orbit_tolerance)
        self.fast, self.source = (
            one.at_tolerance(rtol).surveying() for one in (exact, source.relative_to(baseline))
        )
        self.problem = self.stage.problem(self.config, exact.scene, baseline)
        self._bar = np.inf if self.problem.broken(baseline) else 1.0
        if self.problem.with_maxima:
            self.exact = exact.with_maxima()
        # Sequential quadratic programming needs more accurate gradients than a descent.
        self.sharp = self.exact.surveying()
        self._baseline = baseline
        start = self.problem.point(list(first.design.values()))
        sample = self.stage.sample(self.problem, start, self.settings)
        points, reason = feasible_points(self.problem, sample)
        if reason is not None:
            return Optimization(
                self.problem, baseline, None, [], {}, self.stop.is_set(), infeasible=reason
            )
        screens = bool(self.settings.screening)
        trials = self._side_by_side(self._screen, [*enumerate(points)]) if screens else []
        starts = self._starts(points, trials) or points[:1]
        work = self._descend if self.noisy else self._solve
        trials += self._side_by_side(work, list(enumerate(starts, self.stage.first)))
        bounding, further = self._bounded(trials, self.stage.first + len(starts))
        trials += further
        if self.stop.is_set():
            if self.noisy and (outcome := self.so_far()) is not None:
                return outcome
            trials = self._in_order()
        if self.problem.limits and not any(trial.candidate for trial in trials):
            further, reason = self._unmet(points, self.stage.first + len(starts))
            trials += further
        rows = history_of(trials)
        if self.noisy:
            noise.add_errors(rows, trials, self.problem)
            outcome = noise.verify(self.problem, self.exact, trials)
            return dataclasses.replace(outcome, history=rows, interrupted=self.stop.is_set())
        if self.problem.limits and not any(trial.candidate for trial in trials):
            return Optimization(
                self.problem, baseline, None, rows, {}, self.stop.is_set(), infeasible=reason
            )
        verification = self._verification()
        optimized, record = verification.confirmed(trials)
        optimality = None if optimized is None else verification.optimality(optimized)
        if optimality is not None and optimized is not None and bounding is not None:
            bound = bounding.bound(self.problem.objective(optimized))
            optimality = dataclasses.replace(optimality, bound=bound)
        if optimality is not None and optimized is not None and optimality.converged:
            vertex = self._vertex(optimized, trials)
            optimality = dataclasses.replace(optimality, vertex=vertex)
        return Optimization(
            self.problem, baseline, optimized, rows, record, self.stop.is_set(), optimality
        )

    def _starts(self, points: list[NDArray[np.float64]], trials: list[Trial]) -> list[NDArray]:
        """Return where the local searches begin, apart from each other.

        They are the best of the `trials` of the screening; without one, the first of the `points`
        (d,)."""
        if not self.settings.screening:
            return apart(points, self.stage.apart, self.settings.starts)
        # Limits may leave only a small part of the bounds.
        extent = float(np.max(np.ptp(points, axis=0)))
        return apart(ranked(trials), extent * self.stage.apart, self.settings.starts)

    def _bounded(self, trials: list[Trial], number: int) -> tuple[Bounding | None, list[Trial]]:
        """Look for a lower bound of the objective, and search again from each better design.

        `trials`: those of the search so far; `number`: index of its next local search. Return the
        bound (`None` if it is not requested), and the trials of further searches."""
        candidates = [one for one in trials if one.candidate]
        size = len(trials[0].point) if trials else 0
        given = self.settings.prove
        quick = size <= QUICK and FIRST * (size + 1) <= len(trials)
        asked = self.stage.broad and not self.noisy and size <= PARAMETERS and given is not False
        if not (asked and candidates and (quick or given is True)):
            return None, []
        # By default the bound may cost about as much as the search.
        most, boxes = MOST if given is True else (3 * len(trials) // 2, 18 * len(trials))
        best = min(candidates, key=objective).objective
        bounding = Bounding(self.problem.limits_at, size, best, boxes)
        known, further, count = [], [], 0

        def told(batch: list[Trial]) -> None:
            for one in batch:
                bounding.tell(one.point, self.problem.local(one.evaluation, one.point))
            known.extend(one for one in batch if one.evaluation.usable)

        told(trials)
        while count < most and (points := bounding.ask(TOGETHER)):
            best, batch = bounding.best, self._beside(known, points, count)
            told(batch)
            count += len(points)
            if self.stop.is_set():
                break
            first = min(filter(candidate, batch), key=objective, default=None)
            if first is not None and first.objective < best - BETTER * abs(best):
                further += (again := self._side_by_side(self._solve, [(number, first.point)]))
                told(again)
                number += 1
        return bounding, further

    def _vertex(self, optimized: Evaluation, trials: list[Trial]) -> VertexOptimum | None:
        """Return the facts on an optimum at a vertex of the limits; `None` for any other optimum.

        Simulate at most as many designs as the search had `trials`. Return `None` also for an
        objective over a sample, and with more than `PARAMETERS` parameters."""
        if not self.stage.broad or len(optimized.design) > PARAMETERS:
            return None
        known = [one for one in trials if one.evaluation.usable]

        def simulated(points: list[NDArray[np.float64]]) -> list[float]:
            batch = self._beside(known, points, AT_VERTEX)
            values = [x.objective if x.excess <= FEASIBLE else math.nan for x in batch]
            return values or [math.nan] * len(points)

        point = self.problem.point([*optimized.design.values()])
        return vertex_optimum(self.problem, point, simulated, min(len(trials), DRAWN))

    def _beside(
        self, known: list[Trial], points: list[NDArray[np.float64]], number: int
    ) -> list[Trial]:
        """Evaluate `points` (d,), each from the nearest of the `known` orbits.

        `number`: that of the first trial. Return none if the search is stopped."""

        def evaluated(number: int, point: NDArray[np.float64], orbit: Any) -> list[Trial]:
            return [self._evaluate(self.sharp, point, _BOUND, number, orbit)]

        tasks = []
        for place, point in enumerate(points, number):
            near = min(known, key=lambda one: float(np.linalg.norm(one.point - point)))
            tasks.append((place, point, near.evaluation.start))
        self.expected = max(self.expected, len(self._trials) + len(tasks))
        return self._side_by_side(evaluated, tasks)

    def _verification(self) -> Verification:
        outcome = self._bar, self.stop.is_set, self._descents, self._refuted
        return Verification(self.problem, self.exact, *outcome)

    def so_far(self) -> Optimization | None:
        """Return the results of the search so far, without verification.

        Return `None` until the baseline has been simulated. Another thread can call this method
        during the search."""
        if self._baseline is None:
            return None
        trials = self._in_order()
        rows = history_of(trials)
        better = [
            trial
            for trial in trials
            if trial.candidate
            and trial.objective < self._bar
            and not near(trial.point, self._refuted)
        ]
        best = min(better, key=objective, default=None)
        if self.noisy:
            noise.add_errors(rows, trials, self.problem)
            best = noise.most_promising(self.problem, trials)
        verification: dict[str, Any] = {"holds_up": None, "rejected": []}
        if best is not None:
            verification |= {
                "searched_objective": best.objective,
                "verified_objective": None,
                "status": best.evaluation.status.label,
            }
        optimized = None if best is None else best.evaluation
        return Optimization(
            self.problem, self._baseline, optimized, rows, verification, True,
            beginning=self.beginning,
        )  # fmt: skip

    def _in_order(self) -> list[Trial]:
        """Return all trials so far: those of the screening, then those of each local search."""
        with self._lock:
            trials = [trial for trial in self._trials if trial.start > _BOUND]
        return sorted(trials, key=lambda trial: (trial.start, trial.iteration))

    def _side_by_side(self, work: Callable[..., list[Trial]], tasks: Sequence) -> list[Trial]:
        """Run `work(*task)` for all tasks in parallel, and return all trials.

        The trials are in the order of the tasks. If `stop` is set before all tasks end, return an
        empty list at once, without waiting for running evaluations."""
        pool = ThreadPoolExecutor(self.runs.slots)
        tasks = tasks if not self.stop.is_set() else []
        done = [pool.submit(work, *task) for task in tasks]
        try:
            pending = set(done)
            while pending and not self.stop.is_set():
                finished, pending = wait(pending, POLL, FIRST_EXCEPTION)
                for future in finished:
                    future.result()
            return [] if pending else [trial for future in done for trial in future.result()]
        finally:
            pool.shutdown(wait=not self.stop.is_set(), cancel_futures=True)

    def _screen(self, number: int, point) -> list[Trial]:
        if self.stop.is_set():
            return []
        return [self._evaluate(self.fast.without_gradient(), point, -1, 0, key=(-1, number))]

    def _unmet(
        self, points: list[NDArray[np.float64]], number: int
    ) -> tuple[list[Trial], Infeasible | None]:
        """Return the trials of a further local search, and why no design satisfies the limits of
        forces (`None` if the search was stopped).

        There are trials only if a design satisfies the limits after all; the search begins there.
        `points`: feasible points (d,), used if the local searches found none; `number`: index of
        the local search."""
        if self.stop.is_set():
            return [], None
        look = self.problem.looks(self.sharp)
        usable = [outcome for outcome in self._descents.values() if outcome.local is not None]
        usable.sort(key=lambda outcome: outcome.local.violation if outcome.local else np.inf)
        begins = [outcome.point for outcome in usable[: _SIMULATED - 1]] + points[:1]
        reason = explain(
            self.problem, begins, lambda point: None if self.stop.is_set() else look(point)
        )
        point = reason.feasible(self.problem)
        return ([] if point is None else self._side_by_side(self._solve, [(number, point)])), reason

    def _solve(self, number: int, point: NDArray[np.float64]) -> list[Trial]:
        """Search from `point` (d,) by sequential quadratic programming, and return the trials.

        `number`: index of the local search."""
        trials: list[Trial] = []
        last: list[Trial] = []

        def look(point: NDArray[np.float64]) -> Linearization | None:
            orbit = last[-1].evaluation.start if last else None
            trial = self._evaluate(self.sharp, point, number, len(trials), orbit)
            trials.append(trial)
            if trial.local is not None:
                last.append(trial)
            return trial.local

        stops = Stops(evaluations=self.settings.iterations + 1, asked=self.stop.is_set)
        for begin in (point, *self.problem.nearby(point, _BESIDE)):
            if self.stop.is_set():
                break
            outcome = descend(look, begin, stops, self.problem.limits_at)
            with self._lock:
                self._descents[number] = outcome
            if outcome.local is not None:
                break
        return trials

    def _descend(self, number: int, point: NDArray[np.float64]) -> list[Trial]:
        """Descend from `point` (d,) by Adam's rule, and return the trials.

        `number`: index of the local search."""

        def evaluate(point: NDArray[np.float64], iteration: int, orbit: Any) -> Trial:
            return self._evaluate(self.fast, point, number, iteration, orbit)

        iterations, asked = self.settings.iterations, self.stop.is_set
        return noise.descended(self.problem, evaluate, point, iterations, asked)

    def _evaluate(
        self, evaluator: Evaluator, point, start, iteration, orbit=None, key=None
    ) -> Trial:
        """Evaluate a `point` (d,), or use its stored evaluation, and return it as a new trial.

        `start`, `iteration`: as in `Trial`; `orbit`: where the motion begins; `key`: key in the
        checkpoint, by default (`start`, `iteration`)."""
        point = np.array(point, dtype=np.float64)
        # A sample is distributed by its evaluator.
        runs = HERE if evaluator.shifts else self.runs
        asked = Point(evaluator, self.problem.design(point), orbit)
        key = key or (start, iteration)
        evaluation = self.checkpoint.evaluated(runs.evaluated, key, asked, point)
        objective = self.problem.objective(evaluation)
        feasible, excess = self.problem.feasible(point), self.problem.excess(evaluation)
        searched = start >= 0 and not self.noisy
        local = self.stage.local(self.problem, start, evaluation, point) if searched else None
        trial = Trial(point, start, iteration, evaluation, objective, feasible, local, excess)
        with self._lock:
            self._trials.append(trial)
            if trial.candidate:
                self._best = float(np.fmin(self._best, objective))
            self.progress(len(self._trials), self.expected, self._best)
        return trial
