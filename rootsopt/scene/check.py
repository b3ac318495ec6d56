"""Checks a config's geometry, computes its outline, and finds the member of a given outer radius.

In the unit box of the family's parameters, `sized` minimises the distance from a reference design.
The outer radius is an equality constraint; the margins of a sound profile must keep some room.
Gradients are exact, and the searches (SciPy's SLSQP) begin at members of a Sobol sample."""

import functools

import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike, NDArray

from rootsopt.config.families import family_of
from rootsopt.config.reading import Config
from rootsopt.config.study import limits_of
from rootsopt.config.units import MM
from rootsopt.errors import InputError
from rootsopt.profiles import Geometry, geometry, outline
from rootsopt.runtime.programs import CachedFunction
from rootsopt.scene import families
from rootsopt.scene.build import Scene
from rootsopt.scene.reading import design_vector
from rootsopt.scene.space import Space, slacks_and_slopes, sobol

# Excess (mm) of the bore over the root circle above which a design is rejected. A search may end at
# less.
_TOUCHING = 1e-6


def check_geometry(config: Config, design: ArrayLike | None = None, simulated: bool = True) -> None:
    """Raise `InputError` unless the config's profile is sound and leaves room for the bore.

    `design` (d,): in config units, by default the config's own; `simulated`: whether the rotor is
    to be simulated. An outline from a file must then lie around its axis, which is checked before
    anything is compiled."""
    if design is not None:
        config = config.with_design(np.asarray(design, float))
    if simulated and config.profile.from_file:
        from rootsopt.measured.source import check_center  # Slow import, for outlines only.

        check_center(config.profile)
    families.check(config.profile)
    bore = config.rotor.bore_mm
    if bore is None:
        return
    root = float(shape_of(config).root_radius) / MM
    if bore >= 2 * root + (0.0 if design is None else 2 * _TOUCHING):
        raise InputError(
            f"`rotor.bore_mm` must be less than {2 * root:.6g} (the root circle), but is "
            f"{bore:g}; make it smaller"
        )


def shape_of(config: Config) -> Geometry:
    """Return the geometry of a config's own design."""
    return _shape(Scene.from_config(config), design_vector(config))


@CachedFunction
def _shape(scene: Scene, design):
    return geometry(scene.profile(design))


def outline_mm(config: Config, design: ArrayLike | None = None) -> NDArray[np.float64]:
    """Return the closed counter-clockwise outline (n, 2), in mm, of a design.

    `design`: in config units, by default the config's own."""
    design = design_vector(config) if design is None else jnp.asarray(design)
    profile = profile_of(Scene.from_config(config), design)
    return np.asarray(outline(profile, points=240)) / MM


profile_of = CachedFunction(Scene.profile)


# Number of sampled members. Number of searches that begin at the best of them. Magnitude (mm) that
# replaces values that are not finite.
_SAMPLE, _STARTS, _FAR = 64, 3, 1e3
# Least margin of a member, as a fraction of the greatest one in the sample, and its tolerance;
# deviation (mm) of the outer radius up to which it counts as met.
#
# A margin that is 0 in every member, such as the lever at the tip, needs no room.
_ROOM, _SLACK, _CLOSE = 0.02, 1e-6, 1e-6


