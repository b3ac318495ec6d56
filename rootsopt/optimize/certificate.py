"""First-order certificate of an optimum: Karush-Kuhn-Tucker residual and multipliers.

The objective is a smooth function plus maxima over branches (`rootsopt.optimize.local`). At a
first-order optimum, the gradient of the Lagrangian is zero. The Lagrangian contains the active
constraints and bounds, each with a non-negative multiplier. It also contains the active branches,
each with a non-negative share. The shares of one maximum add up to 1.

Multipliers and shares are computed from the point alone, by non-negative least squares. The
certificate therefore does not depend on the method that found the point. See Nocedal and Wright,
Numerical Optimization (2006), section 12.3. For the maxima, these are the conditions of the
epigraph form, in which a variable bounds each branch from above."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rootsopt.optimize.local import Linearization

RESIDUAL = 1e-4
"""First-order residual above which a design does not count as converged."""
NEAR = 1e-4
"""Distance above which a limit or a branch cannot be active.

For a constraint, the distance is its scaled slack. For a bound, it is measured in the unit box. For
a branch, it is the difference from the greatest branch."""

# Weight, in the least-squares problem, of the condition that the shares of a maximum sum to 1.
_WEIGHT = 1e4

# Norm of a constraint's scaled gradient below which the constraint counts as inactive.
_NEGLIGIBLE = 1e-6


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
