"""Loads that oppose the rotation, and forces on the axes: gas, teeth of the timing gear, weight.

Frame: rotor 1 at the origin, rotor 2 at (2r, 0). Rotor 1 turns counter-clockwise. Gas is carried
along the housing from suction, above, to discharge, below. `docs/bearings.md` derives the formulas.
"""

import abc
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from rootsopt.contact.gap import Slices
from rootsopt.contact.law import smooth_step
from rootsopt.dynamics.parts.base import Part
from rootsopt.dynamics.parts.machine import TimingGear
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
    result = value(normal)
    for segment in profile.segments():
        if segment.land:
            continue
        begin, end = profile.roll_angle(jnp.stack([segment.start, segment.stop]))
        share = _spread_share(addendum, begin, end)
        before = value(jnp.where(addendum < jnp.minimum(begin, end), normal, segment.start))
        after = value(jnp.where(addendum > end, normal, segment.stop))
        spread = before + smooth_step(share) * (after - before)
        brief = (end - begin < BRIEF) & (share > 0) & (share < 1)
        result = jnp.where(brief, spread, result)
    return result


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

    def margins(self, motion, own) -> Float[Array, " s"]:
        def of_slice(offset):
            return self.section.margins(motion._replace(phi=motion.phi + offset), own)

        return jax.vmap(of_slice)(self.offsets).ravel()


def _spread_share(addendum, begin, end):
    """Return the fraction of a spread jump's roll angle that lies before `addendum`: 0 at its
    start, 1 at its end.

    The jump is spread over the roll angle `BRIEF`, centred midway between `begin` and `end`, the
    roll angles at the ends of a flank segment. `addendum`: roll angle of the addendum point in
    contact. All angles are in rad. Outside the jump, the fraction is negative or exceeds 1."""
    return (addendum - (begin + end - BRIEF) / 2) / BRIEF


MIRROR = np.array([-1.0, 1.0])
"""Factors of x and y that mirror a vector at the plane midway between the rotors."""


def contact_place(profile: Profile, phi: Float[Array, ""]) -> Float[Array, "2"]:
    """Return the point (m) where the rotors touch in perfect rolling, x and y from rotor 1's axis.

    `phi`: φ1 (rad). Where a whole arc touches at once, the place moves along it while φ1 changes by
    a short angle. `GasLoad` spreads the jump of its torque over the same angle."""
    half = profile.half_pitch
    centred = phi - 4 * half * jnp.round(phi / (4 * half))
    roll = jnp.abs(centred)
    lead = jnp.where(roll < half, 1.0, -1.0)
    # At φ1 < 0 the leading flank of rotor 1 touches.
    side = jnp.where(centred < 0, 1.0, -1.0)

    def place(nu):
        _, psi, s = profile.addendum(nu)
        across = profile.pitch_radius + lead * s * jnp.sin(psi)
        return jnp.stack([across, lead * side * s * jnp.cos(psi)])

    return over_segments(profile, half - jnp.abs(roll - half), place)


