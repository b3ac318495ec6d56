"""Local search with a second-order model of every branch and constraint.

Sequential quadratic programming has one Hessian for all functions together. If many branches and
constraints of different curvature are active at an optimum, its steps leave the feasible set. The
line search then shortens every step, and progress is slow (Maratos effect). Here, each function has
its own model: value and gradient at the best point, and a Hessian from differences of gradients. A
step minimises the models within a trust region. After each step, symmetric rank-one updates correct
the Hessians (Nocedal and Wright, Numerical Optimization, 2006, section 6.2).

The method is sequential quadratically constrained quadratic programming. Source: Anitescu, A
superlinearly convergent sequential quadratically constrained quadratic programming algorithm for
degenerate nonlinear programming, SIAM Journal on Optimization 12 (2002) 949-978."""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment, minimize

from rootsopt.optimize.local import Group, Local

_STEP = 1e-3
"""Step (unit box) of the difference quotients that give the first Hessians."""
_FIRST, _LEAST = 0.05, 1e-6
"""Half width of the trust region (unit box): at the start, and that below which the search ends."""
_SAME = 0.1
"""Difference between phases above which branches at two points count as different."""
_ROUNDS = 25
"""Maximum number of steps."""
_FALL = 1e-9
"""Predicted decrease of the merit function below which the search ends."""
_PRICE = 2.0, 5.0
"""Weight of the violation in the merit function: the first number plus the second times the
greatest multiplier."""

Rows = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Values (n,) and gradients (n, d) of the functions of a problem."""


class Models:
    """Quadratic models of all functions of a problem near a point.

    The n functions are, in this order: the smooth part of the objective; the branches of each
    maximum; the constraints; the branches of each wall, with the opposite sign. `point` (d,):
    centre; `local`: the problem there, with the n values and gradients in `rows`; `bends` (n, d,
    d): Hessians."""

    def __init__(self, point: NDArray[np.float64], local: Local):
        self.point, self.local, self.rows = point, local, _rows(local)
        count, size = self.rows[1].shape
        self.bends = np.zeros((count, size, size))

    def measure(self, at: Callable[[NDArray[np.float64]], Local | None]) -> None:
        """Compute the Hessians from differences of gradients.

        `at`: function that evaluates the problem at a point."""
        size = len(self.point)
        columns = np.zeros_like(self.bends)
        for axis in range(size):
            step = np.zeros(size)
            step[axis] = _STEP if self.point[axis] < 0.5 else -_STEP
            found = at(self.point + step)
            if found is None:
                continue
            slopes, known = _matched(self.local, found)
            change = (slopes - self.rows[1]) / step[axis]
            columns[known, axis] = change[known]
        self.bends = (columns + np.swapaxes(columns, 1, 2)) / 2

    def moved(self, point: NDArray[np.float64], local: Local) -> "Models":
        """Return the models at a new `point` (d,), where the problem is `local`.

        The Hessians are updated with the change of the gradients. The Hessian of a new branch is
        zero."""
        slopes, known = _matched(self.local, local)
        step = point - self.point
        for k in np.flatnonzero(known):
            left = slopes[k] - self.rows[1][k] - self.bends[k] @ step
            weight = float(left @ step)
            if abs(weight) > 1e-8 * np.linalg.norm(left) * np.linalg.norm(step):
                self.bends[k] += np.outer(left, left) / weight
        found = Models(point, local)
        for k, place in enumerate(_places(self.local, local)):
            if place >= 0:
                found.bends[place] = self.bends[k]
        return found

    def values(self, step: NDArray[np.float64]) -> Rows:
        """Return the models' values (n,) and gradients (n, d) after a `step` (d,)."""
        value, slope = self.rows
        bent = self.bends @ step
        return value + slope @ step + bent @ step / 2, slope + bent

    def best(self, reach: float) -> NDArray[np.float64]:
        """Return the step (d,) that minimises the models, at most `reach` in each coordinate."""
        size, sizes = len(self.point), [len(group.values) for group in self.local.groups]
        tops = len(sizes)
        owner = np.repeat(np.arange(tops), sizes)
        free = [(None, None)] * tops
        low = np.maximum(-reach, -self.point)
        high = np.minimum(reach, 1.0 - self.point)
        branches = slice(1, 1 + len(owner))

        def smooth(z):
            value, slope = self.values(z[:size])
            return value[0] + np.sum(z[size:]), np.concatenate([slope[0], np.ones(tops)])

        def slack(z):
            value, _ = self.values(z[:size])
            return np.concatenate([z[size:][owner] - value[branches], value[1 + len(owner) :]])

        def normals(z):
            _, slope = self.values(z[:size])
            rows = np.zeros((len(slope) - 1, size + tops))
            rows[:, :size] = slope[1:]
            rows[: len(owner), :size] *= -1
            rows[np.arange(len(owner)), size + owner] = 1.0
            return rows

        start = np.concatenate([np.zeros(size), [group.top for group in self.local.groups]])
        found = minimize(
            smooth,
            start,
            jac=True,
            method="SLSQP",
            bounds=[*zip(low, high, strict=True), *free],
            constraints={"type": "ineq", "fun": slack, "jac": normals},
            options={"maxiter": 200, "ftol": 1e-15},
        )
        return np.clip(found.x[:size], low, high)

    def merit(self, step: NDArray[np.float64], price: float) -> float:
        """Return the models' objective after a `step` (d,), plus `price` times the violation."""
        value, _ = self.values(step)
        total, begin = float(value[0]), 1
        for group in self.local.groups:
            total += float(np.max(value[begin : begin + len(group.values)]))
            begin += len(group.values)
        return total + price * float(np.sum(np.maximum(-value[begin:], 0.0)))


