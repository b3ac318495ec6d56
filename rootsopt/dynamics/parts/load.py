"""Loads: the parts that oppose the rotation."""

import abc
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from rootsopt.contact.impact import smooth_step
from rootsopt.dynamics.parts.base import Part
from rootsopt.profiles.base import Profile

BRIEF = 0.01
"""Minimum roll angle (rad) over which the seal crosses one flank segment."""


class Load(Part):
    """Torques that oppose the rotors, as functions of the angle φ1 of rotor 1.

    `torque` (N·m): mean torque against rotor 2.
    """

    torque: eqx.AbstractVar[Float[Array, ""]]

    @abc.abstractmethod
    def torque1(self, phi: Float[Array, ""]) -> Float[Array, ""] | None:
        """Return the torque (N·m) against rotor 1 at φ1 = `phi` (rad); None: zero at any angle."""

    @abc.abstractmethod
    def torque2(self, phi: Float[Array, ""]) -> Float[Array, ""]:
        """Return the torque (N·m) against rotor 2 at φ1 = `phi` (rad)."""

    @property
    @abc.abstractmethod
    def total(self) -> Float[Array, ""]:
        """Mean torque (N·m) against both rotors together."""

    def torque_on_1(self, motion, own):
        torque = self.torque1(motion.phi)
        return None if torque is None else -torque

    def torque_on_2(self, motion, own):
        return -self.torque2(motion.phi)


class ConstantLoad(Load):
    """A constant `torque` (N·m) that opposes rotor 2."""

    torque: Float[Array, ""]

    def torque1(self, phi):
        return None

    def torque2(self, phi):
        return self.torque

    @property
    def total(self):
        return self.torque


class GasLoad(Load):
    """Gas torque from a pressure difference across the pair.

    The tips at the housing and the contact between the rotors separate the two chambers. The tips
    are at the outer radius r_a, the contact at the radii ρ1 and ρ2 about the axes. Each rotor acts
    as a vane from ρ to r_a, so the torque against it is

        T = Δp L (r_a² - ρ²) / 2.

    ρ is computed for perfect rolling at φ1; the effect of ε on ρ, of order ε, is neglected.
    Averaged over a turn, the torques on both rotors together equal the displaced volume times Δp /
    2π. This is exact unless a whole tip arc meshes at one instant (as on a CIC profile whose
    involute has its greatest length). There ρ jumps, and the jump is spread over the roll angle
    `BRIEF`, for two reasons. The real pressure does not jump at a wide gap. Besides, the
    derivatives of a jump that moves with the design would need separate treatment.

    `pressure_length` (N/m): pressure difference Δp (Pa) times the rotor's length L (m); `profile`
    of the rotors; `outer_radius` r_a (m); `torque`: mean torque against one rotor (N·m).
    """

    pressure_length: Float[Array, ""]
    profile: Profile
    outer_radius: Float[Array, ""]
    torque: Float[Array, ""]

    def torque1(self, phi):
        return self._torque(phi, 1.0)

    def torque2(self, phi):
        return self._torque(phi, -1.0)

    @property
    def total(self):
        return 2 * self.torque

    def _roll(self, phi):
        """Return the roll angle (rad) at which the pair touches: 0 at a tip of rotor 1, π/N at a
        tip of rotor 2."""
        pitch = 2 * jnp.pi / self.profile.lobes
        return jnp.abs(phi - pitch * jnp.round(phi / pitch))

    def _torque(self, phi, rotor):
        """Return the torque (N·m) against a rotor at φ1 = `phi` (rad); `rotor`: 1 for rotor 1, -1
        for rotor 2."""
        profile = self.profile
        half = profile.half_pitch
        roll = self._roll(phi)
        addendum = half - jnp.abs(roll - half)
        lead = rotor * jnp.where(roll < half, 1.0, -1.0)

        def vane(normal):
            s = profile.contact_distance(normal)
            across = profile.pitch_radius * jnp.cos(normal - profile.roll_angle(normal))
            return self.outer_radius**2 - (profile.pitch_radius**2 + s**2 + lead * 2 * s * across)

        squares = over_segments(profile, addendum, vane)
        return self.pressure_length / 2 * squares

    def switches(self, motion, own) -> Bool[Array, " s"]:
        return self.margins(motion, own) > 0

    def margins(self, motion, own) -> Float[Array, " s"]:
        phi, half = motion.phi, self.profile.half_pitch
        roll = self._roll(phi)
        addendum = half - jnp.abs(roll - half)
        passed, within = [], jnp.zeros((), bool)
        for segment in self.profile.segments():
            begin, end = self.profile.roll_angle(jnp.stack([segment.start, segment.stop]))
            brief = jnp.zeros((), bool) if segment.land else end - begin < BRIEF
            # A segment's end that lies inside a spread jump does not matter. (There, the normal
            # angle of the contact jumps, so that it has no smooth margin.)
            passed.append(jnp.where(within | brief, 1.0, addendum - begin))
            within = brief
            if not segment.land:
                share = _spread_share(addendum, begin, end)
                passed += [jnp.where(brief, edge, 1.0) for edge in (share, share - 1)]
        # The first segment begins at the tip.
        return jnp.stack([jnp.sin(phi * self.profile.lobes), roll - half, *passed[1:]])


