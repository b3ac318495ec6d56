"""Closed-form limits of the involute's length, and the range in which a search varies it."""

import math
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from rootsopt.config.units import DEG, hint
from rootsopt.errors import InputError

if TYPE_CHECKING:
    from rootsopt.config.scene import ProfileConfig

_ANGLE, _LENGTH, _TIP = "pressure_angle_deg", "involute_length_mm", "tip_arc_angle_deg"
OVERLENGTH = 0.02
"""Excess of the involute length u over u_max = `CIC.longest_involute` (fraction of u_max) above
which a config is rejected. Beyond u_max the roll angle turns back and two points of a flank mesh at
once. A node search finds no interference (< 1 nm) up to 5 % excess; the paper's printed Table 1 has
1.2 %."""
_CLEAR = 1e-6
"""Excess (pitch radii) of the involute length over its lower limit below which a config is
rejected. At this limit, the centre of the tip arc lies on the pitch circle, and one of the arc's
normals is tangent to the circle. With a shorter involute, some of these normals miss the circle:
their points touch nothing on the other rotor."""
LEAST = 0.002
"""Involute length (fraction of the longest) below which a config is rejected. A shorter involute
has no effect, and its length was probably given in metres."""
_TOUCHING = 1e-6
"""Undercut (mm) up to which a config is accepted: a search may end at such a design."""
_INSIDE = 1 + 1e-6
"""Factor by which a search stays away from the lower limits of a config."""


def ranges(
    lobes: int,
    pitch_radius_mm: Float[Array, ""],
    pressure_angle_deg: Float[Array, ""],
    involute_length_mm: Float[Array, ""],
    tip_arc_angle_deg: Float[Array, ""] | float = 0.0,
) -> dict[str, tuple[Float[Array, ""], Float[Array, ""]]]:
    """Return {"involute_length_mm": (shortest, longest)}, the range (mm) that `check` accepts.

    The range follows from the number of lobes `lobes`, the pitch radius `pitch_radius_mm`, the
    pressure angle `pressure_angle_deg` and half the tip land's angle, `tip_arc_angle_deg`.
    `involute_length_mm` is not used. The longest involute is `CIC.longest_involute`, so that u ≤
    u_max holds by construction."""
    del involute_length_mm
    half = jnp.pi / (2 * lobes)
    base = pitch_radius_mm * jnp.sin(pressure_angle_deg * DEG)
    longest = base * (half - tip_arc_angle_deg * DEG)
    touching = longest - base * 2 * pressure_angle_deg * DEG + _CLEAR * pitch_radius_mm
    shortest = _INSIDE * jnp.maximum(LEAST * longest, touching)
    return {_LENGTH: (shortest, longest)}


def check(profile: "ProfileConfig") -> None:
    """Raise `InputError` if no valid CIC rotor has the dimensions of `profile`.

    The tip land may be too wide; the involute too short or too long; the radius of the tip arc not
    positive; or the dedendum undercut."""
    alpha: Any = getattr(profile, _ANGLE)
    length: Any = getattr(profile, _LENGTH)
    tip: Any = getattr(profile, _TIP, 0.0)
    radius, sine = profile.pitch_radius_mm, math.sin(alpha * DEG)
    half = 90.0 / profile.lobes
    if tip >= half:
        raise InputError(
            f"`profile.tip_arc_angle_deg` must be less than {half:g} (a quarter of the lobe "
            f"pitch) for {profile.lobes} lobes, but is {tip:g}"
        )
    longest = radius * sine * (half - tip) * DEG
    limit = longest * (1 + OVERLENGTH)
    if length < LEAST * longest:
        raise InputError(
            f"`profile.involute_length_mm` must be at least {LEAST * longest:.4g} "
            f"({LEAST:g} of the longest, {longest:.4g}), but is {length:g}"
            + hint("involute_length_mm", length, LEAST * longest, limit)
        )
    if length > limit:
        raise InputError(
            f"`profile.involute_length_mm` must be at most {longest:.4g} at "
            f"`profile.pressure_angle_deg` = {alpha:g} and `profile.tip_arc_angle_deg` = "
            f"{tip:g} (up to {limit:.4g} is tolerated), but is {length:g}: the roll angle would "
            "turn back; shorten it or raise the pressure angle"
        )
    # The tip arc's centre must lie inside the pitch circle, so that all its normals cross it.
    shortest = radius * sine * (half - tip - 2 * alpha) * DEG
    if length < shortest + _CLEAR * radius:
        raise InputError(
            f"`profile.involute_length_mm` must be at least {shortest + _CLEAR * radius:.4g} at "
            f"`profile.pressure_angle_deg` = {alpha:g} and `profile.tip_arc_angle_deg` = {tip:g}, "
            f"but is {length:g}: the tip arc would touch nothing on the other rotor; lengthen it, "
            "or raise the pressure angle or the tip arc"
        )
    # Beyond the longest involute the tip arc turns back; its radius decreases to 0.
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
    # On the dedendum, undercut starts at the conjugate of the involute's end.
    uncut = radius * sine * math.tan(alpha * DEG)
    if (uncut - length) / math.tan(alpha * DEG) < -_TOUCHING:
        raise InputError(
            f"`profile.involute_length_mm` must be at most {uncut:.4g} at "
            f"`profile.pressure_angle_deg` = {alpha:g}, but is {length:g}: the dedendum is "
            f"undercut (margin {(uncut - length) / math.tan(alpha * DEG):.3g} mm); shorten it "
            "or raise the pressure angle"
        )
