"""The search: screening, optax descent with projection, verification.

Screening chooses the starts from a Sobol sample of feasible designs. From each start, an optax
update rule descends in the unit box. The gradient is first projected onto the directions that
active constraints allow; each step is projected back onto the feasible set. Each orbit is the first
guess for the next orbit. The best design is simulated again from rest at a tighter tolerance before
it is reported. A search can be stopped at any time (`stop`). It then verifies the best design found
so far, unless the objective is an average over an ensemble.
"""

import dataclasses
import operator
import os
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_EXCEPTION, Future, ThreadPoolExecutor, wait
from typing import Any, TypeVar

import numpy as np
import optax
from numpy.typing import NDArray

from rootsopt.config import FAMILY_KEYS, Config
from rootsopt.design.space import Space, sobol
from rootsopt.errors import InputError
from rootsopt.optimize.problem import Problem
from rootsopt.response.evaluation import Evaluation
from rootsopt.response.evaluators import evaluator_for
from rootsopt.response.wrapper import Evaluates
from rootsopt.runtime.programs import Program
from rootsopt.scene import design_vector
from rootsopt.status import Status

T = TypeVar("T")
RULES: dict[str, Callable[..., optax.GradientTransformation]] = {
    "adam": optax.adam,
    "rmsprop": optax.rmsprop,
    "sgd": optax.sgd,
}
_PATIENCE = 4
"""Number of successive steps without a gain above which a descent ends."""
_GAIN = 1e-4
"""Relative decrease of the best objective below which a step does not count as a gain."""
_STATIONARY = 1e-3
"""Norm of the projected gradient in the unit box below which a descent ends."""
_HOLDS_UP = 0.01
"""Relative change of the objective in the verification above which a design is rejected."""
_POLL = 0.05
"""Interval (s) at which a waiting thread checks whether it should stop."""

Progress = Callable[[int, int, float], None]
"""Type of a progress callback, with arguments (evaluations done, evaluations expected, best
objective)."""


@dataclasses.dataclass(frozen=True)
class Trial:
    """One evaluated design of a search.

    `point` (d,) of the unit box; `start`: number of the descent (-1: screening); `iteration`:
    number of steps since the start of the descent; `evaluation` of the design; `objective`: NaN
    without a usable steady state; `feasible`: whether all constraints are satisfied.
    """

    point: NDArray[np.float64]
    start: int
    iteration: int
    evaluation: Evaluation
    objective: float
    feasible: bool

    @property
    def candidate(self) -> bool:
        """Whether the design may be the result: feasible, with a known objective."""
        return self.feasible and not np.isnan(self.objective)


@dataclasses.dataclass(frozen=True)
class Optimization:
    """Outcome of a search.

    `problem`: the design problem, None if the baseline has no usable steady state; `baseline`:
    evaluation of the baseline; `optimized`: evaluation of the best design, None if no design better
    than the baseline was confirmed; `history`: one row per trial; `verification`: objective in the
    search and in the verification; `interrupted`: whether the search was stopped.
    `verification["holds_up"]` is None if the search was stopped before the best design could be
    verified.
    """

    problem: Problem | None
    baseline: Evaluation
    optimized: Evaluation | None
    history: list[dict[str, Any]]
    verification: dict[str, Any]
    interrupted: bool = False

    @property
    def status(self) -> Status:
        """Status of the search as a whole."""
        if self.interrupted:
            return Status.INTERRUPTED
        if not self.baseline.usable:
            return self.baseline.status
        return Status.NOT_IMPROVED if self.optimized is None else self.optimized.status

    @property
    def improvement(self) -> dict[str, float]:
        """Reductions of objective and forces, as fractions of the baseline's values."""
        if self.problem is None or self.optimized is None:
            return {}
        gains = {"objective": 1 - self.problem.objective(self.optimized)}
        for key in ("mean_force_N", "peak_force_N", "rms_force_N"):
            before, after = self.baseline.response[key], self.optimized.response[key]
            gains[key] = 1 - after / before if before > 0 else 0.0
        return gains

    @property
    def constraints(self) -> list[dict[str, Any]]:
        """Constraints at the optimum, one row each."""
        if self.problem is None or self.optimized is None:
            return []
        return self.problem.constraint_rows(self.optimized)

    @property
    def objective_by_speed(self) -> list[dict[str, float]]:
        """Objective at the optimum at each speed, one row each; empty unless there are several
        speeds."""
        if self.problem is None or self.optimized is None:
            return []
        return self.problem.by_speed(self.optimized)


