"""Periodic orbits followed over a parameter, through folds, with their stability.

A branch begins at an orbit found before (`Evaluation.state` and its period) and is followed
by pseudo-arclength (`rootsopt.arclength`). The unknowns are the state at φ1 = 0, in units
that stay those of the first orbit, and the parameter; the equations say that the state comes
back after k mesh periods, and their derivatives come with the motion, from its linearised
steps. Unstable orbits, which no simulation shows, are followed like stable ones, and flagged.
"""

import dataclasses
import enum
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float
from numpy.typing import ArrayLike, NDArray

from rootsopt.arclength import End, Look, Path, Spot, Steps, StoppedError, corrected, follow_curve
from rootsopt.config import DESIGN_KEYS, Config, parse
from rootsopt.dynamics.flow import Flow, Integrator, flow
from rootsopt.dynamics.pair import RotorPair
from rootsopt.dynamics.steady import RESIDUAL, SAMPLES
from rootsopt.dynamics.switches import with_switches
from rootsopt.errors import InputError
from rootsopt.model import MM, Model, check_geometry, design_keys, integrators
from rootsopt.programs import Program

PLACES = {
    "speed_rpm": "scene.speed_rpm",
    "torque_N_m": "scene.load.torque_N_m",
    "backlash_mm": "scene.timing_gear.backlash_mm",
    "damping_ratio": "scene.timing_gear.damping_ratio",
} | {key: f"profile.{key}" for key in DESIGN_KEYS}
"""Parameters that can be followed, in the config's units, and where they stand there."""
_GEAR = ("backlash_mm", "damping_ratio")
_SPAN = 20.0
"""Change of the scaled state that counts as much as the whole range of the parameter."""
_LOOKS = 504
"""Uniform times at which contact is looked for."""
_LONGEST = 8
"""Longest orbit (mesh periods)."""
_STEP = 1 / 256
"""Steps (mesh periods) are not much longer than this."""
_TOO_DEEP = 0.02
"""Penetration, in pitch radii, beyond which a contact law means nothing."""
_HALVED = 0.004
"""Distance (as `Steps` counts) from the state half an orbit later, where a branch that ends for
no other reason is about to meet one of half the period."""
_SAME = 1e-5
"""Distance from there within which it is one of half the period (states between steps are
interpolated)."""
_SIZES = 3e-4, 1e-3, 3e-3, 1e-4, 1e-2
"""Distances from a bifurcation (as `Steps` counts) at which its doubled orbit is sought."""


class Kind(enum.Enum):
    """What happens to an orbit at a bifurcation."""

    FOLD = "Two orbits meet and vanish; a multiplier passes through +1."
    PERIOD_DOUBLING = "An orbit of twice the period is born; a multiplier passes through -1."
    NEIMARK_SACKER = "Quasi-periodic motion is born; two multipliers leave the unit circle."
    CORNER = "A touch of the flanks or of the gear begins or ends; multipliers jump."


@dataclasses.dataclass(frozen=True)
class BranchPoint:
    """One periodic orbit.

    `value` of the parameter (config's unit); `state` (n,) at φ1 = 0, scaled as the config with
    that value scales it, so that an `Evaluator` can start there; `period` (mesh periods);
    `mean`, `peak`, `rms` of the contact force (N); `multipliers` (n,): Floquet multipliers;
    `residual`: greatest entry of Φ(z) - z, relative to that of z where this exceeds one;
    `slope`: change of the parameter along the branch, as a share of its range and of arclength;
    `gap_time`: longest time (mesh periods) in which neither flanks nor gear touch;
    `depth`: greatest penetration (m); `reach`: greatest |ε| (rad); `looks`: integrations it
    took.
    """

    value: float
    state: NDArray[np.float64]
    period: int
    mean: float
    peak: float
    rms: float
    multipliers: NDArray[np.complex128]
    residual: float
    slope: float
    gap_time: float
    depth: float
    reach: float
    looks: int

    @property
    def stable(self) -> bool:
        """Whether all multipliers lie inside the unit circle."""
        return bool(np.max(np.abs(self.multipliers)) < 1)


@dataclasses.dataclass(frozen=True)
class Bifurcation:
    """Where a branch changes: the orbit there, what it is, and the index of the branch's last
    point before it."""

    kind: Kind
    point: BranchPoint
    after: int

    @property
    def value(self) -> float:
        """The parameter there (config's unit)."""
        return self.point.value


