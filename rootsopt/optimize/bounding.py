"""Lower bound of an objective over all feasible points of the unit box, by branch and bound.

Every evaluated point c gives minorants of the objective f. If f + ½ Σ κ_j x_j² is convex,

    f(x) ≥ b + g·(x - c) - ½ Σ κ_j (x_j - c_j)²

for each branch of f, with the value b and the gradient g at c. All minorants have the same
quadratic part, so that the greatest of them is a maximum of affine functions minus one paraboloid.
Source: Breiman and Cutler, A deterministic algorithm for global optimization, Mathematical
Programming 58 (1993) 179-199. Limits of forces have minorants, too.

A box is halved until a linear program shows that the objective is nowhere in it below the target,
or that no point of it is feasible. Points are evaluated where the minorants are least, or at the
next feasible point. The curvatures κ are estimates: the least that agree with all pairs of points,
times `FACTOR`. Constraints of the geometry cost little. In each box they are replaced by their
tangents, plus `_DEVIATION` times the deviation from these that is found at the corners."""

import heapq
import itertools
import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rootsopt.optimize.local import FEASIBLE, Limits, Linearization, Rows
from rootsopt.optimize.optimality import Bound
from rootsopt.scene.space import onto, sobol

FACTOR = 2.0
"""Factor on the least curvatures that agree with all pairs."""
FIRST = 6
"""Number of points spread over the feasible set, per parameter and once more."""

# Number of points from which these are chosen, and greatest number of them that are moved onto the
# feasible set if few are feasible.
_DRAWN, _MOVED = 256, 64

# Factor on the deviations of constraints from their tangents.
_DEVIATION = 1.5

# Relative distance below the best objective at which a box counts as bounded, and the least
# magnitude of the objective to which it is related.
_GAP, _SMALL = 1e-4, 0.1

# Difference of objectives that is not attributed to curvature.
_NOISE = 1e-6

# Distance (unit box) of two points below which their pair says nothing about curvature. It is
# also the curvature before any pair is known.
_CLOSE = 1e-3

# Least curvature along a coordinate, relative to the curvature that agrees with all pairs if it is
# the same along all coordinates.
_LEAST = 0.1

# Share of a rise that the curvatures must explain. With the whole rise, almost every new point
# would change them, and all bounds would have to be computed again.
_SLACK = 0.9

# Curvature and slope above which a pair counts as a corner, and as a jump. They are relative to the
# range of all values over the square of the greatest extent of the points, and over this extent:
# limits may leave only a small part of the bounds, in which values hardly differ.
_STEEP, _SHARP = 100.0, 10.0

# Number of minorants in a linear program for the middle of a box and for each of its corners.
_ROWS = 3

# Half width below which a box is not halved: a box without a bound, and any other box.
_NARROW, _NARROWEST = 1 / 64, 1 / 8192

# Distance from the middle of a box (half widths) beyond which a feasible point says nothing about
# it; half width below which a box counts as empty if no feasible point is that near.
_OUTSIDE, _SMALL_BOX = 2.0, 1 / 16

# Greatest number of design parameters for a lower bound: with `optimizer.prove`, and by default.
PARAMETERS, QUICK = 4, 3

# Number of evaluations and of boxes of a lower bound that is asked for.
MOST = 2000, 20_000

# Number of points of a lower bound that a search evaluates side by side.
TOGETHER = 8

# Relative gain of a design found beside a lower bound from which a local search begins at it.
BETTER = 1e-5


class Box(NamedTuple):
    """A box of points: `middle` ± `half` (d,), with a lower `bound` of the objective.

    `number`: order of creation; `bend` (m,): deviations of the constraints from their tangents, NaN
    where not known; `age`: number of halvings since they were found."""

    bound: float
    number: int
    middle: NDArray[np.float64]
    half: NDArray[np.float64]
    bend: NDArray[np.float64]
    age: int


