"""Choose the evaluator that a config needs: for one motion, for all coexisting motions or for an
ensemble; at one speed or over several."""

from rootsopt.config import Config
from rootsopt.response.attractors import AttractorEvaluator
from rootsopt.response.ensemble import EnsembleEvaluator
from rootsopt.response.evaluation import Evaluator
from rootsopt.response.speeds import SpeedsEvaluator
from rootsopt.response.wrapper import Evaluates


def evaluator_for(config: Config) -> Evaluates:
    """Return the evaluator that `objective.motion` and `objective.speeds_rpm` select."""
    single = Evaluator.of(config)
    found: Evaluates = single
    if config.objective.motion == "ensemble":
        found = EnsembleEvaluator(single)
    elif config.objective.motion in ("worst", "weighted"):
        found = AttractorEvaluator(single)
    if config.objective.speeds_rpm:
        found = SpeedsEvaluator(found)
    return found
