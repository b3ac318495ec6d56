"""The search: screening, local searches, and verification with a certificate.

Screening simulates a Sobol sample of feasible designs and chooses the best as starts. From each
start, a local search begins. It is either sequential quadratic programming on exact gradients
(`rootsopt.optimize.sqp`), or a descent by an optax update rule. The descent projects the gradient
onto the directions that active constraints allow, and each new point onto the feasible set. In a
local search, the last orbit is the first guess for the next.

The best design is simulated again from rest before it is reported, and its first-order conditions
are checked there. A search can be stopped at any time (`stop`). It then verifies the best design so
far, unless the objective is an average over an ensemble."""

import dataclasses
import operator
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_EXCEPTION, Future, ThreadPoolExecutor, wait
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from rootsopt.config import FAMILY_KEYS, Config
from rootsopt.design.space import Space, sobol
from rootsopt.errors import InputError
from rootsopt.optimize.beginning import Beginning, beginning
from rootsopt.optimize.certificate import RESIDUAL, Certificate, certify
from rootsopt.optimize.infeasible import Infeasible, explain
from rootsopt.optimize.limits import force_limits, limited
from rootsopt.optimize.local import Local
from rootsopt.optimize.optimality import Optimality, StartOutcome, judged
from rootsopt.optimize.problem import FEASIBLE, Problem, needs_maxima
from rootsopt.optimize.sqp import Found, Stops, descend
from rootsopt.response.checkpoint import Checkpoint
from rootsopt.response.evaluation import Evaluation, Evaluator
from rootsopt.response.many import HERE, Point, Runs
from rootsopt.response.sensitivity import by_scene, quantities
from rootsopt.response.starts import Seeds
from rootsopt.runtime.programs import Program
from rootsopt.scene import Scene
from rootsopt.status import Status

if TYPE_CHECKING:
    from rootsopt.optimize.robust import Robustness

T = TypeVar("T")
_PATIENCE = 4
"""Number of successive steps without a gain above which a descent ends."""
_GAIN = 1e-4
"""Relative decrease of the best objective below which a step does not count as a gain."""
_STATIONARY = 1e-3
"""Norm of the projected gradient (objective per side of the unit box) below which a descent ends.
"""
_HOLDS_UP = 0.01
"""Relative difference between a design's objectives in search and verification above which the
design is rejected."""
_SHARPER = 0.01
"""Factor on the tolerance of orbits for a second evaluation, if the first-order conditions do not
hold."""
_BESIDE = 1e-6, 1e-5, 3e-5, 1e-4
"""Distances (unit box, per coordinate) from a design at which its verification is repeated."""
_MEETS = 1e-4
"""Scaled excess over a force limit above which the verification rejects a design."""
_EXPLAINED = 8
"""Maximum number of points at which the search for the least violation of the constraints starts.
"""
_SIMULATED = 3
"""Maximum number of these points if each must be simulated."""
_POLL = 0.05
"""Interval (s) at which a waiting thread checks whether it should stop."""

Progress = Callable[[int, int, float], None]
"""Type of a progress callback, with arguments (evaluations done, evaluations expected, best
objective)."""


@dataclasses.dataclass(frozen=True)
class Trial:
    """One evaluated design of a search.

    `point` (d,): the design in the unit box. `start`: index of the local search, -1 for the
    screening. `iteration`: index of the evaluation in the local search. `evaluation`:
    result of the simulation. `objective`: its objective, NaN without a usable steady state.
    `feasible`: whether all constraints of the geometry are satisfied. `local`: objective and
    constraints with gradients, `None` if not known. `excess`: scaled amount by which limits of
    forces are exceeded, at most 0 if they hold."""

    point: NDArray[np.float64]
    start: int
    iteration: int
    evaluation: Evaluation
    objective: float
    feasible: bool
    local: Local | None = None
    excess: float = 0.0

    @property
    def residual(self) -> float:
        """Residual of the first-order conditions at the point; NaN if not known."""
        return float("nan") if self.local is None else certify(self.local, self.point).residual

    @property
    def candidate(self) -> bool:
        """Whether the design may become the result: it is feasible and has an objective."""
        return self.begins and self.excess <= FEASIBLE

    @property
    def begins(self) -> bool:
        """Whether a local search may begin at the design: only limits of forces may be violated."""
        return self.feasible and not np.isnan(self.objective)


