"""Turns several terms into one objective, whose optimum is one point of the front.

The terms u_i are scaled so that less is better, and so that the ends of the front lie at 0 and 1.
From a reference point r, the search finds the design that goes furthest in all terms at once:

    min over x of   max_i (u_i(x) - r_i) / d_i  +  ρ Σ_i u_i(x),    i in the terms that lead.

Every point of a front is the optimum for some r, also where the front is not convex. A weighted sum
does not reach these points. All d_i are 1, except beside a gap. The small second part excludes
designs that are worse in one term and better in none. Sources: Pascoletti and Serafini, Scalarizing
vector optimization problems, Journal of Optimization Theory and Applications 42 (1984) 499-524.
Steuer and Choo, An interactive weighted Tchebycheff procedure, Mathematical Programming 26 (1983)
326-344.

The maximum is one `Group` of branches. The certificate gives the share of each branch. The shares
are the weights of the terms at the optimum, and their ratios are the rates at which the terms
trade.

The reference points of a front form a grid: a line for two terms, a triangle for three. A *key*
identifies one of them by one whole number per term; their sum is the number of divisions. At the
end of a term (the optimum of this term alone), the number of this term is that sum, and all others
are 0."""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rootsopt.optimize.local import Certificate, Group, Linearization
from rootsopt.optimize.tradeoffs.study import Sample

RHO = 1e-3
"""Weight ρ of the sum. It excludes a design if a small loss in one term would gain more than 1/ρ
times as much of another term, both in ranges."""


class Scale(NamedTuple):
    """Scale of k terms: u = (value - `ideal`) / `width`, both (k,)."""

    ideal: NDArray[np.float64]
    width: NDArray[np.float64]

    def of(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the scaled terms (…, k) for their values (…, k), all to be minimised."""
        return (values - self.ideal) / self.width


class Scalar(NamedTuple):
    """One scalar objective made of k terms.

    `scale`: scale of the terms; `reference` (k,): reference point r, in scaled terms; `leading`:
    indices of the terms in the maximum; `direction` (k,): d, by default 1 for each term."""

    scale: Scale
    reference: NDArray[np.float64]
    leading: tuple[int, ...]
    direction: NDArray[np.float64] | None = None

    @property
    def steps(self) -> NDArray[np.float64]:
        """Divisor (k,) of each scaled term in the maximum: `direction`, or ones by default."""
        return np.ones(len(self.reference)) if self.direction is None else self.direction

    def value(self, values: NDArray[np.float64]) -> float:
        """Return the objective for the values (k,) of the terms."""
        u = self.scale.of(values)
        lead = [*self.leading]
        return float(np.max(((u - self.reference) / self.steps)[lead]) + RHO * np.sum(u))

    def local(self, sample: Sample) -> Linearization:
        """Return objective and constraints at a `sample`, with gradients."""
        smooth, slope = 0.0, np.zeros(len(sample.point))
        together: list[Group] = []
        corners: list[Group] = []
        for number, group in enumerate(sample.terms):
            width = self.scale.width[number]
            values = (group.values - self.scale.ideal[number]) / width
            if number in self.leading:
                step = self.steps[number]
                lead = (values - self.reference[number]) / step
                together.append(Group(group.tags, lead, group.slopes / (width * step)))
            if sample.cornered[number]:
                corners.append(Group(group.tags, RHO * values, RHO * group.slopes / width))
            else:
                smooth += RHO * float(values[0])
                slope = slope + RHO * group.slopes[0] / width
        first = Group(*(np.concatenate(arrays) for arrays in zip(*together, strict=True)))
        limits = sample.slack, sample.normals, sample.walls
        return Linearization(smooth, slope, (first, *corners), *limits)

    def weights(self, sample: Sample, certificate: Certificate) -> NDArray[np.float64]:
        """Return the weights (k,) of the scaled terms in the maximum at an optimum; their sum is 1.

        `sample`, `certificate`: those of the optimum."""
        kinds = np.concatenate([sample.terms[k].tags[:, 0] for k in self.leading]).astype(int)
        found = np.zeros(len(sample.terms))
        np.add.at(found, kinds, certificate.shares[0])
        found = found / self.steps
        return found / np.sum(found)


def rates(
    weights: NDArray[np.float64], width: NDArray[np.float64], least: float = 1e-4
) -> NDArray[np.float64]:
    """Return the rates (k, k) at which terms trade along the front.

    Entry (i, j) is the change of term i per unit of term j, both taken as terms to be minimised:
    -(w_j / width_j) / (w_i / width_i). `weights` (k,): those of the scaled terms; `width` (k,):
    their scale. The rate is NaN if one of the two weights is below `least`. That term then does not
    influence the optimum, as at an end of the front or beside a gap."""
    held = np.where(weights >= least, weights / width, np.nan)
    found = -held[None, :] / held[:, None]
    np.fill_diagonal(found, np.nan)
    return found


def end_scale(baseline: NDArray[np.float64], screened: NDArray[np.float64]) -> Scale:
    """Return the scale of k terms before the ends of the front are known.

    `baseline` (k,): values of the baseline; `screened` (n, k): those of all screened designs. The
    width is the magnitude of the baseline's value, or the range of the screened designs if this
    value is nearly 0."""
    magnitude = np.abs(baseline)
    spread = np.ptp(screened, axis=0) if len(screened) else np.zeros_like(magnitude)
    width = np.where(magnitude > 1e-3 * spread, magnitude, spread)
    return Scale(np.zeros_like(width), np.where(width > 0, width, 1.0))


Key = tuple[int, ...]


def keys(count: int, divisions: int) -> list[Key]:
    """Return all keys for `count` terms, beginning with the end of the first term. `divisions`:
    number of steps from one end to another.

    Subtract one of the `directions` from a key to get a neighbour that comes before it."""
    every = itertools.product(range(divisions, -1, -1), repeat=count)
    return [key for key in every if sum(key) == divisions]


def corners(count: int, divisions: int) -> list[Key]:
    """Return the keys of the ends of the front, in the order of the `count` terms."""
    return [tuple(divisions * (i == k) for i in range(count)) for k in range(count)]


def directions(count: int) -> list[Key]:
    """Return the steps from a key to those neighbours that come after it in `keys`, for `count`
    terms."""
    pairs = itertools.combinations(range(count), 2)
    return [tuple((k == j) - (k == i) for k in range(count)) for i, j in pairs]


def links(found: Sequence[Key]) -> list[tuple[int, int]]:
    """Return the pairs of neighbours on the grid, as indices of the keys in `found`."""
    place = {key: number for number, key in enumerate(found)}
    pairs = []
    for key, number in place.items():
        for step in directions(len(key)):
            other = place.get(tuple(a + b for a, b in zip(key, step, strict=True)))
            if other is not None:
                pairs.append((number, other))
    return pairs
