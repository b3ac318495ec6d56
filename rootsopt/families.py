"""Profile families by the names and units of the config: how they are made, and what is wrong."""

import math
from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from rootsopt.config import FAMILY_KEYS, LIST_KEYS, ProfileConfig, hint
from rootsopt.config.words import shown
from rootsopt.errors import InputError
from rootsopt.outline.conjugacy import conjugacy
from rootsopt.profiles import (
    CIC,
    EE,
    FreeForm,
    Outline,
    Profile,
    arc,
    arcs_epicycloid,
    circle_epicycloid,
    ellipse,
    extended_cycloid,
    five_arcs,
    four_arcs,
    hypo_epicycloid,
    project,
)
from rootsopt.profiles.departure import departure
from rootsopt.profiles.validity import PURE, margins
from rootsopt.programs import Program

MM = 1e-3
DEG = math.pi / 180
_OVERLENGTH = 0.02
"""How far u may exceed u_max, relative. Past u_max the roll angle turns back and two
points of a flank mesh at once. Node search finds no interference (< 1 nm) up to 5 % over;
the paper's printed Table 1 is 1.2 % over."""
_CLEAR = 1e-6
"""Least involute beyond that at which the tip arc is centred on the pitch circle a second time, in
pitch radii."""
_LEAST_INVOLUTE = 0.002
"""Least involute in units of the longest: less makes no difference, and is a length in metres."""
_ROUNDING = 1e-9
"""Margin relative to its scale that counts as 0."""

_MAKERS: dict[str, Callable[..., Profile]] = {
    "cic": CIC,
    "ee": EE,
    "arc": arc,
    "arcs_epicycloid": arcs_epicycloid,
    "arc_involute": lambda lobes, r, angle, length: CIC(lobes, r, angle, length, 0.0),
    "four_arcs": four_arcs,
    "five_arcs": five_arcs,
    "circle_epicycloid": circle_epicycloid,
    "hypo_epicycloid": hypo_epicycloid,
    "extended_cycloid": extended_cycloid,
    "ellipse": ellipse,
    "free_form": FreeForm,
}
CLASSICAL = tuple(family for family in _MAKERS if not {*FAMILY_KEYS[family]} & {*LIST_KEYS})
"""Families made from a few parameters."""
BY_LIMITS = ("cic", "arc_involute")
"""Families whose soundness is known from limits of their parameters; that of the others is by
margins."""


def unit_of(key: str) -> float:
    """SI value of one unit of a config key."""
    if key.endswith("_deg"):
        return DEG
    return MM if key.endswith("_mm") else 1.0


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
    it at most. Raises `InputError` for an outline from a file."""
    if config.family == "outline":
        raise InputError(
            "`profile.family` must be that of a design to be projected onto a free form, but is "
            "outline: its dedendum need not be the mate of its addendum, as that of a free form "
            "is; name the family the rotor was made to"
        )
    radius = jnp.asarray(config.pitch_radius_mm * MM)
    profile = profile_of(config.family, config.lobes, radius, design_of(config))
    found = project(profile, count)
    # Decimals enough for a hundredth of a micrometre.
    result = ProfileConfig.model_validate(
        {
            "family": "free_form",
            "lobes": config.lobes,
            "pitch_radius_mm": config.pitch_radius_mm,
            "tip_arc_angle_deg": round(float(found.tip_arc_angle) / DEG, 9),
            "coefficients": tuple(round(float(c), 6) for c in found.coefficients),
        }
    )
    written = profile_of("free_form", config.lobes, radius, design_of(result))
    return result, departure(profile, written)


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
    if config.family in BY_LIMITS:
        _check_involute(config)
        return
    if config.family == "arcs_epicycloid":
        _check_edge(config)
    radius = jnp.asarray(config.pitch_radius_mm * MM)
    found = _margins(config.family, config.lobes, radius, design_of(config))
    for name, value in found._asdict().items():
        if (config.family, name) in INHERENT:
            continue
        scale = 1.0 if name in PURE else config.pitch_radius_mm * MM
        if not float(value) >= -_ROUNDING * scale:
            given = ", ".join(
                f"`profile.{key}` = {_written(getattr(config, key))}"
                for key in FAMILY_KEYS[config.family]
            )
            raise InputError(
                f"the profile of family {config.family} must be sound, but with {given} "
                f"{_FAULTS[name]}; {_REMEDIES[config.family]}"
            )


def margins_of(config: ProfileConfig) -> dict[str, float]:
    """The margins of a config's profile by name and unit, for the result file; none for an outline
    from a file."""
    if config.family == "outline":
        return {}
    radius = jnp.asarray(config.pitch_radius_mm * MM)
    found = _margins(config.family, config.lobes, radius, design_of(config))._asdict()
    units = {"turning": ("_deg", DEG), "order": ("_deg", DEG), "rolling": ("", 1.0)}
    record = {}
    for name, value in found.items():
        suffix, unit = units.get(name, ("_mm", MM))
        record[name + suffix] = float(value) / unit
    return record


@Program
def _margins(family, lobes, pitch_radius, design):
    """Margins of the profile of a design in config units."""
    return margins(profile_of(family, lobes, pitch_radius, design))


INHERENT = {("arcs_epicycloid", "rolling")}
"""What belongs to a family: an edge outside of the pitch circle meshes twice."""
_SHARPEST = 0.002
"""Least radius of an edge in pitch radii: less is a corner, along which the outline's and the
contact's nodes fall together."""