def refine(
    at: Callable[[NDArray[np.float64]], Local | None],
    point: NDArray[np.float64],
    local: Local,
    greatest: float,
) -> None:
    """Search from a `point` (d,), where the problem is `local`, with steps from `Models`.

    `at`: function that evaluates the problem at a point. It also stores the best point, so that
    nothing is returned here, and raises an exception to end the search. `greatest`: greatest
    multiplier of a constraint at the point."""
    price = _PRICE[0] + _PRICE[1] * greatest
    models, reach = Models(point, local), _FIRST
    models.measure(at)
    nothing = np.zeros(len(point))
    for _ in range(_ROUNDS):
        step = models.best(reach)
        before = models.merit(nothing, price)
        promised = before - models.merit(step, price)
        if promised < _FALL or reach < _LEAST:
            return
        found = at(np.clip(models.point + step, 0.0, 1.0))
        length = float(np.max(np.abs(step)))
        if found is None:
            reach = length / 4
            continue
        new = models.moved(np.clip(models.point + step, 0.0, 1.0), found)
        share = (before - new.merit(nothing, price)) / promised
        if share > 0.05:
            models = new
        if share < 0.25:
            reach = length / 4
        elif share > 0.75 and length > 0.9 * reach:
            reach *= 2


def _rows(local: Local) -> Rows:
    """Return the values (n,) and gradients (n, d) of the n functions listed in `Models`."""
    values = [np.array([local.smooth]), *(g.values for g in local.groups), local.slack]
    slopes = [local.slope[None], *(g.slopes for g in local.groups), local.normals]
    values += [-wall.values for wall in local.walls]
    slopes += [-wall.slopes for wall in local.walls]
    return np.concatenate(values), np.concatenate(slopes)


def _places(one: Local, other: Local) -> NDArray[np.int64]:
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


def _matched(one: Local, other: Local) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return the gradients (n, d) in the problem `other` of the functions of the problem `one`.

    Also return a mask (n,) of the functions that `other` has."""
    places = _places(one, other)
    return _rows(other)[1][places], places >= 0


def _alike(group: Group, other: Group) -> NDArray[np.int64]:
    """Return the index (k,) in `other` of each branch of `group`; -1 if there is no such branch.

    Two branches are the same if their kinds are equal and their phases are close (`_SAME`)."""
    apart = np.abs(group.tags[:, None, 1] - other.tags[None, :, 1])
    apart = np.minimum(apart % 1.0, -apart % 1.0)
    differ = group.tags[:, None, 0] != other.tags[None, :, 0]
    cost = np.where(differ | ~(apart <= _SAME), 10.0, apart)
    found = np.full(len(group.values), -1)
    for branch, place in zip(*linear_sum_assignment(cost), strict=True):
        if cost[branch, place] < 10.0:
            found[branch] = place
    return found


__all__ = ["Models", "refine"]