@dataclasses.dataclass(frozen=True)
class Optimization:
    """Outcome of a search.

    `problem`: the design problem, `None` if the baseline has no usable steady state. `baseline`:
    evaluation of the baseline. `optimized`: evaluation of the best design, `None` if no design
    better than the baseline was confirmed. `history`: one row per trial.

    `verification`: the best design's objective in the search and in the verification, and
    `holds_up`: whether they agree. `holds_up` is `None` if the search was stopped before the
    verification. `interrupted`: whether the search was stopped.

    `optimality`: first-order conditions at the best design, and outcomes of the local searches. It
    is `None` without a verified design, or if the objective is an average over an ensemble.
    `infeasible`: why no design satisfies all constraints, `None` if a design does. `robustness`:
    the nominal optimum and the comparison with it, if scene or design scatter (`tolerances`).
    `beginning`: the fitted design that began the search; `None` unless the baseline's profile is
    from a file.

    >>> import jax
    >>> import rootsopt
    >>> jax.config.update("jax_enable_x64", True)
    >>> quick = ["optimizer.starts=1", "optimizer.screening=0", "optimizer.iterations=2"]
    >>> found = rootsopt.optimize_design(rootsopt.load_config("cic", quick))
    >>> sorted(found.improvement)
    ['mean_force_N', 'objective', 'peak_force_N', 'rms_force_N']
    """

    problem: Problem | None
    baseline: Evaluation
    optimized: Evaluation | None
    history: list[dict[str, Any]]
    verification: dict[str, Any]
    interrupted: bool = False
    optimality: Optimality | None = None
    infeasible: Infeasible | None = None
    robustness: "Robustness | None" = None
    beginning: Beginning | None = None

    @property
    def status(self) -> Status:
        """Status of the search as a whole."""
        if self.interrupted:
            return Status.INTERRUPTED
        if not self.baseline.usable:
            return self.baseline.status
        if self.infeasible is not None:
            return Status.INFEASIBLE
        if self.optimized is None:
            return Status.NOT_IMPROVED
        if self.optimality is not None and not self.optimality.converged:
            return Status.NOT_CONVERGED
        return self.optimized.status

    @property
    def improvement(self) -> dict[str, float]:
        """Reductions of the objective and of the mean, peak and RMS force.

        Each is a fraction of the baseline's value. The mapping is empty without an optimised
        design."""
        return self._gains(self.baseline, 1.0)

    @property
    def nominal(self) -> Evaluation | None:
        """Evaluation of the family member fitted to a baseline from a file.

        `None` without such a baseline, or if the member has no usable steady state."""
        found = None if self.beginning is None else self.beginning.evaluation
        return found if found is not None and found.usable else None

    @property
    def improvement_over_nominal(self) -> dict[str, float]:
        """The same reductions as fractions of the values of `nominal`; empty without it.

        The difference from `improvement` is the share of the measured rotor's own deviations."""
        if self.problem is None or self.nominal is None:
            return {}
        return self._gains(self.nominal, self.problem.objective(self.nominal))

    def _gains(self, first: Evaluation, objective: float) -> dict[str, float]:
        """Return the reductions with respect to the evaluation `first` with this objective."""
        if self.problem is None or self.optimized is None:
            return {}
        gains = {"objective": 1 - self.problem.objective(self.optimized) / objective}
        for key in ("mean_force_N", "peak_force_N", "rms_force_N"):
            before, after = first.response[key], self.optimized.response[key]
            gains[key] = 1 - after / before if before > 0 else 0.0
        return gains

    @property
    def cost(self) -> str:
        """Sentence for a design that is worse than the baseline, because this violates limits.

        It is empty for a better design, and without an optimised one."""
        gain = self.improvement.get("objective", 0.0)
        if self.problem is None or gain >= 0:
            return ""
        names = ", ".join(self.problem.broken(self.baseline))
        return (
            f"The baseline violates: {names}. The reported design is the best that was found to "
            f"meet all limits. Its objective is {-100 * gain:.3g} % above that of the baseline."
        )

    @property
    def constraints(self) -> list[dict[str, Any]]:
        """Constraints at the optimum, one row each; empty without an optimised design."""
        if self.problem is None or self.optimized is None:
            return []
        certificate = None if self.optimality is None else self.optimality.certificate
        return self.problem.constraint_rows(self.optimized, certificate)

    @property
    def objective_by_speed(self) -> list[dict[str, float]]:
        """Objective of the optimised design at each speed, one row per speed.

        The list is empty without `objective.speeds_rpm` or without an optimised design."""
        if self.problem is None or self.optimized is None:
            return []
        return self.problem.by_speed(self.optimized)


