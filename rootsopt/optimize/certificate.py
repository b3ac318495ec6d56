"""First-order certificate of an optimum: Karush-Kuhn-Tucker residual and multipliers.

A point is a first-order optimum if non-negative multipliers of active constraints and bounds, and
shares of the active branches that add up to 1 per group, make the gradient of the Lagrangian zero.
They are computed from the point alone by non-negative least squares, so the certificate does not
depend on the method that found the point. See Nocedal and Wright, Numerical Optimization (2006),
section 12.3; for maxima of branches, the same conditions of the epigraph form.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from rootsopt.optimize.local import Local

NEAR = 1e-4
"""Distance from a limit, or of a branch from the greatest one, up to which it can be active."""
_WEIGHT = 1e4
"""Weight of the condition that shares add up to 1. It holds exactly where the residual is 0."""
_NEGLIGIBLE = 1e-6
"""Length of a constraint's gradient up to which the constraint cannot hold a design."""


class Certificate(NamedTuple):
    """First-order conditions at a point.

    `residual`: length of the Lagrangian's gradient, together with the products of multipliers and
    distances from the limits (complementarity), in the objective's unit per side of the unit box;
    `violation`: greatest violation of a constraint; `multipliers` (m,) of the constraints, `lower`
    and `upper` (d,) of the bounds; `shares`: one array (k,) per group, which add up to 1.
    """

    residual: float
    violation: float
    multipliers: NDArray[np.float64]
    lower: NDArray[np.float64]
    upper: NDArray[np.float64]
    shares: tuple[NDArray[np.float64], ...]

    def holds(self, tolerance: float, feasibility: float) -> bool:
        """Return whether the point is a first-order optimum within the tolerances."""
        return self.residual <= tolerance and self.violation <= feasibility


def certify(local: Local, point: NDArray[np.float64], near: float = NEAR) -> Certificate:
    """Return the certificate of a `point` (d,) of the unit box, from what is known there.

    `near`: distance up to which limits and branches can be active."""
    size, rows = len(point), []
    gaps: list[NDArray[np.float64]] = []
    chosen: list[NDArray[np.bool_]] = []
    for group in local.groups:
        gap = group.top - group.values
        chosen.append(gap <= near)
        rows.append(group.slopes[chosen[-1]])
        gaps.append(gap[chosen[-1]])
    long = np.linalg.norm(local.normals, axis=1) > _NEGLIGIBLE
    limits = (
        ((local.slack <= near) & long, -local.normals, np.maximum(local.slack, 0.0)),
        (point <= near, -np.eye(size), point),
        (1 - point <= near, np.eye(size), 1 - point),
    )
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
    multipliers, lower, upper = numbers
    left = local.combined(tuple(shares)) - multipliers @ local.normals - lower + upper
    apart = [s * (g.top - g.values) for s, g in zip(shares, local.groups, strict=True)]
    apart += [multipliers * np.maximum(local.slack, 0.0), lower * point, upper * (1 - point)]
    residual = float(np.linalg.norm(np.concatenate([left, *apart])))
    return Certificate(residual, local.violation, multipliers, lower, upper, tuple(shares))


__all__ = ["NEAR", "Certificate", "certify"]
