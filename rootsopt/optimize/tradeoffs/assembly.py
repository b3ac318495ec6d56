"""Assembles a front from its nodes: which points stay, which are neighbours, and the rates.

A *node* is an optimum that the tracing has found; a *point* belongs to the finished front. An *end*
of the front is the optimum of one term alone.

If two neighbours lie far apart, a search looks for a point between them (bisection). Without a gap,
it finds such a point. At a gap, where the terms or the designs jump, it leads back to one of the
two neighbours. The *spacing* of terms is the distance between neighbouring reference points
(`rootsopt.optimize.tradeoffs.front`). Points are identified by their indices."""

import dataclasses
import itertools
import operator
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rootsopt.config.units import words
from rootsopt.optimize.infeasible import Infeasible
from rootsopt.optimize.limits import HELD
from rootsopt.optimize.local import Certificate
from rootsopt.optimize.outcome import apart
from rootsopt.optimize.tradeoffs.front import (
    Front,
    FrontPoint,
    Gap,
    Key,
    Scalar,
    Scale,
    directions,
    dominated,
    ordered,
    rates,
    repeated,
)
from rootsopt.optimize.tradeoffs.study import Course, Sample, Seen, Study
from rootsopt.status import Standing

if TYPE_CHECKING:
    from rootsopt.optimize.tradeoffs.trace import Tracer

Pair = tuple[int, int]
# Distance in terms (multiples of the spacing) above which two neighbours are bisected.
_WIDE_TERMS = 1.8
# Distances in the unit box (multiples of the typical distance; absolute) above which two neighbours
# are bisected. Both must be exceeded.
_WIDE_DESIGN, _LEAST_DESIGN = 3.0, 0.05
# Distance in terms (multiples of the spacing) below which two neighbours with distant designs are a
# gap of kind `design`, without another bisection.
_CLOSE = 0.3
# Distance from a neighbour (fraction of the distance between both neighbours) below which a point
# found by bisection counts as that neighbour.
_BACK = 0.1

# Difference between the objectives of two searches (fraction of a term's range) below which a
# search that has converged counts as the better one.
_EQUAL = 1e-7

# Gain in the objective (fraction of a term's range) above which a design evaluated earlier starts
# another search.
BETTER = 1e-4

# Distance in the unit box above which two designs count as distant from each other.
APART = 0.15

# Accuracy (fraction of the gap's width) with which the sides of a gap are located.
_SHARP = 0.01


class Edge(NamedTuple):
    """Two neighbours on a front, with the distances between them.

    `pair`: indices of the neighbours; `distance`: Euclidean distance in scaled terms;
    `design_distance`: greatest difference of a coordinate of the unit box."""

    pair: Pair
    distance: float
    design_distance: float


class Spacing(NamedTuple):
    """Typical distances between neighbours: `terms` in scaled terms, `design` in the unit box."""

    terms: float
    design: float

    def excess(self, edge: Edge) -> float:
        """Return the distance of two neighbours divided by that above which they are bisected.

        It is the greater of the quotients in terms and in the unit box."""
        jump = edge.design_distance / max(_WIDE_DESIGN * self.design, _LEAST_DESIGN)
        return max(edge.distance / (_WIDE_TERMS * self.terms), jump)

    def kind(self, edge: Edge) -> str:
        """Return "terms" if two neighbours are far apart in terms, otherwise "design"."""
        return "terms" if edge.distance > _WIDE_TERMS * self.terms else "design"


def divides(
    edge: Edge, values: NDArray[np.float64], one: NDArray[np.float64], other: NDArray[np.float64]
) -> bool:
    """Return whether a point with scaled terms `values` (k,) lies between two neighbours.

    `edge`: edge of the neighbours; `one`, `other` (k,): their scaled terms."""
    apart = [float(np.linalg.norm(values - end)) for end in (one, other)]
    return min(apart) > _BACK * edge.distance and max(apart) < edge.distance * (1 + _BACK)


@dataclasses.dataclass
class Bisections:
    """Results of all bisections so far.

    `pairs`: pairs of neighbours (three terms only); `tried`: number of searches between each pair;
    `closed`: kind of the gap between each pair that is not bisected further."""

    pairs: list[Pair]
    tried: dict[Pair, int] = dataclasses.field(default_factory=dict)
    closed: dict[Pair, str] = dataclasses.field(default_factory=dict)

    def divided(self, pair: Pair, middle: int) -> None:
        """Record that the point with the index `middle` was found between the two of a `pair`."""
        count = self.tried.get(pair, 0)
        for end in pair:
            new = (min(end, middle), max(end, middle))
            self.tried[new] = count
            self.pairs.append(new)
        if pair in self.pairs:
            self.pairs.remove(pair)


