"""One design at several speeds: for `objective.speeds_rpm`, and for `rootsopt sweep`.

The speed is an array of the model, so all speeds share the same compiled programs.
"""

import dataclasses
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from rootsopt.config import Config
from rootsopt.response.result import Evaluation, Part, together
from rootsopt.response.wrapper import Evaluates, Wrapper
from rootsopt.status import Status


@dataclasses.dataclass(frozen=True)
class SpeedsEvaluator(Wrapper):
    """Evaluates designs at every speed of `objective.speeds_rpm` and at the scene's own speed.

    `single`: the evaluator used at each speed; `baseline`: per-speed parts of the baseline's
    evaluation, to which forces at the same speed are relative; empty: no baseline.

    The response is reported at the scene's own speed. If `objective.speeds_rpm` does not contain
    this speed, its share in the objective is 0, but its status counts.
    """

    baseline: tuple[Part, ...] = ()

    def relative_to(self, baseline: Evaluation) -> "SpeedsEvaluator":
        """Return another evaluator that compares coexisting motions at each speed by their forces
        relative to those of the `baseline` at the same speed."""
        return dataclasses.replace(self, baseline=baseline.by_speed)

    def __call__(self, design=None, start=None, series=True) -> Evaluation:
        """Evaluate a design.

        `design` (d,): in config units, by default the config's own; `start`: the `start` of a
        neighbouring design's evaluation; `series`: whether to compute the series at the scene's own
        speed."""
        config, own = self.config, self.config.scene.speed_rpm
        parts = []
        for number, (speed, share) in enumerate(shares(config).items()):
            now = self.single.at_speed(speed)
            if self.baseline:
                now = now.relative_to(self.baseline[number].evaluation)
            known = None if start is None else start[number]
            found = now(design, known, series and speed == own)
            parts.append(Part({"speed_rpm": speed}, found, share))
        return over_speeds(parts, own)


def over_speeds(parts: Sequence[Part], own: float) -> Evaluation:
    """Return the evaluation over several speeds, reported at the speed `own` (rpm).

    Its status is that of the first part that is not usable, or of the first part if all are."""
    (head,) = (part.evaluation for part in parts if part.speed_rpm == own)
    found = together(head, parts, overall(parts), {"speeds": len(parts)})
    return dataclasses.replace(found, maxima=None, rivals=(), speeds=tuple(parts))


def alone(config: Config, speed_rpm: float | None = None) -> Config:
    """Return `config` with the single speed `speed_rpm`, by default the scene's own speed."""
    speed = config.scene.speed_rpm if speed_rpm is None else speed_rpm
    none = {"speeds_rpm": (), "speed_weights": (), "over_speeds": "weighted"}
    return config.model_copy(
        update={
            "scene": config.scene.model_copy(update={"speed_rpm": speed}),
            "objective": config.objective.model_copy(update=none),
        }
    )


def shares(config: Config) -> dict[float, float]:
    """Return the speeds (rpm) that a config's objective needs, ascending, with their shares.

    The scene's own speed is included, with share 0 if the objective does not contain this speed."""
    objective = config.objective
    speeds = objective.speeds_rpm or (config.scene.speed_rpm,)
    weights = objective.speed_weights or (1.0,) * len(speeds)
    found = {config.scene.speed_rpm: 0.0}
    found |= {s: w / sum(weights) for s, w in zip(speeds, weights, strict=True)}
    return dict(sorted(found.items()))


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


def swept_speeds(config: Config) -> list[float]:
    """Return the speeds (rpm) of the config's sweep, ascending."""
    wanted = config.sweep.speed_rpm
    if wanted is None and config.objective.speeds_rpm:
        return sorted(config.objective.speeds_rpm)
    if wanted is None:
        own = config.scene.speed_rpm
        wanted = {"from": 0.1 * own, "to": 2 * own, "points": 39}
    return np.linspace(wanted["from"], wanted["to"], int(wanted["points"])).tolist()


def sweep(
    evaluator: Evaluates,
    speeds_rpm: Sequence[float],
    design: Any = None,
    progress: Callable[[int, int], None] = lambda done, expected: None,
) -> tuple[Part, ...]:
    """Evaluate `design` (config units; default: the config's own) at each of the speeds, from rest.

    `evaluator`: an evaluator for a single speed; `progress` is called with (number of speeds done,
    number of speeds). All parts of the result have equal shares.
    """
    parts: list[Part] = []

    def at(speed: float) -> Part:
        found = evaluator.at_speed(speed)(design, series=False)
        return Part({"speed_rpm": speed}, found, 1 / len(speeds_rpm))

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        for part in pool.map(at, speeds_rpm):
            parts.append(part)
            progress(len(parts), len(speeds_rpm))
    return tuple(parts)


def overall(parts: Sequence[Part]) -> tuple[Status, str]:
    """Return status and message of the first part that is not usable, or of the first part if all
    are."""
    for part in parts:
        if not part.evaluation.usable:
            return part.evaluation.status, f"At {part.speed_rpm:g} rpm: {part.evaluation.message}"
    return parts[0].evaluation.status, parts[0].evaluation.message
