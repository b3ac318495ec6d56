"""The robust optimum: the best design if values of scene and design scatter (`tolerances`), or over
ranges of assumed values (`objective.over: assumptions`).

The search has two stages. The first one finds the nominal optimum, as without `tolerances`. In the
second one, local searches begin at the optima of the first stage. Each of their designs is
simulated in every scene of a fixed sample, and a rule combines the objectives. At the end,
baseline, nominal optimum and robust optimum are simulated in many fresh scenes."""

import dataclasses
import itertools
import threading
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from rootsopt.config.reading import Config
from rootsopt.config.tolerances import scatterable
from rootsopt.errors import InputError
from rootsopt.optimize.assumptions import compared
from rootsopt.optimize.local import Linearization
from rootsopt.optimize.outcome import RIVAL, Optimization, Progress
from rootsopt.optimize.problem import Problem
from rootsopt.optimize.robust_problem import RobustProblem, Stage
from rootsopt.optimize.search import Search
from rootsopt.response.evaluation import Evaluator
from rootsopt.response.journal import Checkpoint
from rootsopt.response.reducers import HERE, Runs, combine, evaluate_many
from rootsopt.response.result import RESPONSES, Evaluation
from rootsopt.response.scatter import Shift, draw, in_conditions, shifts
from rootsopt.scene.build import Scene

OBJECTIVE = "objective"
"""Name of the objective among the compared quantities."""
COMPARED: tuple[str, ...] = (OBJECTIVE, *RESPONSES)
"""Quantities that are compared over fresh scenes: the objective (1 for the baseline in the nominal
scene), and mean, peak and RMS force (N)."""

# Level of the quantile that the comparison reports.
_LEVEL = 0.95

# Distance in the unit box below which two designs count as the same.
_APART = 1e-6


@dataclasses.dataclass(frozen=True)
class Scattered:
    """One design in n fresh scenes.

    `values`: arrays (n,) by the names `COMPARED`, NaN where the motion is not usable; `statuses`:
    number of scenes by status label; `combined`: robust objective over the usable scenes (the rule
    of the search, relative to the baseline)."""

    values: dict[str, NDArray[np.float64]]
    statuses: dict[str, int]
    combined: float

    @property
    def usable(self) -> NDArray[np.bool_]:
        """Mask (n,) of the scenes in which the motion is usable."""
        return np.isfinite(self.values[OBJECTIVE])

    def statistics(self, name: str) -> dict[str, float]:
        """Return statistics of one of the `COMPARED` quantities over the usable scenes.

        They are mean, its standard error, standard deviation, 95 % quantile and greatest value.
        All are NaN if no scene is usable."""
        values = self.values[name][self.usable]
        if not values.size:
            return dict.fromkeys(
                ("mean", "standard_error", "sigma", "quantile_95", "worst"), float("nan")
            )
        sigma = float(np.std(values))
        return {
            "mean": float(np.mean(values)),
            "standard_error": sigma / float(np.sqrt(len(values))),
            "sigma": sigma,
            "quantile_95": float(np.quantile(values, _LEVEL)),
            "worst": float(np.max(values)),
        }

    def record(self) -> dict[str, Any]:
        """Return the record for the result file."""
        return {
            "scenes": len(self.usable),
            "failed_share": float(np.mean(~self.usable)) if len(self.usable) else 0.0,
            "statuses": self.statuses,
            "combined_objective": self.combined,
            **{name: self.statistics(name) for name in COMPARED},
        }