class Node(NamedTuple):
    """One point of a front while it is traced.

    `scalar`: the objective that was minimised; `sample`: the best design; `certificate`:
    first-order conditions there; `reason`: why the search ended; `end`: index of the term whose
    optimum this is, or -1; `standing`: status, `NOT_VERIFIED` until the design has been simulated
    again."""

    scalar: Scalar
    sample: Sample
    certificate: Certificate
    reason: str
    end: int = -1
    standing: Standing = Standing.NOT_VERIFIED

    @property
    def objective(self) -> float:
        """Value of the objective."""
        return self.scalar.value(self.sample.values)


class Selection(NamedTuple):
    """The nodes, out of n, that form the front.

    `values` (n, k): scaled terms; `points` (n, d): designs in the unit box; `standings`: status of
    each node; `same`: for each node that repeats another one, the index of that other node, or -1;
    `kept`: indices of the nodes on the front, in order."""

    values: NDArray[np.float64]
    points: NDArray[np.float64]
    standings: list[Standing]
    same: list[int]
    kept: list[int]

    def edges(self, pairs: Sequence[Pair]) -> list[Edge]:
        """Return the pairs of neighbours on the front, each once.

        `pairs`: indices of neighbouring nodes, where a repeated node stands for the one that it
        repeats; used for three terms only. With two terms, neighbours are nodes that follow each
        other in `kept`."""
        known, values, points = {*self.kept}, self.values, self.points
        given = ([self.same[k] if self.same[k] >= 0 else k for k in pair] for pair in pairs)
        chosen = itertools.pairwise(self.kept) if values.shape[1] == 2 else given
        neighbours = dict.fromkeys((min(pair), max(pair)) for pair in chosen)
        return [
            Edge(
                (i, j),
                float(np.linalg.norm(values[i] - values[j])),
                float(np.max(np.abs(points[i] - points[j]))),
            )
            for i, j in neighbours
            if i != j and known.issuperset((i, j))
        ]


def selected(nodes: Sequence[Node], scale: Scale) -> Selection:
    """Return the `nodes` that form the front.

    Nodes that are dominated, repeat another node, or failed the verification are left out."""
    count = len(scale.width)
    values = scale.of(np.array([node.sample.values for node in nodes]).reshape(-1, count))
    points = np.array([node.sample.point for node in nodes])
    standings = [node.standing for node in nodes]
    same = [-1] * len(nodes)
    alive = [k for k, one in enumerate(standings) if one.kept]
    # Of several equal nodes, keep an end if there is one, otherwise a certified node.
    alive.sort(key=lambda k: (nodes[k].end < 0, standings[k] is not Standing.CERTIFIED))
    beaten = dominated(values[alive]) if alive else []
    for k, one in zip(alive, beaten, strict=True):
        if one:
            standings[k] = Standing.DOMINATED
    alive = [k for k in alive if standings[k].kept]
    for k, first in zip(alive, repeated(values[alive], points[alive]), strict=True):
        if first >= 0:
            standings[k], same[k] = Standing.REPEATED, alive[first]
    alive = [k for k in alive if standings[k].kept]
    kept = [alive[k] for k in ordered(values[alive])] if alive else []
    return Selection(values, points, standings, same, kept)


def spacing_of(selection: Selection, pairs: Sequence[Pair], ends: int, divisions: int) -> Spacing:
    """Return the typical distances between neighbours before any bisection.

    `selection`: nodes on the front; `pairs`: as in `Selection.edges`; `ends`: number of ends, which
    are the first nodes; `divisions`: number of steps between two ends."""
    corners = selection.values[:ends]
    sides = [np.linalg.norm(a - b) for k, a in enumerate(corners) for b in corners[k + 1 :]]
    moves = [edge.design_distance for edge in selection.edges(pairs)]
    if not sides:
        return Spacing(np.inf, np.inf)
    return Spacing(float(np.mean(sides)) / divisions, float(np.median(moves)) if moves else 0.0)


