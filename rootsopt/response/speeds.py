"""The speeds of a config: for `objective.speeds_rpm`, and for `rootsopt sweep`."""

from collections.abc import Callable, Iterable

import numpy as np

from rootsopt.config import Config
from rootsopt.response.result import Evaluation, Part


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
    """Return the speeds (rpm) of a sweep without keys, ascending.

    They are those of the objective, or from 0.1 to 2 times that of the scene."""
    own = config.scene.speed_rpm
    return sorted(config.objective.speeds_rpm) or np.linspace(0.1 * own, 2 * own, 39).tolist()


def parts_at(
    shares: Iterable[tuple[float, float]], found: Iterable[Evaluation]
) -> tuple[Part, ...]:
    """Return the parts of evaluations at several speeds; `shares`: (speed in rpm, share)."""
    pairs = zip(shares, found, strict=True)
    return tuple(Part({"speed_rpm": speed}, one, share) for (speed, share), one in pairs)
