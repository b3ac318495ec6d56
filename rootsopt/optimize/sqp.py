"""Local search by sequential quadratic programming, for an objective with corners.

The corners come from maxima over smooth branches b_i. In the epigraph form, each maximum becomes a
variable t with one constraint b_i(x) ≤ t per branch, so all functions are smooth. SciPy's SLSQP
solves this problem with exact gradients. See Kraft, A software package for sequential quadratic
programming, DFVLR-FB 88-28, 1988. If it stops or becomes too slow (`_SLOW`) before the first-order
conditions hold, `rootsopt.optimize.refine` continues with a second-order model of every function.

A point without an objective gets a value far above all others, and is never the result. The line
search then shortens its step until it finds a usable point."""

import contextlib
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment, minimize

from rootsopt.optimize.certificate import Certificate, certify
from rootsopt.optimize.local import Group, Local, Look
from rootsopt.optimize.refine import refine

SCALE = 0.1
"""Factor from SLSQP's variables z to the point x of the unit box: x = `SCALE` · z. It shortens the
first step, because SLSQP starts with a unit Hessian."""
_SLOTS = 4
"""Number of constraints reserved for new branches of a maximum that appear during a search. They
add to twice the number of branches at the start."""
_SAME = 0.1
"""Difference between phases above which branches at neighbouring points count as different."""
_UNUSABLE = 1e3
"""Amount by which the value of a point without an objective exceeds the best objective."""
_RESTARTS = 6
"""Maximum number of rounds. Each runs SLSQP from the best point, with a unit Hessian, and then
`refine`."""
_GAIN = 1e-9
"""Decrease of the objective in a round below which the search does not start another round."""
_TIE = 3e-8
"""Difference of two objectives below which the smaller residual decides which point is better.
Evaluations of the same design differ by up to this amount if their first guesses of the orbit
differ."""
_SLOW = 12, 2e-5
"""Number of successive points, and decrease of the merit over them below which SLSQP is too slow.
The round then continues with `refine`."""


class Stops(NamedTuple):
    """Criteria for the end of a local search.

    `residual`: first-order residual below which the search ends at once; `enough`: residual below
    which it does not begin another round, because gradients are hardly more accurate;
    `feasibility`: scaled violation below which a point is feasible; `evaluations`: maximum number
    of evaluated points; `asked`: function that returns whether to end at once."""

    residual: float = 1e-6
    enough: float = 5e-5
    feasibility: float = 1e-6
    evaluations: int = 200
    asked: Callable[[], bool] = lambda: False


class Found(NamedTuple):
    """Outcome of a local search.

    `point` (d,): the best feasible point, or the least infeasible one. `local`: objective and
    constraints there, `None` if the start was not usable. `certificate`: first-order conditions
    there. `reason`: key of `REASONS`. `evaluations`: number of evaluated points."""

    point: NDArray[np.float64]
    local: Local | None
    certificate: Certificate | None
    reason: str
    evaluations: int

    @property
    def converged(self) -> bool:
        """Whether the first-order conditions hold at the point."""
        return self.reason == "converged"


REASONS = {
    "converged": "The first-order conditions hold.",
    "evaluations": (
        "The evaluations ran out before the first-order conditions held. Raise "
        "optimizer.iterations."
    ),
    "no_progress": (
        "No step along the gradients lowers the objective further, but the first-order conditions "
        "do not hold: the gradients are less accurate than they require, or the motion changes its "
        "kind beside the design. Tighten solver.rtol, or raise optimizer.starts."
    ),
    "infeasible": "No point near the start satisfies all constraints. Relax a constraint.",
    "unusable": "The start has no usable steady state. Choose another one.",
    "interrupted": "The search was stopped before its end.",
}
"""Reasons why a local search ends: each word with its explanation and advice."""


class EndError(Exception):
    """Raised inside SLSQP's callbacks to end a search."""


class SlowError(Exception):
    """Raised inside SLSQP's callbacks if the search is too slow (`_SLOW`)."""