def points_of(
    study: Study, nodes: Sequence[Node], selection: Selection, scale: Scale
) -> tuple[list[FrontPoint], list[FrontPoint]]:
    """Return (points of the front in order, dropped points) for all `nodes`.

    `study`: evaluates their designs; `selection`: nodes that form the front; `scale`: scale of the
    terms."""
    number = {k: place for place, k in enumerate(selection.kept, start=1)}
    every = [
        _point(study, node, number.get(k, 0), standing, scale)
        for k, (node, standing) in enumerate(zip(nodes, selection.standings, strict=True))
    ]
    dropped = [one for k, one in enumerate(every) if k not in number]
    return [every[k] for k in selection.kept], dropped


def gaps_of(
    selection: Selection, search: Bisections, spacing: Spacing
) -> tuple[list[tuple[int, int]], list[Gap]]:
    """Return (pairs of neighbours without a gap between them, the gaps).

    Both refer to points by their numbers on the front (`FrontPoint.number`). `search`: results of
    the bisections; `spacing`: typical distances between neighbours."""
    number = {k: place for place, k in enumerate(selection.kept, start=1)}
    edges, gaps = [], []
    for edge in selection.edges(search.pairs):
        first, second = sorted(number[k] for k in edge.pair)
        closed = search.closed.get(edge.pair)
        if closed is None and spacing.excess(edge) <= 1:
            edges.append((first, second))
            continue
        kind = closed or spacing.kind(edge)
        tried = search.tried.get(edge.pair, 0)
        far = edge.distance, edge.design_distance
        gaps.append(Gap(first, second, kind, *far, tried, closed is not None))
    return edges, sorted(gaps)


def _point(study: Study, node: Node, number: int, standing: Standing, scale: Scale) -> FrontPoint:
    names = [aim.name for aim in study.aims]
    signs = np.array([aim.sign for aim in study.aims])
    weights = node.scalar.weights(node.sample, node.certificate)
    # The rates are those of terms to be minimised; the signs convert them to the terms themselves.
    traded = rates(weights, scale.width)[0] * signs[0] * signs
    return FrontPoint(
        number=number,
        end_of=names[node.end] if node.end >= 0 else "",
        point=node.sample.point,
        terms=study.term_values(node.sample.evaluation),
        evaluation=node.sample.evaluation,
        standing=standing,
        reason=node.reason,
        residual=node.certificate.residual,
        violation=node.certificate.violation,
        weights=dict(zip(names, map(float, weights), strict=True)),
        rates={name: float(rate) for name, rate in zip(names[1:], traded[1:], strict=True)},
        limits=_limits(study, node.certificate),
    )


def _limits(study: Study, certificate: Certificate) -> dict[str, float]:
    limits = {
        constraint.name: float(multiplier)
        for constraint, multiplier in zip(
            study.problem.space.constraints, certificate.multipliers, strict=True
        )
        if multiplier > HELD
    }
    return limits | {
        f"{side} bound of {words(key)}": float(multiplier)
        for side, multipliers in (("lower", certificate.lower), ("upper", certificate.upper))
        for key, multiplier in zip(study.problem.config.design_keys, multipliers, strict=True)
        if multiplier > HELD
    }


def better(best: Node | None, other: Node | None) -> Node | None:
    """Return the node with the lower objective.

    Of two that are equally good (`_EQUAL`), return one whose search has converged, or `best`."""
    if best is None or other is None:
        return other if best is None else best
    gain = best.objective - other.objective
    sooner = other.reason == "converged" != best.reason
    return other if gain > (-_EQUAL if sooner else _EQUAL) else best


def predictions(key: Key, ahead: bool, nodes: Mapping[Key, Node], course: Course):
    """Yield (start (d,), orbit) for a `key` of the grid, from its neighbours among the `nodes`.

    `ahead`: as in `Tracer._chain`; `course`: the searches from these starts. The first start is the
    secant through two neighbours in line. If there is only one neighbour, or if the search from
    the secant fails at once, the start is the nearest neighbour."""
    steps = directions(len(key))
    for step in steps if ahead else [tuple(-x for x in one) for one in steps]:
        near = nodes.get(tuple(a - b for a, b in zip(key, step, strict=True)))
        if near is None:
            continue
        far = nodes.get(tuple(a - 2 * b for a, b in zip(key, step, strict=True)))
        before = course.evaluations
        if far is not None and np.max(np.abs(near.sample.point - far.sample.point)) < 2 * APART:
            secant = np.clip(2 * near.sample.point - far.sample.point, 0.0, 1.0)
            yield secant, near.sample.evaluation.start
            if course.evaluations > before + 1:  # The start had a steady state.
                return
        yield near.sample.point, near.sample.evaluation.start
        return


