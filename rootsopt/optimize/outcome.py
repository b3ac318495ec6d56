"""Outcome of a search: its trials, its gains over the baseline, and a comparison over assumptions.

Also selects trials: those nearby, far apart, or best to begin from."""

import dataclasses
import itertools
import math
import operator
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from rootsopt.config.tolerances import Span
from rootsopt.optimize.infeasible import Beginning, Infeasible
from rootsopt.optimize.limits import constraint_rows
from rootsopt.optimize.local import FEASIBLE, Linearization, certify
from rootsopt.optimize.optimality import Optimality
from rootsopt.response.result import RESPONSES, Evaluation
from rootsopt.response.scatter import RANDOM
from rootsopt.response.terms import objective_weights
from rootsopt.status import Status

if TYPE_CHECKING:
    from rootsopt.optimize.problem import Problem
    from rootsopt.optimize.robust import Robustness

Item = TypeVar("Item")
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
    local: Linearization | None = None
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
    `assumptions`: baseline and optimum over the spread of what is assumed about the scene.
    `beginning`: the fitted design that began the search; `None` unless the baseline's profile is
    from a file.

    >>> import jax
    >>> import rootsopt
    >>> jax.config.update("jax_enable_x64", True)
    >>> quick = ["optimizer.starts=1", "optimizer.screening=0", "optimizer.iterations=2"]
    >>> quick += ["assumptions.scenes=0"]  # no comparison in other scenes
    >>> optimization = rootsopt.optimize_design(rootsopt.load_config("cic", quick))
    >>> sorted(optimization.improvement)
    ['mean_force_N', 'objective', 'peak_force_N', 'rms_force_N']
    """

    problem: "Problem | None"
    baseline: Evaluation
    optimized: Evaluation | None
    history: list[dict[str, Any]]
    verification: dict[str, Any]
    interrupted: bool = False
    optimality: Optimality | None = None
    infeasible: Infeasible | None = None
    robustness: "Robustness | None" = None
    beginning: Beginning | None = None
    assumptions: "Assumed | None" = None

    @property
    def status(self) -> Status:
        """Status of the search as a whole."""
        optimized, optimality = self.optimized, self.optimality
        failures = (
            (Status.INTERRUPTED, self.interrupted),
            (self.baseline.status, not self.baseline.usable),
            (Status.INFEASIBLE, self.infeasible is not None),
            (Status.NOT_IMPROVED, optimized is None),
            (Status.NOT_CONVERGED, optimality is not None and not optimality.converged),
        )
        ended = self.baseline.status if optimized is None else optimized.status
        return next((status for status, met in failures if met), ended)

    @property
    def improvement(self) -> dict[str, float]:
        """Reductions of the objective, of mean, peak and RMS force, and of all weighted terms.

        Each is a fraction of the baseline's value. The mapping is empty without an optimised
        design."""
        return self._gains(self.baseline, 1.0)

    @property
    def nominal(self) -> Evaluation | None:
        """Evaluation of the family member fitted to a baseline from a file.

        `None` without such a baseline, or if the member has no usable steady state."""
        evaluation = None if self.beginning is None else self.beginning.evaluation
        return evaluation if evaluation is not None and evaluation.usable else None

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
        counted = (*RESPONSES, *objective_weights(self.problem.config))
        for key in dict.fromkeys(counted):
            before, after = (one.response.get(key) for one in (first, self.optimized))
            if before is not None and after is not None:
                gains[key] = 1 - after / before if before > 0 else 0.0
        return gains

    @property
    def cost(self) -> str:
        """Sentence for a design worse than the baseline, which is then one that violates limits.

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
        return constraint_rows(self.problem, self.optimized, certificate)

    @property
    def objective_by_speed(self) -> list[dict[str, float]]:
        """Objective of the optimised design at each speed, one row per speed.

        The list is empty without `objective.speeds_rpm` or without an optimised design."""
        if self.problem is None or self.optimized is None:
            return []
        return self.problem.by_speed(self.optimized)


