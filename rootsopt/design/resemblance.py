"""Finds the member of each classical family that is nearest to a profile, and its distance.

A *member* of a family is a profile with some values of the family's parameters. A family is
*classical* if its profiles are made from single numbers, not from a list or a file.
"""

import functools
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import NDArray
from scipy.optimize import linprog

from rootsopt.config.families import family_of
from rootsopt.config.units import MM
from rootsopt.design.space import sobol
from rootsopt.profiles import Profile
from rootsopt.profiles.departure import departure
from rootsopt.profiles.validity import PURE, margins
from rootsopt.runtime.programs import Program
from rootsopt.scene.families import classical, profile_of

_NODES = 96
"""Number of nodes on each side of the pitch circle at which a search compares two flanks."""
_SAMPLE = 128
"""Number of sampled members of a family. The searches start from the best of them."""
_STARTS = 3
"""Number of searches per family."""
_PROGRAMS, _LONGEST, _SHORTEST = 80, 0.2, 1e-9
"""Limits of a search: number of linear programs after which the search ends; greatest step; step
below which the search ends. Steps are fractions of the parameters' usual ranges."""
_UNSOUND_WEIGHT = 10.0
"""Factor of the penalty for a negative margin. The penalty is this factor times the margin's
magnitude (relative to its scale), and is added to the distance (pitch radii)."""
_UNSOUND = 1e-6
"""Magnitude of a negative margin (relative to its scale) above which a member counts as unsound."""


class Likeness(NamedTuple):
    """The member of a family that is nearest to a profile.

    `family`: name of the family; `design`: the member's parameters by key, in config units;
    `departure`: greatest distance (m) between the flanks of the member and the profile."""

    family: str
    design: dict[str, float]
    departure: float

    def record(self) -> dict[str, Any]:
        """Return the fields as a dictionary for the result file, with the departure in µm."""
        return {
            "family": self.family,
            "design": self.design,
            "departure_um": self.departure * 1e6,
        }


def likenesses(profile: Profile) -> list[Likeness]:
    """Return the member of each classical family that is nearest to `profile`, nearest first.

    The nearest member minimises the greatest distance between its flank and that of `profile`. The
    search starts from the best members of a Sobol sample, and may therefore miss a nearer member.
    Families in which the search finds no sound member are left out.
    """
    found = []
    for family in classical():
        likeness = _nearest(profile, family)
        if likeness is not None:
            found.append(likeness)
    return sorted(found, key=lambda one: one.departure)


def _nearest(profile: Profile, family: str) -> Likeness | None:
    lobes, radius = profile.lobes, profile.pitch_radius
    parameters, keys = family_of(family).parameters, family_of(family).keys
    look = _Look(profile, family)
    if not keys:
        starts = [np.zeros(0)]
    else:
        size = float(radius) / MM, lobes
        low, high = np.array([parameter.usually(*size) for parameter in parameters]).T
        sample = low + (high - low) * sobol(_SAMPLE, 0, len(keys))
        faults = np.array([look(one).fault for one in sample])
        starts = [_fitted(look, sample[k], high - low) for k in np.argsort(faults)[:_STARTS]]
    sound = [one for one in starts if look(one).sound]
    if not sound:
        return None
    design = min(sound, key=lambda one: look(one).away)
    member = profile_of(family, lobes, radius, jnp.asarray(design))
    named = dict(zip(keys, map(float, design), strict=True))
    return Likeness(family, named, departure(profile, member))


class _Seen(NamedTuple):
    """Comparison of a member of a family with a profile.

    `distance` (n,): signed distances between the flanks (pitch radii); `margin` (m,): margins
    relative to their scales; `distance_slope` (n, d), `margin_slope` (m, d): derivatives of both
    with respect to the design."""

    distance: NDArray[np.float64]
    margin: NDArray[np.float64]
    distance_slope: NDArray[np.float64]
    margin_slope: NDArray[np.float64]

    @property
    def finite(self) -> bool:
        """Whether all numbers in the fields are finite."""
        return all(np.all(np.isfinite(part)) for part in self)

    @property
    def sound(self) -> bool:
        """Whether the member is a sound profile."""
        return self.finite and bool(np.min(self.margin) >= -_UNSOUND)

    @property
    def fault(self) -> float:
        """Value that a search minimises: the greatest distance (pitch radii) plus a penalty.

        The penalty is `_UNSOUND_WEIGHT` times the magnitude of the least margin if that is
        negative, otherwise 0. The value is infinite if any number is not finite."""
        if not self.finite:
            return math.inf
        lacking = max(0.0, -float(np.min(self.margin)))
        return float(np.max(np.abs(self.distance))) + _UNSOUND_WEIGHT * lacking

    @property
    def away(self) -> float:
        """Greatest distance (pitch radii) between the flanks; infinite if the member is unsound."""
        return float(np.max(np.abs(self.distance))) if self.sound else math.inf


