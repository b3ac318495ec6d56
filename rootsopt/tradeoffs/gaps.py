"""Recognises gaps: places where a front, or the designs along it, jump.

Neighbours that lie far apart are bisected. On a front without a gap, the point found in between
divides the distance. At a gap, the search leads back to one of both neighbours."""

import dataclasses
import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Pair = tuple[int, int]
_WIDE_TERMS = 1.8
"""Distance of neighbours in terms, in distances of their reference points, above which the place
between them is searched."""
_WIDE_DESIGN, _LEAST_DESIGN = 3.0, 0.05
"""Distance of neighbours in the unit box, in typical distances and absolute, above which the place
between them is searched."""
_CLOSE = 0.3
"""Distance of neighbours in terms, in distances of their reference points, below which their
designs count as those of two kinds if they are still far apart."""
_BACK = 0.1
"""Share of the distance of two neighbours up to which a point found between them counts as one of
them."""


class Edge(NamedTuple):
    """Two neighbours on a front.

    `pair`: their numbers; `distance`: distance in scaled terms; `design_distance`: greatest
    difference of a coordinate of the unit box."""

    pair: Pair
    distance: float
    design_distance: float


class Spacing(NamedTuple):
    """Typical distances of neighbours: `terms` in scaled terms, `design` in the unit box."""

    terms: float
    design: float

    def excess(self, edge: Edge) -> float:
        """Return how far apart two neighbours are, 1 where the place between them is searched."""
        jump = edge.design_distance / max(_WIDE_DESIGN * self.design, _LEAST_DESIGN)
        return max(edge.distance / (_WIDE_TERMS * self.terms), jump)

    def kind(self, edge: Edge) -> str:
        """Return whether neighbours are far apart in `terms`, or only in `design`."""
        return "terms" if edge.distance > _WIDE_TERMS * self.terms else "design"

    def close(self, edge: Edge) -> bool:
        """Return whether neighbours are so close in terms that a bisection cannot tell more."""
        return edge.distance <= _CLOSE * self.terms


def measured(pair: Pair, values: NDArray[np.float64], points: NDArray[np.float64]) -> Edge:
    """Return the edge of a `pair`, given scaled terms (n, k) and points (n, d) of all numbers."""
    i, j = pair
    apart = float(np.linalg.norm(values[i] - values[j]))
    return Edge(pair, apart, float(np.max(np.abs(points[i] - points[j]))))


def along(kept: Sequence[int]) -> list[Pair]:
    """Return pairs of successive numbers of an ordered front of two terms."""
    return list(itertools.pairwise(kept))


def among(pairs: Sequence[Pair], kept: Sequence[int], same: Sequence[int]) -> list[Pair]:
    """Return those `pairs` whose numbers are both in `kept`, each once.

    `same`: for each number, that of an earlier one which stands for it, or -1."""
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

    `edge`: the neighbours; `one`, `other` (k,): their scaled terms."""
    apart = [float(np.linalg.norm(values - end)) for end in (one, other)]
    return min(apart) > _BACK * edge.distance and max(apart) < edge.distance * (1 + _BACK)


@dataclasses.dataclass
class Search:
    """What the bisections have found so far.

    `pairs`: pairs of neighbours (three terms only); `tried`: number of points searched for between
    a pair; `closed`: pairs that turned out to be the two sides of a gap, with its kind."""

    pairs: list[Pair]
    tried: dict[Pair, int] = dataclasses.field(default_factory=dict)
    closed: dict[Pair, str] = dataclasses.field(default_factory=dict)

    def divided(self, pair: Pair, middle: int) -> None:
        """Record that the point number `middle` was found between a `pair`."""
        count = self.tried.get(pair, 0)
        for end in pair:
            new = (min(end, middle), max(end, middle))
            self.tried[new] = count
            self.pairs.append(new)
        if pair in self.pairs:
            self.pairs.remove(pair)


__all__ = ["Edge", "Pair", "Search", "Spacing", "along", "among", "divides", "measured"]