def over_segments(
    profile: Profile,
    addendum: Float[Array, ""],
    value: Callable[[Float[Array, ""]], Float[Array, "*v"]],
) -> Float[Array, "*v"]:
    """Return the `value` at the normal angle (rad) of the addendum point that touches.

    `addendum`: roll angle (rad) of this point. Where a whole segment touches within the roll angle
    `BRIEF`, the values at its ends are blended over that angle."""
    normal = profile.normal_at(addendum)
    found = value(normal)
    for segment in profile.segments():
        if segment.land:
            continue
        begin, end = profile.roll_angle(jnp.stack([segment.start, segment.stop]))
        share = _spread_share(addendum, begin, end)
        before = value(jnp.where(addendum < jnp.minimum(begin, end), normal, segment.start))
        after = value(jnp.where(addendum > end, normal, segment.stop))
        spread = before + smooth_step(share) * (after - before)
        brief = (end - begin < BRIEF) & (share > 0) & (share < 1)
        found = jnp.where(brief, spread, found)
    return found


class TwistedLoad(Load):
    """The mean of a load over the slices of twisted rotors.

    `section`: the load of rotors that are straight; `offsets` (n,) in rad and `weights` (n,): see
    `rootsopt.contact.gap.Slices`. The mean over a mesh period is that of the section."""

    section: Load
    offsets: Float[Array, " n"]
    weights: Float[Array, " n"]

    @property
    def torque(self) -> Float[Array, ""]:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.section.torque

    @property
    def total(self):
        return self.section.total

    def torque1(self, phi):
        each = jax.vmap(self.section.torque1)(phi + self.offsets)
        return None if each is None else jnp.dot(self.weights, each)

    def torque2(self, phi):
        return jnp.dot(self.weights, jax.vmap(self.section.torque2)(phi + self.offsets))

    def switches(self, motion, own) -> Bool[Array, " s"]:
        return self._by_slice(self.section.switches, motion, own)

    def margins(self, motion, own) -> Float[Array, " s"]:
        return self._by_slice(self.section.margins, motion, own)

    def _by_slice(self, flags, motion, own):
        def of_slice(offset):
            return flags(motion._replace(phi=motion.phi + offset), own)

        return jax.vmap(of_slice)(self.offsets).ravel()


def _spread_share(addendum, begin, end):
    """Return the fraction of a spread jump's roll angle that lies before `addendum`: 0 at its
    start, 1 at its end.

    The jump is spread over the roll angle `BRIEF`, centred midway between `begin` and `end`, the
    roll angles at the ends of a flank segment. `addendum`: roll angle of the addendum point in
    contact. All angles are in rad. Outside the jump, the fraction is negative or exceeds 1."""
    return (addendum - (begin + end - BRIEF) / 2) / BRIEF
