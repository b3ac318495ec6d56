"""Profile families by the names and units of the config: how they are made, and what is wrong."""

import math
from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from rootsopt.config import FAMILY_KEYS, LIST_KEYS, ProfileConfig
from rootsopt.errors import InputError
from rootsopt.profiles import CIC, EE, FreeForm, Profile, ellipse, project
from rootsopt.profiles.arc_families import arc, five_arcs, four_arcs
from rootsopt.profiles.departure import departure
from rootsopt.profiles.validity import margins

MM = 1e-3
DEG = math.pi / 180
_OVERLENGTH = 0.02
"""How far u may exceed u_max, relative. Past u_max the roll angle turns back and two
points of a flank mesh at once. Node search finds no interference (< 1 nm) up to 5 % over;
the paper's printed Table 1 is 1.2 % over."""
_CLEAR = 1e-6
"""Least involute beyond that at which the tip arc is centred on the pitch circle a second time, in
pitch radii."""
_ROUNDING = 1e-9
"""Margin relative to its scale that counts as 0."""

_MAKERS: dict[str, Callable[..., Profile]] = {
    "cic": CIC,
    "ee": EE,
    "arc": arc,
    "arc_involute": lambda lobes, r, angle, length: CIC(lobes, r, angle, length, 0.0),
    "four_arcs": four_arcs,
    "five_arcs": five_arcs,
    "ellipse": ellipse,
    "free_form": FreeForm,
}
BY_LIMITS = ("cic", "arc_involute")
"""Families whose soundness is known from limits of their parameters; that of the others is by
margins."""


def unit_of(key: str) -> float:
    """SI value of one unit of a config key."""
    if key in LIST_KEYS:
        return 1.0
    return DEG if key.endswith("_deg") else MM


def profile_of(
    family: str, lobes: int, pitch_radius: Float[Array, ""], design: Float[Array, " d"]
) -> Profile:
    """The profile of a `family` with a `design` in config units, `pitch_radius` in m."""
    values: list[Float[Array, "*n"]] = []
    for k, key in enumerate(FAMILY_KEYS[family]):
        value = design[k:] if key in LIST_KEYS else design[k]
        values.append(value * unit_of(key))
    return _MAKERS[family](lobes, pitch_radius, *values)


def keys_of(config: ProfileConfig) -> tuple[str, ...]:
    """Names of the design parameters of a config: its keys, those of a list numbered from 1."""
    names: list[str] = []
    for key in FAMILY_KEYS[config.family]:
        value = getattr(config, key)
        numbers = range(1, 1 + len(value)) if key in LIST_KEYS else ()
        names += [f"{key}_{number}" for number in numbers] or [key]
    return tuple(names)


def design_of(config: ProfileConfig) -> Float[Array, " d"]:
    """The design parameters of a config, in its units."""
    values = [getattr(config, key) for key in FAMILY_KEYS[config.family]]
    return jnp.asarray(np.hstack([*values, ()]), float)


def with_design(config: ProfileConfig, design: ArrayLike) -> ProfileConfig:
    """A config's profile with another `design` (d,) in its units, as many as it has."""
    given = [float(value) for value in np.asarray(design)]
    values: dict[str, float | tuple[float, ...]] = {}
    for k, key in enumerate(FAMILY_KEYS[config.family]):
        values[key] = tuple(given[k:]) if key in LIST_KEYS else given[k]
    return config.model_copy(update=values)


def free_form_of(config: ProfileConfig, count: int) -> tuple[ProfileConfig, float]:
    """A config's profile as a free form of `count` coefficients, and how far (m) that departs from
    it at most."""
    radius = jnp.asarray(config.pitch_radius_mm * MM)
    profile = profile_of(config.family, config.lobes, radius, design_of(config))
    found = project(profile, count)
    # Decimals enough for a hundredth of a micrometre.
    result = ProfileConfig(
        family="free_form",
        lobes=config.lobes,
        pitch_radius_mm=config.pitch_radius_mm,
        tip_arc_angle_deg=round(float(found.tip_arc_angle) / DEG, 9),
        coefficients=tuple(round(float(c), 6) for c in found.coefficients),
    )
    written = profile_of("free_form", config.lobes, radius, design_of(result))
    return result, departure(profile, written)


