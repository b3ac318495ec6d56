"""Bounds of the design parameters, the unit box of these bounds, and the constraints in it.

Each design parameter is mapped linearly from its bounds to the range 0 … 1. If its range depends on
the other parameters, the part of this range within the bounds is mapped instead. Constraints depend
on the geometry alone and are cheap. For families whose closed-form limits do not ensure a sound
profile, the margins of `rootsopt.profiles.soundness` are further constraints.
"""

import importlib
import threading
from collections.abc import Callable, Iterator
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import NDArray

from rootsopt.config.families import Family, Parameter, family_of
from rootsopt.config.reading import Config
from rootsopt.config.study import BASELINE, TWIST
from rootsopt.config.units import DEG, MM, si_unit, unit_of, words
from rootsopt.errors import InputError
from rootsopt.profiles import Geometry, Profile, geometry
from rootsopt.profiles.soundness import Soundness, margins
from rootsopt.runtime.programs import CachedFunction
from rootsopt.scene.build import Scene

# Distance (fraction of the width of the bounds) from a design to the bounds that are widened for
# it.
_ROOM = 0.1


def bounds_of(config: Config) -> list[tuple[float, float]]:
    """Return the bounds (low, high) of each design parameter of a config, in config units.

    Raises `InputError` if a bound is impossible, such as a tip land wider than the lobe."""
    bounds = [_pair(config, parameter) for parameter in _parameters(config)]
    return [*bounds, config.optimizer.bounds[TWIST]] if config.twist_free else bounds


def floors_of(config: Config) -> tuple[float, ...]:
    """Return the default lower bound of each design parameter, as a fraction of its range's end.

    It is 0 for parameters that have bounds in the config, or whose range depends on no other."""
    given = config.optimizer.bounds
    floors = [one.floor if given.get(one.key) is None else 0.0 for one in _parameters(config)]
    return (*floors, 0.0) if config.twist_free else tuple(floors)


def _parameters(config: Config) -> Iterator[Parameter]:
    """Yield the parameter of each entry of a design, without the twist."""
    for parameter in family_of(config.profile.family).parameters:
        yield from [parameter] * np.size(getattr(config.profile, parameter.key))


def widened(config: Config) -> tuple[Config, tuple[str, ...]]:
    """Return (config whose bounds hold its own design, keys of the widened bounds).

    Only default bounds are widened, by `_ROOM` of their width beyond the design, within the limits
    of the key. Bounds of the config that differ from the default are kept."""
    changes: dict[str, tuple[float, float]] = {}
    lobes, radius = config.profile.lobes, config.profile.pitch_radius_mm
    for parameter in family_of(config.profile.family).parameters:
        given = config.optimizer.bounds.get(parameter.key)
        if given is not None and tuple(given) != parameter.default_bounds:
            continue
        low, high = given or parameter.bounds(config.profile)
        value = getattr(config.profile, parameter.key)
        values = value if isinstance(value, tuple) else (value,)
        if low <= min(values) and max(values) <= high:
            continue
        least, most = parameter.bounds_range
        sized = parameter.limits(radius) or (least, most)
        least, most = max(least, sized[0]), min(most, sized[1])
        room = _ROOM * (high - low)
        pair = max(least, min(low, min(values) - room)), min(most, max(high, max(values) + room))
        try:
            parameter.check_bounds(pair, lobes)
        except InputError:
            pair = pair[0], max(high, *values)
        changes[parameter.key] = pair
    if not changes:
        return config, ()
    bounds = config.optimizer.bounds | changes
    return config.moved({"optimizer.bounds": bounds}), tuple(changes)


def _pair(config: Config, parameter: Parameter) -> tuple[float, float]:
    given = config.optimizer.bounds.get(parameter.key)
    if given is None:
        return parameter.bounds(config.profile)
    parameter.check_bounds(given, config.profile.lobes)
    return given