class Surface:
    """The minorants of one function of the points, and the curvatures that they need.

    The function is the objective, or the amount by which a limit of a force is exceeded. `points`
    (n, d): evaluated points; `curved` (d,): curvatures; `pairs`, `jumps`: number of pairs from
    which they are estimated, and of pairs too steep for that. A minorant too high at another
    point because of a jump ends at half the distance to it. At a corner that bends downwards (as
    where the peak force moves to another place of the profile) it goes on as a cone, lower by
    `lean` times the distance. `ends` (2, rows): where paraboloids and cones end."""

    def __init__(self, size: int):
        self.points, self.tops = np.zeros((0, size)), np.zeros(0)
        self.values, self.slopes = np.zeros(0), np.zeros((0, size))
        self.owner, self.ends, self.lean = np.zeros(0, int), np.zeros((2, 0)), 0.0
        self.rises, self.squares = np.zeros(0), np.zeros((0, size))
        self.curved, self.pairs, self.jumps = np.full(size, _CLOSE), 0, 0

    def add(self, point: NDArray[np.float64], rows: Rows) -> bool:
        """Add an evaluated `point` (d,), and return whether the curvatures have changed.

        `rows`: values (k,) and gradients (k, d) of the branches there."""
        values, slopes = rows
        away, count, top = self.points - point, len(self.points), np.max(values)
        distance, rises, turned = np.linalg.norm(away, axis=1), np.zeros(0), False
        self.points, self.tops = np.vstack([self.points, point]), np.append(self.tops, top)
        ends = np.full((2, len(values)), np.inf)
        if count:
            # Excess of each minorant of this point over the values at the others, and of each of
            # theirs over the value at this one.
            ahead = values[:, None] + slopes @ away.T - self.tops[:-1]
            back = self.values - np.sum(self.slopes * away[self.owner], axis=1) - top
            over, bent, reach, lean = self._told(np.broadcast_to(distance, ahead.shape), ahead)
            ends = np.min(reach, axis=2)
            under, turns, reach, rise = self._told(distance[self.owner], back)
            self.ends = np.minimum(self.ends, reach)
            first = np.flatnonzero(np.diff(self.owner, prepend=-1))
            rises = np.maximum(np.max(over, axis=0), np.maximum.reduceat(under, first))
            self.jumps += int(np.sum(np.any(bent, axis=0) | np.logical_or.reduceat(turns, first)))
            turned = _SLACK * max(lean, rise) > self.lean / FACTOR
            self.lean = FACTOR * max(lean, rise) if turned else self.lean
        self.ends = np.hstack([self.ends, ends])
        self.pairs += 2 * int(np.sum(distance > _CLOSE))
        told = (rises > 0) & (distance > _CLOSE)
        self.rises = np.append(self.rises, rises[told])
        self.squares = np.vstack([self.squares, away[told] ** 2])
        self.values, self.slopes = np.append(self.values, values), np.vstack([self.slopes, slopes])
        self.owner = np.append(self.owner, np.full(len(values), count))
        if np.all(_SLACK * self.rises <= 0.5 * self.squares @ self.curved / FACTOR):
            return turned
        self._fit()
        return True

    def _told(self, far: NDArray[np.float64], rises: NDArray[np.float64]):
        """Return what pairs of points show about curvature, corners and jumps.

        `far`: distances of the pairs; `rises`: amounts by which minorants are too high there (an
        array of the same shape). Return four results: the rises that curvature explains, 0 for
        others; whether a pair is too steep for that; distances (2, ...) at which paraboloid and
        cone end, half of `far` or inf; the greatest slope that only a corner explains."""
        extent = max(float(np.max(np.ptp(self.points, axis=0))), _CLOSE)
        steep = max(float(np.ptp(self.tops)), _GAP) / extent
        rises = rises - _NOISE
        bent = (rises > _GAP) & (2 * rises > _STEEP * steep / extent * far**2)
        jump = bent & (rises > _SHARP * steep * far)
        ends = np.where(np.array([bent, jump]), far / 2, np.inf)
        corner = bent & ~jump
        lean = float(np.max(rises[corner] / far[corner], initial=0.0))
        return np.where(bent, 0.0, rises), bent, ends, lean

    def _fit(self) -> None:
        """Fit the least curvatures that agree with all pairs."""
        from scipy.optimize import linprog  # Slow import (0.3 s).

        size = len(self.curved)
        least = _LEAST * np.max(2 * self.rises / np.sum(self.squares, axis=1))
        ends = [(least, None)] * size
        solution = linprog(np.ones(size), -0.5 * self.squares, -self.rises, bounds=ends)
        self.curved = FACTOR * solution.x

    def within(self, box: Box) -> Rows:
        """Return affine minorants in a `box`, without the paraboloid that they have in common.

        They are values (n,) at the middle of the box, and gradients (n, d)."""
        away = box.middle - self.points[self.owner]
        values = self.values + np.sum((self.slopes - 0.5 * self.curved * away) * away, axis=1)
        far = np.linalg.norm(np.abs(away) + box.half, axis=1)
        values -= np.where(far > self.ends[0], self.lean * far, 0.0)
        held = far <= self.ends[1]
        return values[held], (self.slopes - self.curved * away)[held]

    def room(self, box: Box) -> float:
        """Return the greatest value of the common paraboloid in a `box`, 0 at its middle."""
        return float(0.5 * box.half**2 @ self.curved)

    def near(self, point: NDArray[np.float64], others: NDArray[np.float64]) -> float:
        """Return the least ½ Σ κ_j (x_j - p_j)² from a `point` p (d,) to `others` (n, d)."""
        return float(np.min(0.5 * (others - point) ** 2 @ self.curved, initial=np.inf))


