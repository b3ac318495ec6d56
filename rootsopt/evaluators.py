"""Which evaluator a config asks for: of one motion, of all that coexist, or of an ensemble."""

import copy
from typing import Any

from rootsopt.config import Config
from rootsopt.evaluate import Evaluator


def evaluator_for(config: Config, **options: Any) -> Evaluator:
    """The evaluator that `objective.motion` asks for, with the options of an `Evaluator`."""
    if config.objective.motion == "ensemble":
        from rootsopt.ensemble import EnsembleEvaluator

        return EnsembleEvaluator(config, **options)
    if config.objective.motion in ("worst", "weighted"):
        from rootsopt.basins import AttractorEvaluator

        return AttractorEvaluator(config, **options)
    return Evaluator(config, **options)


def without_gradient(evaluator: Evaluator) -> Evaluator:
    """`evaluator`, or a copy that leaves out the gradient where that takes most of the time."""
    if hasattr(evaluator, "differentiate"):
        evaluator = copy.copy(evaluator)
        evaluator.differentiate = False  # type: ignore[attr-defined]
    return evaluator
