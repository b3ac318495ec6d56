"""Evaluates many points, and reduces many evaluations to one number with its gradient.

Points are designs, scenes or speeds, in this process or on others.

Combinations of values are R = Σ w_k(J) J_k, where J_k is the value in scene k of n. The weights w
add up to 1:

- Mean plus c = `tolerances.k` standard deviations: R = m + c s, with m = Σ J_k / n and
  s² = Σ (J_k - m)² / n. Hence w_k = (1 + c (J_k - m) / s) / n.
- Quantile q: the estimator of Harrell and Davis, a weighted mean of all ordered values. The weight
  of the i-th smallest is B(i/n) - B((i-1)/n). B is the distribution function of the beta
  distribution with parameters (n + 1) q and (n + 1) (1 - q). This estimator varies less between
  samples than a single ordered value, and every scene contributes to its gradient. Source: Harrell
  and Davis, A new distribution-free quantile estimator, Biometrika 69 (1982) 635-640.
- Worst: the greatest value. Its weight is 1.

Each R is a homogeneous function of J of degree 1. Therefore dR/dJ_k = w_k (Euler's theorem),
wherever R is differentiable."""

import dataclasses
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from itertools import islice
from os import cpu_count
from typing import Any, NamedTuple, Protocol, TypeVar, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rootsopt.config.reading import Config
from rootsopt.config.tolerances import TolerancesConfig
from rootsopt.response.result import Evaluation, Part, Seeds
from rootsopt.status import Status

# Standard deviation, relative to the mean, below which all values count as equal.
_EQUAL = 1e-14


class Combined(NamedTuple):
    """A combination R of n values.

    `value`: R; `weights` (n,): derivatives of R with respect to the values."""

    value: float
    weights: NDArray[np.float64]


def combine(tolerances: TolerancesConfig, values: ArrayLike) -> Combined:
    """Return the combination of `values` (n,) that `tolerances.combine` selects."""
    array = np.asarray(values, np.float64)
    if tolerances.combine == "worst":
        weights = np.zeros(len(array))
        weights[np.argmax(array)] = 1.0
    elif tolerances.combine == "quantile":
        weights = np.empty(len(array))
        weights[np.argsort(array, kind="stable")] = order_weights(len(array), tolerances.quantile)
    else:
        weights = _mean_and_deviation(array, tolerances.k)
    return Combined(float(weights @ array), weights)


def order_weights(count: int, quantile: float) -> NDArray[np.float64]:
    """Return the weights (count,) of Harrell and Davis for `count` values in ascending order.

    `quantile`: the quantile q that the weighted mean estimates."""
    from scipy.special import betainc  # Slow import (0.1 s).

    edges = np.arange(count + 1) / count
    cumulative = betainc((count + 1) * quantile, (count + 1) * (1 - quantile), edges)
    return np.diff(cumulative)


def _mean_and_deviation(values: NDArray[np.float64], k: float) -> NDArray[np.float64]:
    away = values - np.mean(values)
    deviation = float(np.sqrt(np.mean(away**2)))
    # For equal values, the standard deviation has a corner, and 0 is one of its subgradients.
    if deviation <= _EQUAL * abs(float(np.mean(values))):
        return np.full(len(values), 1 / len(values))
    return (1 + k * away / deviation) / len(values)


def over_speeds(parts: Sequence[Part], own: float) -> Evaluation:
    """Return the evaluation over several speeds, reported at the speed `own` (rpm)."""
    (head,) = (part.evaluation for part in parts if part.speed_rpm == own)
    evaluation = _together(head, parts, {"speeds": len(parts)})
    return dataclasses.replace(evaluation, maxima=None, rivals=(), speeds=tuple(parts))


def over_scenes(parts: Sequence[Part]) -> Evaluation:
    """Return the evaluation over several scenes, reported in the nominal scene.

    `parts`: that of the nominal scene first."""
    evaluation = _together(parts[0].evaluation, parts, {"samples": len(parts) - 1})
    return dataclasses.replace(evaluation, scenes=tuple(parts))


def _together(head: Evaluation, parts: Sequence[Part], counts: dict[str, int]) -> Evaluation:
    """Return the evaluation `head` as that of all `parts`; add `counts` to its statistics.

    The result has a gradient, and a start with one entry per part, only if all parts are usable."""
    status, message = overall(parts)
    seconds = sum(part.evaluation.statistics.get("seconds", 0.0) for part in parts)
    return dataclasses.replace(
        head,
        gradient=head.gradient if status.usable else {},
        status=status,
        message=message,
        statistics=head.statistics | counts | {"seconds": seconds},
        start=tuple(part.evaluation.start for part in parts) if status.usable else None,
    )


def overall(parts: Sequence[Part]) -> tuple[Status, str]:
    """Return status and message of the first part that is not usable, or of the first part if all
    are usable."""
    failed = [part for part in parts if not part.evaluation.usable]
    first = failed[0] if failed else parts[0]
    status, message = first.evaluation.status, first.evaluation.message
    if not (failed and first.values):
        return status, message
    if not math.isnan(first.speed_rpm):
        return status, f"At {first.speed_rpm:g} rpm: {message}"
    values = ", ".join(f"{key} = {value:.6g}" for key, value in first.values.items())
    return status, (
        f"In {len(failed)} of the {len(parts) - 1} scenes of `tolerances`, the motion is not "
        f"usable. With {values}: {message}"
    )