class Search:
    """One optimisation run of a config.

    `progress`: function called after each evaluation with (evaluations done, evaluations expected,
    best objective so far). `stop`: event that another thread can set to end the search early.
    `checkpoint`: file that stores every evaluation and supplies those of an interrupted search;
    `runs`: where screening and local searches evaluate designs.

    Raises `InputError` if there is no design parameter, or if the optimisation
    method does not suit the objective."""

    first = 0
    """Index of the first local search."""

    def __init__(
        self,
        config: Config,
        progress: Progress | None = None,
        stop: threading.Event | None = None,
        checkpoint: Checkpoint | None = None,
        runs: Runs = HERE,
    ):
        self.runs = runs
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
            valid = ", ".join(family for family, keys in FAMILY_KEYS.items() if keys)
            raise InputError(
                f"`profile.family` must be one of {valid} to be optimised, but is "
                f"{config.profile.family}: it has no design parameter; use `simulate` for it, "
                "or make the twist one with `optimizer.bounds.helix_deg`"
            )
        self.config = config
        self.settings = config.optimizer
        self.progress = progress or (lambda done, expected, best: None)
        self.method = method_of(config)
        self.expected = self.settings.screening + self.settings.starts * (
            self.settings.iterations + 1
        )
        self.exact = Evaluator.of_objective(config)
        # If objectives are noisy, steps without a gain do not show that a descent has converged.
        self.noisy = config.objective.motion == "ensemble"
        self.patience = np.inf if self.noisy else _PATIENCE
        self.checkpoint = checkpoint
        self.stop = threading.Event() if stop is None else stop
        self._lock, self._best = threading.Lock(), float("nan")
        self._trials: list[Trial] = []
        self._refuted: list[NDArray[np.float64]] = []
        self._found: dict[int, Found] = {}
        self._baseline: Evaluation | None = None
        # A baseline that violates a limit may be better than every design that does not.
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
        Space.of(self.config, exact.scene, 0.0).prepare()
        first = exact()
        baseline = first
        if self.beginning is not None:
            self.beginning = dataclasses.replace(self.beginning, evaluation=first)
            baseline = Evaluator.of_objective(self.given)()
        if not baseline.usable:
            return Optimization(None, baseline, None, [], {}, self.stop.is_set())
        # Forces of coexisting motions are compared relative to the baseline's.
        self.exact = exact = exact.relative_to(baseline)
        # Screening and descent need a ranking of designs and gradients, but only a few digits.
        self.fast = exact.at_tolerance(max(1e-6, self.config.solver.orbit_tolerance)).surveying()
        self.problem = self._problem(exact.scene, baseline)
        self._bar = np.inf if self.problem.broken(baseline) else 1.0
        if self.problem.with_maxima:
            self.exact = exact.with_maxima()
        # Sequential quadratic programming needs more accurate gradients than a descent.
        self.sharp = self.exact.surveying()
        self._baseline = baseline
        start = self.problem.point(list(first.design.values()))
        points = self._feasible(start)
        if not points:
            reason = explain(self.problem, self._sample[:_EXPLAINED])
            nothing = None, [], {}, self.stop.is_set(), None, reason
            return Optimization(self.problem, baseline, *nothing)
        trials: list[Trial] = []
        if self.settings.screening:
            trials = self._side_by_side(self._screen, list(enumerate(points)))
        starts = self._starts(trials) or points[:1]
        work = self._solve if self.method == "slsqp" else self._descend
        trials += self._side_by_side(work, list(enumerate(starts, self.first)))
        if self.stop.is_set():
            if self.noisy and (found := self.so_far()) is not None:
                return found
            trials = self._in_order()
        rows = _history(trials)
        if self.noisy:
            from rootsopt.optimize import noise

            noise.add_errors(rows, trials, self.problem)
            found = noise.verify(self.problem, self.exact, trials)
            settled = found.problem, found.baseline, found.optimized, rows, found.record
            return Optimization(*settled, self.stop.is_set())
        if self.problem.limits and not any(trial.candidate for trial in trials):
            reason = None if self.stop.is_set() else self._unmet(points)
            return Optimization(
                self.problem, baseline, None, rows, {}, self.stop.is_set(), None, reason
            )
        optimized, verification = self._verify(trials)
        settled = self.problem, baseline, optimized, rows, verification
        optimality = None if optimized is None else self._optimality(optimized, trials)
        return Optimization(*settled, self.stop.is_set(), optimality)

    def _problem(self, scene: Scene, baseline: Evaluation) -> Problem:
        """Return the design problem, given the scene and the evaluated `baseline`."""
        return Problem.of(self.config, scene, baseline)

    def _local(self, start: int, evaluation: Evaluation, point) -> Local | None:
        """Return objective and constraints at a `point` (d,) of the local search `start`."""
        del start
        return self.problem.local(evaluation, point)

    def so_far(self) -> Optimization | None:
        """Return what the search has found so far, without verification.

        Return `None` until the baseline has been simulated. Another thread can call this method
        during the search."""
        if self._baseline is None:
            return None
        return dataclasses.replace(self._so_far(self._baseline), beginning=self.beginning)

    def _so_far(self, baseline: Evaluation) -> Optimization:
        trials = self._in_order()
        rows = _history(trials)
        better = [
            trial
            for trial in trials
            if trial.candidate
            and trial.objective < self._bar
            and not _near(trial.point, self._refuted)
        ]
        best = min(better, key=_objective, default=None)
        if self.noisy:
            from rootsopt.optimize import noise

            noise.add_errors(rows, trials, self.problem)
            best = noise.most_promising(self.problem, trials)
        verification: dict[str, Any] = {"holds_up": None, "rejected": []}
        if best is None:
            return Optimization(self.problem, baseline, None, rows, verification, True)
        verification |= {
            "searched_objective": best.objective,
            "verified_objective": None,
            "status": best.evaluation.status.label,
        }
        return Optimization(self.problem, baseline, best.evaluation, rows, verification, True)

    def _in_order(self) -> list[Trial]:
        """Return all trials so far: those of the screening, then those of each local search."""
        with self._lock:
            return sorted(self._trials, key=lambda trial: (trial.start, trial.iteration))

    def _side_by_side(self, work: Callable[..., list[Trial]], tasks: Sequence) -> list[Trial]:
        """Run `work(*task)` for all tasks in parallel, and return all trials.

        The trials are in the order of the tasks. If `stop` is set before all tasks end, return an
        empty list at once: evaluations that are still running are not waited for."""
        pool = ThreadPoolExecutor(self.runs.slots)
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
        """Return the baseline's point and a Sobol sample, moved onto the feasible set.

        Points that remain infeasible are left out."""
        start = self.problem.project(baseline_point)
        count, seed = self.settings.screening, self.settings.seed
        sample = sobol(count, seed, len(baseline_point))
        points = [start, *(self.problem.toward(point, start) for point in sample)]
        self._sample = points
        return [point for point in points if self.problem.feasible(point)]

    def _screen(self, number: int, point) -> list[Trial]:
        if self.stop.is_set():
            return []
        return [self._evaluate(self.fast.without_gradient(), point, -1, 0, key=(-1, number))]

    def _starts(self, trials: list[Trial]) -> list[NDArray[np.float64]]:
        """Return the best screened points as starts of the local searches.

        Designs that meet the limits of forces come first, then those that exceed them least.
        The starts are more than 0.15 apart in the unit box."""
        chosen: list[NDArray[np.float64]] = []
        able = [trial for trial in trials if trial.begins]
        for trial in sorted(able, key=lambda one: (max(one.excess, FEASIBLE), one.objective)):
            apart = all(np.linalg.norm(trial.point - p) > 0.15 for p in chosen)
            if apart and len(chosen) < self.settings.starts:
                chosen.append(trial.point)
        return chosen

    def _unmet(self, points: list[NDArray[np.float64]]) -> Infeasible:
        """Return why no design satisfies the limits of forces.

        `points`: feasible points (d,), used if the local searches found none."""
        starts: list[Seeds] = [None]

        def look(point: NDArray[np.float64]) -> Local | None:
            if self.stop.is_set():
                return None
            evaluation = self.sharp(self.problem.design(point), start=starts[-1], series=False)
            if evaluation.usable:
                starts.append(evaluation.start)
            return self.problem.local(evaluation, point)

        usable = [found for found in self._found.values() if found.local is not None]
        usable.sort(key=lambda found: found.local.violation if found.local else np.inf)
        begins = [found.point for found in usable[: _SIMULATED - 1]] + points[:1]
        return explain(self.problem, begins, look)

    def _solve(self, number: int, point: NDArray[np.float64]) -> list[Trial]:
        """Search from `point` (d,) by sequential quadratic programming, and return the trials.

        `number`: index of the local search."""
        trials: list[Trial] = []
        last: list[Trial] = []

        def look(point: NDArray[np.float64]) -> Local | None:
            orbit = last[-1].evaluation.start if last else None
            trial = self._evaluate(self.sharp, point, number, len(trials), orbit)
            trials.append(trial)
            if trial.local is not None:
                last.append(trial)
            return trial.local

        stops = Stops(evaluations=self.settings.iterations + 1, asked=self.stop.is_set)
        if not self.stop.is_set():
            found = descend(look, point, stops, self.problem.limits_at)
            with self._lock:
                self._found[number] = found
        return trials

    def _descend(self, number: int, point: NDArray[np.float64]) -> list[Trial]:
        """Descend from `point` (d,) by an update rule, and return the trials.

        `number`: index of the local search."""
        settings = self.settings
        rule = self.method, settings.learning_rate, settings.iterations
        state = _init(*rule, point)
        best, since = np.inf, 0
        trials: list[Trial] = []
        last: Trial | None = None
        for iteration in range(settings.iterations + 1):
            if self.stop.is_set():
                break
            orbit = last.evaluation.start if last is not None and last is trials[-1] else None
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

    def _evaluate(
        self, evaluator: Evaluator, point, start, iteration, orbit=None, key=None
    ) -> Trial:
        """Evaluate a `point` (d,), or use its stored evaluation, and return it as a new trial.

        `start`, `iteration`: as in `Trial`; `orbit`: where the motion begins; `key`: key in the
        checkpoint, by default (`start`, `iteration`)."""
        point = np.array(point, dtype=np.float64)
        key = (start, iteration) if key is None else key
        kept = None if self.checkpoint is None else self.checkpoint.known(key, point)
        if kept is None:
            # A sample is distributed by its evaluator.
            runs = HERE if evaluator.shifts else self.runs
            evaluation = runs.evaluated(Point(evaluator, self.problem.design(point), orbit))
            if self.checkpoint is not None:
                self.checkpoint.keep(key, point, evaluation)
        else:
            evaluation = kept
        objective = self.problem.objective(evaluation)
        feasible, excess = self.problem.feasible(point), self.problem.excess(evaluation)
        local = None
        if start >= 0 and not self.noisy:
            local = self._local(start, evaluation, point)
        trial = Trial(point, start, iteration, evaluation, objective, feasible, local, excess)
        with self._lock:
            self._trials.append(trial)
            if trial.candidate:
                self._best = float(np.fmin(self._best, objective))
            self.progress(len(self._trials), self.expected, self._best)
        return trial

    def _verify(self, trials: list[Trial]) -> tuple[Evaluation | None, dict[str, Any]]:
        """Simulate the best designs again, from rest at a tight tolerance, until one is confirmed.

        Return (evaluation of this design, or `None`; record for the result file)."""
        ends = {found.point.tobytes() for found in self._found.values()}
        ranked = sorted(filter(_candidate, trials), key=_objective)
        # Try the results of the local searches first. Points next to them are hardly different.
        ranked.sort(key=lambda trial: trial.point.tobytes() not in ends)
        tried: list[np.ndarray] = []
        failures = []
        for candidate in ranked:
            if candidate.objective >= self._bar or len(tried) >= 5:
                break
            if _near(candidate.point, tried):
                continue
            tried.append(candidate.point)
            evaluation, record = self._again(candidate)
            if record["holds_up"] and record["verified_objective"] < self._bar:
                return evaluation, record | {"rejected": failures}
            failures.append(record | {"design": evaluation.design})
            self._refuted.append(candidate.point)
        return None, {"holds_up": False, "rejected": failures}

    def _again(self, candidate: Trial) -> tuple[Evaluation, dict[str, Any]]:
        """Simulate a candidate from rest, more tightly and beside it, until its objective holds up.

        Return (evaluation that holds up, or else the first one; record for the result file). The
        record has the statuses of all attempts."""
        attempts: list[tuple[Evaluation, dict[str, Any]]] = []
        for evaluator, point in self._attempts(candidate.point):
            evaluation = evaluator(self.problem.design(point))
            objective = self.problem.objective(evaluation)
            change = abs(objective / candidate.objective - 1)
            record = {
                "searched_objective": candidate.objective,
                "verified_objective": None if np.isnan(objective) else objective,
                "status": evaluation.status.label,
                "holds_up": bool(change <= _HOLDS_UP and self.problem.excess(evaluation) <= _MEETS),
            }
            attempts.append((evaluation, record))
            if record["holds_up"] or self.stop.is_set():
                break
        found, record = attempts[-1 if attempts[-1][1]["holds_up"] else 0]
        return found, record | {"attempts": [one["status"] for _, one in attempts]}

    def _attempts(self, point: NDArray[np.float64]) -> Iterator[tuple[Evaluator, NDArray]]:
        """Yield (evaluator, point) of each attempt to confirm the design at a `point` (d,).

        An orbit can fail a check of accuracy at a design although all its neighbours pass."""
        yield self.exact, point
        yield self.exact.at_tolerance(_SHARPER * self.config.solver.orbit_tolerance), point
        for size in _BESIDE:
            yield self.exact, self.problem.toward(point + size * np.sign(0.5 - point), point)

    def _optimality(self, optimized: Evaluation, trials: list[Trial]) -> Optimality | None:
        """Return the first-order conditions at a verified design, and the outcomes of the starts.

        Return `None` if the design has no usable steady state."""
        point = self.problem.point(list(optimized.design.values()))
        local = self.problem.local(optimized, point)
        if local is None:
            return None
        certificate = certify(local, point)
        if not certificate.holds(RESIDUAL, FEASIBLE) and not self.stop.is_set():
            # The gradients may be less accurate than the residual requires.
            sharper = self.exact.at_tolerance(_SHARPER * self.config.solver.orbit_tolerance)
            again = sharper(self.problem.design(point), start=optimized.start, series=False)
            found = self.problem.local(again, point)
            if found is not None and (other := certify(found, point)).residual < RESIDUAL:
                certificate, optimized = other, again
        ends = sorted(self._found.items())
        reason, promised = "verification" if ends else "descent", float("nan")
        near = [found for _, found in ends if _near(found.point, [point])]
        if near:
            found = min(near, key=lambda one: float(np.linalg.norm(one.point - point)))
            reason = judged(found.reason, certificate.holds(RESIDUAL, FEASIBLE))
            promised = found.promised
        held = self.problem.held_by(optimized, certificate)
        starts = [self._outcome(number, found) for number, found in ends]
        starts = starts or self._ends(trials)
        rows = self._sensitivities(optimized, certificate)
        return Optimality(self.method, certificate, reason, promised, held, starts, rows)

    def _sensitivities(self, optimized: Evaluation, certificate: Certificate) -> list[dict]:
        """Return one row per scene quantity, with its effect on forces and objective.

        Forces are those in the nominal scene; the effect on the objective is left out for a sample.
        Return an empty list for several speeds, for several motions, or after `stop`."""
        nominal = self.exact.nominal
        if not nominal.single or self.stop.is_set():
            return []
        moved = by_scene(nominal, optimized.nominal)
        if moved is None:
            return []
        slopes = {} if optimized.scenes else self.problem.along_scene(moved, certificate)
        level = self.problem.objective(optimized)
        rows = []
        for one in quantities(nominal.config):
            forces = {name: one.step * row[one.key] for name, row in moved.gradient.items()}
            row = {"quantity": one.name, "key": one.key, "unit": one.unit, "value": one.value}
            row |= {"step": one.step} | forces
            if slopes:
                row["objective_percent"] = one.step * (100 * slopes[one.key] / level)
            rows.append(row)
        return rows

    def _outcome(self, number: int, found: Found) -> StartOutcome:
        """Return the outcome of a local search by sequential quadratic programming.

        `number`: index of the search; `found`: what it found."""
        certificate, local = found.certificate, found.local
        reason = found.reason
        met = local is not None and local.violation <= FEASIBLE
        if local is not None and not met and reason != "interrupted":
            reason = "infeasible"
        return StartOutcome(
            start=number,
            objective=local.objective if local is not None and met else float("nan"),
            residual=float("nan") if certificate is None else certificate.residual,
            reason=reason,
            evaluations=found.evaluations,
            design=self._named(found.point),
            point=found.point,
        )

    def _ends(self, trials: list[Trial]) -> list[StartOutcome]:
        """Return the outcomes of all descents, each with the best trial of the descent."""
        starts: dict[int, list[Trial]] = {}
        for trial in trials:
            if trial.start >= 0:
                starts.setdefault(trial.start, []).append(trial)
        found = []
        for number, every in sorted(starts.items()):
            best = min(filter(_candidate, every), key=_objective, default=every[0])
            outcome = best.objective, best.residual, "descent", len(every)
            found.append(StartOutcome(number, *outcome, self._named(best.point), best.point))
        return found

    def _named(self, point) -> dict[str, float]:
        """Return the design at a `point` (d,), in config units by key."""
        values = self.problem.look(point)[0].tolist()
        return dict(zip(self.problem.config.design_keys, values, strict=True))


