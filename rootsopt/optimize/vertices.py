"""Vertices of the feasible set: designs with as many active limits as parameters.

A limit is a constraint of the geometry, or a bound of the unit box. If the optimum is at a vertex,
the forces only choose between vertices. The others are found by walking along the edges. One limit
is released, and Newton steps keep the rest active until a further limit is reached. Limits of
forces are ignored, because they are not known without a simulation."""

import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rootsopt.config.units import words
from rootsopt.optimize.local import NEAR, Limits
from rootsopt.optimize.problem import Problem

# Length (unit box) of a step along an edge.
_STEP = 1 / 24

# Greatest number of steps along an edge.
_STEPS = 60

# Greatest number of Newton steps, and slack at which they end.
_NEWTON, _EXACT = 12, 1e-10

# Smallest singular value of the gradients below which limits that meet at a point count as
# dependent.
_FLAT = 1e-6

# Nodes per axis of a plane: to find the feasible part of the box, and in this part.
_COARSE, _NODES = 25, 33

# Least number of designs between which an objective is drawn.
_CORNERS = 4

# Greatest number of other vertices that are simulated.
_VERTICES = 8

# Number of the first trial beside an optimum at a vertex, and greatest number of these trials.
AT_VERTEX, DRAWN = 100_000, 40


class Vertex(NamedTuple):
    """A vertex: its `point` (d,) in the unit box, and the numbers (d,) of its active `limits`.

    The m constraints come first, then the d lower and the d upper bounds."""

    point: NDArray[np.float64]
    held: tuple[int, ...]


class Plane(NamedTuple):
    """Points of the unit box on a grid, along two coordinates from one point.

    `axes`: the coordinates; `x`, `y` (n,): their values; `slacks` (n, n): least slack of the
    constraints, by y and x."""

    axes: tuple[int, int]
    x: NDArray[np.float64]
    y: NDArray[np.float64]
    slacks: NDArray[np.float64]

    def at(self, point: NDArray[np.float64], row: int, column: int) -> NDArray[np.float64]:
        """Return the node of the plane through a `point` (d,)."""
        here = point.copy()
        here[list(self.axes)] = self.x[column], self.y[row]
        return here

    def some(self, most: int) -> list[tuple[int, int]]:
        """Return the indices (row, column) of up to `most` feasible nodes, evenly spread."""
        for stride in range(1, len(self.x)):
            chosen = np.argwhere(self.slacks[::stride, ::stride] >= 0) * stride
            if len(chosen) <= most:
                return [(int(i), int(j)) for i, j in chosen]
        return []


class VertexOptimum(NamedTuple):
    """An optimum at a vertex of the limits.

    `limits`: names of its active limits. `others`: other vertices, best first, each with `design`
    (config units by key), `limits` and `objective` (`None` without a usable motion). `keys`: two
    parameters; `designs`: columns `x`, `y` (config units), `slack` and `objective` (NaN where not
    simulated) of designs that differ from the optimum in these parameters only."""

    limits: list[str]
    others: list[dict[str, Any]]
    keys: tuple[str, ...]
    designs: dict[str, list[float]]

    def record(self) -> dict[str, Any]:
        """Return the entry `optimality.vertex` of the result file."""
        return {"limits": self.limits, "others": self.others}

    def columns(self) -> dict[str, list[float]]:
        """Return the columns of `feasible.csv`, those of the parameters under their own names."""
        return dict(zip([*self.keys, "slack", "objective"], self.designs.values(), strict=True))


