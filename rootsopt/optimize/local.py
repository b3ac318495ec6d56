"""An optimisation problem at one point of the unit box, to first order.

The objective is a smooth function s plus a sum of maxima over groups g of smooth *branches* b:

    f(x) = s(x) + Σ_g max_i b_gi(x),    subject to c_j(x) ≥ 0, max_i w_ki(x) ≤ 0 and 0 ≤ x ≤ 1.

For example, the local maxima of the contact force over time are the branches of its peak. If only
the worst of several speeds counts, the objectives at these speeds are branches. Each branch is
smooth, even where the maximum has a corner. The same holds for the *walls* w_k: limits of a
quantity that is a maximum over branches.

At a first-order optimum, the gradient of the Lagrangian is zero. The Lagrangian contains the active
constraints and bounds, each with a non-negative multiplier. It also contains the active branches,
each with a non-negative share. The shares of one maximum add up to 1. Multipliers and shares are
computed from the point alone, by non-negative least squares. The certificate therefore does not
depend on the method that found the point. See Nocedal and Wright, Numerical Optimization (2006),
section 12.3. For the maxima, these are the conditions of the epigraph form, in which a variable
bounds each branch from above."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

RESIDUAL = 1e-4
"""First-order residual above which a design does not count as converged."""
NEAR = 1e-4
"""Distance above which a limit or a branch cannot be active.

For a constraint, the distance is its scaled slack. For a bound, it is measured in the unit box. For
a branch, it is the difference from the greatest branch."""

FEASIBLE = 1e-6
"""Scaled violation of a constraint above which a point counts as infeasible. It is also the
distance from a bound of the unit box above which the bound counts as inactive."""
# Weight, in the least-squares problem, of the condition that the shares of a maximum sum to 1.
_WEIGHT = 1e4

# Norm of a constraint's scaled gradient below which the constraint counts as inactive.
_NEGLIGIBLE = 1e-6


class Group(NamedTuple):
    """The k branches of one maximum.

    `tags` (k, 2): kind and phase of each branch, which identify it at neighbouring points. The kind
    is a whole number. The phase is periodic with period 1.

    `values` (k,): value of each branch; `slopes` (k, d): its gradient."""

    tags: NDArray[np.float64]
    values: NDArray[np.float64]
    slopes: NDArray[np.float64]

    @property
    def top(self) -> float:
        """Greatest value of all branches."""
        return float(np.max(self.values))


class Linearization(NamedTuple):
    """Objective and m constraints at one point x (d,), with their gradients.

    `smooth`: smooth part of the objective; `slope` (d,): its gradient; `groups`: the maxima that
    are added to it. `slack` (m,): values of the constraints c ≥ 0; `normals` (m, d): their
    gradients. `walls`: limits of maxima over branches; each branch must be at most 0."""

    smooth: float
    slope: NDArray[np.float64]
    groups: tuple[Group, ...]
    slack: NDArray[np.float64]
    normals: NDArray[np.float64]
    walls: tuple[Group, ...] = ()

    @property
    def objective(self) -> float:
        """Value of the objective: the smooth part plus all maxima."""
        return self.smooth + sum(group.top for group in self.groups)

    @property
    def violation(self) -> float:
        """Greatest violation of a constraint or wall; 0 if all are satisfied."""
        beyond = max((wall.top for wall in self.walls), default=0.0)
        return max(0.0, -float(np.min(self.slack, initial=0.0)), beyond)

    @property
    def minorants(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Values (k,) and gradients (k, d) of k branches of the objective, the greatest first.

        The first sums up the greatest branch of each maximum. In each other one, one maximum has
        another branch."""
        first = [int(np.argmax(group.values)) for group in self.groups]
        slope = self.slope + sum(
            (g.slopes[k] for k, g in zip(first, self.groups, strict=True)), 0.0
        )
        values, slopes = [np.array([self.objective])], [slope[None]]
        for top, group in zip(first, self.groups, strict=True):
            others = np.arange(len(group.values)) != top
            values.append(self.objective + group.values[others] - group.values[top])
            slopes.append(slope + group.slopes[others] - group.slopes[top])
        return np.concatenate(values), np.concatenate(slopes)

    def combined(self, shares: tuple[NDArray[np.float64], ...]) -> NDArray[np.float64]:
        """Return the gradient (d,) of the smooth part plus the weighted branches.

        `shares`: one array (k,) per group, with a weight for each branch."""
        pairs = zip(shares, self.groups, strict=True)
        return self.slope + sum((share @ g.slopes for share, g in pairs), np.zeros(len(self.slope)))


