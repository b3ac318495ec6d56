"""What is known about an optimum: its certificate, what holds it, and how the starts agree."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rootsopt.optimize.certificate import Certificate
from rootsopt.optimize.sqp import REASONS

RESIDUAL = 1e-4
"""First-order residual up to which an optimum counts as converged."""
_SAME = 1e-4, 0.03
"""Differences of objective (relative) and point (in the unit box) up to which two local searches
have found the same optimum."""

_REASONS = REASONS | {
    "descent": (
        "The descent has a step size and no test for an optimum: the design may be short of it. "
        "Set optimizer.method to auto."
    ),
    "verification": (
        "The first-order conditions held in the search, but not when the design was simulated "
        "again from rest. Tighten solver.rtol."
    ),
}


class StartOutcome(NamedTuple):
    """What one local search has found.

    `start`: its number; `objective`, NaN if not usable; `residual`; `reason` for its end;
    `evaluations`; `design` in config units; `point` (d,) of the unit box.
    """

    start: int
    objective: float
    residual: float
    reason: str
    evaluations: int
    design: dict[str, float]
    point: NDArray[np.float64]


class Holder(NamedTuple):
    """A branch of the objective that is active at the optimum.

    `speed_rpm`: NaN for a single speed; `rotation_deg` of rotor 1 at the maximum of the force
    (degrees from φ1 = 0, NaN where the branch is no maximum); `force_N`: its height; `objective`:
    value of the branch; `share` of it in the objective's slope.
    """

    speed_rpm: float
    rotation_deg: float
    force_N: float
    objective: float
    share: float

    def record(self) -> dict[str, float | None]:
        """Return the entries for the result file."""
        return {k: None if math.isnan(v) else v for k, v in self._asdict().items()}


class Optimum(NamedTuple):
    """One of the distinct optima that the starts have led to.

    `objective`; `found`: by how many of the starts; `design` in config units.
    """

    objective: float
    found: int
    design: dict[str, float]


@dataclasses.dataclass(frozen=True)
class Optimality:
    """What is known about the optimum of a search.

    `method` of the local searches; `certificate` at the verified design; `reason`: a word for why
    the search stopped; `holders`: branches that are active; `starts`: outcome of each local search;
    `sensitivities`: rows of the table of scene quantities.
    """

    method: str
    certificate: Certificate
    reason: str
    holders: Sequence[Holder]
    starts: Sequence[StartOutcome]
    sensitivities: Sequence[dict[str, Any]] = ()

    @property
    def converged(self) -> bool:
        """Whether the design satisfies the first-order conditions of an optimum."""
        return self.reason == "converged"

    @property
    def message(self) -> str:
        """Explanation of the reason, with advice."""
        return _REASONS[self.reason]

    @property
    def optima(self) -> list[Optimum]:
        """Distinct optima among the converged starts, the best first."""
        return distinct([one for one in self.starts if one.reason == "converged"])

    def record(self) -> dict[str, Any]:
        """Return the entries for the result file."""
        optima = self.optima
        return {
            "method": self.method,
            "converged": self.converged,
            "reason": self.reason,
            "message": self.message,
            "residual": self.certificate.residual,
            "required_residual": RESIDUAL,
            "violation": self.certificate.violation,
            "held_by": [one.record() for one in self.holders],
            "starts": [
                {
                    "start": one.start,
                    "objective": None if math.isnan(one.objective) else one.objective,
                    "residual": None if math.isnan(one.residual) else one.residual,
                    "reason": one.reason,
                    "evaluations": one.evaluations,
                    "design": one.design,
                }
                for one in self.starts
            ],
            "optima": [one._asdict() for one in optima],
            "unseen": unseen(sum(one.found for one in optima), len(optima)),
            "sensitivities": [*self.sensitivities],
        }


def distinct(starts: Sequence[StartOutcome]) -> list[Optimum]:
    """Return the distinct optima among local searches, the best first.

    Two searches have found the same optimum if both their objectives and their points agree."""
    groups: list[list[StartOutcome]] = []
    relative, near = _SAME
    for one in sorted(starts, key=lambda one: one.objective):
        for group in groups:
            first = group[0]
            alike = abs(one.objective - first.objective) <= relative * abs(first.objective)
            if alike and np.max(np.abs(one.point - first.point)) <= near:
                group.append(one)
                break
        else:
            groups.append([one])
    return [Optimum(group[0].objective, len(group), group[0].design) for group in groups]


def unseen(searches: int, optima: int) -> dict[str, float | None]:
    """Return the Bayesian estimates of optima that were not found.

    `searches`: number of local searches N that ended at an optimum; `optima`: number W of distinct
    ones. `expected_optima`: posterior mean W (N - 1) / (N - W - 2) of the number of optima.
    `share_of_starts`: posterior mean W (W + 1) / (N (N - 1)) of the probability that a further
    start would end at a new one. Both assume that the starts are drawn independently, without
    knowledge of the number of optima. None where the searches are too few. Source: Boender and
    Rinnooy Kan, Bayesian stopping rules for multistart global optimization methods, Mathematical
    Programming 37 (1987) 59-80.
    """
    count, n = optima, searches
    expected = count * (n - 1) / (n - count - 2) if n > count + 2 else None
    share = min(1.0, count * (count + 1) / (n * (n - 1))) if n > 1 else None
    return {"searches": n, "optima": count, "expected_optima": expected, "share_of_starts": share}


__all__ = ["RESIDUAL", "Holder", "Optimality", "Optimum", "StartOutcome", "distinct", "unseen"]