def sized(config: Config) -> Config | list[float]:
    """Return the config with a member of its family that fills the housing.

    Its outer radius is `constraints.outer_radius_max_mm` to 1e-6 mm. Among such members, it is the
    one nearest to the config's own profile, in the unit box of the family's default bounds. If none
    is found, return outer radii (mm) of sound members, among them the least and the greatest."""
    limit = limits_of(None, config.constraints.outer_radius_max_mm)[1]
    if not family_of(config.profile.family).keys:
        own = float(shape_of(config).outer_radius) / MM
        return _met(config, config.design, limit) or [own]
    space = _space(config)
    outer = np.array([row.quantity == "outer_radius" for row in space.constraints])
    home = np.asarray(space.point(jnp.asarray(config.design)))
    at = functools.lru_cache(maxsize=4096)(lambda *point: _seen(space, point))
    sample = [*sobol(_SAMPLE, 0, len(home)), home]
    sound = [point for point in sample if np.min(at(*point)[1][~outer]) >= 0]
    if not sound:
        return []
    room = _ROOM * np.max([at(*point)[1] for point in sound], axis=0) - _SLACK
    search = functools.partial(_searched, at, outer, room, home)

    def radius(point):
        return limit - float(at(*point)[1][outer][0])

    sound.sort(key=radius)
    if not radius(sound[0]) <= limit <= radius(sound[-1]):
        # Without this limit, a search for an outer radius that no member has would take long.
        ends = [search(point, side) for side in (-1.0, 1.0) for point in (sound[0], sound[-1])]
        sound += [one for one in ends if np.all((at(*one)[1] - room)[~outer] >= -_SLACK)]
    radii = [radius(point) for point in sound]
    if min(radii) <= limit <= max(radii):
        sound.sort(key=lambda point: abs(radius(point) - limit))
        points = [search(point, 0.0) for point in sound[:_STARTS]]
        for point in sorted(points, key=lambda one: float(np.sum((one - home) ** 2))):
            if (met := _met(config, at(*point)[0], limit)) is not None:
                return met
    return radii


def _met(config: Config, design, limit: float) -> Config | None:
    """Return a config with a rounded design (d,), `None` unless its outer radius is `limit` mm."""
    # Ten digits keep the outer radius.
    config = config.with_design([float(f"{value:.10g}") for value in design])
    try:
        families.check(config.profile)
    except InputError:
        return None
    return config if abs(float(shape_of(config).outer_radius) / MM - limit) <= _CLOSE else None


def _space(config: Config) -> Space:
    profile, bounds = config.profile, {}
    for one in family_of(profile.family).parameters:
        # Bounds around the example would exclude members with other numbers of lobes.
        if one.usual is None and one.default_bounds is None and not one.floor:
            least, most = one.limits(profile.pitch_radius_mm) or one.bounds_range
            low, high = one.usually(profile.pitch_radius_mm, profile.lobes)
            bounds[f"optimizer.bounds.{one.key}"] = [max(low, least), min(high, most)]
    free = config.replaced(bounds)
    return Space.of(free, Scene.from_config(free))


def _seen(space: Space, point) -> tuple[NDArray[np.float64], ...]:
    """Return (design (d,), slacks (m,), their derivatives (m, d)) at a point of the unit box."""
    design, _, *slacks = slacks_and_slopes(space, np.asarray(point))
    finite = (
        np.nan_to_num(np.asarray(one), nan=-_FAR, posinf=_FAR, neginf=-_FAR) for one in slacks
    )
    return np.asarray(design), *finite


def _searched(at, outer, room, home, start, side: float) -> NDArray[np.float64]:
    """Return the point (d,) nearest to `home` whose outer radius is the limit.

    With a `side` of -1 or 1, return that of the greatest or least outer radius instead. `at`:
    function of the coordinates that returns what `_seen` does; `outer` (m,): whether a constraint
    is that of the outer radius; `room` (m,): least slacks of the others; `start` (d,): where the
    search begins."""
    from scipy.optimize import minimize

    rows = [
        {"type": "ineq", "fun": lambda x: (at(*x)[1] - room)[~outer],
         "jac": lambda x: at(*x)[2][~outer]},
        {"type": "eq", "fun": lambda x: at(*x)[1][outer], "jac": lambda x: at(*x)[2][outer]},
    ]  # fmt: skip
    goals = (
        (lambda x: np.sum((x - home) ** 2) / 2, lambda x: x - home)
        if not side
        else (lambda x: -side * at(*x)[1][outer][0] / _FAR,
              lambda x: -side * at(*x)[2][outer][0] / _FAR)
    )  # fmt: skip
    minimum = minimize(
        goals[0], start, jac=goals[1], bounds=[(0, 1)] * len(home), method="SLSQP",
        constraints=rows[:1] if side else rows, options={"maxiter": 100, "ftol": 1e-13},
    )  # fmt: skip
    return minimum.x
