"""Follow periodic orbits along a parameter, through folds, with their stability.

A branch begins at a known orbit (`Evaluation.state` and its period). It is the curve of an
`OrbitFamily`, followed by pseudo-arclength continuation (`arclength`). Unstable orbits, which a
simulation does not show, are followed like stable orbits; `BranchPoint.stable` distinguishes them.
"""

import contextlib
import dataclasses
import enum
import itertools

import numpy as np
from numpy.typing import ArrayLike

from rootsopt.config import Config
from rootsopt.errors import InputError
from rootsopt.response.continuation.arclength import (
    End,
    Spot,
    StepSizes,
    StoppedError,
    follow_curve,
)
from rootsopt.response.continuation.family import SPAN, BranchPoint, OrbitFamily

# Distance (unit of `StepSizes`) below which the states at the start and the middle of an orbit
# count as equal. A branch whose steps have become too small there ends at an orbit of half the
# period (`End.HALVED`).
_HALVED = 0.004
# Distances (unit of `StepSizes`) from a period doubling at which the orbit of twice the period is
# tried, in this order.
_SIZES = 3e-4, 1e-3, 3e-3, 1e-4, 1e-2
# Number of points below which a doubled branch that falls back to the single period is tried again,
# from another distance.
_FEW = 8


class Kind(enum.Enum):
    """Kinds of bifurcation. Each value says what happens to the orbit."""

    FOLD = "Two orbits meet and vanish; a multiplier passes through +1."
    PERIOD_DOUBLING = "An orbit of twice the period is born; a multiplier passes through -1."
    NEIMARK_SACKER = "Quasi-periodic motion is born; two multipliers leave the unit circle."
    CORNER = "A contact of the flanks or of the gear begins or ends; multipliers jump."


@dataclasses.dataclass(frozen=True)
class Bifurcation:
    """A bifurcation of a branch.

    `kind` of bifurcation; `spot`: where it is on the curve; `after`: index of the branch's last
    point before the bifurcation.
    """

    kind: Kind
    spot: Spot
    after: int

    @property
    def point(self) -> BranchPoint:
        """The orbit at the bifurcation."""
        return self.spot.data


@dataclasses.dataclass(frozen=True)
class Branch:
    """A family of orbits of the same period, followed along a parameter.

    `family`: config, key of the parameter, period and limits; `spots`: the curve, in order;
    `bifurcations` on the branch; `ends`: why the branch begins and ends where it does.
    """

    family: OrbitFamily
    spots: tuple[Spot, ...]
    bifurcations: tuple[Bifurcation, ...]
    ends: tuple[End, End]

    @property
    def points(self) -> tuple[BranchPoint, ...]:
        """The orbits, in order."""
        return tuple(spot.data for spot in self.spots)

    def at(self, value: float) -> list[BranchPoint]:
        """Return all orbits of the branch at one `value` of the parameter (config's unit).

        Each orbit is closed again at exactly this value, and left out if that fails. The branch's
        last point is returned unchanged. The list is empty if the branch does not pass the value.
        """
        found = []
        for old, new in itertools.pairwise(self.spots):
            low, high = sorted((old.data.value, new.data.value))
            if not low <= value < high:
                continue
            share = (value - old.data.value) / (new.data.value - old.data.value)
            guess = old.place + share * (new.place - old.place)
            fixed = np.eye(len(guess))[-1]
            with contextlib.suppress(StoppedError):
                found.append(self.family(guess, fixed, old if share < 0.5 else new).data)
        return found + [point for point in self.points[-1:] if point.value == value]


def follow(config: Config, key: str, state: ArrayLike, period: int, limits: StepSizes) -> Branch:
    """Follow the orbit of `period` mesh periods near the scaled `state` (n,) along a parameter.

    The branch extends in both directions, towards falling and rising values of the parameter.

    `key`: dotted key of the parameter, such as `scene.speed_rpm`; scene or design must
    depend linearly on it. `limits`: range of the parameter (config's unit), which must contain the
    config's own value, and step sizes. A step of length 1 spans the range, or changes the scaled
    state by `SPAN`.

    Raises `InputError` for an invalid `key` or `period`; for limits that exclude the config's
    value, or that the config cannot have; if collocation does not close orbits of this config; and
    if no orbit is found for the first point.
    """
    family = OrbitFamily(config, key, period, limits)
    if period not in family.periods:
        first, step = family.periods[0], family.periods.step
        raise InputError(
            f"Argument `period` must be {first} to {family.periods[-1]}"
            f"{f' in steps of {step}' if step > 1 else ''}, but is {period}"
        )
    value, place = family.value(family.share), np.append(np.asarray(state) / SPAN, family.share)
    if not 0 <= family.share <= 1:
        raise InputError(
            f"`{key}` must lie in the range to follow, {limits.low:g} to {limits.high:g}, but is "
            f"{value:g}"
        )
    rising = np.eye(len(place))[-1]
    try:
        start = family.from_integration(place, rising)
    except StoppedError as stop:
        raise InputError(
            f"there is no orbit of {period} mesh periods near the state at `{key}` = {value:g}: "
            f"{stop.end.value} Start from the state of a periodic Evaluation"
        ) from None
    falling = _branch(family, start.along(-rising))
    if falling.ends[1] is End.CLOSED:
        return falling
    return _joined(falling, _branch(family, start.along(-falling.spots[0].tangent)))