Look = Callable[[NDArray[np.float64]], Linearization | None]
"""Function that returns the problem at a point (d,), or `None` if there is no objective at this
point."""


class Certificate(NamedTuple):
    """First-order conditions at a point, for d design parameters and m constraints.

    `residual`: norm of all conditions that should be zero, in the objective's unit per side of the
    unit box. One condition is the Lagrangian's gradient. The others are complementarity products:
    each multiplier or share, times the distance of its limit or branch from being active.

    `violation`: greatest scaled violation of a constraint. `multipliers` (m,): those of the
    constraints. `lower`, `upper` (d,): multipliers of the bounds. `shares`: one array (k,) for each
    maximum over k branches, whose entries add up to 1. `walls`: one array (k,) for each wall, with
    a multiplier for each of its k branches."""

    residual: float
    violation: float
    multipliers: NDArray[np.float64]
    lower: NDArray[np.float64]
    upper: NDArray[np.float64]
    shares: tuple[NDArray[np.float64], ...]
    walls: tuple[NDArray[np.float64], ...] = ()

    @property
    def total(self) -> float:
        """Sum of the multipliers of all constraints and walls."""
        return float(np.sum(self.multipliers) + sum(map(np.sum, self.walls)))

    def holds(self, tolerance: float, feasibility: float) -> bool:
        """Return whether the conditions hold within tolerances.

        `tolerance`: greatest accepted `residual`; `feasibility`: greatest accepted `violation`."""
        return self.residual <= tolerance and self.violation <= feasibility


def certify(local: Linearization, point: NDArray[np.float64], near: float = NEAR) -> Certificate:
    """Return the certificate of a `point` (d,) of the unit box.

    `local`: objective and constraints at the point, with gradients. `near`: distance above which
    limits and branches cannot be active, as in `NEAR`."""
    from scipy.optimize import nnls  # Slow import (0.3 s).

    size, rows = len(point), []
    gaps: list[NDArray[np.float64]] = []
    chosen: list[NDArray[np.bool_]] = []
    for group in local.groups:
        gap = group.top - group.values
        chosen.append(gap <= near)
        rows.append(group.slopes[chosen[-1]])
        gaps.append(gap[chosen[-1]])
    long = np.linalg.norm(local.normals, axis=1) > _NEGLIGIBLE
    limits = [
        ((local.slack <= near) & long, -local.normals, np.maximum(local.slack, 0.0)),
        (point <= near, -np.eye(size), point),
        (1 - point <= near, np.eye(size), 1 - point),
    ]
    for wall in local.walls:
        steep = np.linalg.norm(wall.slopes, axis=1) > _NEGLIGIBLE
        limits.append(((-wall.values <= near) & steep, wall.slopes, np.maximum(-wall.values, 0.0)))
    for active, normals, gap in limits:
        rows.append(normals[active])
        gaps.append(gap[active])
    every, gap = np.concatenate(rows), np.concatenate(gaps)
    counts = [int(np.sum(one)) for one in chosen]
    sums = np.zeros((len(counts), len(every)))
    begin = 0
    for k, count in enumerate(counts):
        sums[k, begin : begin + count] = _WEIGHT
        begin += count
    matrix = np.concatenate([every.T, np.diag(gap), sums])
    wanted = np.concatenate([-local.slope, np.zeros(len(gap)), np.full(len(counts), _WEIGHT)])
    found = nnls(matrix, wanted)[0] if matrix.shape[1] else np.zeros(0)
    shares = []
    for mask, count in zip(chosen, counts, strict=True):
        part, found = found[:count], found[count:]
        total = np.sum(part)
        share = np.zeros(len(mask))
        share[mask] = part / total if total > 0 else 1 / count
        shares.append(share)
    numbers = []
    for active, _, _ in limits:
        count = int(np.sum(active))
        values = np.zeros(len(active))
        values[active], found = found[:count], found[count:]
        numbers.append(values)
    multipliers, lower, upper, *walls = numbers
    left = local.combined(tuple(shares)) - multipliers @ local.normals - lower + upper
    for wall, held in zip(local.walls, walls, strict=True):
        left = left + held @ wall.slopes
    apart = [s * (g.top - g.values) for s, g in zip(shares, local.groups, strict=True)]
    apart += [value * gap for value, (_, _, gap) in zip(numbers, limits, strict=True)]
    residual = float(np.linalg.norm(np.concatenate([left, *apart])))
    held = multipliers, lower, upper, tuple(shares), tuple(walls)
    return Certificate(residual, local.violation, *held)
