"""Which of the named families a profile resembles, and how far it departs from that."""

import functools
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import NDArray
from scipy.optimize import least_squares, minimize

from rootsopt.config import FAMILY_KEYS, LIST_KEYS
from rootsopt.families import MM, profile_of
from rootsopt.optimize.bounds import around
from rootsopt.optimize.problem import sobol
from rootsopt.profiles import Profile
from rootsopt.profiles.departure import departure
from rootsopt.profiles.validity import margins
from rootsopt.programs import Program

_NODES = 96
"""Nodes on either side of the pitch circle, in the search."""
_SAMPLE = 128
"""Members of a family that are tried; the best of them begin a search."""
_STARTS = 3
_UNSOUND = 1e-6
"""Negative margin, relative to its scale, with which a member of a family is none."""


class Likeness(NamedTuple):
    """The member of a `family` that is nearest to a profile: its `design` in config units, and the
    greatest distance (m) of the outlines."""

    family: str
    design: dict[str, float]
    departure: float

    def record(self) -> dict[str, Any]:
        """The record of the result file."""
        return {
            "family": self.family,
            "design": self.design,
            "departure_um": self.departure * 1e6,
        }


def likenesses(profile: Profile) -> list[Likeness]:
    """The nearest member of every family with parameters of its own to `profile`, nearest first.

    Nearest is where the greatest distance of the outlines is least, looked for from the best of a
    Sobol sample: a nearer member may be left unfound. Families without a sound one are left out.
    """
    found = []
    for family, keys in FAMILY_KEYS.items():
        if not any(key in LIST_KEYS for key in keys):
            likeness = _nearest(profile, family, keys)
            if likeness is not None:
                found.append(likeness)
    return sorted(found, key=lambda one: one.departure)


def _nearest(profile: Profile, family: str, keys: tuple[str, ...]) -> Likeness | None:
    lobes, radius = profile.lobes, profile.pitch_radius
    look = _Look(profile, family)
    if not keys:
        starts = [np.zeros(0)]
    else:
        low, high = np.array([around(key, float(radius) / MM, lobes) for key in keys]).T
        sample = low + (high - low) * sobol(_SAMPLE, 0, len(keys))
        away = np.array([look(one).away for one in sample])
        starts = [_fitted(look, sample[k], high - low) for k in np.argsort(away)[:_STARTS]]
    sound = [one for one in starts if look(one).sound]
    if not sound:
        return None
    design = min(sound, key=lambda one: look(one).away)
    member = profile_of(family, lobes, radius, jnp.asarray(design))
    named = dict(zip(keys, map(float, design), strict=True))
    return Likeness(family, named, departure(profile, member))


class _Seen(NamedTuple):
    """Distances (n,) of a member's outline, in pitch radii, its margins (m,) relative to their
    scales, and the derivatives of both by the design."""

    distance: NDArray[np.float64]
    margin: NDArray[np.float64]
    distance_slope: NDArray[np.float64]
    margin_slope: NDArray[np.float64]

    @property
    def finite(self) -> bool:
        return all(np.all(np.isfinite(part)) for part in self)

    @property
    def sound(self) -> bool:
        return self.finite and bool(np.min(self.margin) >= -_UNSOUND)

    @property
    def away(self) -> float:
        """Greatest distance; of what is not sound, beyond every other."""
        return float(np.max(np.abs(self.distance))) if self.sound else math.inf


class _Look:
    """Members of a `family` as seen from a `profile`."""

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
    """The design near `start` with the least greatest distance: from that of the least squares, by
    sequential quadratic programs in the design and a bound on all distances."""
    if not look(start).finite:
        return start

    def at(x):
        # Where a member cannot be made, it is far away.
        seen = look(start + width * x)
        return seen if seen.finite else look(start)._replace(distance=np.full(2 * _NODES, 10.0))

    squares = least_squares(
        lambda x: at(x).distance, np.zeros(len(start)), lambda x: at(x).distance_slope * width
    )
    begin = np.append(squares.x, np.max(np.abs(at(squares.x).distance)))

    def spare(z):
        seen = at(z[:-1])
        return np.concatenate([z[-1] - seen.distance, z[-1] + seen.distance, seen.margin])

    def spare_slope(z):
        seen = at(z[:-1])
        by_design = [-seen.distance_slope, seen.distance_slope, seen.margin_slope]
        ones = np.ones(2 * len(seen.distance))
        by_bound = np.append(ones, np.zeros(len(seen.margin)))
        return np.column_stack([np.concatenate(by_design) * width, by_bound])

    bound = minimize(
        lambda z: z[-1],
        begin,
        jac=lambda z: np.eye(len(z))[-1],
        method="SLSQP",
        constraints={"type": "ineq", "fun": spare, "jac": spare_slope},
        options={"ftol": 1e-12, "maxiter": 60},
    )
    ends = [start + width * x for x in (squares.x, bound.x[:-1], np.zeros(len(start)))]
    return min(ends, key=lambda one: look(one).away)


@Program
def _target(profile: Profile):
    """Normal angles (n,), and of addendum and dedendum points (m) and outward normals there,
    (2, n, 2) each."""
    nu = profile.pitch_normal * jnp.linspace(0.0, 1.0, _NODES)
    points = [side(nu) for side in (profile.addendum, profile.dedendum)]
    places = jnp.stack([profile.position(point) for point in points])
    angles = jnp.stack([point.beta + jnp.pi / 2 - point.psi for point in points])
    return nu, places, jnp.stack([jnp.cos(angles), jnp.sin(angles)], axis=-1)


@Program
def _compared(family: str, lobes: int, radius: Float[Array, ""], target, design):
    """Distances along the normals of the `target` at equal normal angles of the addendum, which
    are distances of the outlines but for what is of second order; margins; slopes of both."""
    nu, places, normals = target

    def both(design):
        profile = profile_of(family, lobes, radius, design)
        sides = [profile.position(side(nu)) for side in (profile.addendum, profile.dedendum)]
        away = jnp.sum((jnp.stack(sides) - places) * normals, axis=-1).ravel() / radius
        found = margins(profile)._asdict()
        scaled = [v / (1.0 if k in ("turning", "rolling") else radius) for k, v in found.items()]
        values = away, jnp.stack(scaled)
        return values, values

    slopes, values = jax.jacfwd(both, has_aux=True)(design)
    return *values, *slopes