def method_of(config: Config) -> str:
    """Return the method of the local searches, with `auto` replaced by the method it stands for.

    Raises `InputError` if the search needs exact gradients but there are none: the objective is an
    average over an ensemble, or the contact is not smooth."""
    method, noisy = config.optimizer.method, config.objective.motion == "ensemble"
    if method == "auto":
        return "adam" if noisy else "slsqp"
    if method == "slsqp" and noisy:
        raise InputError(
            "`optimizer.method` must be adam, rmsprop or sgd for `objective.motion` ensemble, but "
            "is slsqp: gradients of averages have noise; set it to auto"
        )
    return method


def until_stopped(work: Callable[[], T], stop: threading.Event, patience: float) -> T | None:
    """Run `work()` in its own thread, and return its result, or `None` if it ends too late.

    `stop`: event that asks `work` to end. Once it is set, this function waits at most `patience`
    (s). The first `KeyboardInterrupt` sets `stop`; a second one is raised. Because `work` has its
    own thread, an interrupt takes effect even while compiled code is running."""
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


def _rule(method: str, learning_rate: float, iterations: int):
    """Return the update rule of optax that `method` names."""
    import optax

    return getattr(optax, method)(optax.cosine_decay_schedule(learning_rate, iterations, 0.05))


@Program
def _init(method, learning_rate, iterations, point):
    """Return the initial state of an update rule at `point` (d,)."""
    return _rule(method, learning_rate, iterations).init(point)


@Program
def _update(method, learning_rate, iterations, slope, state):
    """Return (step (d,), next state) of an update rule, given the gradient `slope` (d,)."""
    return _rule(method, learning_rate, iterations).update(slope, state)


def _near(point: NDArray[np.float64], others: Sequence[NDArray[np.float64]]) -> bool:
    """Return whether `point` (d,) is closer than 0.02 to one of the points in `others`."""
    return any(np.linalg.norm(point - other) < 0.02 for other in others)


_candidate = operator.attrgetter("candidate")
_objective = operator.attrgetter("objective")


def _history(trials: list[Trial]) -> list[dict[str, Any]]:
    """Return one row per trial for the history, each with the best objective so far."""
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
                "feasible": trial.feasible and trial.excess <= FEASIBLE,
                "residual": trial.residual,
                "status": evaluation.status.label,
            }
        )
    return rows