def widest(edges: Sequence[Edge], spacing: Spacing, gaps: Bisections) -> Edge | None:
    """Return the neighbours that lie farthest apart, out of those that may be bisected.

    Return `None` if no neighbours are left to bisect."""
    open_ones = []
    for edge in edges:
        if edge.pair in gaps.closed or spacing.excess(edge) <= 1:
            continue
        if edge.distance <= _CLOSE * spacing.terms:
            gaps.closed[edge.pair] = "design"
            continue
        open_ones.append(edge)
    return max(open_ones, key=spacing.excess, default=None)


def starts_apart(
    course: Course, scalar: Scalar, count: int, first: NDArray[np.float64]
) -> list[Seen]:
    """Return up to `count` designs evaluated earlier that are distant from each other.

    They are in order of the objective `scalar`, the best first. Without such designs, return
    the point `first` (d,)."""
    seen = sorted(course.seen, key=lambda one: scalar.value(one.values))
    chosen = apart(seen, APART, count, operator.attrgetter("point"))
    return chosen or [Seen(first, np.zeros(0), None)]


def front_of(
    tracer: "Tracer", nodes: Sequence[Node], infeasible: Infeasible | None = None
) -> Front:
    """Return the front of the `nodes` of a `tracer`; `infeasible`: why there are none, if known."""
    study, baseline = tracer.study, tracer.study.problem.baseline
    known: dict = {}
    if nodes:
        selection = selected(nodes, tracer.scale)
        points, dropped = points_of(study, nodes, selection, tracer.scale)
        spacing = tracer._spacing
        if not np.isfinite(spacing.terms):  # Stopped early, or the terms do not conflict.
            spacing = spacing_of(selection, [], len(study.aims), tracer._divisions)
        edges, gaps = gaps_of(selection, tracer._gaps, spacing)
        if tracer.stop.is_set():  # Neighbours may be far apart only because points are missing.
            gaps = [gap for gap in gaps if gap.confirmed]
        known = {"points": tuple(points), "dropped": tuple(dropped),
                 "edges": tuple(edges), "gaps": tuple(gaps)}  # fmt: skip
    return Front(
        config=tracer.config,
        aims=study.aims,
        baseline=baseline,
        baseline_terms=study.term_values(baseline) if baseline.usable else {},
        limits_dropped=study.limits_dropped,
        searches=tracer._searches,
        evaluations=tracer._evaluations,
        interrupted=tracer.stop.is_set(),
        infeasible=infeasible,
        **known,
    )


def sharpened(tracer: "Tracer", pair: Pair) -> Pair:
    """Move the two sides of a gap towards each other, as far as the front continues.

    The front has two terms. Each side improves its worse term, as long as it stays better than
    the other side in the other term. Return the indices of the sides. A side that has moved has
    a new index."""
    first, second = sorted(pair, key=lambda k: tracer._scaled(k)[0])
    for lead in (0, 1):
        moving, fixed = (second, first) if lead == 0 else (first, second)
        start, limit = tracer._scaled(moving), tracer._scaled(fixed)
        apart = start[lead] - limit[lead]
        direction = np.where(np.arange(2) == lead, 1.0, _SHARP)
        reference = limit - np.where(np.arange(2) == lead, 0.0, _SHARP * apart)
        node = tracer._all()[moving]
        scalar = Scalar(tracer.scale, reference, (0, 1), direction)
        orbit = node.sample.evaluation.start
        best = tracer._solved(scalar, node.sample.point, orbit, None, tracer._course)
        if best is None or tracer.stop.is_set():
            continue
        terms = tracer.scale.of(best.sample.values)
        if terms[lead] < start[lead] - BETTER and terms[1 - lead] < limit[1 - lead]:
            with tracer._lock:
                tracer._nodes[(len(tracer._nodes),)] = best
            moved = len(tracer._all()) - 1
            first, second = (first, moved) if lead == 0 else (moved, second)
    return min(first, second), max(first, second)