def follow_doubled(branch: Branch, bifurcation: Bifurcation, points: int = 400) -> Branch | None:
    """Follow the branch of twice the period that begins at a period doubling of `branch`.

    The search for its first orbit starts a little away from the bifurcation, displaced along the
    eigenvector of the multiplier -1. `points`: maximum number of points. The result is None if no
    orbit of twice the period is found, or if twice the period exceeds `OrbitFamily.periods`.

    Raises `ValueError` if `bifurcation` is not a period doubling."""
    if bifurcation.kind is not Kind.PERIOD_DOUBLING:
        raise ValueError(
            "Argument `bifurcation` must be a period doubling, but is "
            f"{bifurcation.kind.name.lower()}"
        )
    simple, place, line = branch.family, bifurcation.spot.place, bifurcation.point.made.line
    if 2 * simple.period not in simple.periods:
        return None
    limits = dataclasses.replace(simple.limits, points=points)
    family = OrbitFamily(simple.config, simple.key, 2 * simple.period, limits)
    multipliers, vectors = np.linalg.eig(line.monodromy)
    flipped = line.to_state @ np.real(vectors[:, np.argmin(np.abs(multipliers + 1))])
    across = np.append(flipped / np.linalg.norm(flipped), 0.0)
    # Both directions lead to the same orbit, shifted by the single period. Near a grazing contact
    # one of them may fail.
    fallen = None
    for size, way in itertools.product(_SIZES, (1, -1)):
        try:
            start = family.from_integration(place + size * way * across, way * across)
        except StoppedError:
            continue
        if start.data.half_way <= 0.2 * size:
            continue
        found = _branch(family, start.along(way * across))
        if found.ends[1] is not End.HALVED or len(found.spots) >= _FEW:
            return found
        fallen = found
    return fallen


def _branch(family: OrbitFamily, start: Spot) -> Branch:
    """Return the branch that leads from `start` in the direction of its tangent."""
    steps = dataclasses.replace(family.limits, low=0.0, high=1.0)
    path = follow_curve(family, start, steps, _TESTS)
    halved = family.halves and path.spots[-1].data.half_way < _HALVED
    end = End.HALVED if halved and path.end is End.STEP_TOO_SMALL else path.end
    bifurcations = []
    for after, name, spot in path.crossings:
        # Two real multipliers with product 1 are a neutral saddle, which is not a bifurcation.
        real = np.all(np.abs(spot.data.multipliers.imag) < 1e-9)
        if Kind[name] is not Kind.NEIMARK_SACKER or not real:
            bifurcations.append(Bifurcation(Kind[name], spot, after))
    return Branch(family, tuple(path.spots), tuple(bifurcations), (End.START, end))


def _joined(falling: Branch, rising: Branch) -> Branch:
    """Join two branches that begin at the same point, with the points of `falling` reversed."""
    count = len(falling.spots) - 1
    turned = [
        dataclasses.replace(one, after=count - 1 - one.after) for one in falling.bifurcations[::-1]
    ]
    moved = [dataclasses.replace(one, after=count + one.after) for one in rising.bifurcations]
    spots = [spot.along(-spot.tangent) for spot in falling.spots[:0:-1]]
    return Branch(
        rising.family, (*spots, *rising.spots), (*turned, *moved), (falling.ends[1], rising.ends[1])
    )


def _torus(spot: Spot) -> float:
    multipliers = spot.data.multipliers
    first, second = np.triu_indices(len(multipliers), 1)
    return float(np.prod(multipliers[first] * multipliers[second] - 1).real)


_TESTS = {
    "FOLD": lambda spot: float(spot.tangent[-1]),
    "PERIOD_DOUBLING": lambda spot: float(np.prod(spot.data.multipliers + 1).real),
    "NEIMARK_SACKER": _torus,
}