class Search:
    """One optimisation run of a config.

    `progress` is called with (evaluations done, evaluations expected, best objective). `stop`: an
    event that another thread can set to end the search early.

    Raises InputError for a profile family without design parameters.
    """

    def __init__(
        self,
        config: Config,
        progress: Progress | None = None,
        stop: threading.Event | None = None,
    ):
        if not FAMILY_KEYS[config.profile.family]:
            valid = ", ".join(family for family, keys in FAMILY_KEYS.items() if keys)
            raise InputError(
                f"`profile.family` must be one of {valid} to be optimised, but is "
                f"{config.profile.family}: it has no design parameter; use `simulate` for it"
            )
        self.config = config
        self.settings = config.optimizer
        self.progress = progress or (lambda done, expected, best: None)
        self.expected = self.settings.screening + self.settings.starts * (
            self.settings.iterations + 1
        )
        self.exact = evaluator_for(config)
        # If objectives are noisy, steps without a gain do not show that a descent has converged.
        self.noisy = config.objective.motion == "ensemble"
        self.patience = np.inf if self.noisy else _PATIENCE
        self.stop = threading.Event() if stop is None else stop
        self._lock, self._best = threading.Lock(), float("nan")
        self._trials: list[Trial] = []
        self._refuted: list[NDArray[np.float64]] = []
        self._baseline: Evaluation | None = None

    def run(self) -> Optimization:
        """Evaluate the baseline, screen, descend from the starts and verify; return the outcome.

        After `stop`, the outcome is the best design found before. It is verified, unless the
        objective is an average over an ensemble.

        Raises InputError if no design is feasible, or if the objective is not defined for the
        baseline."""
        exact = self.exact.prepare(design_vector(self.config))
        Space.of(self.config, exact.scene, 0.0).prepare()
        exact, baseline = exact.fit()
        if not baseline.usable:
            return Optimization(None, baseline, None, [], {}, self.stop.is_set())
        # Forces of coexisting motions are compared relative to the baseline's.
        self.exact = exact = exact.relative_to(baseline)
        # The search needs gradients and a ranking of designs, not the last digits.
        self.fast = exact.at_tolerance(max(1e-6, self.config.solver.rtol)).surveying()
        self.problem = Problem.of(self.config, exact.scene, baseline)
        self._baseline = baseline
        start = self.problem.point(list(baseline.design.values()))
        points = self._feasible(start)
        trials: list[Trial] = []
        if self.settings.screening:
            trials = self._side_by_side(self._screen, [(point,) for point in points])
        starts = self._starts(trials) or points[:1]
        trials += self._side_by_side(self._descend, list(enumerate(starts)))
        if self.stop.is_set():
            if self.noisy and (found := self.so_far()) is not None:
                return found
            trials = self._in_order()
        rows = _history(trials)
        if self.noisy:
            from rootsopt.optimize import noise
            from rootsopt.response.ensemble import EnsembleEvaluator

            assert isinstance(self.exact, EnsembleEvaluator)
            noise.add_errors(rows, trials, self.problem)
            found = noise.verify(self.problem, self.exact, trials)
            settled = found.problem, found.baseline, found.optimized, rows, found.record
            return Optimization(*settled, self.stop.is_set())
        optimized, verification = self._verify(trials)
        settled = self.problem, baseline, optimized, rows, verification
        return Optimization(*settled, self.stop.is_set())

    def so_far(self) -> Optimization | None:
        """Return what the search has found so far, without verification.

        The result is None until the baseline has been simulated. Another thread can call this
        method during the search."""
        if self._baseline is None:
            return None
        trials = self._in_order()
        rows = _history(trials)
        better = [
            trial
            for trial in trials
            if trial.candidate and trial.objective < 1 and not _near(trial.point, self._refuted)
        ]
        best = min(better, key=_objective, default=None)
        if self.noisy:
            from rootsopt.optimize import noise

            noise.add_errors(rows, trials, self.problem)
            best = noise.most_promising(self.problem, trials)
        verification: dict[str, Any] = {"holds_up": None, "rejected": []}
        if best is None:
            return Optimization(self.problem, self._baseline, None, rows, verification, True)
        verification |= {
            "searched_objective": best.objective,
            "verified_objective": None,
            "status": best.evaluation.status.label,
        }
        return Optimization(self.problem, self._baseline, best.evaluation, rows, verification, True)

    def _in_order(self) -> list[Trial]:
        """Return all trials so far: the screening first, then one descent after another."""
        with self._lock:
            return sorted(self._trials, key=lambda trial: (trial.start, trial.iteration))

    def _side_by_side(self, work: Callable[..., list[Trial]], tasks: Sequence) -> list[Trial]:
        """Return the trials of `work(*task)` for all tasks, in the order of the tasks.

        If `stop` is set before all tasks end, return an empty list, without waiting for evaluations
        that are still running."""
        pool = ThreadPoolExecutor(os.cpu_count())
        tasks = tasks if not self.stop.is_set() else []
        done = [pool.submit(work, *task) for task in tasks]
        try:
            pending = set(done)
            while pending and not self.stop.is_set():
                finished, pending = wait(pending, _POLL, FIRST_EXCEPTION)
                for future in finished:
                    future.result()
            return [] if pending else [trial for future in done for trial in future.result()]
        finally:
            pool.shutdown(wait=not self.stop.is_set(), cancel_futures=True)

    def _feasible(self, baseline_point) -> list[NDArray[np.float64]]:
        """Return feasible points: the baseline's and a Sobol sample, each projected if necessary.

        Points that stay infeasible are dropped. Raises InputError if no point is feasible."""
        start = self.problem.project(baseline_point)
        count, seed = self.settings.screening, self.settings.seed
        sample = sobol(count, seed, len(baseline_point))
        points = [start, *(self.problem.toward(point, start) for point in sample)]
        points = [point for point in points if self.problem.feasible(point)]
        if not points:
            raise InputError(
                "`constraints` and `optimizer.bounds` leave no feasible design; lower "
                "`constraints.area_efficiency_min`, or widen `optimizer.bounds` or the range of "
                "`constraints.outer_radius_*_mm`"
            )
        return points

    def _screen(self, point) -> list[Trial]:
        if self.stop.is_set():
            return []
        return [self._evaluate(self.fast.without_gradient(), point, start=-1, iteration=0)]

    def _starts(self, trials: list[Trial]) -> list[NDArray[np.float64]]:
        """Return the points of the best screened designs, at least 0.15 apart in the unit box."""
        chosen: list[NDArray[np.float64]] = []
        for trial in sorted(filter(_candidate, trials), key=_objective):
            apart = all(np.linalg.norm(trial.point - p) > 0.15 for p in chosen)
            if apart and len(chosen) < self.settings.starts:
                chosen.append(trial.point)
        return chosen

    def _descend(self, number: int, point: NDArray[np.float64]) -> list[Trial]:
        """Descend from `point` (d,) and return the trials; `number`: index of the descent."""
        settings = self.settings
        rule = settings.method, settings.learning_rate, settings.iterations
        state = _init(*rule, point)
        best, since = np.inf, 0
        trials: list[Trial] = []
        last: Trial | None = None
        for iteration in range(settings.iterations + 1):
            if self.stop.is_set():
                break
            orbit = last.evaluation.state if last is not None and last is trials[-1] else None
            trial = self._evaluate(self.fast, point, number, iteration, orbit)
            trials.append(trial)
            if np.isnan(trial.objective):
                # No usable steady state: go half way back to the last good design.
                if last is None:
                    break
                point = self.problem.toward((point + last.point) / 2, last.point)
                continue
            last = trial
            since = 0 if trial.objective < best * (1 - _GAIN) else since + 1
            best = min(best, trial.objective)
            if since > self.patience or iteration == settings.iterations:
                break
            slope = self.problem.descent(point, self.problem.slope(trial.evaluation, point))
            if np.linalg.norm(slope) < _STATIONARY:
                break
            update, state = _update(*rule, slope, state)
            point = self.problem.toward(point + np.asarray(update), point)
        return trials

    def _evaluate(self, evaluator: Evaluates, point, start, iteration, orbit=None) -> Trial:
        evaluation = evaluator(self.problem.design(point), start=orbit, series=False)
        objective = self.problem.objective(evaluation)
        feasible = self.problem.feasible(point)
        trial = Trial(np.asarray(point), start, iteration, evaluation, objective, feasible)
        with self._lock:
            self._trials.append(trial)
            if trial.candidate:
                self._best = float(np.fmin(self._best, objective))
            self.progress(len(self._trials), self.expected, self._best)
        return trial

    def _verify(self, trials: list[Trial]) -> tuple[Evaluation | None, dict[str, Any]]:
        """Simulate the best designs again, from rest at a tight tolerance, until one is confirmed.

        At most five designs are simulated. Return the evaluation of the confirmed design, or None,
        and a record for the result file."""
        ranked = sorted(filter(_candidate, trials), key=_objective)
        tried: list[np.ndarray] = []
        failures = []
        for candidate in ranked:
            if candidate.objective >= 1 or len(tried) >= 5:
                break
            if _near(candidate.point, tried):
                continue
            tried.append(candidate.point)
            evaluation = self.exact(self.problem.design(candidate.point))
            objective = self.problem.objective(evaluation)
            change = abs(objective / candidate.objective - 1)
            record = {
                "searched_objective": candidate.objective,
                "verified_objective": None if np.isnan(objective) else objective,
                "status": evaluation.status.label,
                "holds_up": bool(change <= _HOLDS_UP),
            }
            if change <= _HOLDS_UP and objective < 1:
                return evaluation, record | {"rejected": failures}
            failures.append(record | {"design": evaluation.design})
            self._refuted.append(candidate.point)
        return None, {"holds_up": False, "rejected": failures}


