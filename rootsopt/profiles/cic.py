"""CIC: circular arc, involute, circular arc."""

import equinox as eqx
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from rootsopt.profiles import trigonometry as trig
from rootsopt.profiles.base import Profile, Segment
from rootsopt.profiles.involute import LEAST, OVERLENGTH


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

    The involute is the paper's Eq. 2: ψ = α, s = ℓ cot α for -u ≤ ℓ ≤ u. One arc joins the tip
    land of half angle θ1 (Eq. 1) to the involute's end B, tangent to both. The arc's centre C lies
    on the ray θ1 at radius c = r cos α / cos(α - δ), with δ = β_u - θ1 and
    β_u = π/2N - u/(r sin α). The arc's radius is ρ = |B - C|. Hence (α, u, θ1) are independent, and
    the outer radius c + ρ follows from them. For u = `longest_involute` the arc is centred on the
    pitch circle (c = r), as in the textbook CIC.

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

    @property
    def single_turn(self) -> float:
        return 5e-3

    @property
    def cusp(self) -> bool:
        return False

    def lever_from(self, nu, cos, sin):
        # Like `lever`, with sin(ν - θ1) from the addition theorem.
        tip_cos, tip_sin = self.tip_direction
        arc = self.arc_center_radius * (sin * tip_cos - cos * tip_sin)
        beyond_land = jnp.where(nu > self.arc_end, self.base_radius, arc)
        return jnp.where(nu < self.tip_arc_angle, 0.0, beyond_land)