# Fixed keys of the section `constraints`, with what they limit (see `Constraint`).
_LIMITED = (
    # key, name, quantity, unit, scale, factor
    ("area_efficiency_min", "area efficiency", "area_efficiency", "", 0.01, 1.0),
    ("undercut_margin_min_mm", "undercut margin", "undercut_margin", "mm", MM, MM),
    ("seal_width_min_mm", "seal width", "seal_width", "mm", MM, MM),
    ("outer_radius_max_mm", "outer radius", "outer_radius", "mm", MM, MM),
    ("outer_radius_min_mm", "outer radius", "outer_radius", "mm", MM, MM),
)

# Constraints that keep a profile sound, in addition to the constraint on the undercut margin. For
# the columns, see `Constraint`.
_SOUND = (
    # name, margin, unit, limit, scale, factor
    ("least turn of a flank segment", "turning", "deg", 0.0, 0.1, DEG),
    ("addendum radius of curvature", "convexity", "mm", 0.0, MM, MM),
    ("normals within the pitch circle", "reach", "mm", 0.0, MM, MM),
    ("outline falls from the tip", "fall", "mm", 0.0, MM, MM),
    ("one contact per flank (roll per turn of the normal)", "rolling", "", 0.0, 0.1, 1.0),
    ("contact begins at the tip (roll angle)", "order", "deg", 0.0, 0.1, DEG),
    ("tangents clear of the axis", "star", "mm", 0.0, MM, MM),
    ("root radius", "root", "mm", 0.0, MM, MM),
)

# Maximum number of steps onto the feasible set.
_STEPS = 30

# Greatest lower bound of a parameter in `Space.ranges`, as a fraction of its upper bound.
_NARROW = 0.999


class Constraint(eqx.Module):
    """A constraint: value ≥ limit, or value ≤ limit for a `ceiling`.

    `name`: name in reports; `quantity`: name of the limited field of `Geometry`, or of
    `Soundness` if `margin` is true; `limit`: limit in SI units; `scale`: divisor (SI) that
    makes slacks comparable, about the size of the limit; `unit`: unit in reports; `factor`: SI
    value of one such unit."""

    name: str = eqx.field(static=True)
    quantity: str = eqx.field(static=True)
    unit: str = eqx.field(static=True)
    limit: Float[Array, ""]
    scale: float = eqx.field(static=True)
    factor: float = eqx.field(static=True)
    margin: bool = eqx.field(static=True, default=False)
    ceiling: bool = eqx.field(static=True, default=False)

    @property
    def sign(self) -> float:
        """+1 if `limit` is a least value, -1 if it is a greatest value."""
        return -1.0 if self.ceiling else 1.0

    @property
    def sense(self) -> str:
        """Relation between value and limit."""
        return "<=" if self.ceiling else ">="

    @property
    def bound(self) -> float:
        """The limit in the unit of reports."""
        return float(self.limit) / self.factor

    def scaled(self, value: Float[Array, ""] | float) -> Float[Array, ""]:
        """Return the slack of a `value` of the limited quantity.

        It is the distance from the limit, divided by `scale`; ≥ 0 if the constraint holds."""
        return self.sign * (value - self.limit) / self.scale

    def slack_of(
        self,
        space: "Space",
        design: Float[Array, " d"],
        profile: Profile,
        shape: Geometry,
        soundness: Soundness | None,
    ) -> Float[Array, ""]:
        """Return the slack of a `design` (d,) of a `space`, given its `profile`; see `scaled`.

        `shape`, `soundness`: geometry and margins of the design. The margins are needed only if
        `margin` is true."""
        return self.scaled(getattr(soundness if self.margin else shape, self.quantity))


class RangeConstraint(Constraint):
    """A lower bound that the upper end of a parameter's range must reach.

    The range depends on the other parameters; `quantity` is the parameter's key."""

    def slack_of(self, space, design, profile, shape, soundness):
        return self.scaled(_NARROW * space.ranges(design)[self.quantity][1] * self.factor)