@dataclasses.dataclass(frozen=True)
class Branch:
    """Orbits of one period along `parameter`, in order; why they begin and end where they do.

    `config` is the one it was started with, `limits` (in the config's unit) those it was
    followed within.
    """

    config: Config
    parameter: str
    period: int
    points: tuple[BranchPoint, ...]
    bifurcations: tuple[Bifurcation, ...]
    ends: tuple[End, End]
    limits: Steps

    def at(self, value: float) -> list[BranchPoint]:
        """All orbits of the branch at a value of the parameter, closed there; none where it
        does not come by."""
        orbits = _Orbits(self.config, self.parameter, self.period, self.limits)
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


def parameters(config: Config) -> tuple[str, ...]:
    """Names of the parameters that can be followed for `config`."""
    gear = _GEAR if config.scene.timing_gear is not None else ()
    return ("speed_rpm", "torque_N_m", *gear, *design_keys(config))


def value_of(config: Config, parameter: str) -> float:
    """Value of a parameter, in the config's unit. Raises `InputError` for an unknown one."""
    _check(config, parameter)
    found: Any = config
    for key in PLACES[parameter].split("."):
        found = getattr(found, key)
    return float(found)


def with_value(config: Config, parameter: str, value: float) -> Config:
    """`config` with another value of a parameter. Raises `InputError` for an unknown
    parameter, and for a value that is out of bounds."""
    _check(config, parameter)
    return parse(config.to_yaml(), [f"{PLACES[parameter]}={float(value)!r}"])


def follow(
    config: Config,
    parameter: str,
    state: ArrayLike,
    period: int,
    limits: Steps,
    ways: tuple[int, ...] = (-1, 1),
) -> Branch:
    """Follow the orbit of `period` mesh periods near the scaled `state` over a parameter.

    `limits`: range of the parameter in the config's unit, the config's own value within, and
    steps, of which one of length 1 spans the range, or changes the scaled state by `_SPAN`.
    `ways`: first along falling (-1) and then rising (1) values, or one of these.

    Raises `InputError` for an unknown parameter, a value outside the limits, single precision,
    or where there is no orbit to start from.
    """
    value = value_of(config, parameter)
    if not limits.low <= value <= limits.high:
        raise InputError(
            f"`{PLACES[parameter]}` must lie in the range to follow, {limits.low:g} to "
            f"{limits.high:g}, but is {value:g}"
        )
    if not 1 <= period <= _LONGEST or not set(ways) <= {-1, 1} or not ways:
        raise InputError(
            f"Arguments `period` and `ways` must be 1 to {_LONGEST} and among -1 and 1, but are "
            f"{period} and {ways}"
        )
    for bound in (limits.low, limits.high):
        with_value(config, parameter, bound)
    orbits = _Orbits(config, parameter, period, limits)
    place = orbits.place(state, value)
    fixed = np.eye(len(place))[-1]
    try:
        start = corrected(orbits, place, fixed, fixed)
    except StoppedError as stop:
        raise InputError(
            f"no orbit of {period} mesh periods is near the state at `{PLACES[parameter]}` = "
            f"{value:g}: {stop.end.value} Start from the state of a periodic Evaluation"
        ) from None
    branches = []
    for way in ways:
        first = start._replace(tangent=way * np.sign(start.tangent[-1] or 1) * start.tangent)
        branches.append(orbits.branch(follow_curve(orbits, first, orbits.steps, _TESTS)))
        if branches[-1].ends[1] is End.CLOSED:
            break
    return branches[0] if len(branches) == 1 else _joined(*branches)


