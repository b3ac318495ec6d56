"""Follow a curve of solutions through its folds by pseudo-arclength continuation.

n equations in n + 1 unknowns, the last of which is the parameter, have curves of solutions. From a
point on a curve, the next point is predicted along the tangent. Newton's method in the plane normal
to the tangent then corrects the prediction (Keller 1977). A fold, where the parameter turns back,
therefore needs no special treatment. The equations are an argument, and can be any equations.

In the code, one evaluation of the equations and their Jacobian is called a *look*. The vector (n +
1,) of all unknowns is called a *place*; a *spot* is a place on the curve, with its tangent.
"""

import dataclasses
import enum
import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

_TOLERANCE = 2e-11
"""Residual (greatest entry) above which Newton's method continues."""
_NEAR = 1e-6
"""Newton step (greatest entry) below which each evaluation of the equations repeats the computation
of the previous one, with the same solver steps (`Linearization.memory`)."""
_FARTHEST = 0.05
"""Newton step (greatest entry) above which the step is shortened to this size."""
_PATIENCE = 4
"""Number of evaluations for one point of the curve after which further evaluations refine their
solver steps (see `SolutionCurve`)."""
_MOST = 14
"""Maximum number of evaluations of the equations for one point of the curve."""
_TURN, _STRAIGHT = 0.9, 0.99
"""Cosines of the angle between the tangents at successive points of the curve. Below the first
cosine, a step is rejected. Above the second, the next step is longer."""
_ASTRAY = 0.5
"""Distance (steps) from the predicted to the corrected point above which the corrected point is
assumed to lie on another curve."""
_CORNER = 3e-5, 1e-4, 3e-4, 1e-3
"""Distances from a corner of the curve (unit of `StepSizes`) at which the search for the curve's
continuation is made, shortest first."""
_SAME = 1e-6
"""Distance (unit of `StepSizes`) below which two points of a curve count as the same."""
_CLOSING = 8
"""Number of points above which the curve is checked for a return to its first point."""


CORNER = "CORNER"
"""Name that stands for a corner of the curve in `Path.crossings`."""


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
    SOLVER_FAILED = "The solver ran out of steps. Raise solver.max_steps_per_period."
    NON_FINITE = "The motion, or its derivative, is not finite."
    LOST_MESH = "The lobes pass through each other beyond this point."
    TOO_DEEP = "Beyond this point, the flanks penetrate too deep for a contact law to be valid."
    NO_GEOMETRY = "No valid profile lies beyond this point."


class StoppedError(Exception):
    """Raised if the next point of the curve cannot be computed; `end` is the reason."""

    def __init__(self, end: End):
        super().__init__(end.value)
        self.end = end


class Linearization(NamedTuple):
    """One evaluation of the equations and their Jacobian.

    `residual` (n,) and `jacobian` (n, n + 1) of the equations; `memory`: pass this to the
    `SolutionCurve` to repeat the same computation, such as the same solver steps; `data`: further
    results. With a repeated computation, the residual is a smooth function. `memory` is None if the
    residual is always smooth. `turned` (n + 1,): a direction along the curve on whose side tangents
    have a positive orientation (`_orientation`); by default, it follows from `jacobian`.
    """

    residual: NDArray[np.float64]
    jacobian: NDArray[np.float64]
    memory: Any = None
    data: Any = None
    turned: NDArray[np.float64] | None = None


SolutionCurve = Callable[[NDArray[np.float64], Any, bool], Linearization]
"""Type of the function that evaluates the equations of a curve. Arguments: the unknowns (n + 1,);
`Linearization.memory` of an earlier evaluation whose solver steps are repeated, or None for new
steps; and whether the steps are to be refined, because Newton's method converges slowly. It returns
a `Linearization`, or raises `StoppedError` if there is no result."""


class Spot(NamedTuple):
    """A point on the curve, with its tangent.

    `place` (n + 1,): unknowns; `tangent` (n + 1,): unit vector; `look`: the last evaluation of the
    equations there; `looks`: number of evaluations that Newton's method took.
    """

    place: NDArray[np.float64]
    tangent: NDArray[np.float64]
    look: Linearization
    looks: int


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
        if not self.low < self.high:
            raise ValueError(
                f"Argument `low` must be less than `high`, but they are {self.low:g} and "
                f"{self.high:g}"
            )
        if not 0 < self.least <= self.first <= self.greatest:
            raise ValueError(
                "Arguments `least` ≤ `first` ≤ `greatest` must be positive and ascend, but are "
                f"{self.least:g}, {self.first:g}, {self.greatest:g}"
            )
        if self.points < 1:
            raise ValueError(f"Argument `points` must be at least 1, but is {self.points}")


