"""An optimisation problem at one point of the unit box, to first order.

The objective is a smooth function s plus a sum of maxima over groups g of smooth *branches* b:

    f(x) = s(x) + Σ_g max_i b_gi(x),    subject to c_j(x) ≥ 0, max_i w_ki(x) ≤ 0 and 0 ≤ x ≤ 1.

For example, the local maxima of the contact force over time are the branches of its peak. If only
the worst of several speeds counts, the objectives at these speeds are branches. Each branch is
smooth, even where the maximum has a corner. The same holds for the *caps* w_k: limits of a
quantity that is a maximum over branches.

At a first-order optimum, the gradient of the Lagrangian is zero. The Lagrangian contains the active
constraints and bounds, each with a non-negative multiplier. It also contains the active branches,
each with a non-negative share. The shares of one maximum add up to 1. Multipliers and shares are
computed from the point alone, by non-negative least squares. The certificate therefore does not
depend on the method that found the point. See Nocedal and Wright, Numerical Optimization (2006),
section 12.3. For the maxima, these are the conditions of the epigraph form, in which a variable
bounds each branch from above.

Second-order models of all functions of a problem near a point, and the step that minimises them.

Each branch, and each limit that needs a simulation, has a model of its own: value and gradient at
the point, and a Hessian. Differences of gradients give the Hessians, and symmetric rank-one updates
correct them after each step (Nocedal and Wright, Numerical Optimization, 2006, section 6.2). With
one Hessian for all functions together, steps leave the feasible set wherever constraints of
different curvature are active (Maratos effect).

Constraints of the geometry need no simulation. A step therefore meets them exactly, not their
models. Along the curved edges of the feasible set, this saves most of the simulations that
linearised constraints cost."""

from collections.abc import Callable, Sequence
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
    gradients. `caps`: limits of maxima over branches; each branch must be at most 0."""

    smooth: float
    slope: NDArray[np.float64]
    groups: tuple[Group, ...]
    slack: NDArray[np.float64]
    normals: NDArray[np.float64]
    caps: tuple[Group, ...] = ()

    @property
    def objective(self) -> float:
        """Value of the objective: the smooth part plus all maxima."""
        return self.smooth + sum(group.top for group in self.groups)

    @property
    def violation(self) -> float:
        """Greatest violation of a constraint or cap; 0 if all are satisfied."""
        beyond = max((cap.top for cap in self.caps), default=0.0)
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
    maximum over k branches, whose entries add up to 1. `caps`: one array (k,) for each cap, with
    a multiplier for each of its k branches."""

    residual: float
    violation: float
    multipliers: NDArray[np.float64]
    lower: NDArray[np.float64]
    upper: NDArray[np.float64]
    shares: tuple[NDArray[np.float64], ...]
    caps: tuple[NDArray[np.float64], ...] = ()

    @property
    def total(self) -> float:
        """Sum of the multipliers of all constraints and caps."""
        return float(np.sum(self.multipliers) + sum(map(np.sum, self.caps)))

    def holds(self, tolerance: float, feasibility: float) -> bool:
        """Return whether the conditions hold within tolerances.

        `tolerance`: greatest accepted `residual`; `feasibility`: greatest accepted `violation`."""
        return self.residual <= tolerance and self.violation <= feasibility