@dataclasses.dataclass(frozen=True)
class Robustness:
    """Results of the search other than the robust optimum.

    `nominal`: outcome of the first stage; `begun`: robust objective of the nominal optimum over the
    sample of the search, NaN if it is not usable; `fresh`: designs in fresh scenes by name
    (`baseline`, `nominal`, `robust`), empty without `tolerances.check_samples`; `scenes`: sampled
    values of these scenes, arrays (n,) by key."""

    nominal: Optimization
    begun: float
    fresh: dict[str, Scattered]
    scenes: dict[str, NDArray[np.float64]]

    def record(self) -> dict[str, Any]:
        """Return the entry `robustness` of the result file."""
        nominal = self.nominal
        optimality = nominal.optimality
        best = nominal.optimized
        return {
            "nominal": {
                "optimized": None if best is None else best.record(),
                "improvement": nominal.improvement,
                "constraints": nominal.constraints,
                "optimality": None if optimality is None else optimality.record(),
                "verification": nominal.verification,
                "status": nominal.status.label,
                "robust_objective": None if np.isnan(self.begun) else self.begun,
            },
            "fresh": {name: one.record() for name, one in self.fresh.items()},
        }


class RobustStage(Stage):
    """The second stage: local searches from the optima of the first stage, over a sample.

    `nominal`: outcome of the first stage, with a problem; `first`: see `Stage`; `others`: further
    designs from which searches begin; `offsets`: those of `RobustProblem`."""

    apart = 0.03
    broad = False

    def __init__(
        self,
        nominal: Optimization,
        first: int,
        others: Sequence[Mapping[str, float]] = (),
        offsets: tuple[float, ...] = (),
    ):
        self.nominal, self.first, self.others, self.offsets = nominal, first, others, offsets
        self._shares: dict[int, NDArray[np.float64]] = {}

    def evaluator(self, exact: Evaluator, runs: Runs) -> Evaluator:
        return exact.scattered(runs)

    def problem(self, config: Config, scene: Scene, baseline: Evaluation) -> Problem:
        return RobustProblem.of(config, scene, baseline, self.offsets)

    def sample(self, problem: Problem, own, settings) -> list[NDArray[np.float64]]:
        """Return the points of the nominal optimum, of `others` and of the other optima.

        Without an optimum, return the baseline's `own` point. All are moved onto the feasible
        set."""
        designs = [] if self.nominal.optimized is None else [self.nominal.optimized.design]
        designs += [dict(one) for one in self.others]
        if self.nominal.optimality is not None:
            designs += [one.design for one in self.nominal.optimality.optima]
        points = [problem.point(list(design.values())) for design in designs] or [own]
        return [problem.project(point) for point in points]

    def local(
        self, problem: Problem, start: int, evaluation: Evaluation, point
    ) -> Linearization | None:
        assert isinstance(problem, RobustProblem)
        if not evaluation.usable:
            return None
        if start not in self._shares:
            self._shares[start] = np.maximum(problem.combined(evaluation).weights, 0.0)
        return problem.local(evaluation, point, self._shares[start])


