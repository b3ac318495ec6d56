"""Explains why no design satisfies all constraints, and which limits could be met instead.

A search minimises the greatest scaled violation of all constraints (elastic mode). See Nocedal and
Wright, Numerical Optimization (2006), section 18.5. The constraints that keep this minimum above
zero are in conflict. Only the geometry is needed, so no design is simulated."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rootsopt.design.space import Constraint
from rootsopt.optimize.local import Group, Local
from rootsopt.optimize.problem import FEASIBLE, Problem
from rootsopt.optimize.sqp import Found, Stops, descend

_STOPS = Stops(residual=1e-7, feasibility=1e-9, evaluations=300)
_PART = 1e-3
"""Share of a constraint in the least violation above which the constraint counts as in conflict.
The shares of all constraints add up to 1."""


class Conflict(NamedTuple):
    """A constraint that is in conflict with others.

    `name`: name in reports; `sense`: "<=" or ">="; `limit`: required limit; `unit`: unit of all
    values. `together`: value in the design of least violation. `alone`: nearest limit that can be
    met while all other constraints hold, or `None` if no such design was found."""

    name: str
    sense: str
    limit: float
    unit: str
    together: float
    alone: float | None


class Infeasible(NamedTuple):
    """Why no design satisfies all constraints.

    `violation`: least possible value of the greatest scaled violation; `conflicts`: the constraints
    in conflict; `design`: design of least violation, in config units by key. If no design could be
    evaluated, `violation` is NaN and the others are empty."""

    violation: float
    conflicts: tuple[Conflict, ...]
    design: dict[str, float]

    @property
    def message(self) -> str:
        """Message for the user: constraints in conflict, and limits that can be met."""
        lines = []
        for one in self.conflicts:
            unit = f" {one.unit}" if one.unit else ""
            line = f"{one.name} {one.sense} {one.limit:.5g}{unit}"
            if one.alone is not None:
                line += f" (possible with the others: {one.alone:.5g}{unit})"
            lines.append(line)
        return (
            "No design within optimizer.bounds satisfies all constraints. In conflict: "
            f"{'; '.join(lines)}. Relax one of these to the value in brackets, or widen "
            "optimizer.bounds."
        )

    def record(self) -> dict[str, Any]:
        """Return the entries `violation`, `conflicts` and `design` of the result file."""
        conflicts = [one._asdict() for one in self.conflicts]
        return {"violation": self.violation, "conflicts": conflicts, "design": self.design}


def explain(problem: Problem, starts: Sequence[NDArray[np.float64]]) -> Infeasible:
    """Return why no design satisfies all constraints of a `problem`.

    `starts`: points (d,) of the unit box from which to search for the least violation."""
    constraints = problem.space.constraints
    nothing = np.zeros(0), np.zeros((0, len(problem.space.lower)))

    def greatest(point: NDArray[np.float64]) -> Local | None:
        slack, normals = problem.look(point)[2:]
        if not np.all(np.isfinite(slack)) or not np.all(np.isfinite(normals)):
            return None
        tags = np.stack([np.arange(len(slack)), np.zeros(len(slack))], axis=1).astype(float)
        return Local(0.0, np.zeros(len(point)), (Group(tags, -slack, -normals),), *nothing)

    best = _best([descend(greatest, start, _STOPS) for start in starts])
    if best is None or best.certificate is None or best.local is None:
        return Infeasible(float("nan"), (), {})
    (shares,) = best.certificate.shares
    slack = -best.local.groups[0].values
    conflicts = []
    for k in np.flatnonzero(shares > _PART):
        one = constraints[k]
        alone = _alone(problem, int(k), [best.point, *starts])
        reached = _in_units(one, slack[k])
        sense = "<=" if one.ceiling else ">="
        limit = float(one.limit) / one.factor
        conflicts.append(Conflict(one.name, sense, limit, one.unit, reached, alone))
    names = problem.config.design_keys
    design = dict(zip(names, map(float, problem.design(best.point)), strict=True))
    return Infeasible(best.local.objective, tuple(conflicts), design)


def _alone(problem: Problem, k: int, starts: Sequence[NDArray[np.float64]]) -> float | None:
    """Return the nearest limit of constraint `k`, in its unit, that can be met if all others hold.

    `starts`: points (d,) of the unit box from which to search. Return `None` if the searches find
    no point that satisfies the other constraints."""

    def look(point: NDArray[np.float64]) -> Local | None:
        slack, normals = problem.look(point)[2:]
        if not np.all(np.isfinite(slack)) or not np.all(np.isfinite(normals)):
            return None
        others = np.delete(slack, k), np.delete(normals, k, axis=0)
        return Local(-float(slack[k]), -normals[k], (), *others)

    found = [descend(look, start, _STOPS) for start in starts]
    found = [one for one in found if one.local is not None and one.local.violation <= FEASIBLE]
    best = _best(found)
    if best is None or best.local is None:
        return None
    return _in_units(problem.space.constraints[k], -best.local.objective)


def _best(found: Sequence[Found]) -> Found | None:
    usable = [(one.local.objective, one) for one in found if one.local is not None]
    return min(usable, key=lambda pair: pair[0], default=(0.0, None))[1]


def _in_units(constraint: Constraint, slack: float) -> float:
    """Return a constraint's value in its reported unit, given its scaled `slack`."""
    limit = float(constraint.limit)
    return (limit + constraint.sign * float(slack) * constraint.scale) / constraint.factor


__all__ = ["Conflict", "Infeasible", "explain"]