def check(config: ProfileConfig) -> None:
    """Raise `InputError` unless the profile can be made and meshes."""
    if config.family in BY_LIMITS:
        _check_involute(config)
        return
    profile = profile_of(
        config.family, config.lobes, jnp.asarray(config.pitch_radius_mm * MM), design_of(config)
    )
    found = margins(profile)
    size = {"turning": 1.0, "rolling": 1.0}
    for name, value in found._asdict().items():
        least = _ROUNDING * size.get(name, config.pitch_radius_mm * MM)
        if not float(value) >= -least:
            given = ", ".join(
                f"`profile.{key}` = {_written(getattr(config, key))}"
                for key in FAMILY_KEYS[config.family]
            )
            raise InputError(
                f"the profile of family {config.family} must be sound, but with {given} "
                f"{_FAULTS[name]}; {_REMEDIES[config.family]}"
            )


def _written(value: float | tuple[float, ...]) -> str:
    return f"{[*value]}" if isinstance(value, tuple) else f"{value:g}"


_FAULTS = {
    "turning": "an arc would end before it begins",
    "convexity": "the addendum is not convex",
    "reach": "some normals of the addendum miss the pitch circle: it would touch nothing there",
    "rolling": "two points of a flank would mesh at once",
    "undercut": "the dedendum is undercut",
    "star": "the outline folds back, seen from the axis",
    "root": "the root lies beyond the axis",
}
_REMEDIES = {
    "arc": "move the centre: it must lie inside the pitch circle, and too far out undercuts",
    "four_arcs": "move the tip arc's centre inwards, or change where it ends or its radius",
    "five_arcs": "lower the outer radius, or change the tip arc's radius or where it ends",
    "ellipse": "move the centre, or change the height",
    "free_form": "change the coefficients, or begin with `rootsopt profile --project`",
}


def _check_involute(profile_config: ProfileConfig) -> None:
    alpha = profile_config.pressure_angle_deg
    length = profile_config.involute_length_mm
    tip = profile_config.tip_arc_angle_deg or 0.0
    assert alpha is not None
    assert length is not None
    half = 90.0 / profile_config.lobes
    if tip >= half:
        raise InputError(
            f"`profile.tip_arc_angle_deg` must be less than {half:g} (a quarter of the lobe "
            f"pitch) for {profile_config.lobes} lobes, but is {tip:g}"
        )
    longest = profile_config.pitch_radius_mm * math.sin(alpha * DEG) * (half - tip) * DEG
    limit = longest * (1 + _OVERLENGTH)
    if length > limit:
        raise InputError(
            f"`profile.involute_length_mm` must be at most {longest:.4g} at "
            f"`profile.pressure_angle_deg` = {alpha:g} and `profile.tip_arc_angle_deg` = "
            f"{tip:g} (up to {limit:.4g} is tolerated), but is {length:g}: the roll angle would "
            "turn back; shorten it or raise the pressure angle"
        )
    radius, sine = profile_config.pitch_radius_mm, math.sin(alpha * DEG)
    # The tip arc's centre must lie inside the pitch circle, which all its normals cross.
    shortest = radius * sine * (half - tip - 2 * alpha) * DEG
    if length < shortest + _CLEAR * radius:
        raise InputError(
            f"`profile.involute_length_mm` must be at least {shortest + _CLEAR * radius:.4g} at "
            f"`profile.pressure_angle_deg` = {alpha:g} and `profile.tip_arc_angle_deg` = {tip:g}, "
            f"but is {length:g}: the tip arc would touch nothing on the other rotor; lengthen it, "
            "or raise the pressure angle or the tip arc"
        )
    # On the dedendum the involute's end is the first to be undercut.
    uncut = radius * sine * math.tan(alpha * DEG)
    if length > uncut * (1 + 1e-9):
        raise InputError(
            f"`profile.involute_length_mm` must be at most {uncut:.4g} at "
            f"`profile.pressure_angle_deg` = {alpha:g}, but is {length:g}: the dedendum is "
            f"undercut (margin {(uncut - length) / math.tan(alpha * DEG):.3g} mm); shorten it "
            "or raise the pressure angle"
        )
