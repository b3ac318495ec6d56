"""The rotor pair as an ordinary differential equation.

The smallest scene has two states, ε = φ2 - φ1 and its rate. Parts add what they need: a motor
the speed of rotor 1, supports the displacements of both axes and their rates. The equation is
counted in mesh periods τ of rotor 1's rotation (one lobe pitch), so that it is periodic whatever
the speed does, ε in units of `angle_scale`, so that a solver sees numbers of order one.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from rootsopt.contact.closest import ClosestApproach, FlankPair
from rootsopt.contact.impact import ImpactLaw, force_rounding
from rootsopt.contact.point import ContactPoint, contact_point
from rootsopt.dynamics.pace import Pace
from rootsopt.dynamics.parts import (
    Drive,
    Friction,
    Load,
    MotorDrive,
    Supports,
    TimingGear,
)
from rootsopt.profiles.base import Profile

GapFunction = Callable[
    [Float[Array, ""], Float[Array, ""]],
    tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""]],
]
STALLED = 0.05
"""Share of the drive's speed below which a motor counts as stalled."""
_DISPLACED = 0.1
"""Displacement of an axis, relative to the centre distance, with which the mesh is lost."""


class SearchContact(eqx.Module):
    """Gap and levers by a search for the closest approach at every call: the reference."""

    pair: FlankPair

    @classmethod
    def of(
        cls,
        profile: Profile,
        center_distance: Float[Array, ""] | None = None,
        both: bool = False,
    ) -> "SearchContact":
        return cls(FlankPair.of(profile, center_distance, both))

    @property
    def jumps(self) -> bool:
        """Whether the levers may jump, from one minimum of the gap to another as deep."""
        return self.pair.profile.cusp or not self.pair.rolling

    def __call__(self, roll, relative):
        found = self.pair(roll, relative)
        return found.gap, found.lever1, found.lever2

    def at_distance(self, distance: Float[Array, ""]) -> "SearchContact":
        """The same flanks at another centre distance (m)."""
        return eqx.tree_at(lambda contact: contact.pair.center_distance, self, distance)


class Motion(NamedTuple):
    """Position and velocity of the pair at an instant (SI units): angle φ1 and angular speed of
    rotor 1, ε and its rate; with supports, displacements of both axes (rotor, x and y) and their
    velocities."""

    phi: Float[Array, "*n"]
    relative: Float[Array, "*n"]
    rate: Float[Array, "*n"]
    speed: Float[Array, "*n"]
    shift: Float[Array, "*n 2 2"] | None = None
    drift: Float[Array, "*n 2 2"] | None = None


class FlankForce(NamedTuple):
    """Contact at an instant or several: normal force (N) by flank, greatest penetration (m;
    negative: gap) with its rate (m/s) and the levers (m) of that flank, torques on the rotors
    (N·m), each positive in its rotor's sense of rotation, and, where there are supports, the force
    on rotor 2 (N); that on rotor 1 is opposite."""

    drive: Float[Array, "*n"]
    coast: Float[Array, "*n"]
    depth: Float[Array, "*n"]
    closing: Float[Array, "*n"]
    lever1: Float[Array, "*n"]
    lever2: Float[Array, "*n"]
    torque1: Float[Array, "*n"]
    torque2: Float[Array, "*n"]
    push: Float[Array, "*n 2"] | None = None

    @property
    def total(self) -> Float[Array, "*n"]:
        """Sum of the normal force magnitudes (N)."""
        return self.drive + self.coast


class _Sliding(NamedTuple):
    """What friction and supports need of a contact: its place, the speed (m/s) at which rotor 1
    slides on rotor 2, and, where there are supports, normal and tangent."""

    point: ContactPoint
    speed: Float[Array, ""]
    normal: Float[Array, "2"] | None = None
    tangent: Float[Array, "2"] | None = None


class _Touch(NamedTuple):
    """A flank at a pose: penetration (m) and its rate (m/s), levers (m), roll coordinate (rad) and
    what a search found there; `sliding` where a part asks for it."""

    depth: Float[Array, ""]
    closing: Float[Array, ""]
    lever1: Float[Array, ""]
    lever2: Float[Array, ""]
    roll: Float[Array, ""]
    found: ClosestApproach | None
    sliding: _Sliding | None