def follow_doubled(
    branch: Branch, bifurcation: Bifurcation, limits: Steps | None = None
) -> Branch | None:
    """The branch of twice the period born at a period doubling of `branch`, from there on.

    It begins a little away from the bifurcation, displaced along the eigenvector of the
    multiplier -1. None where no orbit is found that is not the simple one, or where it is longer
    than 8 mesh periods. Raises `ValueError` for another kind of bifurcation.
    """
    if bifurcation.kind is not Kind.PERIOD_DOUBLING:
        raise ValueError(
            "Argument `bifurcation` must be a period doubling, but is "
            f"{bifurcation.kind.name.lower()}"
        )
    if 2 * branch.period > _LONGEST:
        return None
    limits = limits or branch.limits
    simple = _Orbits(branch.config, branch.parameter, branch.period, limits)
    orbits = _Orbits(branch.config, branch.parameter, 2 * branch.period, limits)
    place = simple.place(bifurcation.point.state, bifurcation.value)
    fixed = np.eye(len(place))[-1]
    try:
        monodromy = corrected(simple, place, fixed, fixed).look.data.monodromy
        multipliers, vectors = np.linalg.eig(monodromy)
        flipped = np.real(vectors[:, np.argmin(np.abs(multipliers + 1))])
        across = np.append(flipped / np.linalg.norm(flipped), 0.0)
    except StoppedError:
        return None
    for size in _SIZES:
        try:
            start = corrected(orbits, place + size * across, across, across)
        except StoppedError:
            continue
        if start.look.data.half_way > 0.2 * size:
            return orbits.branch(follow_curve(orbits, start, orbits.steps, _TESTS))
    return None


# The equations


class _Shot(NamedTuple):
    """k mesh periods from a state: `out`, its steps `grid` with ends where the equation is not
    smooth, whether the lobes passed through each other, whether there is contact at uniform
    times, and the `scale` (rad) of the config."""

    out: Flow
    grid: Float[Array, " steps"]
    lost: Bool[Array, ""]
    touching: Bool[Array, " looks"]
    scale: Float[Array, ""]


class _Seen(NamedTuple):
    """What is known of an orbit at a look, beside residual and Jacobian."""

    monodromy: NDArray[np.float64]
    state: NDArray[np.float64]
    statistics: NDArray[np.float64]
    half_way: float
    residual: float
    depth: float
    reach: float
    gap_time: float


