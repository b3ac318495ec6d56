"""A curve of solutions followed through its folds by pseudo-arclength.

n equations in n + 1 unknowns, the last of which is the parameter, have curves of solutions.
From a point of one, the next is predicted along the tangent and brought back by Newton's
method in the plane across it (Keller 1977), so that a fold, where the parameter turns back,
is a point like any other. What the equations stand for is the caller's.
"""

import dataclasses
import enum
import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

_TOLERANCE = 2e-11
"""Residual of a point on the curve."""
_NEAR = 1e-6
"""Newton step from which on the equations are looked at in the same way again and again."""
_FARTHEST = 0.05
"""Longest Newton step."""
_PATIENCE = 4
"""Looks after which they are looked at with care."""
_MOST = 14
"""Looks at the equations for one point."""
_TURN, _STRAIGHT = 0.9, 0.99
"""Least cosine between the tangents of two successive points, and from which on the step grows."""
_ASTRAY = 0.5
"""Greatest distance from prediction to point, in steps: what is farther is another curve."""
_CORNER = 3e-5, 1e-4, 3e-4, 1e-3
"""Distances at which the curve is looked for beyond a corner."""
_SAME = 1e-6
"""Distance within which two points are the same."""
_CLOSING = 8
"""Points after which the curve may come back to its first."""


CORNER = "CORNER"
"""Name under which a corner of the curve stands among the crossings."""


class End(enum.Enum):
    """Why a curve ends where it does; the value is the explanation given to the user."""

    START = "The branch was followed from here on, in one direction."
    RANGE_END = "The parameter reached the end of its range."
    HALVED = "The orbit becomes one of half the period, where that doubles its period."
    CLOSED = "The branch came back to its first point."
    MAX_POINTS = "The branch has as many points as allowed. Raise `limits.points`."
    STEP_TOO_SMALL = (
        "Newton's method converges for no step longer than allowed: the orbits end here or change "
        "too abruptly. Lower `limits.least`, or tighten solver.rtol."
    )
    SOLVER_FAILED = "The solver ran out of steps. Raise solver.max_steps_per_period."
    NON_FINITE = "The motion, or its derivative, is not finite."
    LOST_MESH = "The lobes pass through each other beyond this point."
    TOO_DEEP = "The flanks penetrate beyond the validity of a contact law beyond this point."
    OFF_THE_MAP = "The motion leaves the contact map. Use solver.fidelity search."
    NO_GEOMETRY = "No valid profile lies beyond this point."


class StoppedError(Exception):
    """A point cannot be had, for the reason `end`."""

    def __init__(self, end: End):
        super().__init__(end.value)
        self.end = end


class Look(NamedTuple):
    """The equations at a place: `residual` (n,), `jacobian` (n, n + 1), and `data`.

    `memory`, given back to the curve, has it computed in exactly the same way (the steps of a
    solver repeated, say), where the residual is a smooth function; None where it is one anyway.
    """

    residual: NDArray[np.float64]
    jacobian: NDArray[np.float64]
    memory: Any = None
    data: Any = None


SolutionCurve = Callable[[NDArray[np.float64], Any, bool], Look]
"""From a place (n + 1,), a memory or None, and whether to look with more care than usual, to a
look; raises `StoppedError` where there is none."""


class Spot(NamedTuple):
    """A point of the curve: `place` (n + 1,), unit `tangent` (n + 1,), the last `look`, and how
    many looks it took."""

    place: NDArray[np.float64]
    tangent: NDArray[np.float64]
    look: Look
    looks: int


@dataclasses.dataclass(frozen=True)
class StepSizes:
    """How far to follow: the parameter stays in `low` … `high`; `first`, `least` and `greatest`
    step, in the length of the unknowns taken together; at most so many `points`."""

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
    """Spots in order, those where a test vanishes as (index before, name, spot), and the end."""

    spots: list[Spot]
    crossings: list[tuple[int, str, Spot]]
    end: End


def corrected(
    curve: SolutionCurve,
    guess: NDArray[np.float64],
    across: NDArray[np.float64],
    along: NDArray[np.float64],
) -> Spot:
    """The point of the curve in the plane through `guess` normal to `across` (n + 1,), with the
    tangent that points the way of `along`. Raises `StoppedError`."""
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
        if memory is not None and size > _NEAR:  # What is repeated has missed something.
            memory, careful = None, True
        elif memory is None and size <= _NEAR:
            memory = look.memory
        careful = careful or looks >= _PATIENCE
        place = place + change * min(1.0, _FARTHEST / size) if size > 0 else place
    raise StoppedError(End.STEP_TOO_SMALL)