class Space(eqx.Module):
    """The unit box of d design parameters, with m constraints.

    `scene`: builds profiles from designs; `lower`, `upper` (d,): bounds in config units;
    `constraints`: the m constraints; `floors` (d,): lower bounds as fractions of the upper end of a
    range that depends on the other parameters, 0 where there is none.
    """

    scene: Scene
    lower: Float[Array, " d"]
    upper: Float[Array, " d"]
    constraints: tuple[Constraint, ...]
    floors: tuple[float, ...] = eqx.field(static=True)

    @classmethod
    def of(
        cls,
        config: Config,
        scene: Scene,
        further: tuple[Constraint, ...] = (),
    ) -> "Space":
        """Return the design space of a config.

        `scene`: scene of the config; `further`: constraints in addition to those of the family and
        of the fixed keys of `constraints`. A limit that is `baseline` counts as 0: searches fill it
        in first (`rootsopt.optimize.limits.settled`). Raises `InputError` if the config's bounds
        are impossible."""
        limits, family = config.constraints, family_of(config.profile.family)
        sound = not family.by_limits
        constraints: list[Constraint] = []
        for key, name, quantity, unit, scale, factor in _LIMITED:
            limit = getattr(limits, key)
            if limit is None:
                continue
            # If undercut decides whether the profile is sound, use the margin of more points.
            margin = sound and quantity == "undercut_margin"
            row = name, "undercut" if margin else quantity, unit
            limit = 0.0 if limit == BASELINE else limit * factor
            ceiling = key == "outer_radius_max_mm"
            constraints.append(_constraint(*row, limit, scale, factor, margin, ceiling))
        if scene.bore_radius is not None:
            row = "root radius", "root_radius", "mm"
            constraints.append(_constraint(*row, scene.bore_radius, MM, MM))
        for row in _SOUND if sound else ():
            if row[1] not in family.inherent:
                constraints.append(_constraint(*row, margin=True))
        constraints += [*_reaching(config), *further]
        lower, upper = map(jnp.asarray, np.array(bounds_of(config), dtype=float).T)
        return cls(scene, lower, upper, tuple(constraints), floors_of(config))

    @property
    def family(self) -> Family:
        """Profile family of the designs."""
        return family_of(self.scene.family)

    def design(self, point: Float[Array, " d"]) -> Float[Array, " d"]:
        """Return the design (d,) in config units at `point` (d,) of the unit box."""
        limits = zip(self.lower, self.upper, point, strict=True)
        values = [low + (high - low) * share for low, high, share in limits]
        for place, least, most in self.within(values):
            values[place] = least + (most - least) * point[place]
        return jnp.stack(values)

    def point(self, design: Float[Array, " d"]) -> Float[Array, " d"]:
        """Return the point (d,) of the unit box for a design (d,) in config units.

        Parameters outside their bounds are first moved to the nearest bound."""
        values = jnp.clip(design, self.lower, self.upper)
        limits = zip(self.lower, self.upper, values, strict=True)
        shares = [(value - low) / (high - low) for low, high, value in limits]
        for place, least, most in self.within(values):
            shares[place] = (values[place] - least) / (most - least)
        return jnp.clip(jnp.stack(shares), 0.0, 1.0)

    def ranges(self, values) -> dict[str, tuple[Float[Array, ""], Float[Array, ""]]]:
        """Return {key: (low, high)} of the parameters whose range depends on the other parameters.

        `values` (d,): the design. Values and ranges are in config units."""
        radius = self.scene.pitch_radius / MM
        if self.scene.twist_free:
            values = values[:-1]
        named = dict(zip(self.family.keys, self.family.split(values), strict=True))
        return dict(self.family.dependent(self.scene.lobes, radius, **named))

    def within(self, values):
        """Yield (index, low, high) of each parameter in `ranges`, with the range cut to its bounds.

        `values` (d,): the design. The index is that in the design; ranges are in config units."""
        for key, (least, most) in self.ranges(values).items():
            place = self.family.keys.index(key)
            least = jnp.maximum(least, self.floors[place] * most)
            most = jnp.minimum(most, self.upper[place])
            least = jnp.minimum(jnp.maximum(self.lower[place], least), _NARROW * most)
            yield place, least, most

    def slacks_of(self, design: Float[Array, " d"]) -> Float[Array, " m"]:
        """Return the scaled slacks (m,) of the constraints at a design in config units.

        A slack is ≥ 0 where its constraint is satisfied."""
        profile = self.scene.profile(design)
        shape = geometry(profile)
        soundness = margins(profile) if any(c.margin for c in self.constraints) else None
        every = (c.slack_of(self, design, profile, shape, soundness) for c in self.constraints)
        return jnp.stack([*every])

    def prepare(self) -> None:
        """Start compiling, in the background, the program that a search in this space needs."""
        # Import in advance: with `scipy.optimize`, which it imports, it takes 0.6 s.
        threading.Thread(target=importlib.import_module, args=("scipy.stats.qmc",)).start()
        slacks_and_slopes.prepare(self, jax.ShapeDtypeStruct(self.lower.shape, self.lower.dtype))


