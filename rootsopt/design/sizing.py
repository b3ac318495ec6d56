"""Finds the member of a profile family that has a given outer radius.

In the unit box of the family's parameters, the search minimises the distance from a reference
design. The outer radius is an equality constraint; the margins of a sound profile must keep some
room. Gradients are exact, and the searches (SciPy's SLSQP) begin at members of a Sobol sample."""

import functools
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from rootsopt.config import Config
from rootsopt.config.families import family_of
from rootsopt.config.sheet import rounded
from rootsopt.config.units import MM
from rootsopt.design.space import Space, slacks_and_slopes, sobol
from rootsopt.errors import InputError
from rootsopt.scene import Scene
from rootsopt.scene.check import shape_of
from rootsopt.scene.families import check

_SAMPLE, _STARTS = 64, 3
"""Number of sampled members, and of searches that begin at the best of them."""
_ROOM, _SLACK = 0.02, 1e-6
"""Least margin of a member, as a fraction of the greatest one in the sample, and its tolerance.

A margin that is 0 in every member, such as the lever at the tip, needs no room."""
_FAR = 1e3
"""Magnitude (mm) that stands for values that are not finite."""
_CLOSE = 1e-6
"""Deviation (mm) of the outer radius up to which it counts as met."""


class Reach(NamedTuple):
    """What a family can do at a pitch radius.

    `config`: with the member that has the wanted outer radius, `None` if there is none; `radii`:
    outer radii (mm) of sound members, then with the least and the greatest one."""

    config: Config | None
    radii: list[float]


def sized(config: Config, outer_radius_mm: float) -> Reach:
    """Return the config with a member of its family that has an outer radius, or what is possible.

    The member is the one nearest to the config's own profile, in the unit box of the family's
    default bounds. It has `outer_radius_mm` to 1e-6 mm."""
    if not family_of(config.profile.family).keys:
        return Reach(_met(config, outer_radius_mm), [float(shape_of(config).outer_radius) / MM])
    look = _Look(config)
    sample = [*sobol(_SAMPLE, 0, len(look.home)), look.home]
    sound = [point for point in sample if np.min(look(point).slack) >= 0]
    if not sound:
        return Reach(None, [])
    greatest = np.max([look(point).slack for point in sound], axis=0)
    search = functools.partial(_searched, look, _ROOM * greatest - _SLACK)
    sound.sort(key=lambda point: abs(look(point).outer - outer_radius_mm))
    found = [search(point, outer_radius_mm) for point in sound[:_STARTS]]
    for point in sorted(found, key=lambda one: float(np.sum((one - look.home) ** 2))):
        if met := _met(config.with_design(look(point).design), outer_radius_mm):
            return Reach(met, [])
    sound.sort(key=lambda point: look(point).outer)
    ends = [search(point, None, 1.0) for point in sound[:2]]
    ends += [search(point, None, -1.0) for point in sound[-2:]]
    least = _ROOM * greatest - 2 * _SLACK
    sound += [point for point in ends if np.all(look(point).slack >= least)]
    return Reach(None, [look(point).outer for point in sound])


def _met(config: Config, outer_radius_mm: float) -> Config | None:
    """Return a config as it is written, `None` unless it is sound and has the outer radius."""
    config = config.model_copy(update={"profile": rounded(config.profile)})
    try:
        check(config.profile)
    except InputError:
        return None
    away = abs(float(shape_of(config).outer_radius) / MM - outer_radius_mm)
    return config if away <= _CLOSE else None


class _Seen(NamedTuple):
    """A member: `design` (d,) in config units; `outer` radius (mm); `slack` (m,): scaled margins.

    `outer_slope` (d,), `slack_slope` (m, d): derivatives in the unit box."""

    design: NDArray[np.float64]
    outer: float
    slack: NDArray[np.float64]
    outer_slope: NDArray[np.float64]
    slack_slope: NDArray[np.float64]


class _Look:
    """Members of a config's family at points of the unit box. `home` (d,): the config's own."""

    def __init__(self, config: Config):
        profile, bounds = config.profile, {}
        for one in family_of(profile.family).parameters:
            # Bounds about the example would not hold the members of other numbers of lobes.
            if one.usual is None and one.default_bounds is None and not one.floor:
                least, most = one.limits(profile.pitch_radius_mm) or one.bounds_range
                low, high = one.usually(profile.pitch_radius_mm, profile.lobes)
                bounds[f"optimizer.bounds.{one.key}"] = [max(low, least), min(high, most)]
        free = config.replaced({**bounds, "constraints.area_efficiency_min": 0.0})
        self.space = Space.of(free, Scene.from_config(free), 0.0)
        self.is_outer = np.array([c.quantity == "outer_radius" for c in self.space.constraints])
        self.home = np.asarray(self.space.point(jnp.asarray(profile.design)))

    @functools.lru_cache(maxsize=4096)  # noqa: B019
    def _at(self, point: tuple[float, ...]) -> _Seen:
        design, _, slack, slope = (
            np.nan_to_num(np.asarray(part), nan=-_FAR, posinf=_FAR, neginf=-_FAR)
            for part in slacks_and_slopes(self.space, np.asarray(point))
        )
        here, others = np.flatnonzero(self.is_outer)[0], ~self.is_outer
        limit = float(self.space.constraints[here].limit) / MM
        outer = limit - float(slack[here])
        return _Seen(design, outer, slack[others], -slope[here], slope[others])

    def __call__(self, point) -> _Seen:
        return self._at(tuple(map(float, point)))


def _searched(
    look: _Look, room: NDArray[np.float64], start, target: float | None, side: float = 0.0
) -> NDArray[np.float64]:
    """Return the point (d,) nearest to home whose outer radius is `target` (mm), from a start.

    Without a target, return that of the least outer radius if `side` is 1, of the greatest if it is
    -1. `room` (m,): least scaled margins."""
    from scipy.optimize import minimize

    size = float(look.space.scene.pitch_radius) / MM
    wanted, weight = (0.0, 0.0) if target is None else (target, 1.0)
    rows = [
        {
            "type": "ineq",
            "fun": lambda x: look(x).slack - room,
            "jac": lambda x: look(x).slack_slope,
        },
        {
            "type": "eq",
            "fun": lambda x: look(x).outer - wanted,
            "jac": lambda x: look(x).outer_slope,
        },
    ]
    found = minimize(
        lambda x: side * look(x).outer / size + weight * np.sum((x - look.home) ** 2) / 2,
        start,
        jac=lambda x: side * look(x).outer_slope / size + weight * (x - look.home),
        bounds=[(0, 1)] * len(look.home),
        constraints=rows if weight else rows[:1],
        method="SLSQP",
        options={"maxiter": 100, "ftol": 1e-13},
    ).x
    for _ in range(3 if weight else 0):  # SLSQP may end some nanometres beside the target.
        slope = look(found).outer_slope
        step = (wanted - look(found).outer) / max(float(slope @ slope), 1e-12)
        found = np.clip(found + step * slope, 0.0, 1.0)
    return found
