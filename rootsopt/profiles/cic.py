"""CIC: circular arc, involute, circular arc."""

import math
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from rootsopt.config.units import DEG, hint
from rootsopt.errors import InputError
from rootsopt.profiles import base as trig
from rootsopt.profiles.base import Profile, Segment

if TYPE_CHECKING:
    from rootsopt.config.rotor import ProfileConfig

_ANGLE, _LENGTH, _TIP = "pressure_angle_deg", "involute_length_mm", "tip_arc_angle_deg"
OVERLENGTH = 0.02
"""Excess of the involute length u over u_max = `CIC.longest_involute` (fraction of u_max) above
which a config is rejected. Beyond u_max the roll angle turns back and two points of a flank mesh at
once. A node search finds no interference (< 1 nm) up to 5 % excess; the paper's printed Table 1 has
1.2 %."""
# Excess (pitch radii) of the involute length over its lower limit below which a config is rejected.
# At this limit, the centre of the tip arc lies on the pitch circle, and one of the arc's normals is
# tangent to the circle. With a shorter involute, some of these normals miss the circle: their
# points touch nothing on the other rotor.
_CLEAR = 1e-6
LEAST = 0.002
"""Involute length (fraction of the longest) below which a config is rejected. A shorter involute
has no effect, and its length was probably given in metres."""
# Undercut (mm) above which a config is rejected. A search may end at a design with less.
_TOUCHING = 1e-6
# Factor by which a search stays away from the lower limits of a config.
_INSIDE = 1 + 1e-6


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


def arc_involute(
    lobes: int,
    pitch_radius: Float[ArrayLike, ""],
    pressure_angle: Float[ArrayLike, ""],
    involute_length: Float[ArrayLike, ""],
) -> "CIC":
    """Return a CIC rotor without a tip land, whose addendum is an arc and an involute.

    `lobes`: number of lobes N; `pitch_radius`: r (m); `pressure_angle`: α (rad); `involute_length`:
    u (m). See `CIC`."""
    return CIC(lobes, pitch_radius, pressure_angle, involute_length, 0.0)