def tangent(jacobian: NDArray[np.float64], along: NDArray[np.float64]) -> NDArray[np.float64]:
    """Unit vector (n + 1,) that `jacobian` (n, n + 1) takes to zero, pointing the way of
    `along`."""
    found = np.linalg.svd(jacobian)[2][-1]
    return found if found @ along >= 0 else -found


def follow_curve(
    curve: SolutionCurve,
    start: Spot,
    steps: StepSizes,
    tests: Mapping[str, Callable[[Spot], float]] | None = None,
) -> Path:
    """The curve from `start` on, the way its tangent points, to a named end.

    A step is halved until Newton's method converges and the tangent turns little. `tests`:
    functions of a spot whose changes of sign are located.
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
        # Many looks are no reason to shrink: near a grazing touch every point takes as many.
        if new.tangent @ old.tangent > _STRAIGHT:
            step = min(1.5 * step, steps.greatest)


def _leaves(spot: Spot, steps: StepSizes) -> bool:
    """Whether the curve leaves the range here."""
    value, way = float(spot.place[-1]), float(spot.tangent[-1])
    return (value <= steps.low and way < 0) or (value >= steps.high and way > 0)


def _next(curve: SolutionCurve, old: Spot, step: float, steps: StepSizes) -> Spot:
    """The spot after `old`, on the edge of the range at the farthest."""
    new = None
    guess = old.place + step * old.tangent
    if steps.low <= guess[-1] <= steps.high:
        new = corrected(curve, guess, old.tangent, old.tangent)
    beyond = guess if new is None else new.place
    if not steps.low <= beyond[-1] <= steps.high:
        bound = float(np.clip(beyond[-1], steps.low, steps.high))
        share = (bound - old.place[-1]) / (beyond[-1] - old.place[-1])
        guess = old.place + share * (beyond - old.place)
        guess[-1] = bound
        new = corrected(curve, guess, np.eye(len(guess))[-1], old.tangent)
        new.place[-1] = bound
    assert new is not None
    far = np.linalg.norm(new.place - guess) > _ASTRAY * step
    # Along one curve the orientation changes nowhere but where another one crosses it.
    if far or new.tangent @ old.tangent < _TURN or _orientation(new) != _orientation(old):
        raise StoppedError(End.STEP_TOO_SMALL)
    return new


def _around_corner(curve: SolutionCurve, old: Spot, steps: StepSizes) -> Spot | None:
    """A spot close to `old`, where the curve turns too sharply for a step to follow.

    It lies ahead, not behind, if the tangent there, with the orientation kept, points away.
    """
    for size in _CORNER:
        for across in np.vstack([np.eye(len(old.place)), -np.eye(len(old.place))]):
            try:
                new = corrected(curve, old.place + size * across, across, old.tangent)
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
    return float(np.sign(np.linalg.det(np.vstack([spot.look.jacobian, spot.tangent]))))


def _back_at_first(curve: SolutionCurve, spots: list[Spot]) -> bool:
    """Whether the first spot lies on the last step."""
    first, old, new = spots[0], spots[-2], spots[-1]
    chord = new.place - old.place
    share = (first.place - old.place) @ chord / (chord @ chord)
    between = old.place + share * chord
    far = np.linalg.norm(between - first.place) > 0.5 * np.linalg.norm(chord)
    if len(spots) <= _CLOSING or not 0 < share <= 1 or far or new.tangent @ first.tangent < 0.5:
        return False
    try:
        again = corrected(curve, between, chord / np.linalg.norm(chord), new.tangent)
    except StoppedError:
        return False
    return bool(np.linalg.norm(again.place - first.place) < _SAME)


def _located(curve: SolutionCurve, old: Spot, new: Spot, test: Callable[[Spot], float]) -> Spot:
    """The spot between two where `test` vanishes, by the Illinois variant of regula falsi."""
    chord = new.place - old.place
    across = chord / np.linalg.norm(chord)
    low, high = 0.0, 1.0
    at_low, at_high = test(old), test(new)
    enough = 1e-9 * max(abs(at_low), abs(at_high))
    best = old if abs(at_low) < abs(at_high) else new
    side = 0
    for _ in range(40):
        share = (low * at_high - high * at_low) / (at_high - at_low)
        try:
            spot = corrected(curve, old.place + share * chord, across, old.tangent)
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
