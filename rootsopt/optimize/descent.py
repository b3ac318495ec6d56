"""Descent by Adam's rule, for objectives with noise.

It projects the gradient onto the directions that active constraints allow, and each new point onto
the feasible set."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rootsopt.optimize.outcome import Trial
from rootsopt.optimize.problem import Problem
from rootsopt.runtime.programs import CachedFunction

# Norm of the projected gradient (objective per side of the unit box) below which a descent ends.
_STATIONARY = 1e-3

# First step of the rule (of the unit box).
_STEP = 0.05


def descended(
    problem: Problem,
    evaluate: Callable[[NDArray[np.float64], int, Any], Trial],
    point: NDArray[np.float64],
    iterations: int,
    asked: Callable[[], bool],
) -> list[Trial]:
    """Descend from `point` (d,) in the unit box, and return the trials.

    `evaluate`: takes a point, the number of the iteration, and where the motion begins;
    `iterations`: greatest number; `asked`: whether to end."""
    state = _init(iterations, point)
    trials: list[Trial] = []
    last: Trial | None = None
    for iteration in range(iterations + 1):
        if asked():
            break
        orbit = last.evaluation.start if last is not None and last is trials[-1] else None
        trial = evaluate(point, iteration, orbit)
        trials.append(trial)
        if np.isnan(trial.objective):
            # No usable steady state: go half way back to the last good design.
            if last is None:
                break
            point = problem.toward((point + last.point) / 2, last.point)
            continue
        last = trial
        if iteration == iterations:
            break
        slope = problem.descent(point, problem.slope(trial.evaluation, point))
        if np.linalg.norm(slope) < _STATIONARY:
            break
        update, state = _update(iterations, slope, state)
        point = problem.toward(point + np.asarray(update), point)
    return trials


def _rule(iterations: int):
    """Return the update rule, with steps that shrink over the iterations."""
    import optax

    return optax.adam(optax.cosine_decay_schedule(_STEP, iterations, 0.05))


@CachedFunction
def _init(iterations, point):
    """Return the initial state of the rule at `point` (d,)."""
    return _rule(iterations).init(point)


@CachedFunction
def _update(iterations, slope, state):
    """Return (step (d,), next state) of the rule, given the gradient `slope` (d,)."""
    return _rule(iterations).update(slope, state)
