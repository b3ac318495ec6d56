"""The front of a trade-off as a result: points, dropped points, gaps and status.

Turns several terms into one objective, whose optimum is one point of the front.

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

import dataclasses
import itertools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rootsopt.config.reading import Config
from rootsopt.config.units import words
from rootsopt.optimize.infeasible import Infeasible
from rootsopt.optimize.local import RESIDUAL, Certificate, Group, Linearization
from rootsopt.optimize.tradeoffs.study import Aim, Sample
from rootsopt.response.result import Evaluation
from rootsopt.status import Standing, Status

EQUAL = 1e-6
"""Difference between two designs in a term (fraction of its range along the front) below which the
term counts as equal when designs are compared."""


@dataclasses.dataclass(frozen=True)
class FrontPoint:
    """One design of a front.

    `number`: number of the point, from 1 at the best design in the first term; 0 if it was dropped.
    `end_of`: name of the term in which this design is the best, or "". `point` (d,): the design in
    the unit box. `terms`: value of each term, in its unit. `evaluation`: the simulated design, or
    its geometry if no term needs a simulation.

    `standing`: status; `reason`: why the local search ended, as in `rootsopt.optimize.sqp`;
    `residual`, `violation`: first-order conditions, as in `Certificate`. A *range* of a term is its
    range along the front; the residual is in ranges per side of the unit box. `weights`: weight of
    each term at the optimum; their sum is 1. `rates`: change of the first term per unit of each
    other term along the front, NaN if unknown. `limits`: multiplier of each active constraint and
    bound by name, in ranges per scaled unit."""

    number: int
    end_of: str
    point: NDArray[np.float64]
    terms: dict[str, float]
    evaluation: Evaluation
    standing: Standing
    reason: str
    residual: float
    violation: float
    weights: dict[str, float]
    rates: dict[str, float]
    limits: dict[str, float]

    @property
    def design(self) -> dict[str, float]:
        """Design parameters in config units, by key."""
        return self.evaluation.design

    def record(self) -> dict[str, Any]:
        """Return the entry of the point in the result file."""
        shown = self.evaluation.record()
        del shown["design"]
        evaluation = {f"evaluation_{k}" if k in ("status", "message") else k: v
                      for k, v in shown.items()}  # fmt: skip
        return {
            "point": self.number,
            "end_of": self.end_of or None,
            "terms": self.terms,
            "design": self.design,
            "status": self.standing.label,
            "message": self.standing.value,
            "certificate": {
                "reason": self.reason,
                "residual": self.residual,
                "required_residual": RESIDUAL,
                "violation": self.violation,
            },
            "weights": self.weights,
            "rates": {k: None if math.isnan(v) else v for k, v in self.rates.items()},
            "multipliers": self.limits,
        } | evaluation

    def row(self) -> dict[str, Any]:
        """Return the row of the point in front.csv."""
        first = next(iter(self.terms))
        rates = {f"{first}_per_{k}": None if math.isnan(v) else v for k, v in self.rates.items()}
        geometry = {k: v for k, v in self.evaluation.geometry.items() if k not in self.terms}
        own = {"point": self.number, "status": self.standing.label, "end_of": self.end_of}
        row = own | self.terms | rates | self.design | geometry
        forces = {k: v for k, v in self.evaluation.response.items() if k not in row}
        return row | forces | {"residual": self.residual}


class Gap(NamedTuple):
    """A gap between two points of a front, where the terms or the designs jump.

    `first`, `second`: numbers of the points on both sides. `kind`: `terms` if there is no best
    compromise between them, `design` if the terms are continuous but the designs jump.
    `distance`: distance between the points in terms, in ranges along the front; `design_distance`:
    greatest difference of a coordinate of the unit box. `tried`: number of searches for a point in
    between. `confirmed`: whether these searches led back to one of the two sides. Otherwise,
    `pareto.refinements` was used up before."""

    first: int
    second: int
    kind: str
    distance: float
    design_distance: float
    tried: int
    confirmed: bool


@dataclasses.dataclass(frozen=True)
class Front:
    """Outcome of a trade-off.

    `config`: config of the run; `aims`: the terms; `baseline`: the evaluated design of the config;
    `baseline_terms`: its terms, empty if it has no usable steady state. `points`: the front, from
    the best in the first term on. `dropped`: points that are dominated, repeated or not usable.
    `edges`: pairs of point numbers of neighbours without a gap between them; `gaps`: the gaps.

    `limits_dropped`: terms whose limits under `constraints`, the baseline's values, were dropped,
    because they would cut off a side of the front. `searches`, `evaluations`: effort.
    `interrupted`: whether the search was stopped. `infeasible`: why no design satisfies all
    constraints, `None` if one does.

    >>> import jax
    >>> import rootsopt
    >>> jax.config.update("jax_enable_x64", True)
    >>> terms = "pareto.terms=[outer_radius_mm, area_efficiency]"
    >>> quick = [terms, "pareto.points=3", "pareto.refinements=0"]
    >>> front = rootsopt.pareto_front(rootsopt.load_config("cic_drawn", quick))
    >>> front.status.label, len(front.points)
    ('geometry_only', 3)
    """

    config: Config
    aims: tuple[Aim, ...]
    baseline: Evaluation
    baseline_terms: dict[str, float]
    points: tuple[FrontPoint, ...] = ()
    dropped: tuple[FrontPoint, ...] = ()
    edges: tuple[tuple[int, int], ...] = ()
    gaps: tuple[Gap, ...] = ()
    limits_dropped: tuple[str, ...] = ()
    searches: int = 0
    evaluations: int = 0
    interrupted: bool = False
    infeasible: Infeasible | None = None

    @property
    def certified(self) -> int:
        """Number of certified points."""
        return sum(one.standing is Standing.CERTIFIED for one in self.points)

    @property
    def status(self) -> Status:
        """Status of the front as a whole."""
        failures = (
            (Status.INTERRUPTED, self.interrupted),
            (self.baseline.status, not self.baseline_terms),
            (Status.INFEASIBLE, self.infeasible is not None),
            (Status.NOT_CONVERGED, not self.certified),
        )
        return next((status for status, met in failures if met), self.baseline.status)

    @property
    def message(self) -> str:
        """Sentences for the user: what was found, with advice."""
        if self.interrupted:
            count = len(self.points)
            return (
                f"The search was stopped: the front has the {count} point"
                f"{'s' if count != 1 else ''} found so far. Run it again for the whole front."
            )
        if not self.baseline_terms:
            return f"baseline: {self.baseline.message}"
        if self.infeasible is not None:
            return self.infeasible.message
        if not self.points:
            return (
                "No point of the front held up when simulated from rest. Raise "
                "optimizer.screening or optimizer.starts, or tighten solver.accuracy."
            )
        if not self.certified:
            return f"No point of the front is certified. {Standing.NOT_CERTIFIED.value}"
        parts = [f"{self.certified} of {len(self.points)} points are certified."]
        if len(self.points) == 1:
            parts.append("One design is the best in all terms: they are not in conflict.")
        if self.gaps:
            parts.append(f"The front has {len(self.gaps)} gap{'s' if len(self.gaps) > 1 else ''}.")
        if self.limits_dropped:
            names = ", ".join(map(words, self.limits_dropped))
            parts.append(
                "Limits that are the baseline's own values were dropped, because they limit terms: "
                f"{names}. A number under constraints stays."
            )
        return " ".join(parts)

    def config_of(self, point: FrontPoint) -> Config:
        """Return the config of the run with the design of a `point`."""
        return self.config.with_design([*point.design.values()])

    def record(self) -> dict[str, Any]:
        """Return the entries of the result file."""
        entries: dict[str, Any] = {
            "terms": [
                {"name": aim.name, "sense": aim.sense, "unit": aim.unit} for aim in self.aims
            ],
            "baseline": self.baseline.record() | {"terms": self.baseline_terms},
            "points": [one.record() for one in self.points],
            "dropped": [one.record() for one in self.dropped],
            "edges": [[*pair] for pair in self.edges],
            "gaps": [one._asdict() for one in self.gaps],
            "limits_dropped": [*self.limits_dropped],
            "status": self.status.label,
            "message": self.message,
            "statistics": {"searches": self.searches, "evaluations": self.evaluations},
        }
        if self.infeasible is not None:
            entries["infeasible"] = self.infeasible.record()
        return entries


def dominated(values: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return a mask (n,) of the points that another point dominates.

    `values` (n, k): scaled terms, of which less is better. A point is dominated if another one is
    no worse in any term and better in one, by more than `EQUAL`."""
    worse = values[:, None, :] - values[None, :, :]
    beaten = np.all(worse >= -EQUAL, axis=2) & np.any(worse > EQUAL, axis=2)
    # Compare the sums as well: within `EQUAL`, two points could otherwise dominate each other.
    total = values.sum(axis=1)
    return np.any(beaten & (total[None, :] < total[:, None]), axis=1)


