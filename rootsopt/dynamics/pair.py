"""The rotor pair as an ordinary differential equation.

The smallest scene has two states, ε = φ2 - φ1 and its rate. Time is counted in mesh
periods τ (one lobe pitch of rotor 1) and ε in units of `angle_scale`, so that a solver
sees numbers of order one.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from rootsopt.contact.closest import FlankPair
from rootsopt.contact.impact import ImpactLaw
from rootsopt.dynamics.pace import Pace
from rootsopt.dynamics.parts import ConstantLoad, PrescribedDrive, TimingGear
from rootsopt.profiles.base import Profile

GapFunction = Callable[
    [Float[Array, ""], Float[Array, ""]],
    tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""]],
]


class SearchContact(eqx.Module):
    """Gap and levers by a search for the closest approach at every call: the reference."""

    pair: FlankPair

    @classmethod
    def of(cls, profile: Profile) -> "SearchContact":
        return cls(FlankPair.of(profile))

    def __call__(self, roll, relative):
        return self.with_switches(roll, relative)[0]

    def with_switches(self, roll, relative):
        """Gap and levers, and `FlankPair.switches`."""
        found = self.pair(roll, relative)
        return (found.gap, found.lever1, found.lever2), self.pair.switches(roll, found)


class FlankForce(NamedTuple):
    """Contact at an instant or several: normal force (N) by flank, penetration (m; negative:
    gap) and the levers (m)."""

    drive: Float[Array, "*n"]
    coast: Float[Array, "*n"]
    depth: Float[Array, "*n"]
    lever1: Float[Array, "*n"]
    lever2: Float[Array, "*n"]

    @property
    def total(self) -> Float[Array, "*n"]:
        """Sum of the normal force magnitudes (N)."""
        return self.drive + self.coast

    @property
    def torque1(self) -> Float[Array, "*n"]:
        """Torque on rotor 1 (N·m), positive in its sense of rotation."""
        return -self.lever1 * (self.drive - self.coast)

    @property
    def torque2(self) -> Float[Array, "*n"]:
        """Torque on rotor 2 (N·m), positive in its sense of rotation."""
        return self.lever2 * (self.drive - self.coast)


class RotorPair(eqx.Module):
    """Two identical rotors in mesh, rotor 1 driven, rotor 2 loaded.

    `contact`: gap and levers at a pose; `law`: contact force; `clearance` (m) added to
    every flank gap; `inertia` of one rotor (kg·m²); `drive`, `load`, `gear`: parts;
    `angle_scale` (rad) and `force_scale` (N): units the solver works in; `pace`: how quickly
    it can change, None if unknown. An absent gear is None and costs nothing.
    """

    lobes: int = eqx.field(static=True)
    contact: GapFunction
    law: ImpactLaw
    clearance: Float[Array, ""]
    inertia: Float[Array, ""]
    drive: PrescribedDrive
    load: ConstantLoad
    gear: TimingGear | None
    angle_scale: Float[Array, ""]
    force_scale: Float[Array, ""]
    pace: Pace | None = None

    @property
    def mesh_period(self) -> Float[Array, ""]:
        """Duration of one lobe pitch (s)."""
        return 2 * jnp.pi / (self.lobes * self.drive.speed)

    @property
    def angle_limit(self) -> float:
        """|ε| (rad) beyond which the lobes count as having passed through each other: a
        quarter of the angle from a lobe's axis to its flank at the pitch circle."""
        return jnp.pi / (8 * self.lobes)

    def physical(
        self, tau: Float[Array, "*n"], state: Float[Array, "*n 2"]
    ) -> tuple[Float[Array, "*n"], Float[Array, "*n"], Float[Array, "*n"]]:
        """φ1 (rad), ε (rad), dε/dt (rad/s) from time in mesh periods and scaled state."""
        relative = self.angle_scale * state[..., 0]
        rate = self.angle_scale * state[..., 1] / self.mesh_period
        return 2 * jnp.pi / self.lobes * tau, relative, rate

    def contact_force(
        self, phi: Float[Array, ""], relative: Float[Array, ""], rate: Float[Array, ""]
    ) -> FlankForce:
        """Flank contact at rotor 1's angle `phi` (rad), ε and dε/dt.

        With no negative clearance at the nominal centre distance, only the drive flank
        can touch when ε < 0 and only the coast flank when ε > 0, so one search is
        enough; the force is exactly zero on both sides of ε = 0.
        """
        side = jnp.where(relative < 0, 1.0, -1.0)
        geometry = self.contact(-side * (phi + relative / 2), side * relative)
        depth, closing, lever1, lever2 = self._approach(side, geometry, rate)
        force = self.law(depth, closing)
        drives = relative < 0
        return FlankForce(
            drive=jnp.where(drives, force, 0.0),
            coast=jnp.where(drives, 0.0, force),
            depth=depth,
            lever1=lever1,
            lever2=lever2,
        )

    def _approach(self, side, geometry, rate):
        """Penetration and its rate on a side (1 drive, -1 coast), and the levers."""
        gap, lever1, lever2 = geometry
        speed = self.drive.speed
        closing = side * (lever1 * speed - lever2 * (speed + rate))
        return -gap - self.clearance, closing, lever1, lever2

    def contact_at(self, tau: Float[Array, ""], state: Float[Array, "2"]) -> FlankForce:
        """Flank contact at time `tau` (mesh periods) and scaled `state`."""
        return self.contact_force(*self.physical(tau, state))

    def switches(self, tau: Float[Array, ""], state: Float[Array, "2"]) -> Bool[Array, " s"]:
        """Which of its smooth pieces the equation is on, at time `tau` (mesh periods) and
        scaled `state`: side and pieces of the flanks, of the contact law, of the gear."""
        phi, relative, rate = self.physical(tau, state)
        side = jnp.where(relative < 0, 1.0, -1.0)
        pose = -side * (phi + relative / 2), side * relative
        if isinstance(self.contact, SearchContact):
            geometry, pieces = self.contact.with_switches(*pose)
        else:
            geometry, pieces = self.contact(*pose), jnp.zeros(0, bool)
        depth, closing, *_ = self._approach(side, geometry, rate)
        flags = [jnp.stack([relative < 0]), self.law.switches(depth, closing), pieces]
        if self.gear is not None:
            flags.append(self.gear.switches(relative))
        return jnp.concatenate(flags)

    def derivative(
        self, tau: Float[Array, ""], state: Float[Array, "2"]
    ) -> tuple[Float[Array, "2"], FlankForce]:
        """d(state)/dτ and the contact it comes from."""
        phi, relative, rate = self.physical(tau, state)
        contact = self.contact_force(phi, relative, rate)
        torque = contact.torque2 - self.load.torque
        if self.gear is not None:
            torque = torque - self.gear(relative, rate)
        acceleration = torque / self.inertia * self.mesh_period**2 / self.angle_scale
        # A pair that has lost its mesh stands still rather than run to infinity; the
        # caller reports it.
        meshing = lax.stop_gradient(jnp.abs(relative) < self.angle_limit)
        slope = jnp.stack([state[1], acceleration])
        return jnp.where(meshing, slope, 0.0), contact
