"""First-order description of an optimisation problem at one point.

The objective is a smooth function plus a sum of maxima over groups of smooth *branches*:

    f(x) = s(x) + Σ_g max_i b_gi(x),    subject to c_j(x) ≥ 0 and 0 ≤ x ≤ 1.

Branches are, for example, the local maxima of the contact force, or the objective at several speeds
of which the worst counts. Each branch is smooth where the maximum over them has a corner.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class Group(NamedTuple):
    """The branches of one maximum.

    `tags` (k, 2): what tells branches apart at neighbouring points: a kind (whole number), and a
    phase within the kind, periodic with period 1; `values` (k,); `slopes` (k, d).
    """

    tags: NDArray[np.float64]
    values: NDArray[np.float64]
    slopes: NDArray[np.float64]

    @property
    def top(self) -> float:
        """The greatest branch."""
        return float(np.max(self.values))


class Local(NamedTuple):
    """Values and slopes of objective and constraints at one point x (d,).

    `smooth`, `slope` (d,): smooth part of the objective; `groups`: its maxima; `slack` (m,),
    `normals` (m, d): constraints c ≥ 0 and their gradients.
    """

    smooth: float
    slope: NDArray[np.float64]
    groups: tuple[Group, ...]
    slack: NDArray[np.float64]
    normals: NDArray[np.float64]

    @property
    def objective(self) -> float:
        """Value of the objective."""
        return self.smooth + sum(group.top for group in self.groups)

    @property
    def violation(self) -> float:
        """Greatest violation of a constraint; 0 where all are satisfied."""
        return max(0.0, -float(np.min(self.slack, initial=0.0)))

    def combined(self, shares: tuple[NDArray[np.float64], ...]) -> NDArray[np.float64]:
        """Return the slope (d,) of the objective with given `shares` (k,) of each group."""
        pairs = zip(shares, self.groups, strict=True)
        return self.slope + sum((share @ g.slopes for share, g in pairs), np.zeros(len(self.slope)))


Look = Callable[[NDArray[np.float64]], Local | None]
"""Evaluates a problem at a point (d,); None where there is no objective."""

__all__ = ["Group", "Local", "Look"]
