"""Which evaluator a config asks for: of one motion, of all that coexist, or of an ensemble; at one
speed or over several."""

import copy
from typing import Any

from rootsopt.config import Config
from rootsopt.evaluate import Evaluator


def evaluator_for(config: Config, **options: Any) -> Evaluator:
    """The evaluator that `objective.motion` and `objective.speeds_rpm` ask for, with the options of
    an `Evaluator`."""
    several = bool(config.objective.speeds_rpm)
    if config.objective.motion == "ensemble":
        from rootsopt.ensemble import EnsembleEvaluator

        return EnsembleEvaluator(config, **options)
    if config.objective.motion in ("worst", "weighted"):
        from rootsopt.basins import AttractorEvaluator
        from rootsopt.speeds import SpeedsAttractorEvaluator

        return (SpeedsAttractorEvaluator if several else AttractorEvaluator)(config, **options)
    if several:
        from rootsopt.speeds import SpeedsEvaluator

        return SpeedsEvaluator(config, **options)
    return Evaluator(config, **options)


def without_gradient(evaluator: Evaluator) -> Evaluator:
    """`evaluator`, or a copy that leaves out the gradient where that takes most of the time."""
    if hasattr(evaluator, "differentiate"):
        evaluator = copy.copy(evaluator)
        evaluator.differentiate = False  # type: ignore[attr-defined]
    return evaluator
