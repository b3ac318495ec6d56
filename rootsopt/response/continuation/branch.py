"""Follow periodic orbits along a parameter, through folds, with their stability.

A branch begins at a known orbit (`Evaluation.state` and its period). It is the curve of an
`OrbitFamily`, followed by pseudo-arclength continuation (`arclength`). Unstable orbits, which a
simulation does not show, are followed like stable orbits; `BranchPoint.stable` distinguishes them.

An orbit of the curve is closed by collocation. The unknowns are the state at φ1 = 0 and the
parameter. Newton's method solves for all instants of an orbit, for the times of its events and for
the parameter at once (`rootsopt.dynamics.collocation.bordered`). It starts from the previous orbit,
moved along the curve's tangent, and then once more from an integration over the orbit's period."""

import contextlib
import dataclasses
import enum
import itertools
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float
from numpy.typing import ArrayLike, NDArray

from rootsopt.config.reading import Config, parse
from rootsopt.dynamics.closed import ACCURACY, greatest_error
from rootsopt.dynamics.collocation.bordered import Followed, Plane, followed
from rootsopt.dynamics.collocation.mesh import PIECES, from_pieces
from rootsopt.dynamics.collocation.system import unchanged
from rootsopt.dynamics.flow import strobe
from rootsopt.dynamics.pair import RotorPair
from rootsopt.dynamics.steady import TOO_DEEP
from rootsopt.errors import InputError
from rootsopt.response.continuation.arclength import (
    End,
    Spot,
    StepSizes,
    StoppedError,
    follow_curve,
)
from rootsopt.runtime.programs import CachedFunction
from rootsopt.scene.build import Scene, along
from rootsopt.scene.reading import design_vector

LONGEST = 8
"""Longest orbit that can be followed (mesh periods), rounded up by `RotorPair.whole`."""
SPAN = 20.0
"""Change of the scaled state that has the same length as the whole range of the parameter, when
step lengths are measured."""
# Number of uniform instants on an orbit at which it is checked whether the rotors run as a pair.
_LOOKS = 504
# Distance (unit of `StepSizes`) between the states at the start and the middle of an orbit below
# which the orbit has half the period.
_HALF_ALIKE = 1e-5


@dataclasses.dataclass(frozen=True)
class BranchPoint:
    """One periodic orbit of a branch.

    `value` of the parameter (config's unit); `state` (n,) at φ1 = 0, scaled for the config with
    that value, so that an `Evaluator` can start there; `period` (mesh periods); `mean`, `peak`,
    `rms` of the contact force (N); `multipliers` (n,): Floquet multipliers; `residual`: greatest
    entry of |Φ(z) - z|, divided by the greatest entry of |z| if that exceeds 1; `half_way`:
    distance (unit of `StepSizes`) between the states at the start and the middle of the orbit;
    `made`: the orbit in the form from which its neighbours on the curve are closed.
    """

    value: float
    state: NDArray[np.float64]
    period: int
    mean: float
    peak: float
    rms: float
    multipliers: NDArray[np.complex128]
    residual: float
    half_way: float
    made: Followed = dataclasses.field(repr=False)

    @property
    def stable(self) -> bool:
        """Whether all multipliers lie inside the unit circle."""
        return bool(np.max(np.abs(self.multipliers)) < 1)


class _Range(NamedTuple):
    """Scenes and designs over the range of a parameter.

    `low`: scene and design (d,) at its low end; `change`: their change over the range, with `None`
    in place of anything but numbers; `unit` (rad): unit of ε, the same for the whole curve.
    """

    low: tuple[Scene, Array]
    change: Any
    unit: Float[Array, ""]

    def at(self, share: Float[Array, ""]) -> tuple[RotorPair, Float[Array, ""]]:
        """Return the pair at a `share` of the range, and its own unit of ε (rad)."""
        moved = jax.tree.map(lambda change: share * change, self.change)
        scene, design = eqx.apply_updates(self.low, moved)
        pair = scene.pair(design)
        return eqx.tree_at(lambda p: p.angle_scale, pair, self.unit), pair.angle_scale