def near(point: NDArray[np.float64], others: Sequence[NDArray[np.float64]]) -> bool:
    """Return whether `point` (d,) is closer than 0.02 to one of the points in `others`."""
    return any(np.linalg.norm(point - other) < 0.02 for other in others)


candidate = operator.attrgetter("candidate")
objective = operator.attrgetter("objective")


def history_of(trials: list[Trial]) -> list[dict[str, Any]]:
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


def ranked(trials: list[Trial]) -> list[NDArray[np.float64]]:
    """Return the screened points at which a local search may begin, best first.

    Designs that meet the limits of forces come first, then those that exceed them least."""
    able = [trial for trial in trials if trial.begins]
    able.sort(key=lambda one: (max(one.excess, FEASIBLE), one.objective))
    return [trial.point for trial in able]


def apart(
    items: Iterable[Item],
    least: float,
    most: int,
    point_of: Callable[[Any], NDArray[np.float64]] = lambda one: one,
    others: Iterable[NDArray[np.float64]] = (),
) -> list[Item]:
    """Return the first of the `items`, at most `most`, whose points are more than `least` apart.

    `point_of`: function that returns the point (d,) of an item, by default the item itself;
    `others`: further points (d,) from which they are as far."""
    chosen, points = [], [*others]
    for one in items:
        point = point_of(one)
        if len(chosen) < most and all(np.linalg.norm(point - other) > least for other in points):
            chosen.append(one)
            points.append(point)
    return chosen


BASELINE, OPTIMIZED, RIVAL = "baseline", "optimized", "design"
"""Names of the compared designs; a rival's name ends with its number."""
WINS = 1e-3
"""Difference of two objectives below which neither design counts as better."""

# Levels of the quantiles that are reported, by name.
_LEVELS = {"quantile_5": 0.05, "median": 0.5, "quantile_95": 0.95}
Scenes = Mapping[str, Mapping[str, float]]
"""Values by config key of each scene, by the scene's name; other values are those of the config."""
Piece = tuple[float, float]
"""Part (from, to) of the range of a quantity."""