class _Orbits:
    """Orbits of k mesh periods as a curve: places are (state / `_SPAN`, share of the range)."""

    def __init__(self, config: Config, parameter: str, period: int, limits: Steps):
        if config.solver.precision != "float64":
            raise InputError(
                "`solver.precision` must be float64 to follow a branch, but is "
                f"{config.solver.precision}"
            )
        self.config, self.parameter, self.period, self.limits = config, parameter, period, limits
        self.names = parameters(config)
        self.values = np.array([value_of(config, name) for name in self.names])
        self.index = self.names.index(parameter)
        self.model = Model.of(config)
        self.how = integrators(config)[1]
        self.width = limits.high - limits.low
        self.steps = dataclasses.replace(limits, low=0.0, high=1.0)
        # Built once for its units: they stay those of the config while the parameter changes.
        self.unit = float(_unit(self.model, self.names, self.values))

    def value(self, place: NDArray[np.float64]) -> float:
        """The parameter at a place, in the config's unit; exact at both ends of the range."""
        share = place[-1]
        return float(self.limits.high if share == 1 else self.limits.low + share * self.width)

    def place(self, state: ArrayLike, value: float) -> NDArray[np.float64]:
        """Place of an orbit, from its state scaled as the config with that `value` scales it."""
        scale = float(_unit(self.model, self.names, self._values(value)))
        share = (value - self.limits.low) / self.width
        return np.append(np.asarray(state) * (scale / self.unit / _SPAN), share)

    def _values(self, value: float) -> NDArray[np.float64]:
        values = self.values.copy()
        values[self.index] = value
        return values

    def closed(self, guess: NDArray[np.float64]) -> BranchPoint:
        """The orbit near `guess` at its value of the parameter. Raises `StoppedError`."""
        fixed = np.eye(len(guess))[-1]
        return self.point(corrected(self, guess, fixed, fixed))

    def __call__(self, place: NDArray[np.float64], memory: Any, careful: bool) -> Look:
        self._check_design(self.value(place))
        shot = self._shot(place, memory, refine=memory is None)
        if careful and memory is None:
            # Once more, on steps short enough to see the touches that those chosen step over.
            shot = self._shot(place, shot.grid, refine=True)
        out: Flow = shot.out
        reach = self.unit * float(np.max(np.abs(out.states[:, 0])))
        count = len(place) - 1
        if not out.solved:
            raise StoppedError(End.SOLVER_FAILED)
        if not (np.all(np.isfinite(out.end)) and np.all(np.isfinite(out.slope[:count]))):
            raise StoppedError(End.NON_FINITE)
        if shot.lost:
            raise StoppedError(End.LOST_MESH)
        if out.depth > _TOO_DEEP * float(self.model.pitch_radius):
            raise StoppedError(End.TOO_DEEP)
        if self.model.fidelity == "map" and reach > -float(self.model.deepest):
            raise StoppedError(End.OFF_THE_MAP)
        state = _SPAN * place[:-1]
        miss = np.asarray(out.end) - state
        monodromy = np.asarray(out.slope)[:count, :count]
        by_share = out.slope[:count, count] * self.width / _SPAN
        seen = _Seen(
            monodromy=monodromy,
            state=state * (self.unit / shot.scale),
            statistics=np.array([out.mean, out.peak, np.sqrt(out.mean_square)]),
            half_way=float(np.max(np.abs(out.states[len(out.states) // 2] - state))) / _SPAN,
            residual=float(np.max(np.abs(miss)) / max(1.0, np.max(np.abs(state)))),
            depth=float(out.depth),
            reach=reach,
            gap_time=_longest_gap(np.asarray(shot.touching)) * self.period,
        )
        if self.period % 2 == 0 and seen.half_way < _SAME and seen.residual < RESIDUAL["float64"]:
            raise StoppedError(End.HALVED)
        jacobian = np.column_stack([monodromy - np.eye(count), by_share])
        return Look(miss / _SPAN, jacobian, shot.grid, seen)

    def _shot(self, place: NDArray[np.float64], grid: Any, refine: bool) -> "_Shot":
        return jax.device_get(
            _shoot(
                self.model,
                self.names,
                self._values(self.value(place)),
                np.eye(len(self.names))[self.index],
                np.asarray(self.unit),
                _SPAN * place[:-1],
                np.asarray(float(self.period)),
                self.how,
                np.full(self.how.max_steps, np.inf) if grid is None else grid,
                np.asarray(grid is not None),
                np.asarray(refine),
            )
        )

    def _check_design(self, value: float) -> None:
        """Raise `StoppedError` where no profile can be made."""
        if self.parameter in DESIGN_KEYS:
            try:
                profile = self.config.profile.model_copy(update={self.parameter: value})
                check_geometry(self.config.model_copy(update={"profile": profile}))
            except InputError:
                raise StoppedError(End.NO_GEOMETRY) from None

    def point(self, spot: Spot) -> BranchPoint:
        """The orbit at a spot."""
        seen: _Seen = spot.look.data
        mean, peak, rms = map(float, seen.statistics)
        return BranchPoint(
            value=self.value(spot.place),
            state=seen.state,
            period=self.period,
            mean=mean,
            peak=peak,
            rms=rms,
            multipliers=np.linalg.eigvals(seen.monodromy).astype(complex),
            residual=seen.residual,
            slope=float(spot.tangent[-1]),
            gap_time=seen.gap_time,
            depth=seen.depth,
            reach=seen.reach,
            looks=spot.looks,
        )

    def branch(self, path: Path) -> Branch:
        """The branch of a path."""
        end = path.end
        if end is End.STEP_TOO_SMALL and self.period % 2 == 0:
            half_way = path.spots[-1].look.data.half_way
            end = End.HALVED if half_way < _HALVED else end
        bifurcations = []
        for after, name, spot in path.crossings:
            kind, point = Kind[name], self.point(spot)
            # Two real multipliers whose product is one make a neutral saddle.
            real = np.all(np.abs(point.multipliers.imag) < 1e-9)
            if kind is not Kind.NEIMARK_SACKER or not real:
                bifurcations.append(Bifurcation(kind, point, after))
        return Branch(
            config=self.config,
            parameter=self.parameter,
            period=self.period,
            points=tuple(map(self.point, path.spots)),
            bifurcations=tuple(bifurcations),
            ends=(End.START, end),
            limits=self.limits,
        )


def _joined(falling: Branch, rising: Branch) -> Branch:
    """One branch of two that begin at the same point, the first reversed."""
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


def _check(config: Config, parameter: str) -> None:
    valid = parameters(config)
    if parameter in valid:
        return
    why = "this config has no timing gear" if parameter in _GEAR else "valid here"
    raise InputError(
        f"Argument `parameter` must be one that can be followed, but is {parameter!r}; {why}: "
        f"{', '.join(valid)}"
    )


def _longest_gap(touching: NDArray[np.bool_]) -> float:
    """Longest run of False around a cycle, as a share of it."""
    if not touching.any():
        return 1.0
    ends = np.flatnonzero(touching)
    gaps = np.diff(ends, append=ends[0] + len(touching)) - 1
    return float(np.max(gaps)) / len(touching)


def _build(
    model: Model, names: tuple[str, ...], values: Float[Array, " p"]
) -> tuple[RotorPair, Float[Array, ""]]:
    """The pair with these values of the parameters (config's units), and its angle scale."""
    at = dict(zip(names, values, strict=True))
    gear = model.gear
    if gear is not None:
        half = at["backlash_mm"] * MM / (2 * model.pitch_radius)
        gear = eqx.tree_at(lambda g: g.half_backlash, gear, half)
    tuned = dataclasses.replace(
        model,
        speed=at["speed_rpm"] * (2 * jnp.pi / 60),
        load_torque=at["torque_N_m"],
        gear=gear,
        gear_damping_ratio=at.get("damping_ratio", model.gear_damping_ratio),
    )
    design = [at[key] for key in DESIGN_KEYS if key in at]
    pair = tuned.pair(jnp.stack(design) if design else jnp.zeros(0))
    return pair, pair.angle_scale


@Program
def _unit(model, names, values):
    return _build(model, names, values)[1]


@Program
def _shoot(
    model: Model,
    names: tuple[str, ...],
    values: Float[Array, " p"],
    direction: Float[Array, " p"],
    unit: Float[Array, ""],
    state: Float[Array, " n"],
    period: Float[Array, ""],
    how: Integrator,
    grid: Float[Array, " steps"],
    repeat: Bool[Array, ""],
    refine: Bool[Array, ""],
) -> _Shot:
    """Motion from a state in the fixed `unit` (rad), linearised in it and along `direction`.

    On the steps of `grid` while `repeat`. With `refine` the grid returned has ends added where
    the equation is not smooth.
    """

    def build(values):
        pair, scale = _build(model, names, values)
        return eqx.tree_at(lambda p: p.angle_scale, pair, unit), scale

    def arrays(values):
        return eqx.filter(build(values)[0], eqx.is_inexact_array)

    pair, scale = build(values)
    _, tangent = jax.jvp(arrays, (values,), (direction,))
    tangents = jax.tree.map(lambda x: x[None], tangent)
    out = flow(pair, state, period, how, SAMPLES, tangents, grid, repeat)
    tolerance = how.tolerance(state.dtype)
    finer = lax.cond(
        refine,
        lambda: _without_long(with_switches(pair, out, period, tolerance), period),
        lambda: grid,
    )
    stride = SAMPLES // _LOOKS
    times = period * jnp.arange(_LOOKS) / _LOOKS

    def touches(tau, state):
        held = pair.gear is not None and jnp.any(pair.gear.switches(pair.physical(tau, state)[1]))
        return (pair.contact_at(tau, state).total > 0) | held

    touching = jax.vmap(touches)(times, out.states[::stride])
    farthest = jnp.maximum(jnp.max(jnp.abs(out.states[:, 0])), jnp.abs(out.end[0]))
    return _Shot(out, finer, unit * farthest >= pair.angle_limit, touching, scale)


def _without_long(grid: Float[Array, " steps"], period: Float[Array, ""]) -> Float[Array, " steps"]:
    """`grid` with ends added in steps much longer than `_STEP`.

    In free flight the error control takes steps so long that a short touch goes unseen, or not:
    then the flow would jump from one state to the next.
    """
    ends = _STEP * jnp.arange(1, _LONGEST / _STEP)
    after = jnp.searchsorted(grid, ends)
    before = jnp.where(after > 0, grid[after - 1], 0.0)
    clear = jnp.minimum(ends - before, grid[after] - ends) > _STEP / 4
    ends = jnp.where(clear & (ends < period), ends, jnp.inf)
    return jnp.sort(jnp.concatenate([grid, ends]))[: grid.shape[0]]


__all__ = [
    "PLACES", "RESIDUAL", "Bifurcation", "Branch", "BranchPoint", "End", "Kind", "Steps",
    "follow", "follow_doubled", "parameters", "value_of", "with_value",
]  # fmt: skip
