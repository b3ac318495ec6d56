"""What is left of a gain if the rotors are not exactly as drawn.

Baseline and optimised design are evaluated again with the same errors of manufacture: all flanks
too full or too lean, and the axes too near or too far."""

import dataclasses
import math
from typing import Any

import numpy as np

from rootsopt.config import Config
from rootsopt.optimize.outcome import Optimization
from rootsopt.response.evaluation import Evaluator
from rootsopt.response.many import Point, evaluate_many
from rootsopt.response.still import needed_motion
from rootsopt.status import Status

ERROR = 0.01
"""Error (mm) of the profile along its normal, and of the centre distance."""

# Errors (mm) of profile and centre distance by the name of the case.
_CASES = {
    "as drawn": (0.0, 0.0),
    f"flanks {1e3 * ERROR:g} µm fuller": (ERROR, 0.0),
    f"flanks {1e3 * ERROR:g} µm leaner": (-ERROR, 0.0),
    f"axes {1e3 * ERROR:g} µm nearer": (0.0, -ERROR),
    f"axes {1e3 * ERROR:g} µm farther": (0.0, ERROR),
}


def surviving(result: Optimization, given: Config) -> list[dict[str, Any]]:
    """Return one row per case: the drawing first, then each error alone.

    `given`: config of the baseline, whose family may be another than that of the search.

    A row holds the name of the `case`, the objectives `baseline` and `optimized` (relative to the
    baseline as drawn), the relative `gain` between them, its `share` of the gain as drawn, and
    their `statuses`. Numbers are NaN if one of the two has no steady state. Return [] without an
    optimised design."""
    problem = result.problem
    if problem is None or result.optimized is None:
        return []
    # With an error of 0 as well, so that one program serves all cases.
    own = given.scene.center_distance_error_mm or 0.0
    known = {"scene.center_distance_error_mm": own}
    pairs = (given, result.baseline), (problem.config, result.optimized)
    configs = [config.moved(known) for config, _ in pairs]
    evaluators = [needed_motion(config).without_gradient() for config in configs]
    designs = [np.array([*one.design.values()]) for _, one in pairs]

    def moved(config: Config, evaluator: Evaluator, full: float, away: float) -> Evaluator:
        # Both flanks of a gap move. The scene takes a negative clearance, which no config may have.
        tip = config.value("pump.tip_clearance_mm")
        values = {"contact.clearance_mm": config.contact.clearance_mm - 2 * full}
        values |= {"scene.center_distance_error_mm": own + away}
        values |= {} if tip is None else {"pump.tip_clearance_mm": max(0.0, tip - full)}
        return dataclasses.replace(evaluator, scene=evaluator.scene.renewed(config.moved(values)))

    both = [*zip(configs, evaluators, designs, strict=True)]
    found = evaluate_many(
        Point(moved(config, evaluator, *errors), design)
        for errors in _CASES.values()
        for config, evaluator, design in both
    )
    # Where an orbit does not close, as between jammed flanks, the window still has its forces.
    closed = {Status.NOT_CLOSED: Status.PERIODIC}
    numbers = [
        problem.objective(dataclasses.replace(one, status=closed.get(one.status, one.status)))
        for one in found
    ]
    pairs = [*zip(numbers[::2], numbers[1::2], strict=True)]
    gains = [1 - after / before for before, after in pairs]
    states = [one.status.label for one in found]
    return [
        {"case": name, "baseline": pair[0], "optimized": pair[1], "gain": gain,
         "share": gain / gains[0], "statuses": states[2 * k : 2 * k + 2]}
        for k, (name, pair, gain) in enumerate(zip(_CASES, pairs, gains, strict=True))
    ]  # fmt: skip


def survives(rows: list[dict[str, Any]]) -> str:
    """Return a sentence on the share of the gain that is left in the worst case; "" without rows.

    `rows`: result of `surviving`."""
    lost = [one["case"] for one in rows if not math.isfinite(one["share"])]
    if not rows or lost:
        return f"Unknown with {lost[0]}: a rotor has no steady state there." if lost else ""
    worst = min(rows, key=lambda one: one["share"])
    return (
        f"With errors of ±{1e3 * ERROR:g} µm, at least {100 * worst['share']:.3g} % of the gain "
        f"is left (worst: {worst['case']})."
    )