class Epigraph:
    """The smooth problem that SLSQP solves, with all points evaluated so far.

    The variables z are x / `SCALE`, followed by one variable t per maximum, its upper bound.
    `look`: function that evaluates the problem at a point; `start` (d,): first point; `first`: the
    problem there; `stops`: criteria for the end."""

    def __init__(self, look: Look, start: NDArray[np.float64], first: Local, stops: Stops):
        self.look, self.stops, self.size = look, stops, len(start)
        self.evaluations = 1
        self.known: dict[bytes, Local | None] = {start.tobytes(): first}
        self.good, self.best = first, (start, first)
        self.crawling: list[float] | None = None
        self.certificate = certify(first, start)
        slots = [2 * len(group.values) + _SLOTS for group in (*first.groups, *first.walls)]
        self.slots = [np.full((count, 2), np.nan) for count in slots]
        self.used = [np.zeros(count) for count in slots]

    def at(self, point: NDArray[np.float64]) -> Local | None:
        """Return the problem at a `point` (d,), which is evaluated only on the first call.

        Raises `EndError` if a new evaluation would be needed but the search should end."""
        key = point.tobytes()
        if key not in self.known:
            if self.stops.asked() or self.evaluations >= self.stops.evaluations:
                raise EndError
            self.evaluations += 1
            self.known[key] = found = self.look(point)
            if found is not None:
                self._judge(point, found)
            self._watch(found)
        return self.known[key]

    def _watch(self, found: Local | None) -> None:
        """Raise `SlowError` if the last points have hardly improved the best merit (`_SLOW`).

        `found`: the problem at the new point. The merit is the objective plus the violation times a
        weight that exceeds all multipliers. The best merit after each point is stored in
        `crawling`; if this is `None`, nothing is checked."""
        if self.crawling is None:
            return
        count, least = _SLOW
        before = self.crawling[-1] if self.crawling else np.inf
        price = 2.0 + 5.0 * self.certificate.greatest
        merit = np.inf if found is None else found.objective + price * found.violation
        self.crawling.append(min(before, merit))
        if len(self.crawling) > count and self.crawling[-1 - count] - self.crawling[-1] < least:
            raise SlowError

    def _judge(self, point, found: Local) -> None:
        """Keep a new `point` if it is the best one; `found` is the problem there.

        Raises `EndError` if the best point satisfies the first-order conditions."""
        best = self.best[1]
        limit = self.stops.feasibility
        certificate = certify(found, point)
        residual = certificate.residual
        if max(found.violation, limit) < max(best.violation, limit):
            better = True
        else:
            feasible = found.violation <= max(best.violation, limit)
            gain, flatter = best.objective - found.objective, residual < self.certificate.residual
            better = feasible and (gain > _TIE or (gain > -_TIE and flatter))
        done = certificate.holds(self.stops.residual, limit)
        if better or (done and found.objective <= best.objective + limit):
            self.best, self.certificate = (point, found), certificate
            if done:
                raise EndError

    def point(self, z) -> NDArray[np.float64]:
        """Return the point (d,) of the unit box for SLSQP's variables `z`."""
        return np.clip(np.asarray(z[: self.size]) * SCALE, 0.0, 1.0)

    def start(self) -> NDArray[np.float64]:
        """Return SLSQP's variables at the best point so far."""
        point, local = self.best
        self.good = local
        return np.concatenate([point / SCALE, [group.top for group in local.groups]])

    def value(self, z) -> tuple[float, NDArray[np.float64]]:
        """Return the smooth objective and its gradient at SLSQP's variables `z`.

        The value is far above the best objective if the point is not usable."""
        found = self.at(self.point(z))
        steps = np.ones(len(z) - self.size)
        if found is None:
            gradient = np.concatenate([SCALE * self.good.slope, steps])
            return self.best[1].objective + _UNUSABLE, gradient
        self.good = found
        total = found.smooth + float(np.sum(z[self.size :]))
        return total, np.concatenate([SCALE * found.slope, steps])

    def constraints(self, z) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the values (≥ 0 if satisfied) and gradients of all constraints at SLSQP's `z`.

        First come t - b_i for the branches b_i of each maximum t, then -w_i for those of each
        wall, then the constraints of the problem."""
        found = self.at(self.point(z))
        found = self.good if found is None else found
        values, rows = [], []
        tops = len(found.groups)
        for k, group in enumerate((*found.groups, *found.walls)):
            places = self._places(k, group)
            value, row = np.ones(len(self.slots[k])), np.zeros((len(self.slots[k]), len(z)))
            for place, b, slope in zip(places, group.values, group.slopes, strict=True):
                if place >= 0:
                    value[place] = -b
                    row[place, : self.size] = -SCALE * slope
                if place >= 0 and k < tops:
                    value[place] += z[self.size + k]
                    row[place, self.size + k] = 1.0
            values.append(value)
            rows.append(row)
        wide = np.zeros((len(found.slack), len(z)))
        wide[:, : self.size] = SCALE * found.normals
        return np.concatenate([*values, found.slack]), np.concatenate([*rows, wide])

    def _places(self, k: int, group: Group) -> list[int]:
        """Return the index, within its group, of the constraint that each branch of group `k` uses.

        A branch keeps its index from point to point, so that SLSQP sees smooth constraints. The
        index is -1 if all constraints of the group are taken."""
        slots = self.slots[k]
        apart = np.abs(group.tags[:, None, 1] - slots[None, :, 1])
        apart = np.minimum(apart % 1.0, -apart % 1.0)
        other = group.tags[:, None, 0] != slots[None, :, 0]
        cost = np.where(other | ~(apart <= _SAME), 10.0, apart)
        places = [-1] * len(group.values)
        for branch, slot in zip(*linear_sum_assignment(cost), strict=True):
            if cost[branch, slot] < 10.0:
                places[branch] = int(slot)
        free = [s for s in np.argsort(self.used[k], kind="stable") if s not in places]
        for branch in np.argsort(-group.values, kind="stable"):
            if places[branch] < 0 and free:
                places[branch] = int(free.pop(0))
        for branch, place in enumerate(places):
            if place >= 0:
                slots[place], self.used[k][place] = group.tags[branch], self.evaluations
        return places


def descend(look: Look, start: NDArray[np.float64], stops: Stops | None = None) -> Found:
    """Search for a local minimum from `start` (d,) in the unit box.

    `look`: function that evaluates the problem at a point; `stops`: criteria for the end, by
    default `Stops()`."""
    stops = Stops() if stops is None else stops
    start = np.clip(np.asarray(start, dtype=np.float64), 0.0, 1.0)
    first = look(start)
    if first is None:
        return Found(start, None, None, "unusable", 1)
    problem = Epigraph(look, start, first, stops)
    reason = "no_progress"
    if problem.certificate.holds(stops.residual, stops.feasibility):
        reason = "converged"
    for _ in range(_RESTARTS if reason != "converged" else 0):
        before = problem.best[1]
        try:
            _slsqp(problem)
            if not problem.certificate.holds(stops.enough, stops.feasibility):
                refine(problem.at, *problem.best, problem.certificate.greatest)
        except EndError:
            reason = "interrupted" if stops.asked() else "evaluations"
        if problem.certificate.holds(stops.enough, stops.feasibility):
            reason = "converged"
        after = problem.best[1]
        gained = before.objective - after.objective > _GAIN or before.violation > after.violation
        if reason != "no_progress" or not gained:
            break
    point, local = problem.best
    if local.violation > stops.feasibility and reason == "no_progress":
        reason = "infeasible"
    return Found(point, local, problem.certificate, reason, problem.evaluations)


def _slsqp(problem: Epigraph) -> None:
    """Run SLSQP from the best point until it ends or becomes too slow."""
    start, size = problem.start(), problem.size
    free = [(None, None)] * (len(start) - size)
    problem.crawling = []
    with contextlib.suppress(SlowError):
        _minimize(problem, start, [(0.0, 1.0 / SCALE)] * size + free)
    problem.crawling = None


def _minimize(problem: Epigraph, start: NDArray[np.float64], bounds: Sequence) -> None:
    minimize(
        problem.value,
        start,
        jac=True,
        method="SLSQP",
        bounds=bounds,
        constraints={
            "type": "ineq",
            "fun": lambda z: problem.constraints(z)[0],
            "jac": lambda z: problem.constraints(z)[1],
        },
        options={"maxiter": 1000, "ftol": 1e-14},
    )


__all__ = ["REASONS", "EndError", "Epigraph", "Found", "Stops", "descend"]