class OrbitFamily:
    """Orbits of k mesh periods over a parameter, as a `SolutionCurve`.

    The unknowns (n + 1,) are the scaled state at φ1 = 0 divided by `SPAN`, then the parameter as a
    fraction of its range. `config` of the first orbit; `key`: dotted key of the parameter, such as
    `scene.speed_rpm`; `period`: k; `limits`: range of the parameter (config's unit) and step sizes.
    The attribute `share` is the config's own place in the range; `periods` are all periods that an
    orbit of this config can have.

    Raises `InputError` for an unknown key, or a value that the config cannot have. Also raises it
    for a key on which scene and design do not depend linearly, and for a config whose orbits
    collocation does not close.
    """

    def __init__(self, config: Config, key: str, period: int, limits: StepSizes):
        self.config, self.key, self.period, self.limits = config, key, period, limits
        scene = Scene.from_config(config)
        # Defaults that follow other keys stay as they are.
        resolved, values = parse(config.to_yaml()), np.linspace(limits.low, limits.high, 3)
        moved = [resolved.replaced({key: float(value)}) for value in values]
        ends = [(scene.renewed(one), design_vector(one)) for one in (config, *moved)]
        (own, _), (low, tree), (middle, _), (high, _) = (
            ravel_pytree(eqx.filter(end, eqx.is_inexact_array)) for end in ends
        )
        change = high - low if own.shape == low.shape == high.shape else jnp.zeros(1)
        most = np.nanargmax(np.abs(change))
        if not change[most] or not np.allclose(
            2 * middle, low + high, rtol=1e-9, atol=0, equal_nan=True
        ):
            raise InputError(
                f"`{key}` must be a number on which scene or design depend linearly, but is not; "
                "give a key such as `scene.speed_rpm`, `scene.load.torque_N_m`, "
                "`scene.timing_gear.backlash_mm`, or that of a design parameter"
            )
        pair = _pair(scene, design_vector(config))
        if not pair.contact.smooth:
            raise InputError(
                f"Contact {type(pair.contact).__name__} must be `smooth` between events for orbits "
                "to be followed, but is not; give its `switches`"
            )
        self.share = float((own - low)[most] / change[most])
        self.periods = range(pair.repeats, pair.whole(LONGEST) + 1, pair.repeats)
        # A number that the scene sets later is NaN here.
        self.range = _Range(ends[1], tree(jnp.nan_to_num(change)), pair.angle_scale)

    @property
    def halves(self) -> bool:
        """Whether orbits of half the period can exist."""
        return self.period % (2 * self.periods.step) == 0

    def value(self, share: Any) -> float:
        """Return the parameter's value (config's unit) at a `share` of its range."""
        return float(self.limits.low * (1 - share) + self.limits.high * share)

    def __call__(self, guess: NDArray[np.float64], across: NDArray[np.float64], near: Spot) -> Spot:
        """Return the orbit whose unknowns lie in the plane through `guess` normal to `across`.

        `near`: an orbit of the curve. Raises `StoppedError` if no orbit is found from there."""
        made, away = near.data.made, guess - near.place
        start = made.known, made.line.motion, np.asarray(away @ made.line.tangent)
        try:
            guess = self._closed(start, guess, across).place
        except StoppedError as stop:
            if stop.end is not End.STEP_TOO_SMALL:
                raise
        # Next to a grazing contact, the neighbour's events may not be those of this orbit. From a
        # neighbour alone, a short touch was overlooked: a multiplier was -1.06 instead of -0.99.
        return self.from_integration(guess, across)

    def from_integration(self, guess: NDArray[np.float64], across: NDArray[np.float64]) -> Spot:
        """Return the orbit in a plane, as a call does, from an integration that begins at
        `guess`."""
        return self._closed(_seed(self.range, guess, self.period), guess, across)

    def _closed(self, start: Any, guess: NDArray[np.float64], across: ArrayLike) -> Spot:
        """Return the orbit in a plane; `start`: known motion, as for `bordered.followed`."""
        made, checks = jax.device_get(_follow(self.range, start, guess, across))
        half_way, unit, lost, sound = checks
        scene, line, known = self.range.low[0], made.line, made.known
        close = known.sound and known.error <= greatest_error(scene.solver.orbit.rtol)
        failures = {
            End.NO_GEOMETRY: not sound,
            End.STEP_TOO_SMALL: not close,
            End.LOST_MESH: lost,
            End.TOO_DEEP: made.orbit.depth > TOO_DEEP * scene.pitch_radius,
            End.HALVED: self.halves and half_way < _HALF_ALIKE,
        }
        for end, met in failures.items():
            if met:
                raise StoppedError(end)
        state, monodromy = np.asarray(made.orbit.state), np.asarray(line.monodromy)
        mean, square, peak = map(float, made.orbit.response[:3])
        opened = np.column_stack([monodromy - np.eye(len(state)), line.by_share])
        point = BranchPoint(
            value=self.value(line.share),
            state=state * float(self.range.unit / unit),
            period=self.period,
            mean=mean,
            peak=peak,
            rms=square**0.5,
            multipliers=np.linalg.eigvals(monodromy).astype(complex),
            residual=float(line.residual / max(1.0, np.max(np.abs(state)))),
            half_way=float(half_way),
            made=made,
        )
        orientation = float(np.sign(np.linalg.det(np.vstack([opened, line.inner]))))
        place = np.append(state / SPAN, line.share)
        return Spot(place, np.asarray(line.tangent), orientation, point)