def repeated(
    values: NDArray[np.float64], points: NDArray[np.float64], near: float = 2e-3
) -> list[int]:
    """Return, for each of n points, the number of an earlier point that is the same, or -1.

    `values` (n, k): scaled terms; `points` (n, d): designs in the unit box. Two points are the same
    if no term differs by more than `near`, and no coordinate by more than 5 times `near`."""
    earlier: list[int] = []
    for k in range(len(values)):
        same = [
            j
            for j in range(k)
            if earlier[j] < 0
            and np.max(np.abs(values[j] - values[k])) <= near
            and np.max(np.abs(points[j] - points[k])) <= 5 * near
        ]
        earlier.append(same[0] if same else -1)
    return earlier


def ordered(values: NDArray[np.float64]) -> Sequence[int]:
    """Return the indices (n,) that sort points by their scaled terms `values` (n, k).

    Points are sorted by the first term, equal ones by the next term."""
    return [int(k) for k in np.lexsort(values.T[::-1])]


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
        limits = sample.slack, sample.normals, sample.caps
        return Linearization(smooth, slope, (first, *corners), *limits)

    def weights(self, sample: Sample, certificate: Certificate) -> NDArray[np.float64]:
        """Return the weights (k,) of the scaled terms in the maximum at an optimum; their sum is 1.

        `sample`, `certificate`: those of the optimum."""
        kinds = np.concatenate([sample.terms[k].tags[:, 0] for k in self.leading]).astype(int)
        weights = np.zeros(len(sample.terms))
        np.add.at(weights, kinds, certificate.shares[0])
        weights = weights / self.steps
        return weights / np.sum(weights)


def rates(
    weights: NDArray[np.float64], width: NDArray[np.float64], least: float = 1e-4
) -> NDArray[np.float64]:
    """Return the rates (k, k) at which terms trade along the front.

    Entry (i, j) is the change of term i per unit of term j, both taken as terms to be minimised:
    -(w_j / width_j) / (w_i / width_i). `weights` (k,): those of the scaled terms; `width` (k,):
    their scale. The rate is NaN if one of the two weights is below `least`. That term then does not
    influence the optimum, as at an end of the front or beside a gap."""
    held = np.where(weights >= least, weights / width, np.nan)
    ratios = -held[None, :] / held[:, None]
    np.fill_diagonal(ratios, np.nan)
    return ratios


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


def links(grid: Sequence[Key]) -> list[tuple[int, int]]:
    """Return the pairs of neighbours on the grid, as indices of the keys in `grid`."""
    place = {key: number for number, key in enumerate(grid)}
    return [
        (number, place[other])
        for key, number in place.items()
        for step in directions(len(key))
        if (other := tuple(a + b for a, b in zip(key, step, strict=True))) in place
    ]