class RotorPair(eqx.Module):
    """Two identical rotors in mesh, rotor 1 driven, rotor 2 loaded.

    `contact`: gap and levers at a pose; `law`: contact force; `clearance` (m) added to
    every flank gap; `inertia` of one rotor (kg·m²); `drive`, `load`, `gear`, `friction`,
    `supports`: parts; `angle_scale` (rad) and `force_scale` (N): units the solver works in;
    `pace`: how quickly it can change, None if unknown.
    `both`: whether drive and coast flanks can touch at once, which they cannot at the nominal
    centre distance. A part that is absent is None and costs nothing. Friction, supports and
    `both` need a `SearchContact`.
    """

    lobes: int = eqx.field(static=True)
    contact: GapFunction
    law: ImpactLaw
    clearance: Float[Array, ""]
    inertia: Float[Array, ""]
    drive: Drive
    load: Load
    gear: TimingGear | None
    angle_scale: Float[Array, ""]
    force_scale: Float[Array, ""]
    friction: Friction | None = None
    supports: Supports | None = None
    pace: Pace | None = None
    both: bool = eqx.field(static=True, default=False)

    @property
    def states(self) -> int:
        """How many states there are: ε, its rate, a motor's speed, eight of the supports."""
        return 2 + self.drive.free + 8 * (self.supports is not None)

    @property
    def units(self) -> Float[Array, " n"]:
        """Units of the scaled states: rad and rad/s of ε, rad/s of a motor's speed beside
        `drive.speed`, m and m/s of displaced axes."""
        angle, period = self.angle_scale, self.mesh_period
        parts = [jnp.stack([angle, angle / period])]
        if self.drive.free:
            parts.append((angle / period)[None])
        if self.supports is not None:
            unit = jnp.repeat(self.supports.unit[None], 4)
            parts += [unit, unit / period]
        return jnp.concatenate(parts)

    @property
    def mesh_period(self) -> Float[Array, ""]:
        """Duration of one lobe pitch (s) at the drive's speed."""
        return 2 * jnp.pi / (self.lobes * self.drive.speed)

    @property
    def angle_limit(self) -> float:
        """|ε| (rad) beyond which the lobes count as having passed through each other: a
        quarter of the angle from a lobe's axis to its flank at the pitch circle."""
        return jnp.pi / (8 * self.lobes)

    @property
    def smooth(self) -> bool:
        """Whether the equation is smooth between its `switches`."""
        return getattr(self.contact, "smooth", True)

    @property
    def jumps(self) -> bool:
        """Whether the contact force may jump where no other part does."""
        return isinstance(self.contact, SearchContact) and self.contact.jumps

    def rounding(self, depth: Float[Array, ""]) -> Float[Array, ""]:
        """Relative error of the force at a `depth` (m) that a search found, by rounding alone."""
        if not isinstance(self.contact, SearchContact):
            return jnp.zeros_like(depth)
        return force_rounding(depth, self.law.exponent, self.contact.pair.center_distance / 2)

    def speed(self, state: Float[Array, "*k n"]) -> Float[Array, "*#k"]:
        """Angular speed of rotor 1 (rad/s) in a scaled state."""
        if not self.drive.free:
            return self.drive.speed
        return self.drive.speed + self.angle_scale / self.mesh_period * state[..., 2]

    def lapse(self, state: Float[Array, "*k n"]) -> Float[Array, "*#k"]:
        """Time (s) that a mesh period of rotation takes at a scaled state, relative to
        `mesh_period`. A motor that has stalled is taken to creep on."""
        creep = STALLED / 2 * self.drive.speed
        return self.drive.speed / jnp.maximum(self.speed(state), creep)

    def motion(self, tau: Float[Array, "*k"], state: Float[Array, "*k n"]) -> Motion:
        """Position and velocity from rotation in mesh periods and scaled state, in the precision
        of the pair whatever theirs is."""
        tau, state = (jnp.asarray(x, self.angle_scale.dtype) for x in (tau, state))
        relative = self.angle_scale * state[..., 0]
        rate = self.angle_scale * state[..., 1] / self.mesh_period
        motion = Motion(2 * jnp.pi / self.lobes * tau, relative, rate, self.speed(state))
        if self.supports is None:
            return motion
        unit = self.supports.unit
        shift, drift = (
            state[..., -8 + 4 * i : state.shape[-1] - 4 + 4 * i].reshape(*tau.shape, 2, 2)
            for i in (0, 1)
        )
        return motion._replace(shift=unit * shift, drift=unit / self.mesh_period * drift)

    def physical(
        self, tau: Float[Array, "*k"], state: Float[Array, "*k n"]
    ) -> tuple[Float[Array, "*k"], Float[Array, "*k"], Float[Array, "*k"]]:
        """φ1 (rad), ε (rad), dε/dt (rad/s) from rotation in mesh periods and scaled state."""
        return self.motion(tau, state)[:3]

    def contact_force(
        self, phi: Float[Array, ""], relative: Float[Array, ""], rate: Float[Array, ""]
    ) -> FlankForce:
        """Flank contact at rotor 1's angle `phi` (rad), ε and dε/dt, at the drive's speed and
        with both axes in their places."""
        motion = Motion(phi, relative, rate, self.drive.speed)
        if self.supports is not None:
            rest = jnp.zeros((2, 2), self.angle_scale.dtype)
            motion = motion._replace(shift=rest, drift=rest)
        return self._force(motion)

    def contact_at(self, tau: Float[Array, ""], state: Float[Array, " n"]) -> FlankForce:
        """Flank contact at rotation `tau` (mesh periods) and scaled `state`."""
        return self._force(self.motion(tau, state))

    def _force(self, motion: Motion) -> FlankForce:
        """Contact force of a motion.

        With no negative clearance at the nominal centre distance, only the drive flank
        can touch when ε < 0 and only the coast flank when ε > 0, so one search is
        enough; the force is exactly zero on both sides of ε = 0.
        """
        if self.both:
            sides = jnp.asarray([1.0, -1.0], self.angle_scale.dtype)
            flanks = jax.vmap(self._flank_force, (0, None))(sides, motion)
            drive, coast = flanks.drive
            summed = jax.tree.map(lambda x: jnp.sum(x, axis=0), flanks)
            deeper = jnp.argmax(flanks.depth)
            return summed._replace(
                drive=drive,
                coast=coast,
                depth=flanks.depth[deeper],
                closing=flanks.closing[deeper],
                lever1=flanks.lever1[deeper],
                lever2=flanks.lever2[deeper],
            )
        drives = motion.relative < 0
        flank = self._flank_force(jnp.where(drives, 1.0, -1.0), motion)
        return flank._replace(
            drive=jnp.where(drives, flank.drive, 0.0), coast=jnp.where(drives, 0.0, flank.drive)
        )

    def _flank_force(self, side: Float[Array, ""], motion: Motion) -> FlankForce:
        """Force of the flanks of one side (1 drive, -1 coast), as that of the drive flank."""
        touch = self._touch(side, motion)
        force = self.law(touch.depth, touch.closing)
        forward, sliding = side * force, touch.sliding
        torque1, torque2 = -touch.lever1 * forward, touch.lever2 * forward
        normal = tangent = push = None
        if sliding is not None:
            normal, tangent = sliding.normal, sliding.tangent
        if normal is not None:
            push = force * normal
        if self.friction is not None:
            assert sliding is not None
            drag = self.friction(sliding.speed) * force
            torque1 -= side * drag * sliding.point.support1
            torque2 += side * drag * sliding.point.support2
            if push is not None and tangent is not None:
                push += drag * tangent
        return FlankForce(
            drive=force,
            coast=jnp.zeros_like(force),
            depth=touch.depth,
            closing=touch.closing,
            lever1=touch.lever1,
            lever2=touch.lever2,
            torque1=torque1,
            torque2=torque2,
            push=push,
        )

    def _touch(self, side: Float[Array, ""], motion: Motion) -> _Touch:
        """The flanks of one side (1 drive, -1 coast).

        In the frame with the drive side's normal n from rotor 1 to rotor 2 and the tangent t a
        quarter turn ahead, rotor 1 slides along rotor 2 with ω1 h1 - ω2 h2 + (v1 - v2)·t; the
        coast side is the mirror image. Displaced axes are a pair at another centre distance,
        turned by the angle θ of its line of centres: φ1 - θ and φ2 + θ.
        """
        contact, line, relative = self.contact, None, motion.relative
        if motion.shift is not None:
            assert isinstance(contact, SearchContact)
            x, y = motion.shift[1] - motion.shift[0]
            line = jnp.stack([contact.pair.center_distance + x, y])
            relative = relative + 2 * jnp.arctan2(y, line[0])
            contact = contact.at_distance(jnp.hypot(*line))
        roll, turned = -side * (motion.phi + motion.relative / 2), side * relative
        found = sliding = None
        if isinstance(contact, SearchContact):
            found = contact.pair(roll, turned)
            gap, lever1, lever2 = found.gap, found.lever1, found.lever2
        else:
            gap, lever1, lever2 = contact(roll, turned)
        other = motion.speed + motion.rate
        closing = side * (lever1 * motion.speed - lever2 * other)
        if self.friction is not None or line is not None:
            assert isinstance(contact, SearchContact)
            assert found is not None
            point = contact_point(contact.pair, roll, turned, found)
            speed = side * (motion.speed * point.support1 - other * point.support2)
            sliding = _Sliding(point, speed)
            if line is not None:
                assert motion.drift is not None
                distance = contact.pair.center_distance
                cos, sin = line / distance
                along, across = point.radial, side * (lever1 + lever2) / distance
                normal = jnp.stack([cos * along - sin * across, sin * along + cos * across])
                tangent = side * jnp.stack([-normal[1], normal[0]])
                approach = motion.drift[0] - motion.drift[1]
                closing += jnp.dot(approach, normal)
                speed += jnp.dot(approach, tangent)
                sliding = _Sliding(point, speed, normal, tangent)
        depth = -gap - self.clearance
        return _Touch(depth, closing, lever1, lever2, roll, found, sliding)

    def switches(
        self, tau: Float[Array, ""], state: Float[Array, " n"]
    ) -> tuple[Bool[Array, " s"], Bool[Array, " s"]]:
        """Which of its smooth pieces the equation is on, at rotation `tau` (mesh periods) and
        scaled `state`: side and pieces of the flanks, of the contact law, of every part. And which
        of these are of account: not the pieces of a flank that does not touch."""
        motion = self.motion(tau, state)

        def of_flank(side):
            touch = self._touch(side, motion)
            flags = [self.law.switches(touch.depth, touch.closing)]
            if touch.found is not None:
                assert isinstance(self.contact, SearchContact)
                flags.append(self.contact.pair.switches(touch.roll, touch.found))
            if self.friction is not None:
                assert touch.sliding is not None
                flags.append(self.friction.switches(touch.sliding.speed))
            found = jnp.concatenate(flags)
            return found, jnp.full_like(found, touch.depth > 0)

        drives = motion.relative < 0
        if self.both:
            sides = jnp.asarray([1.0, -1.0], self.angle_scale.dtype)
            flags, counts = (x.ravel() for x in jax.vmap(of_flank)(sides))
        else:
            flags, counts = of_flank(jnp.where(drives, 1.0, -1.0))
            flags, counts = jnp.append(flags, drives), jnp.append(counts, True)
        parts = [self.load.switches(motion.phi)]
        if self.gear is not None:
            parts.append(self.gear.switches(motion.relative))
        flags = jnp.concatenate([flags, *parts])
        return flags, jnp.pad(counts, (0, flags.size - counts.size), constant_values=True)

    def derivative(
        self, tau: Float[Array, ""], state: Float[Array, " n"]
    ) -> tuple[Float[Array, " n"], FlankForce]:
        """d(state)/dτ and the contact it comes from."""
        motion = self.motion(tau, state)
        contact = self._force(motion)
        torque = contact.torque2 - self.load.torque2(motion.phi)
        holding = None if self.gear is None else self.gear(motion.relative, motion.rate)
        if holding is not None:
            torque = torque - holding
        acceleration = torque / self.inertia
        unit = self.mesh_period**2 / self.angle_scale
        slopes = [state[1:2]]
        if isinstance(self.drive, MotorDrive):
            torque = self.drive.torque_at(motion.speed) + contact.torque1
            torque = torque - self.load.torque1(motion.phi)
            if holding is not None:
                torque = torque + holding
            driven = torque / (self.inertia + self.drive.inertia)
            slopes += [(unit * jnp.stack([acceleration - driven, driven]))]
        else:
            slopes += [jnp.stack([acceleration * unit])]
        if self.supports is not None:
            assert contact.push is not None
            assert motion.shift is not None
            assert motion.drift is not None
            force = self.supports.force(motion.shift, motion.drift)
            force += jnp.stack([-contact.push, contact.push])
            unit = self.mesh_period**2 / (self.supports.mass * self.supports.unit)
            slopes += [state[-4:], unit * force.ravel()]
        slope = jnp.concatenate(slopes)
        if self.drive.free:
            slope = self.lapse(state) * slope
        # A pair that has lost its mesh stands still rather than run to infinity; the
        # caller reports it.
        return jnp.where(lax.stop_gradient(self.lost(state)), 0.0, slope), contact

    def lost(self, state: Float[Array, " n"]) -> Bool[Array, ""]:
        """Whether a scaled state is no longer one of a running mesh: lobes have passed through
        each other, an axis has left its place, or the motor has stalled."""
        lost = ~(jnp.abs(self.angle_scale * state[0]) < self.angle_limit)
        if self.supports is not None:
            assert isinstance(self.contact, SearchContact)
            farthest = _DISPLACED * self.contact.pair.center_distance
            lost |= jnp.any(jnp.abs(self.supports.unit * state[-8:-4]) > farthest)
        return lost | self.stalled(state) if self.drive.free else lost

    def stalled(self, state: Float[Array, " n"]) -> Bool[Array, ""]:
        """Whether a motor has come to a halt, all but."""
        if not self.drive.free:
            return jnp.zeros((), bool)
        return self.speed(state) < STALLED * self.drive.speed
