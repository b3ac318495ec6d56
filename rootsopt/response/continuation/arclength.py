"""Follow a curve of solutions through its folds by pseudo-arclength continuation.

n equations in n + 1 unknowns, the last of which is the parameter, have curves of solutions. From a
point on a curve, the next point is predicted along the tangent. The prediction is then corrected in
the plane normal to the tangent (Keller 1977). A fold, where the parameter turns back, therefore
needs no special treatment. The function that finds the curve's point in a plane is an argument.

In the code, the vector (n + 1,) of all unknowns is called a *place*; a *spot* is a place on the
curve, with its tangent.
"""

import contextlib
import dataclasses
import enum
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

# Cosines of the angle between the tangents at successive points of the curve. Below the first
# cosine, a step is rejected. Above the second, the next step is longer.
_TURN, _STRAIGHT = 0.9, 0.99
# Distance (steps) from the predicted to the corrected point above which the corrected point is
# assumed to lie on another curve.
_ASTRAY = 0.5
# Distances from a corner of the curve (unit of `StepSizes`) at which the search for the curve's
# continuation is made, shortest first.
_CORNER = 3e-5, 1e-4, 3e-4, 1e-3
# Distance (unit of `StepSizes`) below which two points of a curve count as the same.
_SAME = 1e-6
# Number of points above which the curve is checked for a return to its first point.
_CLOSING = 8


class End(enum.Enum):
    """The reasons why a curve can end. Each value explains the reason to the user."""

    START = "The branch was started here and followed in one direction."
    RANGE_END = "The parameter reached the end of its range."
    HALVED = "The branch ends where an orbit of half the period doubles its period."
    CLOSED = "The branch came back to its first point."
    MAX_POINTS = "The branch has reached the maximum number of points. Raise `limits.points`."
    STEP_TOO_SMALL = (
        "Newton's method does not converge, even for the smallest allowed step: the orbits end "
        "here or change too abruptly. Lower `limits.least`, or tighten solver.accuracy."
    )
    LOST_MESH = "The lobes pass through each other beyond this point."
    TOO_DEEP = "Beyond this point, the flanks penetrate too deep for a contact law to be valid."
    NO_GEOMETRY = "No valid profile lies beyond this point."


class StoppedError(Exception):
    """Raised if the next point of the curve cannot be computed; `end` is the reason."""

    def __init__(self, end: End):
        super().__init__(end.value)
        self.end = end


class Spot(NamedTuple):
    """A point on the curve, with its tangent.

    `place` (n + 1,): unknowns; `tangent` (n + 1,): unit vector; `orientation`: sign of the
    determinant of the equations' Jacobian with the tangent as last row. It stays the same along a
    curve, except where another curve crosses it. `data`: what else is known about the solution.
    """

    place: NDArray[np.float64]
    tangent: NDArray[np.float64]
    orientation: float
    data: Any

    def along(self, direction: NDArray[np.float64]) -> "Spot":
        """Return the spot with its tangent on the side of `direction` (n + 1,)."""
        if self.tangent @ direction >= 0:
            return self
        return self._replace(tangent=-self.tangent, orientation=-self.orientation)


SolutionCurve = Callable[[NDArray[np.float64], NDArray[np.float64], Spot], Spot]
"""Type of the function that finds a point of a curve. Arguments: a place (n + 1,), the direction
(n + 1,) normal to a plane through this place, and a point of the curve nearby. It returns the point
at which the curve meets the plane, with either sign of the tangent, or raises `StoppedError`."""


@dataclasses.dataclass(frozen=True)
class StepSizes:
    """Range and step sizes for following a curve.

    `low`, `high`: range of the parameter; `first`, `least`, `greatest`: first, least and greatest
    step, as Euclidean distances between the unknowns; `points`: maximum number of points.

    Raises ValueError if `low` is not less than `high`; if the steps are not 0 < `least` ≤ `first` ≤
    `greatest`; if `points` is less than 1.
    """

    low: float
    high: float
    first: float = 0.01
    least: float = 1e-6
    greatest: float = 0.03
    points: int = 400

    def __post_init__(self):
        steps = 0 < self.least <= self.first <= self.greatest
        if not (self.low < self.high and steps and self.points >= 1):
            raise ValueError(
                "Arguments must be `low` < `high`, 0 < `least` ≤ `first` ≤ `greatest` and `points` "
                f"≥ 1, but are {self}"
            )


class Path(NamedTuple):
    """The result of following a curve.

    `spots`: points of the curve, in order; `crossings`: points at which a test is zero or the curve
    has a corner; `end`: why the curve ends. Each crossing is a tuple (index of the last of `spots`
    before it, name of the test or "CORNER", point).
    """

    spots: list[Spot]
    crossings: list[tuple[int, str, Spot]]
    end: End


