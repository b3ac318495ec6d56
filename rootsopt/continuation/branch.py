"""Follow periodic orbits along a parameter, through folds, with their stability.

A branch begins at a known orbit (`Evaluation.state` and its period). It is a solution curve of the
equations in `orbits`, followed by pseudo-arclength continuation (`arclength`). Unstable orbits,
which a simulation does not show, are followed like stable orbits; `BranchPoint.stable`
distinguishes them.
"""

import dataclasses
import enum
import itertools

import numpy as np
from numpy.typing import ArrayLike

from rootsopt.config import Config
from rootsopt.continuation.arclength import (
    End,
    Path,
    Spot,
    StepSizes,
    StoppedError,
    corrected,
    follow_curve,
)
from rootsopt.continuation.collocated import CollocatedFamily, can_follow
from rootsopt.continuation.orbits import (
    LONGEST,
    PLACES,
    BranchPoint,
    OrbitFamily,
    parameters,
    place_of,
    value_of,
    with_value,
)
from rootsopt.dynamics.verdict import RESIDUAL
from rootsopt.errors import InputError

_HALVED = 0.004
"""Distance (unit of `StepSizes`) below which the states at the start and the middle of an orbit
count as equal. A branch whose steps have become too small there ends at an orbit of half the period
(`End.HALVED`)."""
_SIZES = 3e-4, 1e-3, 3e-3, 1e-4, 1e-2
"""Distances (unit of `StepSizes`) from a period doubling at which the orbit of twice the period is
tried, in this order."""
_FEW = 8
"""Number of points below which a doubled branch that falls back to the single period is tried
again, from another distance."""


class Kind(enum.Enum):
    """Kinds of bifurcation. Each value says what happens to the orbit."""

    FOLD = "Two orbits meet and vanish; a multiplier passes through +1."
    PERIOD_DOUBLING = "An orbit of twice the period is born; a multiplier passes through -1."
    NEIMARK_SACKER = "Quasi-periodic motion is born; two multipliers leave the unit circle."
    CORNER = "A contact of the flanks or of the gear begins or ends; multipliers jump."


@dataclasses.dataclass(frozen=True)
class Bifurcation:
    """A bifurcation of a branch.

    `kind` of bifurcation; `point`: the orbit at the bifurcation; `after`: index of the branch's
    last point before the bifurcation.
    """

    kind: Kind
    point: BranchPoint
    after: int

    @property
    def value(self) -> float:
        """Value of the parameter at the bifurcation, in the config's unit."""
        return self.point.value


@dataclasses.dataclass(frozen=True)
class Branch:
    """A family of orbits of the same period, followed along a parameter.

    `config` of the orbit from which the branch was followed; `parameter`: name of the parameter;
    `period` of all orbits (mesh periods); `points`: the orbits, in order; `bifurcations` on the
    branch; `ends`: why the branch begins and ends where it does; `limits`: range of the parameter
    (config's unit) and step sizes.
    """

    config: Config
    parameter: str
    period: int
    points: tuple[BranchPoint, ...]
    bifurcations: tuple[Bifurcation, ...]
    ends: tuple[End, End]
    limits: StepSizes

    def at(self, value: float) -> list[BranchPoint]:
        """Return all orbits of the branch at one `value` of the parameter (config's unit).

        Each orbit is closed again at exactly this value, and left out if that fails. The branch's
        last point is returned unchanged. The list is empty if the branch does not pass the value.
        """
        orbits = OrbitFamily(self.config, self.parameter, self.period, self.limits)
        found = []
        for old, new in zip(self.points[:-1], self.points[1:], strict=True):
            ends = sorted((old.value, new.value))
            if not ends[0] <= value < ends[1]:
                continue
            share = (value - old.value) / (new.value - old.value)
            places = [orbits.place(point.state, point.value) for point in (old, new)]
            guess = places[0] + share * (places[1] - places[0])
            try:
                found.append(orbits.closed(guess))
            except StoppedError:
                continue
        if self.points[-1].value == value:
            found.append(self.points[-1])
        return found


def follow(
    config: Config,
    parameter: str,
    state: ArrayLike,
    period: int,
    limits: StepSizes,
    ways: tuple[int, ...] = (-1, 1),
) -> Branch:
    """Follow the orbit of `period` mesh periods near the scaled `state` (n,) along a parameter.

    `limits`: range of the parameter (config's unit), which must contain the config's own value, and
    step sizes. A step of length 1 spans the range, or changes the scaled state by `SPAN`. `ways`:
    directions to follow, -1 for falling and 1 for rising values of the parameter.

    Raises `InputError` for an unknown parameter, or an invalid `period` or
    `ways`; for limits that exclude the config's value, or that the config cannot have; and if there
    is no orbit to start from.
    """
    value = value_of(config, parameter)
    if not limits.low <= value <= limits.high:
        raise InputError(
            f"`{place_of(parameter)}` must lie in the range to follow, {limits.low:g} to "
            f"{limits.high:g}, but is {value:g}"
        )
    if not 1 <= period <= LONGEST or not set(ways) <= {-1, 1} or not ways:
        raise InputError(
            f"Argument `period` must be 1 to {LONGEST}, and `ways` -1, 1 or both, but they are "
            f"{period} and {ways}"
        )
    for bound in (limits.low, limits.high):
        with_value(config, parameter, bound)
    orbits = _family(config, parameter, period, limits)
    place = orbits.place(state, value)
    fixed = np.eye(len(place))[-1]
    try:
        start = corrected(orbits, place, fixed, fixed)
    except StoppedError as stop:
        raise InputError(
            f"there is no orbit of {period} mesh periods near the state at "
            f"`{place_of(parameter)}` = {value:g}: {stop.end.value} Start from the state of a "
            "periodic Evaluation"
        ) from None
    branches = []
    for way in ways:
        first = start._replace(tangent=way * np.sign(start.tangent[-1] or 1) * start.tangent)
        branches.append(_branch(orbits, follow_curve(orbits, first, orbits.steps, _TESTS)))
        if branches[-1].ends[1] is End.CLOSED:
            break
    return branches[0] if len(branches) == 1 else _joined(*branches)


