"""Detects gaps of a front: jumps of the terms, or of the designs, between two neighbours.

If two neighbours lie far apart, a search looks for a point between them (bisection). Without a gap,
it finds such a point. At a gap, it leads back to one of the two neighbours.

Below, the *spacing* of terms is the distance between neighbouring reference points
(`rootsopt.tradeoffs.scalar`). Points are identified by their indices."""

import dataclasses
import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

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


class Edge(NamedTuple):
    """Two neighbours on a front, and the distances between them.

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

        The greater of the quotients in terms and in the unit box counts."""
        jump = edge.design_distance / max(_WIDE_DESIGN * self.design, _LEAST_DESIGN)
        return max(edge.distance / (_WIDE_TERMS * self.terms), jump)

    def kind(self, edge: Edge) -> str:
        """Return "terms" if two neighbours are far apart in terms, otherwise "design"."""
        return "terms" if edge.distance > _WIDE_TERMS * self.terms else "design"

    def close(self, edge: Edge) -> bool:
        """Return whether two neighbours are too close in terms to be bisected."""
        return edge.distance <= _CLOSE * self.terms


def measured(pair: Pair, values: NDArray[np.float64], points: NDArray[np.float64]) -> Edge:
    """Return the `Edge` of a `pair` of points.

    `values` (n, k): scaled terms of all points; `points` (n, d): their designs in the unit box."""
    i, j = pair
    apart = float(np.linalg.norm(values[i] - values[j]))
    return Edge(pair, apart, float(np.max(np.abs(points[i] - points[j]))))


def along(kept: Sequence[int]) -> list[Pair]:
    """Return the pairs of neighbours on a front of two terms: successive indices in `kept`."""
    return list(itertools.pairwise(kept))


def among(pairs: Sequence[Pair], kept: Sequence[int], same: Sequence[int]) -> list[Pair]:
    """Return those `pairs` whose points are both in `kept`, each once.

    `same`: for each point, the index of the point that replaces it, or -1."""
    found: dict[Pair, None] = {}
    for pair in pairs:
        i, j = sorted(same[k] if same[k] >= 0 else k for k in pair)
        if i != j and i in kept and j in kept:
            found[i, j] = None
    return [*found]


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


__all__ = ["Bisections", "Edge", "Pair", "Spacing", "along", "among", "divides", "measured"]