class CIC(Profile):
    """The CIC rotor: tip land, tip arc, involute, and their conjugates.

    The involute is the paper's Eq. 2: ψ = α, s = ℓ cot α for -u ≤ ℓ ≤ u. One arc joins the tip land
    of half angle θ1 (Eq. 1) to the involute's end B, tangent to both. The arc's centre C lies on
    the ray θ1 at radius c = r cos α / cos(α - δ). Here, δ = β_u - θ1 and β_u = π/2N - u/(r sin α).
    The arc's radius is ρ = |B - C|. Hence (α, u, θ1) are independent, and the outer radius c + ρ
    follows from them. For u = `longest_involute` the arc is centred on the pitch circle (c = r), as
    in the textbook CIC.

    `longest_involute`: u_max = r sin α (π/2N - θ1) (m); with a longer involute, the roll angle
    turns back.
    `base_radius`: r cos α (m). `involute_start`: β_u (rad). `arc_center_radius`: c (m).
    `arc_radius`: ρ (m). `arc_end`: normal angle (rad) at which the arc meets the involute.
    `involute_end`: normal angle (rad) at which the involute meets the pitch circle.
    `tip_direction`: cosine and sine of θ1.
    """

    lobes: int = eqx.field(static=True)
    pitch_radius: Float[Array, ""]
    pressure_angle: Float[Array, ""]
    involute_length: Float[Array, ""]
    tip_arc_angle: Float[Array, ""]
    longest_involute: Float[Array, ""]
    base_radius: Float[Array, ""]
    involute_start: Float[Array, ""]
    arc_center_radius: Float[Array, ""]
    arc_radius: Float[Array, ""]
    arc_end: Float[Array, ""]
    involute_end: Float[Array, ""]
    tip_direction: Float[Array, "2"]

    cusp = False
    single_turn = 5e-3

    def __init__(self, lobes, pitch_radius, pressure_angle, involute_length, tip_arc_angle):
        """Build the rotor.

        `lobes`: number of lobes N; `pitch_radius`: r (m); `pressure_angle`: α (rad);
        `involute_length`: u (m); `tip_arc_angle`: θ1 (rad), half the angle of the tip land."""
        self.lobes = lobes
        r = self.pitch_radius = jnp.asarray(pitch_radius)
        alpha = self.pressure_angle = jnp.asarray(pressure_angle)
        u = self.involute_length = jnp.asarray(involute_length)
        self.tip_arc_angle = jnp.asarray(tip_arc_angle)
        sin, cos = jnp.sin(alpha), jnp.cos(alpha)
        half = self.half_pitch
        self.longest_involute = r * sin * (half - self.tip_arc_angle)
        self.base_radius = r * cos
        self.involute_start = half - u / (r * sin)
        offset = self.involute_start - self.tip_arc_angle
        self.arc_center_radius = r * cos / jnp.cos(alpha - offset)
        self.arc_radius = u * cos / sin + r * jnp.sin(offset) / jnp.cos(alpha - offset)
        self.arc_end = self.involute_start + jnp.pi / 2 - alpha
        self.involute_end = half + jnp.pi / 2 - alpha
        tip = self.tip_arc_angle
        self.tip_direction = jnp.stack([jnp.cos(tip), jnp.sin(tip)])

    def segments(self) -> tuple[Segment, ...]:
        zero = jnp.zeros_like(self.tip_arc_angle)
        return (
            Segment("tip land", zero, self.tip_arc_angle, True),
            Segment("tip arc", self.tip_arc_angle, self.arc_end, False),
            Segment("involute", self.arc_end, self.involute_end, False),
        )

    def stretches(self) -> tuple[Segment, ...]:
        land, arc, involute = self.segments()
        # With a short involute, the arc's normals come nearest to the pitch circle inside the arc.
        return (land, *self._cut(arc, self.tip_arc_angle + jnp.pi / 2), involute)

    def _arc_slide(self, turn):
        """Return the signed distance (m) from pitch point to arc centre, along the normal.

        `turn`: normal angle (rad) measured from the arc's start."""
        c, r = self.arc_center_radius, self.pitch_radius
        return c * trig.cos(turn) - jnp.sqrt(r**2 - (c * trig.sin(turn)) ** 2)

    def _arc_turn(self, nu):
        """Return the angle (rad) from the arc's start to the normal angle `nu` (rad), clamped to
        the arc."""
        return jnp.clip(nu, self.tip_arc_angle, self.arc_end) - self.tip_arc_angle

    def roll_angle(self, nu):
        turn = self._arc_turn(nu)
        slide = self._arc_slide(turn)
        arc = self.tip_arc_angle + jnp.arctan2(
            -slide * trig.sin(turn), self.arc_center_radius - slide * trig.cos(turn)
        )
        involute = nu - jnp.pi / 2 + self.pressure_angle
        beyond_land = jnp.where(nu > self.arc_end, involute, arc)
        return jnp.where(nu < self.tip_arc_angle, nu, beyond_land)

    def normal_at(self, roll_angle):
        # The normals of the arc pass through its centre and the pitch point. With c ≥ r (u at
        # least the longest) the involute follows the land directly and the arc is skipped.
        involute = roll_angle >= self.involute_start
        on_arc = (roll_angle > self.tip_arc_angle) & ~involute
        # Off the arc, use any turn that keeps the pitch point away from the centre.
        turn = jnp.where(on_arc, roll_angle - self.tip_arc_angle, jnp.pi / 2)
        r, c = self.pitch_radius, self.arc_center_radius
        arc = self.tip_arc_angle + jnp.arctan2(r * trig.sin(turn), r * trig.cos(turn) - c)
        before_involute = jnp.where(on_arc, arc, roll_angle)
        return jnp.where(involute, roll_angle + jnp.pi / 2 - self.pressure_angle, before_involute)

    def contact_distance(self, nu):
        arc = self.arc_radius + self._arc_slide(self._arc_turn(nu))
        beta = nu - jnp.pi / 2 + self.pressure_angle
        involute = self.base_radius * (self.half_pitch - beta)
        return jnp.where(nu > self.arc_end, involute, arc)

    def lever(self, nu):
        # Normals of the land pass through the axis, those of the arc through its centre, and
        # those of the involute touch the base circle. No roll angle is needed.
        arc = self.arc_center_radius * trig.sin(self._arc_turn(nu))
        return jnp.where(nu > self.arc_end, self.base_radius, arc)

    def support(self, nu):
        turn = self._arc_turn(nu)
        arc = self.arc_center_radius * trig.cos(turn) + self.arc_radius
        beta = nu - jnp.pi / 2 + self.pressure_angle
        reach = self.pitch_radius * trig.sin(self.pressure_angle)
        involute = reach + self.base_radius * (self.half_pitch - beta)
        return jnp.where(nu > self.arc_end, involute, arc)

    def limit_margin(self):
        share = self.involute_length / self.longest_involute
        return jnp.minimum(share - LEAST, 1 + OVERLENGTH - share)

    @property
    def inflected(self) -> bool:
        return False

    @property
    def forked(self) -> bool:
        return False

    def lever_from(self, nu, cos, sin):
        # Like `lever`, with sin(ν - θ1) from the addition theorem.
        tip_cos, tip_sin = self.tip_direction
        arc = self.arc_center_radius * (sin * tip_cos - cos * tip_sin)
        beyond_land = jnp.where(nu > self.arc_end, self.base_radius, arc)
        return jnp.where(nu < self.tip_arc_angle, 0.0, beyond_land)
