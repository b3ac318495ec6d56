"""Finds the member of a profile family that is nearest to a profile, and its distance.

A *member* of a family is a profile with some values of the family's parameters. A family is
*classical* if its profiles are made from single numbers, not from a list or a file.

The distance is that of the closed outlines (Hausdorff): the greatest distance of a point of either
outline from the other outline. A search minimises it by linear programs. Let d be the distance from
a point to the nearest point of an outline. By the envelope theorem, the derivative of d does not
depend on how the nearest point moves along the outline.

Rotors are often cut smaller than conjugate ones, to leave a clearance. If an outline's own mesh
shows such an *inset*, a constant distance along the normal, the search fits it as one more
parameter. Signed distances from an outline that is inset differ from those without by the inset.
"""

import functools
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import NDArray

from rootsopt.config.families import FREE_FORM, Parameter, family_of
from rootsopt.config.rotor import ProfileConfig, model_of
from rootsopt.config.units import DEG, MM
from rootsopt.errors import InputError
from rootsopt.measured.conjugacy import conjugacy
from rootsopt.profiles import Outline, Profile, project
from rootsopt.profiles.geometry import beyond, departures, feet, flank_points
from rootsopt.profiles.soundness import PURE, margins
from rootsopt.runtime.programs import CachedFunction
from rootsopt.scene.families import check, classical, profile_of
from rootsopt.scene.space import sobol

COEFFICIENTS = 12
"""Number of coefficients of a free form that is fitted to a profile."""
# Number of nodes per flank, on each side of the pitch circle, at which a search compares two
# outlines.
_NODES = 128
# Number of sampled members of a family. The searches start from the best of them.
_SAMPLE = 128
# Number of searches per family.
_STARTS = 3
# Limits of a search: number of linear programs after which the search ends; greatest step; step
# below which the search ends. Steps are fractions of the parameters' usual ranges.
_PROGRAMS, _LONGEST, _SHORTEST = 80, 0.2, 1e-9
# Relative decrease of the distance in one step below which a search ends.
_GAIN = 1e-7
# Weight of a negative margin in the function that a search minimises. The weight times the margin's
# magnitude (relative to its scale) is added to the distance (pitch radii).
_UNSOUND_WEIGHT = 10.0
# Magnitude of a negative margin (relative to its scale) above which a member counts as unsound.
_UNSOUND = 1e-6


# Greatest inset and range of usual insets (pitch radii).
_INSET, _INSET_USUAL = 0.05, 0.01


class Likeness(NamedTuple):
    """The member of a family that is nearest to a profile.

    `family`: name of the family; `design`: the member's parameters by key, in config units;
    `departure`: Hausdorff distance (m) between the outlines of the member and the profile; `rms`:
    root mean square of the distances (m) of the profile's points from the member; `inset`: distance
    (m) by which the member is first made smaller along its normals, 0 unless an outline shows an
    inset."""

    family: str
    design: dict[str, float]
    departure: float
    rms: float
    inset: float = 0.0

    def record(self) -> dict[str, Any]:
        """Return the fields as a dictionary for the result file, with the distances in µm."""
        return {
            "family": self.family,
            "design": self.design,
            "departure_um": self.departure * 1e6,
            "departure_rms_um": self.rms * 1e6,
            "inset_um": self.inset * 1e6,
        }

    def config(self, profile: ProfileConfig) -> ProfileConfig:
        """Return the config of the member, with lobes and pitch radius of `profile`.

        Raises `InputError` or `ValueError` if the member is not a valid design."""
        lobes, radius = profile.lobes, profile.pitch_radius_mm
        member = _unset(self.family, lobes, radius).with_design([*self.design.values()])
        return ProfileConfig.model_validate(
            {"family": self.family, "lobes": lobes, "pitch_radius_mm": radius, **member.parameters}
        )