def follow_curve(
    curve: SolutionCurve,
    start: Spot,
    steps: StepSizes,
    tests: Mapping[str, Callable[[Spot], float]],
) -> Path:
    """Follow the curve from `start` in the direction of its tangent, and return the path.

    A step is halved until a point is found and the tangent turns only a little. `tests`: functions
    of a `Spot`, keyed by name; the points at which they are zero are added to `Path.crossings`.
    """
    spots, crossings = [start], []
    step = steps.first
    while True:
        old = spots[-1]
        value, way = old.place[-1], old.tangent[-1]
        if (value <= steps.low and way < 0) or (value >= steps.high and way > 0):
            return Path(spots, crossings, End.RANGE_END)
        if len(spots) >= steps.points:
            return Path(spots, crossings, End.MAX_POINTS)
        try:
            new = _next(curve, old, step, steps)
        except StoppedError as stop:
            step /= 2
            if step >= steps.least:
                continue
            beyond = _around_corner(curve, old, steps)
            if beyond is None:
                return Path(spots, crossings, stop.end)
            crossings.append((len(spots) - 1, "CORNER", old))
            new, step = beyond, steps.first
        for name, test in tests.items():
            if test(old) * test(new) < 0:
                crossings.append((len(spots) - 1, name, _located(curve, old, new, test)))
        spots.append(new)
        if _back_at_first(curve, spots):
            return Path(spots, crossings, End.CLOSED)
        if new.tangent @ old.tangent > _STRAIGHT:
            step = min(1.5 * step, steps.greatest)


def _next(curve: SolutionCurve, old: Spot, step: float, steps: StepSizes) -> Spot:
    """Return the point one `step` after `old`, or at the end of the range if that is closer.

    Raises `StoppedError` if no point is found, or if the point may lie on another curve.
    """
    guess = old.place + step * old.tangent
    inside = steps.low <= guess[-1] <= steps.high
    new = curve(guess, old.tangent, old) if inside else None
    beyond = guess if new is None else new.place
    bound = float(np.clip(beyond[-1], steps.low, steps.high))
    if new is None or beyond[-1] != bound:
        share = (bound - old.place[-1]) / (beyond[-1] - old.place[-1])
        guess = old.place + share * (beyond - old.place)
        new = curve(np.append(guess[:-1], bound), np.eye(len(guess))[-1], old)
        new.place[-1] = bound
    new = new.along(old.tangent)
    far = np.linalg.norm(new.place - guess) > _ASTRAY * step
    if far or new.tangent @ old.tangent < _TURN or new.orientation != old.orientation:
        raise StoppedError(End.STEP_TOO_SMALL)
    return new


def _around_corner(curve: SolutionCurve, old: Spot, steps: StepSizes) -> Spot | None:
    """Return a point close to `old`, beyond a corner too sharp for a step to follow, or None.

    The point must lie ahead of `old`: its tangent, with the orientation of the tangent at `old`,
    must point away from `old`. If it has hardly turned, the point must be further away than the
    last steps tried: otherwise it only shows that the curve goes on for less than these.
    """
    for size in _CORNER:
        for across in np.vstack([np.eye(len(old.place)), -np.eye(len(old.place))]):
            try:
                new = curve(old.place + size * across, across, old)
            except StoppedError:
                continue
            if new.orientation != old.orientation:
                new = new.along(-new.tangent)
            moved = new.place - old.place
            within = steps.low <= new.place[-1] <= steps.high
            distance = np.linalg.norm(moved)
            ahead = distance < 5 * size and new.tangent @ moved > 0.5 * distance
            turned = new.tangent @ old.tangent < _TURN
            if within and ahead and (turned or distance > 2 * steps.least):
                return new
    return None


def _back_at_first(curve: SolutionCurve, spots: list[Spot]) -> bool:
    """Return whether the last step has passed the first of `spots`, so that the curve is closed."""
    first, old, new = spots[0], spots[-2], spots[-1]
    before, after = (first.tangent @ (spot.place - first.place) for spot in (old, new))
    far = np.linalg.norm(new.place - first.place) > np.linalg.norm(new.place - old.place)
    if len(spots) <= _CLOSING or not before < 0 <= after or far:
        return False
    with contextlib.suppress(StoppedError):
        again = curve(first.place, first.tangent, new)
        return bool(np.linalg.norm(again.place - first.place) < _SAME)
    return False


def _located(curve: SolutionCurve, old: Spot, new: Spot, test: Callable[[Spot], float]) -> Spot:
    """Return the point between `old` and `new` at which `test` is zero, or the nearest found."""
    from scipy.optimize import brentq  # Slow import.

    chord = new.place - old.place
    across = chord / np.linalg.norm(chord)
    seen = {0.0: old, 1.0: new}

    def at(share: float) -> float:
        if share not in seen:
            near = seen[min(seen, key=lambda known: abs(known - share))]
            # The sign of a test may depend on the tangent's.
            seen[share] = curve(old.place + share * chord, across, near).along(across)
        return test(seen[share])

    with contextlib.suppress(StoppedError):
        brentq(at, 0.0, 1.0, xtol=1e-9)
    return min(seen.values(), key=lambda spot: abs(test(spot)))
