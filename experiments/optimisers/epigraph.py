"""The smooth problem that the competing methods solve: a bound for all branches of a maximum.

The corners of the objective come from maxima over smooth branches b_i. In the epigraph form, each
maximum becomes a variable t with one constraint b_i(x) ≤ t per branch, so all functions are smooth.

A point without an objective gets a value far above all others."""

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from rootsopt.optimize.local import Group, Linearization, Look, certify
from rootsopt.optimize.sqp import EndError, Stops

# Factor from the variables z of a method to the point x of the unit box: x = `SCALE` · z. It
# shortens the first step, because some methods start with a unit Hessian.
SCALE = 0.1

# First-order residual at which a method may stop.
RESIDUAL = 1e-9

# Number of constraints reserved for new branches of a maximum that appear during a search. They
# add to twice the number of branches at the start.
_SLOTS = 4

# Difference between phases above which branches at neighbouring points count as different.
_SAME = 0.1

# Amount by which the value of a point without an objective exceeds the first objective.
_UNUSABLE = 1e3


class Epigraph:
    """The smooth problem of a method, with all points evaluated so far.

    The variables z are x / `SCALE`, followed by one variable t per maximum, its upper bound.
    `look`: function that evaluates the problem at a point; `start` (d,): first point; `first`: the
    problem there; `stops`: criteria for the end."""

    def __init__(self, look: Look, start: NDArray[np.float64], first: Linearization, stops: Stops):
        self.look, self.stops, self.size = look, stops, len(start)
        self.evaluations = 1
        self.known: dict[bytes, Linearization | None] = {start.tobytes(): first}
        self.begin, self.first = start, first
        self.good = first
        slots = [2 * len(group.values) + _SLOTS for group in (*first.groups, *first.caps)]
        self.slots = [np.full((count, 2), np.nan) for count in slots]
        self.used = [np.zeros(count) for count in slots]

    def at(self, point: NDArray[np.float64]) -> Linearization | None:
        """Return the problem at a `point` (d,), which is evaluated only on the first call.

        Raises `EndError` at the optimum, or if the evaluations have run out."""
        key = point.tobytes()
        if key not in self.known:
            if self.evaluations >= self.stops.evaluations:
                raise EndError
            self.evaluations += 1
            self.known[key] = found = self.look(point)
            if found is not None and certify(found, point).holds(RESIDUAL, self.stops.feasibility):
                raise EndError
        return self.known[key]

    def point(self, z) -> NDArray[np.float64]:
        """Return the point (d,) of the unit box for the variables `z`."""
        return np.clip(np.asarray(z[: self.size]) * SCALE, 0.0, 1.0)

    def start(self) -> NDArray[np.float64]:
        """Return the variables at the start."""
        return np.concatenate([self.begin / SCALE, [group.top for group in self.first.groups]])

    def value(self, z) -> tuple[float, NDArray[np.float64]]:
        """Return the smooth objective and its gradient at the variables `z`.

        The value is far above the first objective if the point is not usable."""
        found = self.at(self.point(z))
        self.good = self.good if found is None else found
        slope = np.append(SCALE * self.good.slope, np.ones(len(z) - self.size))
        if found is None:
            return self.first.objective + _UNUSABLE, slope
        return found.smooth + float(np.sum(z[self.size :])), slope

    def constraints(self, z) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the values (≥ 0 if satisfied) and gradients of all constraints at `z`.

        First come t - b_i for the branches b_i of each maximum t, then -w_i for those of each
        cap, then the constraints of the problem."""
        found = self.at(self.point(z)) or self.good
        values, rows = [], []
        tops = len(found.groups)
        for k, group in enumerate((*found.groups, *found.caps)):
            branches, places = self._places(k, group)
            value, row = np.ones(len(self.slots[k])), np.zeros((len(self.slots[k]), len(z)))
            value[places] = -group.values[branches]
            row[places, : self.size] = -SCALE * group.slopes[branches]
            if k < tops:
                value[places] += z[self.size + k]
                row[places, self.size + k] = 1.0
            values.append(value)
            rows.append(row)
        wide = np.pad(SCALE * found.normals, ((0, 0), (0, len(z) - self.size)))
        return np.concatenate([*values, found.slack]), np.concatenate([*rows, wide])

    def _places(self, k: int, group: Group) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Return branches of group `k`, and the index, within its group, of each one's constraint.

        A branch keeps its index from point to point, so that a method sees smooth constraints. It
        is left out if all constraints of the group are taken."""
        slots = self.slots[k]
        apart = np.abs(group.tags[:, None, 1] - slots[None, :, 1])
        apart = np.minimum(apart % 1.0, -apart % 1.0)
        other = group.tags[:, None, 0] != slots[None, :, 0]
        cost = np.where(other | ~(apart <= _SAME), 10.0, apart)
        branches, places = linear_sum_assignment(cost)
        same = cost[branches, places] < 10.0
        branches, places = branches[same], places[same]
        free = [s for s in np.argsort(self.used[k], kind="stable") if s not in places]
        new = [b for b in np.argsort(-group.values, kind="stable") if b not in branches]
        count = min(len(new), len(free))
        branches = np.append(branches, new[:count]).astype(int)
        places = np.append(places, free[:count]).astype(int)
        slots[places], self.used[k][places] = group.tags[branches], self.evaluations
        return branches, places
