"""Values and gradients of an optimisation problem at one point of the unit box.

The objective is a smooth function s plus a sum of maxima over groups g of smooth *branches* b:

    f(x) = s(x) + Σ_g max_i b_gi(x),    subject to c_j(x) ≥ 0, max_i w_ki(x) ≤ 0 and 0 ≤ x ≤ 1.

For example, the local maxima of the contact force over time are the branches of its peak. If only
the worst of several speeds counts, the objectives at these speeds are branches. Each branch is
smooth, even where the maximum has a corner. The same holds for the *walls* w_k: limits of a
quantity that is a maximum over branches."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


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