def mean(head: Evaluation, evaluations: Sequence[Evaluation], shares: ArrayLike) -> Evaluation:
    """Return `head` with response and gradient averaged over `evaluations`.

    `shares` (n,): weights ≥ 0, scaled to add up to 1; all 0 count as equal."""
    weights = np.asarray(shares, np.float64)
    weights = weights if weights.sum() > 0 else np.ones(len(weights))
    weights = weights / weights.sum()

    def average(values: list[float]) -> float:
        return float(weights @ values)

    # The reserve of a pair without a motion of its own is not known.
    known = [k for k in head.response if all(k in one.response for one in evaluations)]
    return dataclasses.replace(
        head,
        maxima=None,
        response={k: average([one.response[k] for one in evaluations]) for k in known},
        gradient={
            name: {key: average([one.gradient[name][key] for one in evaluations]) for key in row}
            for name, row in head.gradient.items()
            if name in known
        },
    )


def alone(config: Config) -> Config:
    """Return `config` with the scene's own speed as the only one."""
    none = {"speeds_rpm": (), "speed_weights": (), "over_speeds": "weighted"}
    return config.model_copy(update={"objective": config.objective.model_copy(update=none)})


def shares(config: Config) -> dict[float, float]:
    """Return the speeds (rpm) that a config's objective needs, ascending, with their shares.

    The scene's own speed is included, with share 0 if the objective does not contain this speed."""
    objective = config.objective
    speeds = objective.speeds_rpm or (config.scene.speed_rpm,)
    weights = objective.speed_weights or (1.0,) * len(speeds)
    given = {s: w / sum(weights) for s, w in zip(speeds, weights, strict=True)}
    return dict(sorted(({config.scene.speed_rpm: 0.0} | given).items()))


def counted(
    config: Config,
    evaluation: Evaluation,
    baseline: Evaluation,
    value: Callable[[Evaluation, Evaluation], float],
) -> list[tuple[float, Evaluation, Evaluation]]:
    """Return (share, evaluation, baseline) at every speed that counts in the objective.

    The shares add up to 1. With `objective.over_speeds: worst`, only the speed with the greatest
    `value(evaluation, baseline)` counts."""
    pairs = [
        (part.share, part.evaluation, base.evaluation)
        for part, base in zip(evaluation.by_speed, baseline.by_speed, strict=True)
        if part.share > 0
    ]
    if config.objective.over_speeds == "weighted":
        return pairs
    _, worst, base = max(pairs, key=lambda pair: value(*pair[1:]))
    return [(1.0, worst, base)]


def parts_at(
    shares: Iterable[tuple[float, float]], evaluations: Iterable[Evaluation]
) -> tuple[Part, ...]:
    """Return the parts of evaluations at several speeds; `shares`: (speed in rpm, share)."""
    pairs = zip(shares, evaluations, strict=True)
    return tuple(Part({"speed_rpm": speed}, one, share) for (speed, share), one in pairs)


Item = TypeVar("Item")
Result = TypeVar("Result")


class Point(NamedTuple):
    """A point to evaluate, as `evaluator(design, start, series)`.

    The first three are the `Evaluator`, the design (d,) in config units, and where to begin;
    `series`: whether to compute the series."""

    evaluator: Callable[..., Evaluation]
    design: Any
    start: Seeds = None
    series: bool = False


@runtime_checkable
class Runs(Protocol):
    """Runs evaluations for threads that wait for them.

    An evaluation is a pure function, so that its result does not depend on where it runs."""

    @property
    def slots(self) -> int:
        """Number of evaluations that may be requested at a time."""
        ...

    def evaluated(self, point: Point) -> Evaluation:
        """Return the evaluation of a point."""
        ...


class LocalRunner(NamedTuple):
    """Runs evaluations in this process, in the thread that asks for them.

    `slots`: number of threads that should ask."""

    slots: int

    def evaluated(self, point: Point) -> Evaluation:
        """Return the evaluation of a point."""
        return point.evaluator(*point[1:])


HERE = LocalRunner(cpu_count() or 1)
"""One thread per core."""
IN_TURN = LocalRunner(1)
"""No further thread: for points of a design, if designs run side by side."""


def evaluate_many(
    points: Iterable[Point], runs: Runs = HERE, progress: Callable[[int], None] = lambda done: None
) -> list[Evaluation]:
    """Return the evaluations of all `points`, in their order.

    `runs`: where they run; `progress` is called with the number of points done. Points are taken
    only when they can begin, so that a generator can end them early."""
    evaluations = {}
    for number, one in as_done(runs.evaluated, points, runs.slots):
        evaluations[number] = one
        progress(len(evaluations))
    return [evaluations[number] for number in sorted(evaluations)]


def as_done(
    work: Callable[[Item], Result], items: Iterable[Item], slots: int
) -> Iterator[tuple[int, Result]]:
    """Yield (number, `work(item)`) of all items as they are done, `slots` of them at a time.

    Items are taken only when they can begin. After an error, no further item begins."""
    waiting = enumerate(items)
    if slots == 1:
        yield from ((number, work(item)) for number, item in waiting)
        return
    running: dict[Future[Result], int] = {}
    done: list[tuple[int, Result]] = []
    with ThreadPoolExecutor(slots) as pool:
        while True:
            for number, item in islice(waiting, slots - len(running)):
                running[pool.submit(work, item)] = number
            yield from done
            if not running:
                return
            ended, _ = wait(running, return_when=FIRST_COMPLETED)
            done = [(running.pop(one), one.result()) for one in ended]