def follow_doubled(
    branch: Branch, bifurcation: Bifurcation, limits: StepSizes | None = None
) -> Branch | None:
    """Follow the branch of twice the period that begins at a period doubling of `branch`.

    The search for its first orbit starts a little away from the bifurcation, displaced along the
    eigenvector of the multiplier -1. `limits`: by default the limits of `branch`. The result is
    None if no orbit of twice the period is found, or if twice the period exceeds 8 mesh periods.

    Raises `ValueError` if `bifurcation` is not a period doubling."""
    if bifurcation.kind is not Kind.PERIOD_DOUBLING:
        raise ValueError(
            "Argument `bifurcation` must be a period doubling, but is "
            f"{bifurcation.kind.name.lower()}"
        )
    if 2 * branch.period > LONGEST:
        return None
    limits = limits or branch.limits
    simple = OrbitFamily(branch.config, branch.parameter, branch.period, limits)
    orbits = _family(branch.config, branch.parameter, 2 * branch.period, limits)
    place = simple.place(bifurcation.point.state, bifurcation.value)
    fixed = np.eye(len(place))[-1]
    try:
        known = corrected(simple, place, fixed, fixed).look.data
        multipliers, vectors = np.linalg.eig(known.monodromy)
        flipped = known.to_state @ np.real(vectors[:, np.argmin(np.abs(multipliers + 1))])
        across = np.append(flipped / np.linalg.norm(flipped), 0.0)
    except StoppedError:
        return None
    # Both directions lead to the same orbit, shifted by `branch.period`. Near a grazing contact one
    # of them may fail.
    fallen = None
    for size, way in itertools.product(_SIZES, (1, -1)):
        aside = way * across
        try:
            start = corrected(orbits, place + size * aside, aside, aside)
        except StoppedError:
            continue
        if start.look.data.half_way <= 0.2 * size:
            continue
        found = _branch(orbits, follow_curve(orbits, start, orbits.steps, _TESTS))
        if found.ends[1] is not End.HALVED or len(found.points) >= _FEW:
            return found
        fallen = found
    return fallen


def _family(config: Config, parameter: str, period: int, limits: StepSizes) -> OrbitFamily:
    """Return the equations of orbits, closed by collocation if the config allows it."""
    by_shooting = OrbitFamily(config, parameter, period, limits)
    if not can_follow(by_shooting.scene, by_shooting.pair):
        return by_shooting
    return CollocatedFamily(config, parameter, period, limits)


def _branch(orbits: OrbitFamily, path: Path) -> Branch:
    """Return the branch that consists of the points of `path`, with its bifurcations."""
    end = path.end
    if end is End.STEP_TOO_SMALL and orbits.period % 2 == 0:
        half_way = path.spots[-1].look.data.half_way
        end = End.HALVED if half_way < _HALVED else end
    bifurcations = []
    for after, name, spot in path.crossings:
        kind, point = Kind[name], orbits.point(spot)
        # Two real multipliers with product 1 are a neutral saddle, which is not a bifurcation.
        real = np.all(np.abs(point.multipliers.imag) < 1e-9)
        if kind is not Kind.NEIMARK_SACKER or not real:
            bifurcations.append(Bifurcation(kind, point, after))
    return Branch(
        config=orbits.config,
        parameter=orbits.parameter,
        period=orbits.period,
        points=tuple(map(orbits.point, path.spots)),
        bifurcations=tuple(bifurcations),
        ends=(End.START, end),
        limits=orbits.limits,
    )


def _joined(falling: Branch, rising: Branch) -> Branch:
    """Join two branches that begin at the same point, with the points of `falling` reversed."""
    count = len(falling.points) - 1
    points = tuple(
        dataclasses.replace(point, slope=-point.slope) for point in falling.points[:0:-1]
    )
    turned = [
        dataclasses.replace(one, after=count - 1 - one.after) for one in falling.bifurcations[::-1]
    ]
    moved = [dataclasses.replace(one, after=count + one.after) for one in rising.bifurcations]
    return dataclasses.replace(
        rising,
        points=points + rising.points,
        bifurcations=(*turned, *moved),
        ends=(falling.ends[1], rising.ends[1]),
    )


def _fold(spot: Spot) -> float:
    return float(spot.tangent[-1])


def _doubling(spot: Spot) -> float:
    monodromy = spot.look.data.monodromy
    return float(np.linalg.det(monodromy + np.eye(len(monodromy))))


def _torus(spot: Spot) -> float:
    multipliers = np.linalg.eigvals(spot.look.data.monodromy)
    first, second = np.triu_indices(len(multipliers), 1)
    return float(np.prod(multipliers[first] * multipliers[second] - 1).real)


_TESTS = {"FOLD": _fold, "PERIOD_DOUBLING": _doubling, "NEIMARK_SACKER": _torus}


__all__ = [
    "PLACES", "RESIDUAL", "Bifurcation", "Branch", "BranchPoint", "End", "Kind", "StepSizes",
    "follow", "follow_doubled", "parameters", "value_of", "with_value",
]  # fmt: skip