def certify(local: Linearization, point: NDArray[np.float64]) -> Certificate:
    """Return the certificate of a `point` (d,) of the unit box.

    `local`: objective and constraints at the point, with gradients."""
    from scipy.optimize import nnls  # Slow import (0.3 s).

    size, gaps = len(point), [group.top - group.values for group in local.groups]
    branches = [(gap <= NEAR, g.slopes, gap) for gap, g in zip(gaps, local.groups, strict=True)]
    long = np.linalg.norm(local.normals, axis=1) > _NEGLIGIBLE
    limits = [
        ((local.slack <= NEAR) & long, -local.normals, np.maximum(local.slack, 0.0)),
        (point <= NEAR, -np.eye(size), point),
        (1 - point <= NEAR, np.eye(size), 1 - point),
    ]
    for cap in local.caps:
        steep = np.linalg.norm(cap.slopes, axis=1) > _NEGLIGIBLE
        limits.append(((-cap.values <= NEAR) & steep, cap.slopes, np.maximum(-cap.values, 0.0)))
    every = [*branches, *limits]
    rows = np.concatenate([slopes[active] for active, slopes, _ in every])
    gap = np.concatenate([away[active] for active, _, away in every])
    counts = [int(np.sum(active)) for active, _, _ in branches]
    sums = np.zeros((len(counts), len(rows)))
    sums[np.repeat(np.arange(len(counts)), counts), np.arange(sum(counts))] = _WEIGHT
    matrix = np.concatenate([rows.T, np.diag(gap), sums])
    wanted = np.concatenate([-local.slope, np.zeros(len(gap)), np.full(len(counts), _WEIGHT)])
    solution = nnls(matrix, wanted)[0] if matrix.shape[1] else np.zeros(0)
    shares = []
    for (active, _, _), count in zip(branches, counts, strict=True):
        part, solution = solution[:count], solution[count:]
        total, share = np.sum(part), np.zeros(len(active))
        share[active] = part / total if total > 0 else 1 / count
        shares.append(share)
    numbers = []
    for active, _, _ in limits:
        count, values = int(np.sum(active)), np.zeros(len(active))
        values[active], solution = solution[:count], solution[count:]
        numbers.append(values)
    multipliers, lower, upper, *caps = numbers
    left = local.combined(tuple(shares)) - multipliers @ local.normals - lower + upper
    for cap, held in zip(local.caps, caps, strict=True):
        left = left + held @ cap.slopes
    pairs = zip([*shares, *numbers], every, strict=True)
    apart = [value * away for value, (_, _, away) in pairs]
    residual = float(np.linalg.norm(np.concatenate([left, *apart])))
    held = multipliers, lower, upper, tuple(shares), tuple(caps)
    return Certificate(residual, local.violation, *held)


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
    maximum; the m constraints; the branches of each cap, with the opposite sign. `point` (d,):
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
        self._caps = self._begin + len(local.slack)

    def measure(self, at: Look) -> None:
        """Compute the Hessians from differences of gradients.

        `at`: function that evaluates the problem at a point."""
        size = len(self.point)
        columns = np.zeros_like(self.hessians)
        for axis in range(size):
            step = np.zeros(size)
            step[axis] = _STEP if self.point[axis] < 0.5 else -_STEP
            local = at(self.point + step)
            if local is None:
                continue
            slopes, known = _matched(self.local, local)
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
        models = Models(point, local, self.limits)
        for k, place in enumerate(_places(self.local, local)):
            if place >= 0:
                models.hessians[place] = self.hessians[k]
        return models

    def values(self, step: NDArray[np.float64]) -> Rows:
        """Return the models' values (n,) and gradients (n, d) after a `step` (d,)."""
        value, slope = self.rows
        bent = self.hessians @ step
        return value + slope @ step + bent @ step / 2, slope + bent

    def slacks(self, step: NDArray[np.float64]) -> Rows:
        """Return slacks and their gradients after a `step` (d,): constraints, then caps."""
        value, slope = self.values(step)
        caps = value[self._caps :], slope[self._caps :]
        if self.limits is None:
            return value[self._begin :], slope[self._begin :]
        slack, normals = self.limits(self.point + step)
        if not (np.all(np.isfinite(slack)) and np.all(np.isfinite(normals))):
            slack, normals = np.full(len(slack), _ABSENT), self.local.normals
        return np.concatenate([slack, caps[0]]), np.concatenate([normals, caps[1]])

    def tops(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the greatest branch of each maximum, from the `values` (n,) of all functions."""
        tops = np.full(len(self.local.groups), -np.inf)
        np.maximum.at(tops, self.owner, values[1 : self._begin])
        return tops

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
        solution = minimize(
            smooth,
            np.concatenate([start, rises, [worst]]),
            jac=True,
            method="SLSQP",
            bounds=[*zip(low, high, strict=True), *[(None, None)] * count, (0.0, None)],
            constraints={"type": "ineq", "fun": slack, "jac": normals},
            options={"maxiter": _ROUNDS, "ftol": 1e-10},
        )
        return reach * np.clip(solution.x[:size], low, high)


def _rows(local: Linearization) -> Rows:
    """Return the values (n,) and gradients (n, d) of the n functions listed in `Models`."""
    values = [np.array([local.smooth]), *(g.values for g in local.groups), local.slack]
    slopes = [local.slope[None], *(g.slopes for g in local.groups), local.normals]
    values += [-cap.values for cap in local.caps]
    slopes += [-cap.slopes for cap in local.caps]
    return np.concatenate(values), np.concatenate(slopes)


def _places(one: Linearization, other: Linearization) -> NDArray[np.int64]:
    """Return the index (n,) of each function of the problem `one` among those of `other`.

    The index of a branch that `other` does not have is -1."""
    places, start = [np.zeros(1, int)], 1

    def add(groups: Sequence[Group], others: Sequence[Group]) -> None:
        nonlocal start
        for group, new in zip(groups, others, strict=True):
            places.append(np.where((index := _alike(group, new)) >= 0, index + start, -1))
            start += len(new.values)

    add(one.groups, other.groups)
    places.append(start + np.arange(len(other.slack)))
    start += len(other.slack)
    add(one.caps, other.caps)
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
    index = np.full(len(group.values), -1)
    for branch, place in zip(*linear_sum_assignment(cost), strict=True):
        if cost[branch, place] < 10.0:
            index[branch] = place
    return index