class Path(NamedTuple):
    """The result of following a curve.

    `spots`: points of the curve, in order; `crossings`: points at which a test is zero or the curve
    has a corner; `end`: why the curve ends. Each crossing is a tuple (index of the last of `spots`
    before it, name of the test or `CORNER`, point).
    """

    spots: list[Spot]
    crossings: list[tuple[int, str, Spot]]
    end: End


def corrected(
    curve: SolutionCurve,
    guess: NDArray[np.float64],
    across: NDArray[np.float64],
    along: NDArray[np.float64],
    near: Spot | None = None,
) -> Spot:
    """Return the point at which the curve meets the plane through `guess` normal to `across`.

    `guess` and `across` have the shape (n + 1,). The tangent at the point has the orientation of
    `along` (n + 1,). `near`: a point of the curve from which a curve with its own method
    `corrected` may start. Raises `StoppedError` if Newton's method does not converge, or if the
    curve has no result.
    """
    own = getattr(curve, "corrected", None)
    if own is None:
        return by_newton(curve, guess, across, along)
    return own(guess, across, along, near)


def by_newton(
    curve: SolutionCurve,
    guess: NDArray[np.float64],
    across: NDArray[np.float64],
    along: NDArray[np.float64],
) -> Spot:
    """Return the result of `corrected` by Newton's method for the equations of `curve`."""
    place, memory, careful = guess, None, False
    last, grown = math.inf, 0
    for looks in range(1, _MOST + 1):
        look = curve(place, memory, careful)
        if not (np.all(np.isfinite(look.residual)) and np.all(np.isfinite(look.jacobian))):
            raise StoppedError(End.NON_FINITE)
        repeated = memory is not None or look.memory is None
        if repeated and np.max(np.abs(look.residual)) <= _TOLERANCE:
            return Spot(place, tangent(look.jacobian, along), look, looks)
        matrix = np.vstack([look.jacobian, across])
        try:
            change = np.linalg.solve(matrix, -np.append(look.residual, across @ (place - guess)))
        except np.linalg.LinAlgError:
            break
        size = np.max(np.abs(change))
        grown += bool(size > max(last, _NEAR))
        if grown > 2:
            break
        last = size
        if memory is not None and size > _NEAR:  # The repeated steps have skipped a contact.
            memory, careful = None, True
        elif memory is None and size <= _NEAR:
            memory = look.memory
        careful = careful or looks >= _PATIENCE
        place = place + change * min(1.0, _FARTHEST / size) if size > 0 else place
    raise StoppedError(End.STEP_TOO_SMALL)


