"""EE (epicycloid addendum, hypocycloid dedendum), and epicycloids with a circular tip."""

import equinox as eqx
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from rootsopt.profiles import base as trig
from rootsopt.profiles.base import Profile, Segment


class EE(Profile):
    """The EE rotor: rolling radius r/2N, ψ = N |π/2N - β|, s = (r/N) sin(N(π/2N - β)).

    These are the paper's Eqs. 7 and 8 with two misprints corrected: sine and cosine of Eq. 7 are
    swapped, and the undefined τ of Eq. 8 is γ.

    `lobes`: number of lobes N; `pitch_radius`: r (m), the only parameter of the shape.
    """

    lobes: int = eqx.field(static=True)
    pitch_radius: Float[Array, ""] = eqx.field(converter=jnp.asarray)

    single_turn = 5e-3

    def segments(self) -> tuple[Segment, ...]:
        zero = jnp.zeros_like(self.pitch_radius)
        stop = zero + (1 + self.lobes) * self.half_pitch
        return (Segment("epicycloid", zero, stop, False),)

    def roll_angle(self, nu):
        return nu / (1 + self.lobes)

    def normal_at(self, roll_angle):
        return roll_angle * (1 + self.lobes)

    def contact_distance(self, nu):
        beyond_pitch = self.lobes * (self.half_pitch - self.roll_angle(nu))
        return self.pitch_radius / self.lobes * trig.sin(beyond_pitch)

    @property
    def turn_ratio(self) -> float:
        return self.lobes / (1 + self.lobes)

    def lever_from(self, nu, cos, sin):
        # ψ = π/2 - κν.
        return self.pitch_radius * sin


class TippedEpicycloid(Profile):
    """An epicycloid from the pitch crossing to a joint, and a circular arc over the tip.

    On the epicycloid of rolling radius r_e, the pressure angle is ψ = κ (π/2N - β) with
    κ = r / 2 r_e. There, s = 2 r_e sin ψ, so that ds/dβ = -r cos ψ. Its conjugate is the
    hypocycloid of the same circle. EE is the case r_e = r / 2N, in which ψ reaches π/2 on the
    lobe's axis. The tip arc is tangent to the epicycloid at the joint, and its centre C lies on the
    lobe's axis. If ν and ψ are normal and pressure angle at the joint, C lies at the distance
    c = r cos ψ / sin ν from the rotor's axis. No epicycloid with r_e < r is undercut: the arc
    length of its conjugate per ν is 4 r_e (r - r_e) sin ψ / (r + 2 r_e). These formulas are
    derived here, because no source was available.

    `rolling_radius`: r_e (m). `joint`: normal angle (rad) at which the tip arc ends.
    `arc_center_radius`: c (m). `arc_radius`: radius of the tip arc (m). `land`: whether the arc is
    centred on the rotor's axis (c = 0). `lobes`: number of lobes N; `pitch_radius`: r (m).
    """

    lobes: int = eqx.field(static=True)
    land: bool = eqx.field(static=True)
    pitch_radius: Float[Array, ""]
    rolling_radius: Float[Array, ""]
    joint: Float[Array, ""]
    arc_center_radius: Float[Array, ""]
    arc_radius: Float[Array, ""]

    def __init__(self, lobes, pitch_radius, rolling_radius, joint, land=False):
        """Build the rotor.

        `lobes`: number of lobes N; `pitch_radius`: r (m); `rolling_radius`: r_e (m); `joint`:
        normal angle (rad) at which the tip arc ends; `land`: whether the tip arc is a land."""
        self.lobes, self.land = lobes, land
        r = self.pitch_radius = jnp.asarray(pitch_radius)
        self.rolling_radius = jnp.asarray(rolling_radius)
        joint = self.joint = jnp.asarray(joint)
        lever, support = self._lever(joint), self._support(joint)
        if land:
            self.arc_center_radius, self.arc_radius = jnp.zeros_like(r), support
        else:
            self.arc_center_radius = lever / jnp.sin(joint)
            self.arc_radius = support - lever / jnp.tan(joint)

    def segments(self) -> tuple[Segment, ...]:
        zero, stop = jnp.zeros_like(self.joint), jnp.zeros_like(self.joint) + self._stop
        return (
            Segment("tip land" if self.land else "tip arc", zero, self.joint, self.land),
            Segment("epicycloid", self.joint, stop, False),
        )

    def stretches(self) -> tuple[Segment, ...]:
        arc, epicycloid = self.segments()
        return (*self._cut(arc, jnp.asarray(jnp.pi / 2)), epicycloid)

    @property
    def _stop(self):
        return self.half_pitch + jnp.pi / 2

    def _psi(self, nu):
        """Return ψ (rad) on the epicycloid at the normal angle `nu` (rad)."""
        r, rolling = self.pitch_radius, self.rolling_radius
        return (self._stop - nu) * r / (r + 2 * rolling)

    def _lever(self, nu):
        return self.pitch_radius * trig.cos(self._psi(nu))

    def _support(self, nu):
        return (self.pitch_radius + 2 * self.rolling_radius) * trig.sin(self._psi(nu))

    def _on_arc(self, nu):
        """Return (whether the normal angle `nu` is on the arc, `nu` on the arc and 0 elsewhere)."""
        on_arc = nu < self.joint
        return on_arc, jnp.where(on_arc, nu, 0.0)

    def _tilt(self, nu):
        """Return ν - β (rad) on the tip arc at the normal angle `nu` (rad)."""
        return jnp.arcsin(self.arc_center_radius * trig.sin(nu) / self.pitch_radius)

    def roll_angle(self, nu):
        on_arc, here = self._on_arc(nu)
        epicycloid = nu - jnp.pi / 2 + self._psi(nu)
        return jnp.where(on_arc, here - self._tilt(here), epicycloid)

    def contact_distance(self, nu):
        on_arc, here = self._on_arc(nu)
        c, r = self.arc_center_radius, self.pitch_radius
        arc = self.arc_radius + c * trig.cos(here) - r * trig.cos(self._tilt(here))
        return jnp.where(on_arc, arc, 2 * self.rolling_radius * trig.sin(self._psi(nu)))

    def lever(self, nu):
        arc = self.arc_center_radius * trig.sin(nu)
        return jnp.where(nu < self.joint, arc, self._lever(nu))

    def support(self, nu):
        arc = self.arc_radius + self.arc_center_radius * trig.cos(nu)
        return jnp.where(nu < self.joint, arc, self._support(nu))

    def normal_at(self, roll_angle):
        r, rolling, c = self.pitch_radius, self.rolling_radius, self.arc_center_radius
        begin = self.joint - jnp.pi / 2 + self._psi(self.joint)
        psi = (self.half_pitch - roll_angle) * r / (2 * rolling)
        on_arc = roll_angle < begin
        turn = jnp.where(on_arc, roll_angle, jnp.pi / 2)
        arc = jnp.arctan2(r * jnp.sin(turn), r * jnp.cos(turn) - c)
        return jnp.where(on_arc, arc, roll_angle + jnp.pi / 2 - psi)