class _Look:
    """Compares members of a `family` with a `profile`, and caches the results.

    Call an instance with the member's design.
    """

    def __init__(self, profile: Profile, family: str):
        self.family, self.lobes, self.radius = family, profile.lobes, profile.pitch_radius
        self.target = _target(profile)

    @functools.lru_cache(maxsize=1024)  # noqa: B019
    def _at(self, design: tuple[float, ...]) -> _Seen:
        design_array = np.asarray(design, dtype=np.float64)
        found = _compared(self.family, self.lobes, self.radius, self.target, design_array)
        return _Seen(*map(np.asarray, found))

    def __call__(self, design) -> _Seen:
        return self._at(tuple(map(float, design)))


def _fitted(look: _Look, start, width) -> NDArray[np.float64]:
    """Return a design near `start` that locally minimises `_Seen.fault`.

    The search is a sequence of linear programs. Each finds the step that is best to first order
    within a trust region. `width` (d,): widths of the parameters' usual ranges.
    """
    design, size = start, _LONGEST
    for _ in range(_PROGRAMS):
        seen = look(design)
        if not seen.finite or size < _SHORTEST:
            break
        new = design + width * _promising(seen, width, size)
        if look(new).fault < seen.fault:
            design, size = new, min(2 * size, _LONGEST)
        else:
            size /= 4
    return design


def _promising(seen: _Seen, width, size: float) -> NDArray[np.float64]:
    """Return the step (d,), in units of `width`, that minimises the fault to first order.

    No entry of the step exceeds `size` in magnitude. The linear program minimises a bound on all
    distances plus a weighted bound on negative margins."""
    count, distances, soundness = len(width), len(seen.distance), len(seen.margin)
    by_step = np.concatenate([seen.distance_slope, -seen.distance_slope, -seen.margin_slope])
    one, none = np.ones((2 * distances, 1)), np.zeros((2 * distances, 1))
    bounds = np.block([[-one, none], [np.zeros((soundness, 1)), -np.ones((soundness, 1))]])
    found = linprog(
        np.concatenate([np.zeros(count), [1.0, _UNSOUND_WEIGHT]]),
        A_ub=np.hstack([by_step * width, bounds]),
        b_ub=np.concatenate([-seen.distance, seen.distance, seen.margin]),
        bounds=[(-size, size)] * count + [(0, None)] * 2,
    )
    return np.zeros(count) if found.x is None else found.x[:count]


@Program
def _target(profile: Profile):
    """Return (normal angles, points, outward unit normals) of the profile that is compared.

    The normal angles (n,) are in rad. The points (m) and the normals have shape (2, n, 2), with the
    addendum first and the dedendum second."""
    nu = profile.pitch_normal * jnp.linspace(0.0, 1.0, _NODES)
    points = [side(nu) for side in (profile.addendum, profile.dedendum)]
    places = jnp.stack([profile.position(point) for point in points])
    angles = jnp.stack([point.beta + jnp.pi / 2 - point.psi for point in points])
    return nu, places, jnp.stack([jnp.cos(angles), jnp.sin(angles)], axis=-1)


@Program
def _compared(family: str, lobes: int, radius: Float[Array, ""], target, design):
    """Return the fields of `_Seen` for a `design`: distances, margins and their derivatives.

    `family`, `lobes`, `radius`: family, number of lobes and pitch radius (m) of the member;
    `target`: result of `_target`.

    Distances are measured along the normals of the `target`, between points with the same normal
    angle on the addendum. To first order, these are the distances between the flanks."""
    nu, places, normals = target

    def both(design):
        profile = profile_of(family, lobes, radius, design)
        sides = [profile.position(side(nu)) for side in (profile.addendum, profile.dedendum)]
        away = jnp.sum((jnp.stack(sides) - places) * normals, axis=-1).ravel() / radius
        found = margins(profile)._asdict()
        scaled = [
            value / (1.0 if name in PURE else radius)
            for name, value in found.items()
            if name not in family_of(family).inherent
        ]
        values = away, jnp.stack(scaled)
        return values, values

    slopes, values = jax.jacfwd(both, has_aux=True)(design)
    return *values, *slopes
