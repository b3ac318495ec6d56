"""What opposes the rotors."""

import abc

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from rootsopt.contact.impact import smooth_step
from rootsopt.dynamics.parts.base import Part
from rootsopt.profiles.base import Profile

_BRIEF = 0.01
"""Roll angle (rad) in which a stretch of the flank takes at least to pass the seal on."""


class Load(Part):
    """Torques against the rotors at rotor 1's angle φ1; `torque` (N·m) is the mean of that
    against rotor 2."""

    torque: eqx.AbstractVar[Float[Array, ""]]

    @abc.abstractmethod
    def torque1(self, phi: Float[Array, ""]) -> Float[Array, ""] | None:
        """Torque (N·m) against rotor 1 at φ1 = `phi` (rad); None: no torque at any angle."""

    @abc.abstractmethod
    def torque2(self, phi: Float[Array, ""]) -> Float[Array, ""]:
        """Torque (N·m) against rotor 2 at φ1 = `phi` (rad)."""

    @property
    @abc.abstractmethod
    def total(self) -> Float[Array, ""]:
        """Mean torque (N·m) against both rotors together."""

    def torque_on_1(self, motion, own):
        del own
        torque = self.torque1(motion.phi)
        return None if torque is None else -torque

    def torque_on_2(self, motion, own):
        del own
        return -self.torque2(motion.phi)


class ConstantLoad(Load):
    """A constant `torque` (N·m) that opposes rotor 2."""

    torque: Float[Array, ""]

    def torque1(self, phi):
        del phi
        return None

    def torque2(self, phi):
        del phi
        return self.torque

    @property
    def total(self):
        return self.torque


class GasLoad(Load):
    """Gas at a pressure difference across the pair.

    The chambers on both sides are parted by the tips at the housing, at the outer radius, and
    by the contact between the rotors, at radii ρ1 and ρ2 about their axes. Each rotor is a vane
    from ρ to the outer radius, so the torques against the rotors are

        T = Δp L (r_a² - ρ²) / 2.

    ρ is that of perfect rolling at φ1 (what ε changes of it is of the order of ε). The mean
    over a turn is, for both rotors together, the displaced volume times Δp / 2π: exactly, but
    where a tip arc meshes all at once (a canonical CIC). Its jump of ρ is spread over `_BRIEF`,
    since gas at a wide gap does not jump, and a jump that moves with the design would have to be
    followed for its derivatives.

    `pressure` Δp (Pa) times the rotor's length L: `pressure_length` (N/m); `profile`;
    `outer_radius` r_a (m); `torque`: mean against one rotor (N·m).
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
        """Roll angle at which the pair touches: a tip of rotor 1 at 0, one of rotor 2 at π/N."""
        pitch = 2 * jnp.pi / self.profile.lobes
        return jnp.abs(phi - pitch * jnp.round(phi / pitch))

    def _torque(self, phi, rotor):
        profile = self.profile
        half = profile.half_pitch
        roll = self._roll(phi)
        addendum = half - jnp.abs(roll - half)
        lead = rotor * jnp.where(roll < half, 1.0, -1.0)

        def vane(normal):
            s = profile.contact_distance(normal)
            across = profile.pitch_radius * jnp.cos(normal - profile.roll_angle(normal))
            return self.outer_radius**2 - (profile.pitch_radius**2 + s**2 + lead * 2 * s * across)

        normal = profile.normal_at(addendum)
        squares = vane(normal)
        for segment in profile.segments():
            if segment.land:
                continue
            begin, end = profile.roll_angle(jnp.stack([segment.start, segment.stop]))
            share = (addendum - (begin + end - _BRIEF) / 2) / _BRIEF
            before = vane(jnp.where(addendum < jnp.minimum(begin, end), normal, segment.start))
            after = vane(jnp.where(addendum > end, normal, segment.stop))
            spread = before + smooth_step(share) * (after - before)
            brief = (end - begin < _BRIEF) & (share > 0) & (share < 1)
            squares = jnp.where(brief, spread, squares)
        return self.pressure_length / 2 * squares

    def switches(self, motion, own) -> Bool[Array, " s"]:
        del own
        phi, half = motion.phi, self.profile.half_pitch
        roll = self._roll(phi)
        addendum = half - jnp.abs(roll - half)
        ends = [segment.stop for segment in self.profile.segments()[:-1]]
        passed = [self.profile.normal_at(addendum) > end for end in ends]
        return jnp.stack([jnp.sin(phi * self.profile.lobes) > 0, roll > half, *passed])