class StagedSearch:
    """The stages of a search, and the comparisons that follow.

    The first stage finds the nominal optimum. With `tolerances`, or an objective over
    `assumptions`, the second stage finds the optimum over a sample of scenes. The designs are then
    compared over fresh scenes, and over what is assumed about the scene. Arguments: see `Search`.

    Raises `InputError` if `tolerances` name a parameter that the family of the search lacks."""

    def __init__(
        self,
        config: Config,
        progress: Progress | None = None,
        stop: threading.Event | None = None,
        checkpoint: Checkpoint | None = None,
        runs: Runs = HERE,
    ):
        self.config, self.checkpoint, self.runs = config, checkpoint, runs
        self.progress = progress or (lambda done, expected, best: None)
        self.stop = threading.Event() if stop is None else stop
        self._done, self._expected = 0, 0
        self._nominal: Optimization | None = None
        self._robust = is_robust(config)
        first = without(config)
        if self._robust and config.optimizer.prove == "auto":
            # A bound of the nominal objective says little about the robust one.
            first = first.replaced({"optimizer.prove": False})
        self._stage: Search = Search(first, self._report, self.stop, checkpoint, runs)
        if config.tolerances is not None:
            varied = self._stage.config
            for key in set(config.tolerances.keys) - scatterable(varied).keys():
                raise InputError(
                    f"`tolerances` must not name `{key}` for `optimizer.family` "
                    f"{varied.profile.family}, which has no such parameter; remove it"
                )

    def run(self) -> Optimization:
        """Run the stages and the comparisons. Return the outcome of the last stage.

        If the first stage ends without a problem to solve, or `stop` is set, return its outcome.
        If `stop` is set, no further comparison begins.

        Raises `InputError` if the objective is not defined for the baseline."""
        outcome = self._optimum()
        if not self.config.spans:
            return outcome
        before, best = len(outcome.history), 1 - outcome.improvement.get("objective", float("nan"))

        def tick(done: int, expected: int) -> None:
            self.progress(before + done, before + expected, best)

        spread = compared(self.config, outcome, self.runs, self.stop.is_set, tick)
        return dataclasses.replace(outcome, assumptions=spread)

    def _optimum(self) -> Optimization:
        """Run the stages, and compare their designs over fresh scenes."""
        nominal = self._stage.run()
        ended = self.stop.is_set() or nominal.problem is None or nominal.infeasible is not None
        if ended or not self._robust:
            return nominal
        self._done, self._expected = len(nominal.history), self._stage.expected
        second = self._second(nominal)
        if second is None:
            return nominal
        self._nominal = nominal
        how = self._report, self.stop, self.checkpoint, self.runs
        self._stage = stage = Search(second[0], *how, second[1])
        outcome = stage.run()
        if not isinstance(outcome.problem, RobustProblem):
            return outcome
        return _joined(nominal, outcome, *self._compared(stage, outcome.problem, nominal, outcome))

    def _second(self, nominal: Optimization) -> tuple[Config, RobustStage] | None:
        """Return config and stage of the second search; `None` if there is nothing to search."""
        starts = self.config.optimizer.starts
        if self.config.tolerances is not None:
            return self.config, RobustStage(nominal, starts)
        spread = compared(
            self.config, nominal, self.runs, self.stop.is_set,
            lambda done, expected: self._report(done, expected, float("nan")),
        )  # fmt: skip
        if spread is None:
            return None
        scenes, offsets = spread.sample(self.config.assumptions.combine == "regret")
        if not scenes:
            return None
        worst = self.config.assumptions.combine != "mean"
        rule = {"combine": "worst" if worst else "mean_plus_k_sigma", "k": 0.0}
        config = in_conditions(without(self.config), scenes, **rule)
        others = [one for name, one in spread.designs.items() if name.startswith(RIVAL)]
        return config, RobustStage(nominal, starts, others, offsets)

    def so_far(self) -> Optimization | None:
        """Return the results of the search so far, as `Search.so_far` does."""
        outcome = self._stage.so_far()
        if outcome is None:
            return self._nominal
        return outcome if self._nominal is None else _joined(self._nominal, outcome, {}, {})

    def _report(self, done: int, expected: int, best: float) -> None:
        self.progress(self._done + done, self._expected + expected, best)

    def _compared(
        self, stage: Search, problem: RobustProblem, nominal: Optimization, outcome: Optimization
    ) -> tuple[dict, dict]:
        """Return the fields `fresh` and `scenes` of `Robustness`."""
        tolerances = self.config.tolerances
        if tolerances is None or not tolerances.check_samples or self.stop.is_set():
            return {}, {}
        known = {
            "baseline": outcome.baseline,
            "nominal": nominal.optimized,
            "robust": outcome.optimized,
        }
        designs = {
            name: (stage.source if name == "baseline" else stage.fast, one.nominal)
            for name, one in known.items()
            if one is not None
        }
        drawn = draw(self.config, tolerances.check_samples, fresh=True)
        best = problem.objective(outcome.optimized) if outcome.optimized else float("nan")
        before = self._done + len(outcome.history)
        per, total = 1 + tolerances.samples, len(drawn) * len(designs)
        expected, lock, ended = before + total // per, threading.Lock(), [0]

        def tick() -> bool:
            # A design of the search needs `per` simulations, so count `per` simulations as one
            # evaluation.
            with lock:
                ended[0] += 1
                if ended[0] % per == 0:
                    self.progress(before + ended[0] // per, expected, best)
            return self.stop.is_set()

        fresh = compare(problem, designs, drawn, tick, self.runs)
        if self.stop.is_set():
            return {}, {}
        keys = [one.key for one in self.config.scatters]
        return fresh, dict(zip(keys, drawn.T, strict=True))


def _joined(nominal: Optimization, outcome: Optimization, fresh, scenes) -> Optimization:
    """Return the `outcome` of the second stage with the history of both stages.

    `nominal`: outcome of the first stage; `fresh`, `scenes`: fields of `Robustness`."""
    count = len(nominal.history)
    rows = [row | {"evaluation": row["evaluation"] + count} for row in outcome.history]
    first = next((row["objective"] for row in rows), float("nan"))
    robustness, history = Robustness(nominal, float(first), fresh, scenes), nominal.history + rows
    return dataclasses.replace(outcome, history=history, robustness=robustness)


def compare(
    problem: RobustProblem,
    designs: Mapping[str, tuple[Evaluator, Evaluation]],
    drawn: Float[np.ndarray, "n q"],
    tick: Callable[[], bool] = lambda: False,
    runs: Runs = HERE,
) -> dict[str, Scattered]:
    """Simulate designs in the scenes `drawn`, and return each design's `Scattered` by name.

    `problem`: defines the objective; `designs`: an evaluator of the nominal scene and the
    evaluation there, the baseline's first. Each motion starts at the design's orbit in the nominal
    scene. Equal designs are simulated only once. `tick`: function called before each simulation; if
    it returns True, no further one begins."""
    scattered: dict[str, Scattered] = {}
    reference = 1.0
    for name, (evaluator, nominal) in designs.items():
        twin = next((k for k in scattered if _same(problem, designs[k][1], nominal)), None)
        if twin is not None:
            scattered[name] = scattered[twin]
            continue
        one = _scattered(evaluator, problem, nominal, shifts(evaluator.config, drawn), tick, runs)
        if not scattered:
            reference = one.combined
        scattered[name] = dataclasses.replace(one, combined=one.combined / reference)
    return scattered


def _scattered(
    evaluator: Evaluator,
    problem: RobustProblem,
    nominal: Evaluation,
    scenes: Sequence[Shift],
    tick: Callable[[], bool],
    runs: Runs,
) -> Scattered:
    """Simulate one design in many scenes, until `tick` returns True. Arguments: see `compare`."""
    design = np.array(list(nominal.design.values()))

    points = evaluator.in_scenes(scenes, design, itertools.repeat(nominal.start))
    evaluations = evaluate_many(itertools.takewhile(lambda _: not tick(), points), runs)
    labels = [one.status.label for one in evaluations]
    rows = np.full((len(evaluations), len(COMPARED)), np.nan)
    for row, one in zip(rows, evaluations, strict=True):
        if one.usable:
            row[:] = problem.objective(one), *(one.response.get(name, np.nan) for name in RESPONSES)
    values: dict[str, NDArray[np.float64]] = dict(zip(COMPARED, rows.T, strict=True))
    known = values[OBJECTIVE][np.isfinite(values[OBJECTIVE])]
    combined = combine(problem.rule, known).value if known.size else float("nan")
    counts = {label: labels.count(label) for label in dict.fromkeys(labels)}
    return Scattered(values, counts, combined)


def _same(problem: Problem, one: Evaluation, other: Evaluation) -> bool:
    if one.design.keys() != other.design.keys():
        return False
    here, there = (problem.point([*each.design.values()]) for each in (one, other))
    return bool(np.max(np.abs(here - there), initial=0.0) < _APART)


def without(config: Config) -> Config:
    """Return `config` for the nominal optimum: without `tolerances`, in its own scene."""
    objective = config.objective.model_copy(update={"over": "nominal"})
    return config.model_copy(update={"tolerances": None, "objective": objective})


def is_robust(config: Config) -> bool:
    """Return whether the objective of `config` is one over several scenes."""
    return config.tolerances is not None or config.objective.over != "nominal"
