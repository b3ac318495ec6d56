"""Descent by an update rule of optax, for objectives with noise.

It projects the gradient onto the directions that active constraints allow, and each new point onto
the feasible set."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rootsopt.optimize.outcome import Trial
from rootsopt.optimize.problem import Problem
from rootsopt.runtime.programs import CachedFunction

# Number of successive steps without a gain above which a descent ends.
_PATIENCE = 4

# Relative decrease of the best objective below which a step does not count as a gain.
_GAIN = 1e-4

# Norm of the projected gradient (objective per side of the unit box) below which a descent ends.
_STATIONARY = 1e-3


def descended(
    problem: Problem,
    evaluate: Callable[[NDArray[np.float64], int, Any], Trial],
    point: NDArray[np.float64],
    rule: tuple[str, float, int],
    noisy: bool,
    asked: Callable[[], bool],
) -> list[Trial]:
    """Descend from `point` (d,) in the unit box, and return the trials.

    `evaluate`: takes a point, the number of the iteration, and where the motion begins; `rule`:
    optax rule, learning rate, number of iterations; `noisy`: whether steps without a gain say
    nothing; `asked`: whether to end."""
    state = _init(*rule, point)
    best, since = np.inf, 0
    trials: list[Trial] = []
    last: Trial | None = None
    for iteration in range(rule[2] + 1):
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
        since = 0 if trial.objective < best * (1 - _GAIN) else since + 1
        best = min(best, trial.objective)
        # If objectives are noisy, steps without a gain do not show that the descent has converged.
        if (since > _PATIENCE and not noisy) or iteration == rule[2]:
            break
        slope = problem.descent(point, problem.slope(trial.evaluation, point))
        if np.linalg.norm(slope) < _STATIONARY:
            break
        update, state = _update(*rule, slope, state)
        point = problem.toward(point + np.asarray(update), point)
    return trials


def _rule(method: str, learning_rate: float, iterations: int):
    """Return the update rule of optax that `method` names."""
    import optax

    return getattr(optax, method)(optax.cosine_decay_schedule(learning_rate, iterations, 0.05))


@CachedFunction
def _init(method, learning_rate, iterations, point):
    """Return the initial state of an update rule at `point` (d,)."""
    return _rule(method, learning_rate, iterations).init(point)


@CachedFunction
def _update(method, learning_rate, iterations, slope, state):
    """Return (step (d,), next state) of an update rule, given the gradient `slope` (d,)."""
    return _rule(method, learning_rate, iterations).update(slope, state)