class FeasibleSet:
    """The points of the unit box that satisfy all limits.

    `limits`: function that returns the slacks (m,) of the constraints and their gradients (m, d);
    `size`: number d of parameters."""

    def __init__(self, limits: Limits, size: int):
        self.limits, self.size = limits, size

    def slacks(self, point: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the slacks (m + 2 d,) of all limits at a `point` (d,), and their gradients."""
        slack, normals = self.limits(point)
        one = np.eye(self.size)
        return np.concatenate([slack, point, 1 - point]), np.vstack([normals, one, -one])

    def vertex(self, point: NDArray[np.float64]) -> Vertex | None:
        """Return the vertex at a `point` (d,), or `None` if fewer than d limits are active.

        Of more than d active limits, use the first independent ones."""
        slack, normals = self.slacks(point)
        held: list[int] = []
        for number in np.flatnonzero(np.abs(slack) <= NEAR):
            some = [*held, int(number)]
            if len(some) <= self.size and _independent(normals[some]):
                held = some
        return Vertex(point, tuple(held)) if len(held) == self.size else None

    def vertices(self, first: Vertex, most: int) -> list[Vertex]:
        """Return up to `most` other vertices, those nearest to the `first` along edges first."""
        vertices = [first]
        for vertex in vertices:
            for number in vertex.held:
                other = self._other_end(vertex, number)
                if other is not None and all(
                    np.linalg.norm(other.point - one.point) > NEAR for one in vertices
                ):
                    vertices.append(other)
            if len(vertices) > most:
                break
        return vertices[1 : most + 1]

    def plane(self, point: NDArray[np.float64], most: int) -> Plane | None:
        """Return the feasible part of a plane through a `point` (d,) along two coordinates.

        The plane with most feasible points is chosen. `most`: as for `Plane.some`. Return `None` if
        that method would return fewer than `_CORNERS` nodes."""
        ends = np.linspace(0, 1, _COARSE)
        planes = [self._plane(point, axes, ends, ends)
                  for axes in itertools.combinations(range(self.size), 2)]  # fmt: skip
        best = max(planes, key=lambda one: int(np.sum(one.slacks >= 0)), default=None)
        if best is None or not np.any(best.slacks >= 0):
            return None
        around = []
        for axis in (0, 1):
            inside = np.flatnonzero(np.any(best.slacks >= 0, axis=axis))
            low, high = max(inside[0] - 1, 0), min(inside[-1] + 1, _COARSE - 1)
            around.append(np.linspace(ends[low], ends[high], _NODES))
        plane = self._plane(point, best.axes, *around)
        return plane if len(plane.some(most)) >= _CORNERS else None

    def _plane(
        self,
        point: NDArray[np.float64],
        axes: tuple[int, int],
        x: NDArray[np.float64],
        y: NDArray[np.float64],
    ) -> Plane:
        plane = Plane(axes, x, y, np.empty((len(y), len(x))))
        for node in np.ndindex(plane.slacks.shape):
            slack, _ = self.limits(plane.at(point, *node))
            plane.slacks[node] = np.min(slack, initial=np.inf)
        return plane

    def _other_end(self, vertex: Vertex, number: int) -> Vertex | None:
        """Return the other end of the edge on which limit `number` of a `vertex` is released.

        Return `None` if the edge cannot be followed to its end."""
        kept = [one for one in vertex.held if one != number]
        point, last = vertex.point, np.zeros(self.size)
        slack, normals = self.slacks(point)
        away = normals[number]
        for _ in range(_STEPS):
            along = np.linalg.svd(np.vstack([normals[kept], np.zeros(self.size)]))[2][-1]
            ahead = along @ (last if last.any() else away)
            last = along * (1.0 if ahead > 0 else -1.0)
            there = self._on(kept, point + _STEP * last)
            if there is None:
                return None
            after, turned = self.slacks(there)
            crossed = np.setdiff1d(np.flatnonzero(after < -_EXACT), kept)
            if crossed.size:
                # The limit that is crossed first, if slacks change in proportion.
                share = slack[crossed] / (slack[crossed] - after[crossed])
                for k in np.argsort(share):
                    held = [*kept, int(crossed[k])]
                    end = self._on(held, point + share[k] * (there - point))
                    if end is not None and np.min(self.slacks(end)[0]) > -NEAR:
                        return Vertex(end, tuple(held))
                return None
            point, slack, normals = there, after, turned
        return None

    def _on(self, held: list[int], point: NDArray[np.float64]) -> NDArray[np.float64] | None:
        """Return a point near `point` (d,) at which the limits `held` are active.

        Return `None` if Newton's method does not find one."""
        for _ in range(_NEWTON):
            slack, normals = self.slacks(point)
            rest = slack[held]
            if not np.all(np.isfinite(rest)) or not _independent(normals[held]):
                return None
            if np.max(np.abs(rest), initial=0.0) < _EXACT:
                return point
            point = point - np.linalg.lstsq(normals[held], rest)[0]
        return None


def vertex_optimum(
    problem: Problem,
    point: NDArray[np.float64],
    simulated: Callable[[list[NDArray[np.float64]]], list[float]],
    most: int,
) -> VertexOptimum | None:
    """Return the facts on an optimum at a `point` (d,) if it is a vertex, else `None`.

    `simulated`: function that returns the objectives of points, NaN without a usable motion;
    `most`: number of designs that may be simulated."""
    feasible, keys = FeasibleSet(problem.limits_at, len(point)), problem.config.design_keys
    own = feasible.vertex(point)
    if own is None:
        return None
    vertices = feasible.vertices(own, min(most, _VERTICES))
    plane = feasible.plane(point, rest) if (rest := most - len(vertices)) >= _CORNERS else None
    nodes = [] if plane is None else plane.some(rest)
    points = [one.point for one in vertices]
    if plane is not None:
        points += [plane.at(point, *node) for node in nodes]
    objectives = simulated(points)
    limits = [one.name for one in problem.space.constraints]
    limits += [f"{side} bound of {words(key)}" for side in ("lower", "upper") for key in keys]
    others = [
        {
            "design": problem.named(one.point),
            "limits": [limits[number] for number in one.held],
            "objective": None if np.isnan(objective) else objective,
        }
        for one, objective in zip(vertices, objectives, strict=False)
    ]
    others.sort(key=lambda row: np.inf if row["objective"] is None else row["objective"])
    held = [limits[number] for number in own.held]
    if plane is None:
        return VertexOptimum(held, others, (), {})
    values, designs = np.full(plane.slacks.shape, np.nan), np.empty((*plane.slacks.shape, 2))
    for node in np.ndindex(values.shape):
        designs[node] = problem.look(plane.at(point, *node))[0][list(plane.axes)]
    for node, objective in zip(nodes, objectives[len(vertices) :], strict=True):
        values[node] = objective
    return VertexOptimum(held, others, tuple(keys[axis] for axis in plane.axes), {
        "x": designs[..., 0].ravel().tolist(),
        "y": designs[..., 1].ravel().tolist(),
        "slack": plane.slacks.ravel().tolist(),
        "objective": values.ravel().tolist(),
    })  # fmt: skip


def _independent(normals: NDArray[np.float64]) -> bool:
    finite = bool(np.all(np.isfinite(normals)))
    return finite and (
        not len(normals) or float(np.linalg.svd(normals, compute_uv=False)[-1]) > _FLAT
    )