class Bounding:
    """The search for a lower bound: `ask` returns points to evaluate, `tell` takes the results.

    `limits`: function that returns the slacks (m,) of the constraints of the geometry, and their
    gradients (m, d); `size`: number d of coordinates; `best`: least known objective of a feasible
    point; `boxes`: number of boxes after which it asks no more."""

    def __init__(self, limits: Limits, size: int, best: float, boxes: int = 20_000):
        self.limits, self.size, self.best, self.boxes = limits, size, best, boxes
        self.surfaces: list[Surface] = []
        self.unusable: list[NDArray[np.float64]] = []
        self._open: list[Box] = []
        self._closed: list[Box] = []
        self._left: list[Box] = []
        self._seen, self._told, self._first = 0, 0, FIRST * (size + 1)
        self._known: dict[bytes, Rows] = {}
        self._numbers = itertools.count()
        self._sample: list[NDArray[np.float64]] = []
        self._corners = np.array([*itertools.product((-1.0, 1.0), repeat=size)])
        middle = np.full(size, 0.5)
        self._push(-math.inf, middle, middle, self._look(middle)[0] * math.nan, size)

    @property
    def target(self) -> float:
        """Objective above which a box counts as bounded."""
        return self.best - _GAP * max(abs(self.best), _SMALL)

    def tell(self, point: NDArray[np.float64], local: Linearization | None) -> None:
        """Add an evaluated `point` (d,): objective and limits there, `None` if it is not usable."""
        self._told += 1
        if local is None:
            self.unusable.append(point)
            return
        if local.violation <= FEASIBLE:
            self.best = min(self.best, local.objective)
        rows = [local.minorants, *((cap.values, cap.slopes) for cap in local.caps)]
        self.surfaces = self.surfaces or [Surface(self.size) for _ in rows]
        if any([one.add(point, row) for one, row in zip(self.surfaces, rows, strict=True)]):
            # Existing bounds rest on the old curvatures: compute them again.
            boxes, self._open, self._closed = [*self._open, *self._closed], [], []
            for box in boxes:
                self._push(-math.inf, *box[2:])

    def ask(self, most: int) -> list[NDArray[np.float64]]:
        """Return up to `most` feasible points (d,) to evaluate next.

        Return none if every box is bounded or given up, or if there are too many boxes."""
        if self._first > 0:
            spread = self._spread(min(most, self._first))
            self._first -= len(spread) or self._first
            if spread:
                return spread
        wanted: list[NDArray[np.float64]] = []
        waiting: list[Box] = []
        while self._open and len(wanted) < most and self._seen < self.boxes:
            box, least = self._bounded(heapq.heappop(self._open))
            if box.bound >= self.target:
                # Curvatures decide whether a box is feasible only if forces have limits.
                if box.bound < math.inf or len(self.surfaces) > 1:
                    self._closed.append(box)
                continue
            void = any(np.all(np.abs(bad - box.middle) <= box.half) for bad in self.unusable)
            point = None if void or least is None else self._next(box, least)
            lost = void or box.bound == -math.inf
            if np.max(box.half) < (_NARROW if lost else _NARROWEST):
                self._left.append(box._replace(bound=-math.inf) if lost else box)
            elif point is None:
                self._halve(box)
            else:
                if self.surfaces[0].near(point, np.array(wanted).reshape(-1, self.size)) > (
                    self.surfaces[0].room(box)
                ):
                    wanted.append(point)
                waiting.append(box)
        for box in waiting:
            heapq.heappush(self._open, box)
        return wanted

    def bound(self, reached: float) -> Bound:
        """Return the lower bound found so far; `reached`: objective of the reported design."""
        boxes = [self._bounded(box)[0] for box in self._open] + self._left
        known = [box.bound for box in [*boxes, *self._closed] if box.bound > -math.inf]
        lower = float(min([*known, self.best, reached])) if known else -math.inf
        near = reached - 1.1 * _GAP * max(abs(reached), _SMALL)
        loose = [box for box in boxes if box.bound < near]
        return Bound(
            lower,
            reached - lower,
            self._told,
            _SLACK * FACTOR,
            tuple(float(x) for x in self.surfaces[0].curved),
            sum(one.pairs for one in self.surfaces),
            sum(one.jumps for one in self.surfaces),
            len(self.unusable),
            len(loose),
            float(sum(np.prod(2 * box.half) for box in loose)),
            lower >= near and not loose,
        )

    def _next(self, box: Box, least: NDArray[np.float64]) -> NDArray[np.float64] | None:
        """Return a point (d,) in or beside a `box` whose evaluation tells more than halving it.

        `least` (d,): the point where the minorants are least. Return `None` if no point helps."""
        objective = self.surfaces[0]
        for begin in (least, box.middle):
            # Most boxes have an evaluated point near `begin`: do not look for a feasible one there.
            if objective.near(begin, objective.points) <= objective.room(box):
                continue
            if (point := self._within(box, begin)) is None:
                continue
            away = objective.near(point, begin[None])
            if objective.near(point, objective.points) > max(objective.room(box), away):
                return point
        return None

    def _within(self, box: Box, begin: NDArray[np.float64]) -> NDArray[np.float64] | None:
        """Return the feasible point (d,) that is found from a point `begin` (d,), `None` if it is
        not within `_OUTSIDE` of a `box`."""
        point = begin
        for point in onto(self._look, begin):
            if np.max(np.abs(point - box.middle) / box.half) > _OUTSIDE:
                return None
        return point if np.min(self._look(point)[0]) >= -FEASIBLE else None

    def _spread(self, most: int) -> list[NDArray[np.float64]]:
        """Return up to `most` feasible points (d,), each far from the others and from all that are
        evaluated."""
        if not self._sample:
            drawn = sobol(_DRAWN, 0, self.size)
            inside = np.array([np.min(self._look(x)[0]) >= 0 for x in drawn])
            self._sample = [*drawn[inside]]
            for begin in drawn[~inside][:_MOVED]:
                if len(self._sample) >= most:
                    break
                *_, point = onto(self._look, begin)
                if np.min(self._look(point)[0]) >= -FEASIBLE:
                    self._sample.append(point)
        taken = [*self.unusable, *self.surfaces[0].points]
        points: list[NDArray[np.float64]] = []
        for _ in range(min(most, len(self._sample))):
            away = [min(np.linalg.norm(x - y) for y in [*taken, *points]) for x in self._sample]
            if max(away) > _CLOSE:
                points.append(self._sample[int(np.argmax(away))])
        return points

    def _bounded(self, box: Box) -> tuple[Box, NDArray[np.float64] | None]:
        """Return a `box` with its bound, and the point (d,) where its minorants are least.

        The bound is infinite if no point of the box is feasible. The point is `None` if the
        minorants are above the target there."""
        if box.bound >= self.target:
            return box, None
        self._seen += 1
        nothing = box._replace(bound=math.inf), None
        if (tangents := self._tangents(box)) is None:
            return nothing
        objective = self.surfaces[0]
        values, slopes = objective.within(box)
        room = objective.room(box)
        low = float(np.max(values - np.abs(slopes) @ box.half, initial=-math.inf)) - room
        if low >= self.target:
            return box._replace(bound=low), None
        if box.age >= self.size:
            bent = self._bent(box)
            if bent is None or (tangents := self._tangents(bent)) is None:
                return nothing
            box = bent
        if not values.size:
            return box, box.middle
        # The greatest minorants at the middle and at each corner, for there are too many.
        places = np.vstack([np.zeros(self.size), self._corners * box.half])
        chosen = np.unique(np.argsort(-(values[:, None] + slopes @ places.T), axis=0)[:_ROWS])
        rows = [(slopes[chosen], -values[chosen], -1.0), (-tangents[1], tangents[0], 0.0)]
        for cap in self.surfaces[1:]:
            above, normals = cap.within(box)
            rows.append((normals, cap.room(box) - above, 0.0))
        from scipy.optimize import linprog  # Slow import (0.3 s).

        matrix = np.vstack([np.column_stack([a, np.full(len(a), c)]) for a, _, c in rows])
        ends = [*zip(-box.half, box.half, strict=True), (None, None)]
        aim, tops = np.arange(self.size + 1) == self.size, np.concatenate([b for _, b, _ in rows])
        solution = linprog(aim, matrix, tops, bounds=ends)
        if solution.status == 2:  # infeasible
            return nothing
        if solution.status:
            return box._replace(bound=low), box.middle
        step, value = solution.x[:-1], solution.x[-1]
        least = value - 0.5 * step**2 @ objective.curved
        return box._replace(bound=value - room), (
            box.middle + step if least < self.target else None
        )

    def _tangents(self, box: Box) -> Rows | None:
        """Return upper bounds (m,) of the constraints at the middle of a `box`, and their gradients
        (m, d), or `None` if no point of the box is feasible. Unknown ones are left out."""
        slack, normals = self._look(box.middle)
        tops = slack + box.bend
        known = np.isfinite(tops) & np.all(np.isfinite(normals), axis=1)
        tops, normals = tops[known], normals[known]
        return None if np.any(tops + np.abs(normals) @ box.half < 0) else (tops, normals)

    def _bent(self, box: Box) -> Box | None:
        """Return a `box` with the deviations that are found at its corners.

        Return `None` if one constraint is violated at all corners by more than it varies among
        them, or if no feasible point is found from the middle of a small box. Corners at which no
        profile can be made are left out: next to them, the gradients of constraints may have no
        bound."""
        slack, normals = self._look(box.middle)
        steps = self._corners * box.half
        tops, turned = zip(*[self._look(box.middle + step) for step in steps], strict=True)
        every = np.vstack([slack, *tops])
        high, low = np.fmax.reduce(every, axis=0), np.fmin.reduce(every, axis=0)
        # Not as a difference: both can be infinite.
        if np.any(2 * high < low):
            return None
        # A constraint may jump where a profile becomes unsound. Its tangents then say nothing.
        inside = np.min(np.nan_to_num(every, nan=-1.0), axis=1) >= -FEASIBLE
        empty = np.max(box.half) <= _SMALL_BOX and not np.any(inside)
        if empty and self._within(box, box.middle) is None:
            return None
        with np.errstate(invalid="ignore"):
            rise = np.array(tops) - slack - steps @ normals.T
            turn = (np.array(turned) - normals) * steps[:, None]
            away = np.maximum(rise, 0.5 * np.sum(np.maximum(turn, 0.0), axis=2))
        away[~np.isfinite(away)] = np.nan
        return box._replace(bend=_DEVIATION * np.fmax.reduce(away, axis=0), age=0)

    def _halve(self, box: Box) -> None:
        curved = self.surfaces[0].curved
        axis = int(np.argmax(box.half * np.sqrt(curved + np.mean(curved))))
        step = np.where(np.arange(self.size) == axis, box.half / 2, 0.0)
        # The deviations are quadratic in the sides.
        bend = box.bend * (1 - 0.75 / self.size)
        for side in (-step, step):
            self._push(box.bound, box.middle + side, box.half - step, bend, box.age + 1)

    def _push(self, bound: float, *rest: Any) -> None:
        heapq.heappush(self._open, Box(bound, next(self._numbers), *rest))

    def _look(self, point: NDArray[np.float64]) -> Rows:
        key = point.tobytes()
        if key not in self._known:
            self._known[key] = self.limits(point)
        return self._known[key]
