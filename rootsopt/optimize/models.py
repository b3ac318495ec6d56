"""Second-order models of all functions of a problem near a point, and the step that minimises them.

Each branch, and each limit that needs a simulation, has a model of its own: value and gradient at
the point, and a Hessian. Differences of gradients give the Hessians, and symmetric rank-one updates
correct them after each step (Nocedal and Wright, Numerical Optimization, 2006, section 6.2). With
one Hessian for all functions together, steps leave the feasible set wherever constraints of
different curvature are active (Maratos effect).

Constraints of the geometry need no simulation. A step therefore meets them exactly, not their
models. Along the curved edges of the feasible set, this saves most of the simulations that
linearised constraints cost."""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from rootsopt.optimize.local import Group, Linearization, Look

# Step (unit box) of the difference quotients that give the Hessians.
_STEP = 1e-3

# Difference between phases above which branches at two points count as different.
_SAME = 0.1

# Slack of every constraint at a point where no profile exists.
_ABSENT = -10.0

# Maximum number of iterations of SLSQP for one step. It needs about 15.
_ROUNDS = 60

Rows = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Values (n,) and gradients (n, d) of the functions of a problem."""
Limits = Callable[[NDArray[np.float64]], Rows]
"""Function that returns slacks (m,) and their gradients (m, d) at a point (d,), without a
simulation."""


class Models:
    """Quadratic models of all functions of a problem near a point.

    The n functions are, in this order: the smooth part of the objective; the branches of each
    maximum; the m constraints; the branches of each wall, with the opposite sign. `point` (d,):
    centre; `local`: the problem there, with the n values and gradients in `rows`; `hessians` (n, d,
    d): Hessians; `limits`: function for the constraints, which otherwise have models, too."""

    def __init__(
        self, point: NDArray[np.float64], local: Linearization, limits: Limits | None = None
    ):
        self.point, self.local, self.limits, self.rows = point, local, limits, _rows(local)
        count, size = self.rows[1].shape
        self.hessians = np.zeros((count, size, size))
        sizes = [len(group.values) for group in local.groups]
        self.owner = np.repeat(np.arange(len(sizes)), sizes)
        self._begin = 1 + len(self.owner)
        self._walls = self._begin + len(local.slack)

    def measure(self, at: Look) -> None:
        """Compute the Hessians from differences of gradients.

        `at`: function that evaluates the problem at a point."""
        size = len(self.point)
        columns = np.zeros_like(self.hessians)
        for axis in range(size):
            step = np.zeros(size)
            step[axis] = _STEP if self.point[axis] < 0.5 else -_STEP
            found = at(self.point + step)
            if found is None:
                continue
            slopes, known = _matched(self.local, found)
            change = (slopes - self.rows[1]) / step[axis]
            columns[known, axis] = change[known]
        self.hessians = (columns + np.swapaxes(columns, 1, 2)) / 2

    def moved(self, point: NDArray[np.float64], local: Linearization) -> "Models":
        """Return the models at a new `point` (d,), where the problem is `local`.

        The Hessians of both models are updated with the change of the gradients. The Hessian of a
        new branch is zero."""
        slopes, known = _matched(self.local, local)
        step = point - self.point
        for k in np.flatnonzero(known):
            left = slopes[k] - self.rows[1][k] - self.hessians[k] @ step
            weight = float(left @ step)
            if abs(weight) > 1e-8 * np.linalg.norm(left) * np.linalg.norm(step):
                self.hessians[k] += np.outer(left, left) / weight
        found = Models(point, local, self.limits)
        for k, place in enumerate(_places(self.local, local)):
            if place >= 0:
                found.hessians[place] = self.hessians[k]
        return found

    def values(self, step: NDArray[np.float64]) -> Rows:
        """Return the models' values (n,) and gradients (n, d) after a `step` (d,)."""
        value, slope = self.rows
        bent = self.hessians @ step
        return value + slope @ step + bent @ step / 2, slope + bent

    def slacks(self, step: NDArray[np.float64]) -> Rows:
        """Return slacks and their gradients after a `step` (d,): constraints, then walls."""
        value, slope = self.values(step)
        walls = value[self._walls :], slope[self._walls :]
        if self.limits is None:
            return value[self._begin :], slope[self._begin :]
        slack, normals = self.limits(self.point + step)
        if not (np.all(np.isfinite(slack)) and np.all(np.isfinite(normals))):
            slack, normals = np.full(len(slack), _ABSENT), self.local.normals
        return np.concatenate([slack, walls[0]]), np.concatenate([normals, walls[1]])

    def tops(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the greatest branch of each maximum, from the `values` (n,) of all functions."""
        found = np.full(len(self.local.groups), -np.inf)
        np.maximum.at(found, self.owner, values[1 : self._begin])
        return found

    def merit(self, step: NDArray[np.float64], price: float) -> float:
        """Return the models' objective after a `step` (d,), plus `price` times the violation."""
        value, _ = self.values(step)
        worst = max(0.0, -float(np.min(self.slacks(step)[0], initial=0.0)))
        return float(value[0] + np.sum(self.tops(value))) + price * worst

    def best(
        self, reach: float, price: float, begins: Sequence[NDArray[np.float64]] = ()
    ) -> NDArray[np.float64]:
        """Return the step (d,) of least `merit`, at most `reach` in each coordinate.

        `price`: price of the violation; `begins`: further steps from which to search, because a
        stationary point may be a saddle."""
        nothing = np.zeros(len(self.point))
        steps = [self._from(begin, reach, price) for begin in (nothing, *begins)]
        return min([nothing, *steps], key=lambda step: self.merit(step, price))

    def _from(self, begin: NDArray[np.float64], reach: float, price: float) -> NDArray[np.float64]:
        """Return the step (d,) that SLSQP finds from the step `begin`.

        The smooth problem has these variables: step / `reach`, a bound for each maximum, and the
        violation, all divided by `reach` and relative to the point. So it is well scaled, and is
        never infeasible."""
        size, count, value = len(self.point), len(self.local.groups), self.rows[0]
        level = np.append(self.tops(value), 0.0)[self.owner]
        low = np.maximum(-1.0, -self.point / reach)
        high = np.minimum(1.0, (1.0 - self.point) / reach)

        def smooth(z):
            now, slope = self.values(reach * z[:size])
            total = (now[0] - value[0]) / reach + np.sum(z[size:-1]) + price * z[-1]
            return total, np.concatenate([slope[0], np.ones(count), [price]])

        def slack(z):
            rises = (self.values(reach * z[:size])[0][1 : self._begin] - level) / reach
            return np.concatenate(
                [z[size:-1][self.owner] - rises, self.slacks(reach * z[:size])[0] / reach + z[-1]]
            )

        def normals(z):
            slope, limits = self.values(reach * z[:size])[1], self.slacks(reach * z[:size])[1]
            above, rows = len(self.owner), np.zeros((len(self.owner) + len(limits), len(z)))
            rows[:above, :size] = -slope[1 : self._begin]
            rows[np.arange(above), size + self.owner] = 1.0
            rows[above:, :size], rows[above:, -1] = limits, 1.0
            return rows

        from scipy.optimize import minimize  # Slow import (0.3 s).

        start = np.clip(begin / reach, low, high)
        rises = (self.tops(self.values(reach * start)[0]) - self.tops(value)) / reach
        worst = max(0.0, -float(np.min(self.slacks(reach * start)[0], initial=0.0))) / reach
        found = minimize(
            smooth,
            np.concatenate([start, rises, [worst]]),
            jac=True,
            method="SLSQP",
            bounds=[*zip(low, high, strict=True), *[(None, None)] * count, (0.0, None)],
            constraints={"type": "ineq", "fun": slack, "jac": normals},
            options={"maxiter": _ROUNDS, "ftol": 1e-10},
        )
        return reach * np.clip(found.x[:size], low, high)


def _rows(local: Linearization) -> Rows:
    """Return the values (n,) and gradients (n, d) of the n functions listed in `Models`."""
    values = [np.array([local.smooth]), *(g.values for g in local.groups), local.slack]
    slopes = [local.slope[None], *(g.slopes for g in local.groups), local.normals]
    values += [-wall.values for wall in local.walls]
    slopes += [-wall.slopes for wall in local.walls]
    return np.concatenate(values), np.concatenate(slopes)


def _places(one: Linearization, other: Linearization) -> NDArray[np.int64]:
    """Return the index (n,) of each function of the problem `one` among those of `other`.

    The index of a branch that `other` does not have is -1."""
    places, start = [np.zeros(1, int)], 1

    def add(groups: Sequence[Group], others: Sequence[Group]) -> None:
        nonlocal start
        for group, new in zip(groups, others, strict=True):
            places.append(np.where((found := _alike(group, new)) >= 0, found + start, -1))
            start += len(new.values)

    add(one.groups, other.groups)
    places.append(start + np.arange(len(other.slack)))
    start += len(other.slack)
    add(one.walls, other.walls)
    return np.concatenate(places)


def _matched(
    one: Linearization, other: Linearization
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return the gradients (n, d) in the problem `other` of the functions of the problem `one`.

    Also return a mask (n,) of the functions that `other` has."""
    places = _places(one, other)
    return _rows(other)[1][places], places >= 0


def _alike(group: Group, other: Group) -> NDArray[np.int64]:
    """Return the index (k,) in `other` of each branch of `group`; -1 if there is no such branch.

    Two branches are the same if their kinds are equal and their phases are close (`_SAME`)."""
    from scipy.optimize import linear_sum_assignment  # Slow import (0.3 s).

    apart = np.abs(group.tags[:, None, 1] - other.tags[None, :, 1])
    apart = np.minimum(apart % 1.0, -apart % 1.0)
    differ = group.tags[:, None, 0] != other.tags[None, :, 0]
    cost = np.where(differ | ~(apart <= _SAME), 10.0, apart)
    found = np.full(len(group.values), -1)
    for branch, place in zip(*linear_sum_assignment(cost), strict=True):
        if cost[branch, place] < 10.0:
            found[branch] = place
    return found