def until_stopped(work: Callable[[], T], stop: threading.Event, patience: float) -> T | None:
    """Run `work()` in its own thread and return its result, or None if it does not end in time.

    `stop`: an event that asks `work` to end. After that, this function waits at most `patience`
    (s). Because of the thread, the wait can be interrupted even during compiled code. The first
    `KeyboardInterrupt` sets `stop`; a second one is raised."""
    future: Future[T] = Future()

    def do() -> None:
        try:
            future.set_result(work())
        except BaseException as error:
            future.set_exception(error)

    threading.Thread(target=do, daemon=True).start()
    late = float("inf")
    while True:
        try:
            wait([future], _POLL)
            if stop.is_set():
                late = min(late, time.monotonic() + patience)
        except KeyboardInterrupt:
            if stop.is_set():
                raise
            stop.set()
        if future.done():
            return future.result()
        if time.monotonic() > late:
            return None


def _rule(method: str, learning_rate: float, iterations: int) -> optax.GradientTransformation:
    return RULES[method](optax.cosine_decay_schedule(learning_rate, iterations, 0.05))


@Program
def _init(method, learning_rate, iterations, point):
    """Return the state of an update rule at its first point."""
    return _rule(method, learning_rate, iterations).init(point)


@Program
def _update(method, learning_rate, iterations, slope, state):
    """Return the step of an update rule, and its next state."""
    return _rule(method, learning_rate, iterations).update(slope, state)


def _near(point: NDArray[np.float64], others: Sequence[NDArray[np.float64]]) -> bool:
    """Return whether `point` (d,) is closer than 0.02 to one of the points `others`."""
    return any(np.linalg.norm(point - other) < 0.02 for other in others)


_candidate = operator.attrgetter("candidate")
_objective = operator.attrgetter("objective")


def _history(trials: list[Trial]) -> list[dict[str, Any]]:
    """Return the rows of the history, one per trial, each with the best objective so far."""
    rows, best = [], float("nan")
    for number, trial in enumerate(trials, start=1):
        if trial.candidate:
            best = float(np.fmin(best, trial.objective))
        evaluation = trial.evaluation
        rows.append(
            {
                "evaluation": number,
                "start": trial.start,
                "iteration": trial.iteration,
                "objective": trial.objective,
                "best_objective": best,
                "mean_force_N": evaluation.response.get("mean_force_N", float("nan")),
                "peak_force_N": evaluation.response.get("peak_force_N", float("nan")),
                **evaluation.design,
                "area_efficiency": evaluation.geometry["area_efficiency"],
                "feasible": trial.feasible,
                "status": evaluation.status.label,
            }
        )
    return rows