def _written(value: float | tuple[float, ...]) -> str:
    if isinstance(value, tuple):
        return shown([float(f"{number:.6g}") for number in value])
    return f"{value:g}"


_FAULTS = {
    "turning": "a part of it would end before it begins, or miss the pitch crossing",
    "convexity": "the addendum is not convex",
    "reach": "some normals of the addendum miss the pitch circle: it would touch nothing there",
    "fall": "the tip is no tip: the outline rises again behind it",
    "rolling": "two points of a flank would mesh at once",
    "order": "a flank would touch before the tip of its lobe has come to the line of centres",
    "undercut": "the dedendum is undercut",
    "star": "the outline folds back, seen from the axis",
    "root": "the root lies beyond the axis",
}
_REMEDIES = {
    "arc": "move the centre: it must lie inside the pitch circle, and too far out undercuts",
    "arcs_epicycloid": "widen the land, move the arc's centre inwards, or round the edge more (an "
    "edge is sharper than its arc)",
    "four_arcs": "move the tip arc's centre inwards, or change where it ends or its radius",
    "five_arcs": "lower the outer radius, or change the tip arc's radius or where it ends",
    "circle_epicycloid": "let the tip arc end further from the tip, or change the rolling radius",
    "hypo_epicycloid": "make the tip arc angle less than 90° / lobes",
    "extended_cycloid": "bring the trochoid ratio closer to 1",
    "ellipse": "move the centre, or change the height",
    "free_form": "change the coefficients, or begin with `rootsopt profile --project`",
}


def _check_edge(config: ProfileConfig) -> None:
    edge, least = config.edge_radius_mm, _SHARPEST * config.pitch_radius_mm
    assert edge is not None
    if edge < least:
        raise InputError(
            f"`profile.edge_radius_mm` must be at least {least:g} ({_SHARPEST:g} pitch radii), but "
            f"is {edge:g}: a sharp edge has no contact law; round it"
            + hint("edge_radius_mm", edge, 0.01 * config.pitch_radius_mm, config.pitch_radius_mm)
        )


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
    if length < _LEAST_INVOLUTE * longest:
        raise InputError(
            f"`profile.involute_length_mm` must be at least {_LEAST_INVOLUTE * longest:.4g} "
            f"({_LEAST_INVOLUTE:g} of the longest, {longest:.4g}), but is {length:g}"
            + hint("involute_length_mm", length, _LEAST_INVOLUTE * longest, limit)
        )
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
    # Beyond the longest involute the tip arc turns back, until nothing is left of its radius.
    turn = (half - tip) * DEG - length / (radius * sine)
    across = math.cos(alpha * DEG - turn)
    rho = length / math.tan(alpha * DEG) + radius * math.sin(turn) / across if across > 0 else 0.0
    if rho <= 0:
        raise InputError(
            f"`profile.involute_length_mm` must be less than {longest:.4g} at "
            f"`profile.pressure_angle_deg` = {alpha:g} and `profile.tip_arc_angle_deg` = {tip:g}, "
            f"but is {length:g}: the tip arc would have no radius; shorten it or lower the "
            "pressure angle"
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
