"""Profile families by the names and units of the config: how they are made, and what is wrong."""

import math
from collections.abc import Callable

import jax.numpy as jnp
from jaxtyping import Array, Float

from rootsopt.config import FAMILY_KEYS, ProfileConfig
from rootsopt.errors import InputError
from rootsopt.outline.conjugacy import conjugacy
from rootsopt.profiles import CIC, EE, Outline, Profile, ellipse
from rootsopt.profiles.arc_families import arc, five_arcs, four_arcs
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
}


def unit_of(key: str) -> float:
    """SI value of one unit of a config key."""
    return DEG if key.endswith("_deg") else MM


def profile_of(
    family: str, lobes: int, pitch_radius: Float[Array, ""], design: Float[Array, " d"]
) -> Profile:
    """The profile of a `family` with a `design` in config units, `pitch_radius` in m."""
    keys = FAMILY_KEYS[family]
    values = [design[k] * unit_of(key) for k, key in enumerate(keys)]
    return _MAKERS[family](lobes, pitch_radius, *values)


def design_of(config: ProfileConfig) -> Float[Array, " d"]:
    """The design parameters of a config, in its units."""
    return jnp.asarray([getattr(config, key) for key in FAMILY_KEYS[config.family]], float)


def outline(config: ProfileConfig) -> Outline | None:
    """The profile of a config that has it in a file."""
    if config.family != "outline":
        return None
    from rootsopt.outline.source import outline_of  # Half a second, for outlines alone.

    return outline_of(config)[0]


def check(config: ProfileConfig) -> None:
    """Raise `InputError` unless the profile can be made and meshes."""
    if (given := outline(config)) is not None:
        conjugacy(given)
        return
    if config.family in ("cic", "arc_involute"):
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
                f"`profile.{key}` = {getattr(config, key):g}" for key in FAMILY_KEYS[config.family]
            )
            raise InputError(
                f"the profile of family {config.family} must be sound, but with {given} "
                f"{_FAULTS[name]}; {_REMEDIES[config.family]}"
            )


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