@CachedFunction
def slacks_and_slopes(space: Space, point):
    """Return (design (d,), its Jacobian (d, d), slacks (m,), their Jacobian (m, d)) at `point`.

    The design is in config units. The Jacobians are derivatives with respect to `point` (d,) in the
    unit box."""

    def both(point):
        design = space.design(point)
        values = design, space.slacks_of(design)
        return values, values

    (design_slope, slack_slope), (design, slack) = jax.jacfwd(both, has_aux=True)(point)
    return design, design_slope, slack, slack_slope


def _reaching(config: Config):
    """Yield a constraint for each lower bound in a `config` of a parameter in `Space.ranges`."""
    family, profile = family_of(config.profile.family), config.profile
    named = {key: np.asarray(value) for key, value in profile.parameters.items()}
    radius, ranges = np.asarray(profile.pitch_radius_mm), partial(family.dependent, profile.lobes)
    # Only the keys are needed: what computes the ranges would be compiled, one operation at a time.
    for key in jax.eval_shape(ranges, radius, **named):
        given = config.optimizer.bounds.get(key)
        if given is not None:
            factor, name = si_unit(key), f"greatest {words(key)}"
            limit = jnp.asarray(given[0] * factor)
            yield RangeConstraint(name, key, unit_of(key), limit, factor, factor)


def _constraint(
    name, quantity, unit, limit, scale, factor, margin=False, ceiling=False
) -> Constraint:
    limit = jnp.asarray(float(limit))
    return Constraint(name, quantity, unit, limit, scale, factor, margin, ceiling)


def sobol(count: int, seed: int, dimension: int = 3) -> NDArray[np.float64]:
    """Return `count` points (count, dimension) of a scrambled Sobol sequence in the unit box.

    `seed`: seed of the scrambling."""
    from scipy.stats import qmc

    sampler = qmc.Sobol(dimension, rng=np.random.default_rng(seed))
    return sampler.random_base2((count - 1).bit_length())[:count]


def onto(
    limits: Callable[[NDArray[np.float64]], tuple[NDArray[np.float64], ...]],
    point: NDArray[np.float64],
) -> Iterator[NDArray[np.float64]]:
    """Yield points (d,) on the way from a `point` onto the feasible set, by Gauss-Newton steps.

    `limits`: function that returns the slacks (m,) at a point and their gradients (m, d). Each step
    is computed from the violated constraints. The last point can still be infeasible, for example
    if the constraints contradict the bounds."""
    point = np.clip(np.asarray(point, dtype=np.float64), 0.0, 1.0)
    yield point
    for _ in range(_STEPS):
        slack, normals = limits(point)
        violated = slack < 0
        if not violated.any():
            return
        # Aim slightly inside, so that the constraint holds despite rounding. Coordinates held by
        # their bound do not move.
        # Where no profile exists, a margin may have no derivative, and does not move the point.
        rows, want = np.nan_to_num(normals[violated]), 1e-7 - slack[violated]
        push = rows.T @ want
        held = ((point <= 0) & (push < 0)) | ((point >= 1) & (push > 0))
        move = np.linalg.lstsq(np.where(held, 0.0, rows), want, rcond=1e-8)[0]
        point = np.clip(point + np.clip(move, -0.3, 0.3), 0.0, 1.0)
        yield point