_pair = CachedFunction(Scene.pair)


@CachedFunction
def _seed(over: _Range, guess: Float[Array, " m"], period: int):
    """Return the motion of `period` mesh periods that begins at the place `guess` (m,).

    It is in the form from which `_follow` starts."""
    pair, _ = over.at(guess[-1])
    out = strobe(pair, SPAN * guess[:-1], period, over.low[0].solver.orbit, PIECES)
    assert out.pieces is not None
    known = from_pieces(pair, out.pieces, jnp.asarray(period), period)
    return known, unchanged(known.elements, 1), jnp.zeros(())


@CachedFunction
def _follow(over: _Range, start: Any, guess: Float[Array, " m"], across: Float[Array, " m"]):
    """Return the orbit whose place lies in the plane through `guess` (m,) normal to `across` (m,).

    A place is a vector of unknowns of an `OrbitFamily`.

    `start`: motion to start from, direction of the curve there, and distance to go along it. The
    second result is a tuple: `BranchPoint.half_way`; the pair's own unit of ε (rad); whether the
    rotors no longer run as a pair; whether the profiles at the guess and at the orbit are sound."""
    solver, one = over.low[0].solver, jnp.ones(1)
    made = followed(
        lambda share: along(over.at, share, one)[:2],
        solver.measures,
        start,
        Plane(guess, across, jnp.asarray(SPAN)),
        ACCURACY * solver.orbit.tolerance,
    )
    (pair, unit), motion = over.at(made.line.share), made.known.elements
    states = motion.motion(motion.mesh.period * jnp.arange(_LOOKS) / _LOOKS)
    half_way = jnp.max(jnp.abs(states[_LOOKS // 2] - made.orbit.state)) / SPAN
    sound = pair.sound & over.at(guess[-1])[0].sound
    return made, (half_way, unit, jnp.any(jax.vmap(pair.lost)(states)), sound)


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
        points = []
        for old, new in itertools.pairwise(self.spots):
            low, high = sorted((old.data.value, new.data.value))
            if not low <= value < high:
                continue
            share = (value - old.data.value) / (new.data.value - old.data.value)
            guess = old.place + share * (new.place - old.place)
            fixed = np.eye(len(guess))[-1]
            with contextlib.suppress(StoppedError):
                points.append(self.family(guess, fixed, old if share < 0.5 else new).data)
        return points + [point for point in self.points[-1:] if point.value == value]


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
        doubled = _branch(family, start.along(way * across))
        if doubled.ends[1] is not End.HALVED or len(doubled.spots) >= _FEW:
            return doubled
        fallen = doubled
    return fallen


def _branch(family: OrbitFamily, start: Spot) -> Branch:
    """Return the branch that leads from `start` in the direction of its tangent."""
    steps = dataclasses.replace(family.limits, low=0.0, high=1.0)
    path = follow_curve(family, start, steps, _TESTS)
    halved = family.halves and path.spots[-1].data.half_way < _HALVED
    end = End.HALVED if halved and path.end is End.STEP_TOO_SMALL else path.end
    # Two real multipliers with product 1 are a neutral saddle, which is not a bifurcation.
    bifurcations = tuple(
        Bifurcation(Kind[name], spot, after)
        for after, name, spot in path.crossings
        if Kind[name] is not Kind.NEIMARK_SACKER
        or not np.all(np.abs(spot.data.multipliers.imag) < 1e-9)
    )
    return Branch(family, tuple(path.spots), bifurcations, (End.START, end))


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