def likenesses(profile: Profile) -> list[Likeness]:
    """Return the member of each classical family that is nearest to `profile`, nearest first.

    The nearest member minimises the Hausdorff distance between the outlines. The search starts from
    the best members of a Sobol sample, and may therefore miss a nearer member. Families in which
    the search finds no sound member are left out.
    """
    members = [likeness(profile, family) for family in classical()]
    return sorted((one for one in members if one is not None), key=lambda one: one.departure)


def likeness(profile: Profile, family: str) -> Likeness | None:
    """Return the member of a classical `family` that is nearest to `profile`.

    Return `None` if the search finds no sound member. The search is that of `likenesses`."""
    parameters, keys = family_of(family).parameters, family_of(family).keys
    look = _Look(profile, family)
    if not keys:
        return _best(look, profile, [_fitted(look, np.zeros(0), np.zeros(0))])
    size = float(profile.pitch_radius) / MM, profile.lobes
    low, high = np.array([parameter.usually(*size) for parameter in parameters]).T
    sample = low + (high - low) * sobol(_SAMPLE, 0, len(keys))
    faults = np.array([look(look.start(one)).fault for one in sample])
    designs = [_fitted(look, sample[k], high - low) for k in np.argsort(faults)[:_STARTS]]
    if not family_of(family).by_limits:
        return _best(look, profile, designs)
    # The closed-form limits also allow profiles with slightly negative margins.
    free = _Look(profile, family, limited=False)
    again = (_fitted(free, one[:-1], high - low, one[-1]) for one in designs)
    return _best(free, profile, [*designs, *again])


def free_likeness(profile: Profile, *near: Likeness, count: int = COEFFICIENTS) -> Likeness | None:
    """Return the free form of `count` coefficients that is nearest to `profile`.

    `near`: members of other families; searches also start from their projections. Return `None` if
    the searches find no sound free form."""
    radius, look = profile.pitch_radius, _Look(profile, FREE_FORM)
    parameters = family_of(FREE_FORM).parameters
    size = float(radius) / MM, profile.lobes
    usual = [parameter.usually(*size) for parameter in parameters]
    width = np.array([high - low for low, high in [usual[0], *[usual[1]] * count]])
    members = (
        profile_of(one.family, profile.lobes, radius, jnp.asarray([*one.design.values()]))
        for one in near
    )
    starts = []
    for one in (profile, *members):
        free = project(one, count)
        land = float(free.tip_arc_angle)
        if isinstance(one, Outline):
            land = float(one.seal_width / (2 * one.outer_radius))
        starts.append(np.array([land / DEG, *map(float, free.coefficients)]))
    return _best(look, profile, [_fitted(look, start, width) for start in starts])


def _best(look: "_Look", profile: Profile, designs) -> Likeness | None:
    """Return the nearest sound member among those with the given `designs`, each with its inset.

    Return `None` if all of them are unsound."""
    unset = _unset(look.family, profile.lobes, float(profile.pitch_radius) / MM)
    for design in sorted(designs, key=lambda one: look(one).away):
        if not look(design).sound:
            break
        design, inset = design[:-1], float(design[-1] * profile.pitch_radius)
        values = [*map(float, design)]
        named = dict(zip(unset.with_design(values).design_keys, values, strict=True))
        try:
            check(Likeness(look.family, named, 0.0, 0.0).config(unset))
        except (InputError, ValueError):
            continue
        member = profile_of(look.family, profile.lobes, profile.pitch_radius, jnp.asarray(design))
        departure = departures(profile, member, inset=inset)
        return Likeness(look.family, named, departure.greatest, departure.rms, inset)
    return None


def _unset(family: str, lobes: int, pitch_radius_mm: float) -> ProfileConfig:
    """Return the config of a profile of this size, without values of its design parameters."""
    return model_of(family_of(family)).model_construct(
        family=family, lobes=lobes, pitch_radius_mm=pitch_radius_mm
    )