class GasResultant(eqx.Module):
    """Resultant of the gas pressure on each rotor.

    `pressure_length`: Δp L (N/m); `profile`; `outer_radius` r_a (m); `port` (rad): angle before the
    lowest point of the bore at which a pocket opens to discharge; `slices` of twisted rotors, or
    `None`."""

    pressure_length: Float[Array, ""]
    profile: Profile
    outer_radius: Float[Array, ""]
    port: Float[Array, ""]
    slices: Slices | None = None

    @property
    def weights(self) -> Float[Array, " s"] | Float[np.ndarray, " s"]:
        """Share (s,) of the length of every slice; [1] for straight rotors."""
        return np.ones(1) if self.slices is None else self.slices.weights

    @property
    def places(self) -> Float[Array, " s"] | Float[np.ndarray, " s"]:
        """Distance (s,) of every slice from the middle, as a share of the length."""
        return np.zeros(1) if self.slices is None else self.slices.places

    @property
    def _ahead(self) -> Float[Array, ""] | float:
        """Angle (rad) by which the leading end of the rotors is ahead of the middle."""
        return 0.0 if self.slices is None else jnp.abs(self.slices.twist) / 2

    def chords(
        self, phi: Float[Array, ""]
    ) -> tuple[Float[Array, "s rotor xy"], Float[Array, "s rotor xy"]]:
        """Return both ends (m) of the surface under discharge pressure: contact and sealing tip.

        Both are given for every slice and rotor, seen from the rotor's axis; those of rotor 2 are
        mirrored. `phi`: φ1 (rad) of the middle. A pocket has one pressure along its length, so it
        opens where its leading end passes the port."""
        pitch = 2 * jnp.pi / self.profile.lobes
        offsets = jnp.zeros(1) if self.slices is None else self.slices.offsets
        ahead, opening = self._ahead, -jnp.pi / 2 - self.port
        turned = phi + ahead + pitch / 2 * np.arange(2)
        # The last tip whose leading end is before the port, in the sense of rotation.
        tip = opening - jnp.mod(opening - turned, pitch) - ahead

        def of_slice(offset):
            first = contact_place(self.profile, phi + offset)
            second = MIRROR * (first - jnp.stack([2 * self.profile.pitch_radius, 0.0]))
            tips = self.outer_radius * jnp.stack([jnp.cos(tip + offset), jnp.sin(tip + offset)], 1)
            return jnp.stack([first, second]), tips

        return jax.vmap(of_slice)(offsets)

    def slice_forces(self, phi: Float[Array, ""]) -> Float[Array, "s rotor xy"]:
        """Return the force (N) on every slice and rotor; `phi`: φ1 (rad).

        It is Δp L times the chord, rotated by a right angle, times the slice's share of the length.
        """
        contact, tip = self.chords(phi)
        chord = contact - tip
        turned = jnp.stack([-chord[..., 1], chord[..., 0]], axis=-1)
        turned = turned * np.stack([np.ones(2), MIRROR])
        return self.pressure_length * jnp.asarray(self.weights)[:, None, None] * turned

    def openings(self) -> Float[Array, "2"]:
        """Return the angles φ1 (rad), each in one mesh period, at which a pocket opens."""
        pitch = 2 * jnp.pi / self.profile.lobes
        opening = -jnp.pi / 2 - self.port - self._ahead - pitch / 2 * np.arange(2)
        return jnp.mod(opening, pitch)

    def corners(self) -> Float[Array, " k"]:
        """Return the angles φ1 (rad, in one mesh period) at which the forces are not smooth.

        At these angles, a pocket opens, or the contact of a slice passes the end of a segment."""
        pitch = 2 * jnp.pi / self.profile.lobes
        rolls = [jnp.zeros(1), pitch / 4 * jnp.ones(1)]
        for segment in self.profile.segments():
            ends = self.profile.roll_angle(jnp.stack([segment.start, segment.stop]))
            rolls += [ends, (ends[:1] + ends[1:] + BRIEF * np.array([-1.0, 1.0])) / 2]
        roll = jnp.concatenate(rolls)
        each = jnp.concatenate([roll, -roll, pitch / 2 - roll, roll - pitch / 2])
        if self.slices is not None:
            each = (each[:, None] - self.slices.offsets).ravel()
        return jnp.mod(jnp.concatenate([self.openings(), each]), pitch)

    def passed(self, phi: Float[Array, ""]) -> Bool[Array, "4"]:
        """Return flags that change where a pocket opens, a tip passes the line of centres, or the
        contact crosses the pitch circle."""
        pitch = 2 * jnp.pi / self.profile.lobes
        turned = phi + self._ahead + self.port + jnp.pi / 2 + pitch / 2 * np.arange(2)
        opened = jnp.mod(jnp.floor(turned / pitch), 2) > 0
        half = jnp.floor(phi * self.profile.lobes / jnp.pi + jnp.array([0.0, 0.5]))
        return jnp.concatenate([opened, jnp.mod(half, 2) > 0])


def tooth_force(
    torque: Float[Array, "*n"], radius: Float[Array, ""], pressure_angle: Float[Array, ""]
) -> Float[Array, "*n 2"]:
    """Return the force (N) of the timing gear's teeth on rotor 2, x and y.

    `torque` (N·m): torque that the gear passes on to rotor 2, in its sense of rotation; `radius`
    (m): pitch radius; `pressure_angle` (rad): of the teeth. The teeth press along their common
    normal: torque / radius upwards at the pitch point, and away from rotor 1."""
    across = torque / radius
    return jnp.stack([jnp.abs(across) * jnp.tan(pressure_angle), across], axis=-1)


class AxisLoads(Part):
    """Forces on the axes other than those of the flanks: gas, teeth of the timing gear, weight.

    `gas`, `gear`: absent if `None`; `tooth_angle` (rad): pressure angle of the gear's teeth;
    `radius` (m): pitch radius; `weight` (N) of a rotor, downwards, `None`: not counted."""

    gas: GasResultant | None
    gear: TimingGear | None
    tooth_angle: Float[Array, ""]
    radius: Float[Array, ""]
    weight: Float[Array, ""] | None = None

    def gear_force(self, motion) -> Float[Array, "2"]:
        """Return the force (N) of the teeth on rotor 2, x and y; on rotor 1 it is the opposite."""
        if self.gear is None:
            return jnp.zeros(2, motion.relative.dtype)
        torque = self.gear.torque_on_2(motion, np.zeros(0))
        return tooth_force(torque, self.radius, self.tooth_angle)

    def force_on_axes(self, motion, own) -> Float[Array, "2 2"]:
        teeth = self.gear_force(motion)
        total = jnp.stack([-teeth, teeth])
        if self.gas is not None:
            total = total + jnp.sum(self.gas.slice_forces(motion.phi), axis=0)
        if self.weight is not None:
            total = total - self.weight * np.array([[0.0, 1.0], [0.0, 1.0]])
        return total

    def switches(self, motion, own) -> Bool[Array, " s"]:
        flags = []
        if self.gear is not None:
            flags.append((self.gear.torque_on_1(motion, np.zeros(0)) > 0)[None])
        if self.gas is not None:
            flags.append(self.gas.passed(motion.phi))
        return jnp.concatenate(flags) if flags else jnp.zeros(0, bool)