@dataclasses.dataclass(frozen=True)
class Assumed:
    """Designs in the n scenes of `assumptions`.

    `spans`: ranges of the quantities; `scenes`: see `assumed`; `designs`: designs in config units
    by name: `baseline`, `optimized`, and others that are better than the latter in some scene;
    `objectives`: arrays (n,) by name, relative to the baseline in the same scene, NaN without a
    usable motion of both; `statuses`: labels (n,) by name; `worse`: parts of each range, by key, in
    which the optimised design is worse than the baseline, all else as given; `wins`: the same by
    name of another design, where this is better than the optimised one."""

    spans: tuple[Span, ...]
    scenes: Scenes
    designs: dict[str, dict[str, float]]
    objectives: dict[str, NDArray[np.float64]]
    statuses: dict[str, list[str]]
    worse: dict[str, list[Piece]]
    wins: dict[str, dict[str, list[Piece]]]

    def sample(self, regret: bool) -> tuple[Scenes, tuple[float, ...]]:
        """Return the random scenes over which a search optimises, with offsets of the objectives.

        They are those with a usable motion of all designs. `regret`: whether the least objective of
        all designs is subtracted in each scene; the greatest sum is 1 for the baseline."""
        every = np.array([*self.objectives.values()])
        kept = self.drawn & np.isfinite(every).all(axis=0)
        least = np.min(every[:, kept], axis=0, initial=1.0)
        offsets = np.min(least, initial=1.0) - least if regret else np.zeros(len(least))
        scenes = dict(itertools.compress(self.scenes.items(), kept))
        return scenes, tuple(offsets.tolist())

    @property
    def drawn(self) -> NDArray[np.bool_]:
        """Mask (n,) of the random scenes."""
        return np.array([name.startswith(RANDOM) for name in self.scenes])

    def columns(self) -> dict[str, list[Any]]:
        """Return one row per scene for a table file: its values, objectives and statuses."""
        table: dict[str, list[Any]] = {"scene": [*self.scenes]}
        for key, *_ in self.spans:
            table[key] = [one.get(key, math.nan) for one in self.scenes.values()]
        for name, values in self.objectives.items():
            table[f"objective_{name.replace(' ', '_')}"] = values.tolist()
            table[f"status_{name.replace(' ', '_')}"] = self.statuses[name]
        return table

    def record(self) -> dict[str, Any]:
        """Return the entry `assumptions` of the result file.

        Shares, quantiles and rank correlations are those of the random scenes."""
        values, drawn, names = self.objectives[OPTIMIZED], self.drawn, [*self.scenes]
        known = np.isfinite(values)
        some, ends = values[drawn & known], [x for x in values[~drawn][1:] if math.isfinite(x)]
        worst = int(np.nanargmax(values)) if known.any() else None
        rows = []
        for k, span in enumerate(self.spans):
            low, high = self._ends(values, k)
            rows.append({
                **span._asdict(), "objective_low": low, "objective_high": high,
                "worse": self.worse[span.key], "rank_correlation": self._rank(values, span.key),
            })  # fmt: skip
        return {
            "scenes": int(np.sum(drawn)),
            "compared": int(some.size),
            "share_better": float(np.mean(some < 1)) if some.size else None,
            "ends": int(np.sum(~drawn)) - 1,
            "ends_compared": len(ends),
            "ends_better": sum(x < 1 for x in ends),
            "objective_quantiles": {
                name: float(np.quantile(some, level)) if some.size else None
                for name, level in _LEVELS.items()
            },
            "worst": None if worst is None else {
                "scene": names[worst], "objective": float(values[worst]),
                "values": dict(self.scenes[names[worst]]),
            },
            "keys": rows,
            "decides": max(rows, key=lambda row: abs(row["rank_correlation"] or 0.0))["key"],
            "not_compared": [
                {"scene": name, "values": dict(self.scenes[name])}
                | {f"status_{who}": self.statuses[who][k] for who in (BASELINE, OPTIMIZED)}
                for k, name in enumerate(names) if not known[k]
            ],
            "rivals": [self._rival(name) for name in self.wins],
        }  # fmt: skip

    def _rival(self, name: str) -> dict[str, Any]:
        """Return the record of another design that is better than the optimum in some scenes."""
        lead = self.objectives[OPTIMIZED] - self.objectives[name]
        known = lead[self.drawn & np.isfinite(lead)]
        ranks = {one.key: self._rank(lead, one.key) for one in self.spans}
        wins = {key: parts for key, parts in self.wins[name].items() if parts}
        leads = {one.key: np.nanmax([0.0, *self._ends(lead, k)])
                 for k, one in enumerate(self.spans)}  # fmt: skip
        sizes = {key: leads[key] if wins else abs(ranks[key] or 0.0) for key in (wins or ranks)}
        key = max(sizes, key=lambda one: sizes[one])
        return {
            "name": name,
            "design": self.designs[name],
            "share_better": float(np.mean(known > WINS)) if known.size else None,
            "objective": float(self.objectives[name][0]),
            "key": key,
            "better": wins.get(key, []),
            "rank_correlation": ranks[key],
        }

    @staticmethod
    def _ends(values: NDArray[np.float64], k: int) -> list[float]:
        """Return which of the `values` (n,) are those at low and high end of range `k`."""
        return values[1 + 2 * k : 3 + 2 * k].tolist()

    def _rank(self, values: NDArray[np.float64], key: str) -> float | None:
        """Return Spearman's correlation of `values` (n,) with a quantity over random scenes.

        `None` with fewer than 3 known values, or equal ones."""
        from scipy.stats import spearmanr  # Slow import (0.3 s); the samples need it, too.

        mine = np.array([one.get(key, math.nan) for one in self.scenes.values()])
        kept = self.drawn & np.isfinite(values)
        if np.sum(kept) < 3 or np.ptp(values[kept]) == 0:
            return None
        return float(spearmanr(mine[kept], values[kept]).statistic)  # pyright: ignore