class _Comparison(NamedTuple):
    """Comparison of a member of a family with a profile.

    `distance` (n,): signed distances between the outlines (pitch radii), from points of the profile
    and from points of the member; `margin` (m,): margins relative to their scales;
    `distance_slope` (n, d), `margin_slope` (m, d): derivatives of both with respect to the design.
    """

    distance: NDArray[np.float64]
    margin: NDArray[np.float64]
    distance_slope: NDArray[np.float64]
    margin_slope: NDArray[np.float64]

    @property
    def finite(self) -> bool:
        """Whether all numbers in the fields are finite."""
        return all(bool(np.all(np.isfinite(part))) for part in self)

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
        """Greatest distance (pitch radii) of the outlines; infinite if the member is unsound."""
        return float(np.max(np.abs(self.distance))) if self.sound else math.inf


class _Look:
    """Compares members of a `family` with a `profile`, and caches the results.

    Call an instance with the member's design (d,) in config units, followed by its inset (pitch
    radii). `limited`: whether margins are considered; otherwise, all count as zero. `inset`: first
    guess of the inset; 0 if there is none."""

    def __init__(self, profile: Profile, family: str, limited: bool = True):
        self.limited = limited
        self.family, self.lobes, self.radius = family, profile.lobes, profile.pitch_radius
        self.target = flank_points(profile, _NODES) / float(self.radius)
        self.around = beyond(self.target, profile.lobes)
        measured = isinstance(profile, Outline)
        self.inset = conjugacy(profile).inset / float(self.radius) if measured else 0.0

    def start(self, design, inset: float | None = None) -> NDArray[np.float64]:
        """Return a design with its `inset`, by default the first guess."""
        return np.append(design, self.inset if inset is None else inset)

    def limits(self, count: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the least and greatest value of `count` design parameters and of the inset."""
        radius = float(self.radius) / MM
        pairs = [_limits(one, radius) for one in family_of(self.family).parameters]
        pairs += pairs[-1:] * (count - len(pairs))
        free = _INSET if self.inset else 0.0
        low, high = np.array([*pairs, (-free, free)]).T
        return low, high

    @functools.lru_cache(maxsize=1024)  # noqa: B019
    def _at(self, design: tuple[float, ...]) -> _Comparison:
        values = np.asarray(design, dtype=np.float64)
        member = _member(self.family, self.lobes, self.radius, values)
        line, line_slope, margin, margin_slope = map(np.asarray, member)
        if not self.limited:
            margin, margin_slope = 0 * margin, 0 * margin_slope
        if not np.all(np.isfinite(line)):
            nothing = np.full(1, np.nan), np.full((1, len(values)), np.nan)
            return _Comparison(nothing[0], margin, nothing[1], margin_slope)
        # From the profile's points to the member. A nearest point moves along with its segment.
        near, near_slope = beyond(line, self.lobes), beyond(line_slope, self.lobes)
        to = feet(self.target, near, smooth=True)
        share = to.share[:, None, None]
        moved = (1 - share) * near_slope[to.segment] + share * near_slope[to.segment + 1]
        slope = -np.einsum("nk,nkd->nd", to.toward, moved)
        # From the member's points to the profile, with the same sign.
        back = feet(line, self.around, smooth=True)
        back_slope = -np.einsum("nk,nkd->nd", back.toward, line_slope)
        distance = np.concatenate([to.away, -back.away])
        return _Comparison(distance, margin, np.concatenate([slope, back_slope]), margin_slope)

    def __call__(self, design) -> _Comparison:
        *own, inset = map(float, design)
        seen = self._at(tuple(own))
        # Relative to the member reduced by the inset, all distances grow by the inset.
        slopes = (
            np.insert(slope, len(own), by, axis=1)
            for slope, by in ((seen.distance_slope, 1.0), (seen.margin_slope, 0.0))
        )
        return _Comparison(seen.distance + inset, seen.margin, *slopes)


def _limits(parameter: Parameter, radius_mm: float) -> tuple[float, float]:
    """Return the least and the greatest value of a parameter in a config.

    `radius_mm`: pitch radius (mm)."""
    low, high = parameter.limits(radius_mm) or (parameter.lowest, parameter.highest)
    low, high = max(low, parameter.lowest), min(high, parameter.highest)
    return low, high - 1e-9 * (high - low) if parameter.below else high


def _fitted(look: _Look, start, width, inset: float | None = None) -> NDArray[np.float64]:
    """Return a design near `start`, with its inset, that locally minimises `_Comparison.fault`.

    The search is a sequence of linear programs. Each finds the step that is best to first order
    within a trust region. `width` (d,): widths of the parameters' usual ranges; `inset`: first
    guess (pitch radii), by default that of the outline's mesh.
    """
    low, high = look.limits(len(start))
    if not np.any(high > low):
        return look.start(start)
    width = np.append(width, _INSET_USUAL)
    design, size = np.clip(look.start(start, inset), low, high), _LONGEST
    for _ in range(_PROGRAMS):
        seen = look(design)
        if not seen.finite or size < _SHORTEST:
            break
        room = (low - design) / width, (high - design) / width
        new = np.clip(design + width * _promising(seen, width, size, room), low, high)
        fault = look(new).fault
        if fault < seen.fault:
            if size <= 1e-4 and seen.fault - fault < _GAIN * seen.fault:
                return new
            design, size = new, min(2 * size, _LONGEST)
        else:
            size /= 4
    return design


def _promising(seen: _Comparison, width, size: float, room) -> NDArray[np.float64]:
    """Return the step (d,), in units of `width`, that minimises the fault to first order.

    No entry of the step exceeds `size` in magnitude, or leaves the range `room` (low, high), each
    (d,). The linear program minimises a bound on all distances plus a weighted bound on negative
    margins. Distances that cannot reach the bound within the step are left out."""
    from scipy.optimize import linprog  # Slow import (0.3 s).

    slope = seen.distance_slope * width
    rows = np.concatenate([slope, -slope])
    value = np.concatenate([seen.distance, -seen.distance])
    change = size * np.sum(np.abs(rows), axis=1)
    kept = value + change >= np.max(value - change)
    rows, value = rows[kept], value[kept]
    count, soundness = len(width), len(seen.margin)
    one, none = np.ones((len(rows), 1)), np.zeros((len(rows), 1))
    bounds = np.block([[-one, none], [np.zeros((soundness, 1)), -np.ones((soundness, 1))]])
    steps = [
        (max(-size, min(low, 0.0)), min(size, max(high, 0.0)))
        for low, high in zip(*room, strict=True)
    ]
    solution = linprog(
        np.concatenate([np.zeros(count), [1.0, _UNSOUND_WEIGHT]]),
        A_ub=np.hstack([np.concatenate([rows, -seen.margin_slope * width]), bounds]),
        b_ub=np.concatenate([-value, seen.margin]),
        bounds=[*steps, (0, None), (0, None)],
    )
    return np.zeros(count) if solution.x is None else solution.x[:count]


@CachedFunction
def _member(family: str, lobes: int, radius: Float[Array, ""], design):
    """Return (flank, its derivatives, margins, their derivatives) of a member of a `family`.

    `lobes`, `radius`: number of lobes and pitch radius (m); `design` (d,): in config units. The
    flank (n, 2) runs from tip to root, in pitch radii. The margins (m,) are relative to their
    scales. Derivatives are with respect to the design, along a last axis."""

    def both(design):
        profile = profile_of(family, lobes, radius, design)
        nu = profile.pitch_normal * jnp.linspace(0.0, 1.0, _NODES)
        upper, lower = (profile.position(f(nu)) for f in (profile.addendum, profile.dedendum))
        flank_margins = margins(profile).of_flank
        scaled = [
            value / (1.0 if name in PURE else radius)
            for name, value in flank_margins.items()
            if name not in family_of(family).inherent
        ]
        values = jnp.concatenate([upper, lower[::-1]]) / radius, jnp.stack(scaled)
        return values, values

    (line_slope, margin_slope), (line, margin) = jax.jacfwd(both, has_aux=True)(design)
    return line, line_slope, margin, margin_slope