def circle_epicycloid(
    lobes: int,
    pitch_radius: Float[ArrayLike, ""],
    rolling_radius: Float[ArrayLike, ""],
    tip_arc_turn: Float[ArrayLike, ""],
) -> TippedEpicycloid:
    """Return a profile with a tip arc centred on the lobe's axis, followed by an epicycloid.

    `lobes`: number of lobes N; `pitch_radius`: r (m); `rolling_radius`: r_e of the epicycloid (m);
    `tip_arc_turn`: normal angle ν (rad) at which the arc ends. For ν = π/2 - π r / (4 N r_e), the
    arc is centred on the pitch circle (roll angle β = 0 at its end). The whole arc then meshes at
    one instant."""
    return TippedEpicycloid(lobes, pitch_radius, rolling_radius, tip_arc_turn)


def hypo_epicycloid(
    lobes: int, pitch_radius: Float[ArrayLike, ""], tip_arc_angle: Float[ArrayLike, ""]
) -> TippedEpicycloid:
    """Return a flank of half an epicycloid arch and half a hypocycloid arch, between lands.

    One land is at the tip, the other at the root.

    `lobes`: number of lobes N; `pitch_radius`: r (m). The land at the tip has the half angle
    `tip_arc_angle` θ1 (rad). Identical rotors need the same rolling circle for both arches. ψ must
    be π/2 where the land starts: r_e = r (π/2N - θ1) / π. Without a land this is EE. This formula
    is derived here, not taken from a source.
    """
    rolling = jnp.asarray(pitch_radius) * (1 / (2 * lobes) - jnp.asarray(tip_arc_angle) / jnp.pi)
    return TippedEpicycloid(lobes, pitch_radius, rolling, tip_arc_angle, land=True)