def tangent(jacobian: NDArray[np.float64], along: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the unit null vector (n + 1,) of `jacobian` (n, n + 1) with the orientation of
    `along`."""
    found = np.linalg.svd(jacobian)[2][-1]
    return found if found @ along >= 0 else -found


def follow_curve(
    curve: SolutionCurve,
    start: Spot,
    steps: StepSizes,
    tests: Mapping[str, Callable[[Spot], float]] | None = None,
) -> Path:
    """Follow the curve from `start` in the direction of its tangent, and return the path.

    A step is halved until Newton's method converges and the tangent turns only a little. `tests`:
    functions of a `Spot`, keyed by name; the points at which they are zero are added to
    `Path.crossings`.
    """
    tests = tests or {}
    spots, crossings = [start], []
    step = steps.first
    while True:
        old = spots[-1]
        if _leaves(old, steps):
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
            crossings.append((len(spots) - 1, CORNER, old))
            new, step = beyond, steps.first
        for name, test in tests.items():
            if test(old) * test(new) < 0:
                crossings.append((len(spots) - 1, name, _located(curve, old, new, test)))
        spots.append(new)
        if _back_at_first(curve, spots):
            return Path(spots, crossings, End.CLOSED)
        # Many looks are no reason to shorten the step: near a grazing contact, every spot needs
        # many.
        if new.tangent @ old.tangent > _STRAIGHT:
            step = min(1.5 * step, steps.greatest)


def _surely(
    curve: SolutionCurve,
    guess: NDArray[np.float64],
    across: NDArray[np.float64],
    along: NDArray[np.float64],
    near: Spot,
) -> Spot:
    """Return the result of `corrected`, by Newton's method if the curve's own method fails."""
    try:
        return corrected(curve, guess, across, along, near)
    except StoppedError:
        return by_newton(curve, guess, across, along)


def _leaves(spot: Spot, steps: StepSizes) -> bool:
    """Return whether the curve leaves the parameter's range at `spot`.

    It does if `spot` is at an end of the range and its tangent points outwards.
    """
    value, way = float(spot.place[-1]), float(spot.tangent[-1])
    return (value <= steps.low and way < 0) or (value >= steps.high and way > 0)


def _next(curve: SolutionCurve, old: Spot, step: float, steps: StepSizes) -> Spot:
    """Return the point one `step` after `old`, or at the end of the range if that is closer.

    Raises `StoppedError` if no point is found, or if the point may lie on another curve.
    """
    new = None
    guess = old.place + step * old.tangent
    if steps.low <= guess[-1] <= steps.high:
        new = corrected(curve, guess, old.tangent, old.tangent, old)
    beyond = guess if new is None else new.place
    if not steps.low <= beyond[-1] <= steps.high:
        bound = float(np.clip(beyond[-1], steps.low, steps.high))
        share = (bound - old.place[-1]) / (beyond[-1] - old.place[-1])
        guess = old.place + share * (beyond - old.place)
        guess[-1] = bound
        new = corrected(curve, guess, np.eye(len(guess))[-1], old.tangent, old)
        new.place[-1] = bound
    assert new is not None
    far = np.linalg.norm(new.place - guess) > _ASTRAY * step
    # Along one curve the orientation changes only where another curve crosses it.
    if far or new.tangent @ old.tangent < _TURN or _orientation(new) != _orientation(old):
        raise StoppedError(End.STEP_TOO_SMALL)
    return new


def _around_corner(curve: SolutionCurve, old: Spot, steps: StepSizes) -> Spot | None:
    """Return a point close to `old`, beyond a corner too sharp for a step to follow, or None.

    The point must lie ahead of `old`: its tangent, with the orientation of the tangent at `old`,
    must point away from `old`.
    """
    for size in _CORNER:
        for across in np.vstack([np.eye(len(old.place)), -np.eye(len(old.place))]):
            try:
                new = corrected(curve, old.place + size * across, across, old.tangent, old)
            except StoppedError:
                continue
            if _orientation(new) != _orientation(old):
                new = new._replace(tangent=-new.tangent)
            moved = new.place - old.place
            within = steps.low <= new.place[-1] <= steps.high
            distance = np.linalg.norm(moved)
            if within and distance < 5 * size and new.tangent @ moved > 0.5 * distance:
                return new
    return None


def _orientation(spot: Spot) -> float:
    if spot.look.turned is not None:
        return float(np.sign(spot.look.turned @ spot.tangent))
    return float(np.sign(np.linalg.det(np.vstack([spot.look.jacobian, spot.tangent]))))


def _back_at_first(curve: SolutionCurve, spots: list[Spot]) -> bool:
    """Return whether the last step has passed the first of `spots`, so that the curve is closed."""
    first, old, new = spots[0], spots[-2], spots[-1]
    chord = new.place - old.place
    share = (first.place - old.place) @ chord / (chord @ chord)
    between = old.place + share * chord
    far = np.linalg.norm(between - first.place) > 0.5 * np.linalg.norm(chord)
    if len(spots) <= _CLOSING or not 0 < share <= 1 or far or new.tangent @ first.tangent < 0.5:
        return False
    try:
        again = corrected(curve, between, chord / np.linalg.norm(chord), new.tangent, new)
    except StoppedError:
        return False
    return bool(np.linalg.norm(again.place - first.place) < _SAME)


def _located(curve: SolutionCurve, old: Spot, new: Spot, test: Callable[[Spot], float]) -> Spot:
    """Return the point between `old` and `new` at which `test` is zero.

    The method is regula falsi, Illinois variant."""
    chord = new.place - old.place
    across = chord / np.linalg.norm(chord)
    low, high = 0.0, 1.0
    at_low, at_high = test(old), test(new)
    enough = 1e-9 * max(abs(at_low), abs(at_high))
    best = old if abs(at_low) < abs(at_high) else new
    side = 0
    for _ in range(40):
        share = (low * at_high - high * at_low) / (at_high - at_low)
        guess, near = old.place + share * chord, old if share < 0.5 else new
        try:
            spot = _surely(curve, guess, across, old.tangent, near)
        except StoppedError:
            break
        value = test(spot)
        if math.isfinite(value) and abs(value) < abs(test(best)):
            best = spot
        if abs(value) <= enough or high - low < 1e-9:
            break
        if value * at_low > 0:
            low, at_low = share, value
            at_high = at_high / 2 if side == -1 else at_high
            side = -1
        else:
            high, at_high = share, value
            at_low = at_low / 2 if side == 1 else at_low
            side = 1
    return best
