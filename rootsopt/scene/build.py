"""The scene: everything in a simulation except the design. It builds a rotor pair from a design.

A design is a vector of the config's design parameters, in the config's own units. Gradients are
therefore derivatives with respect to config units. A family without parameters (EE) has an empty
design.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rootsopt.config.families import family_of
from rootsopt.config.reading import Config
from rootsopt.config.units import DEG
from rootsopt.contact.gap import Contact
from rootsopt.contact.law import ContactLaw
from rootsopt.contact.search import SearchContact
from rootsopt.contact.wrapped import (
    TwistedContact,
    WornContact,
    greatest_twist,
    slices_needed,
    slices_of,
    wear_series,
)
from rootsopt.dynamics.integrator import Solver
from rootsopt.dynamics.pair import RotorPair
from rootsopt.dynamics.parts.base import Context, Part, Timescales
from rootsopt.dynamics.parts.load import (
    AxisLoads,
    ConstantLoad,
    GasLoad,
    GasResultant,
    Load,
    TwistedLoad,
)
from rootsopt.dynamics.parts.machine import (
    Drive,
    Friction,
    MotorDrive,
    PrescribedDrive,
    Supports,
    TimingGear,
)
from rootsopt.profiles import Geometry, Outline, Profile, geometry
from rootsopt.profiles.soundness import Soundness, soundness
from rootsopt.runtime.environment import check_precision
from rootsopt.scene import families, reading
from rootsopt.scene.reading import GRAVITY, Bearings, Medium

# Mean error of the contact torque of twisted rotors, relative to its maximum.
_SLICE_ERROR = 1e-2


class Scene(eqx.Module):
    """Everything except the design, in SI units: builds a rotor pair from a design.

    Physical quantities are arrays, and responses are differentiable with respect to them. Choices
    are static fields, so that one compiled program serves all scenes with the same choices.

    `family`, `lobes`, `pitch_radius` (m): profile; `design_size`: number d of design parameters.
    `twist_free`: whether the last one of them is the twist (°), which then replaces `helix`.
    `solver`: solver for the steady motion. `slices`: number of slices of twisted rotors, 0 for
    straight ones.
    `length` (m), `density` (kg/m³), `bore_radius` (m, `None`: no bore): body of a rotor. `helix`:
    twist over the length (rad), `None` for straight rotors.
    `law`, `clearance` (m): contact law, and distance added to every flank gap. `wear` (m, `None`:
    no wear): greatest depth of wear.
    `speed` (rad/s), `load_torque` (N·m), `pressure` (Pa, `None`: constant torque): operation.
    `gear`, `motor`, `friction`, `supports`: optional parts. `gear_damping_ratio`: damping of the
    gear as a share of critical damping, which `Scene` adds to `gear.damping` (0 from a config).
    `center_distance_error`: centre distance minus twice the pitch radius (m), or `None`. `outline`:
    profile read from a file, or `None`; `medium`: fluid and clearances for leakage, or `None`;
    `bearings`: what loads the bearings, or `None`; `extra`: further parts.

    >>> import jax
    >>> import rootsopt
    >>> jax.config.update("jax_enable_x64", True)
    >>> scene = rootsopt.Scene.from_config(rootsopt.load_config("cic"))
    >>> print(f"{scene.speed:.1f} rad/s, {scene.load_torque:.3f} N·m")
    314.2 rad/s, 4.775 N·m
    """

    family: str = eqx.field(static=True)
    lobes: int = eqx.field(static=True)
    slices: int = eqx.field(static=True)
    design_size: int = eqx.field(static=True)
    twist_free: bool = eqx.field(static=True)
    pitch_radius: Float[Array, ""]
    length: Float[Array, ""]
    density: Float[Array, ""]
    law: ContactLaw
    clearance: Float[Array, ""]
    speed: Float[Array, ""]
    load_torque: Float[Array, ""]
    gear: TimingGear | None
    gear_damping_ratio: Float[Array, ""]
    solver: Solver
    bore_radius: Float[Array, ""] | None = None
    helix: Float[Array, ""] | None = None
    wear: Float[Array, ""] | None = None
    pressure: Float[Array, ""] | None = None
    motor: MotorDrive | None = None
    friction: Friction | None = None
    supports: Supports | None = None
    center_distance_error: Float[Array, ""] | None = None
    outline: Outline | None = None
    medium: Medium | None = None
    bearings: Bearings | None = None
    extra: tuple[Part, ...] = ()

    @classmethod
    def from_config(cls, config: Config) -> "Scene":
        """Return the scene of a config.

        Raises `RuntimeError` if JAX is not set to double precision, and `InputError` if an outline
        file cannot be used."""
        check_precision()
        families.note_program(config.profile)
        scene = cls(
            family=config.profile.family,
            lobes=config.profile.lobes,
            slices=config.solver.slices or 0,
            design_size=len(config.design_keys),
            twist_free=config.twist_free,
            solver=reading.solver_of(config),
            outline=families.profile_from_file(config.profile),
            **reading.physical_quantities(config),
        )
        if scene.helix is None or scene.slices:
            return scene
        count = slices_needed(
            scene.profile(reading.design_vector(config)),
            scene.law,
            scene.clearance,
            jnp.asarray(scene.static_depth),
            greatest_twist(config) * DEG,
            _SLICE_ERROR,
        )
        return dataclasses.replace(scene, slices=count)

    def renewed(self, config: Config) -> "Scene":
        """Return this scene with the physical quantities of another `config`.

        The config must have the same parts as that of this scene. Profile and solver stay the
        same."""
        return dataclasses.replace(self, **reading.physical_quantities(config))

    def profile(self, design: Float[Array, " d"]) -> Profile:
        """Return the profile of a design (d,) in config units."""
        if self.outline is not None:
            return self.outline
        if self.twist_free:
            design = design[:-1]
        return families.profile_of(self.family, self.lobes, self.pitch_radius, design)

    def at(self, design: Float[Array, " d"]) -> "Scene":
        """Return this scene with the twist of a `design` (d,) in config units.

        If the twist is not a design parameter, return the scene unchanged."""
        if not self.twist_free:
            return self
        return dataclasses.replace(self, helix=design[-1] * DEG)

    def soundness(self, profile: Profile) -> Soundness:
        """Return the margins of all checks of a design with this `profile`."""
        return soundness(profile, self.bore_radius, family_of(self.family).inherent)

    @property
    def static_depth(self) -> float:
        """Penetration (m) at which the static contact force carries the load torque.

        The force is assumed to act at the pitch radius."""
        force = jnp.maximum(self.load_torque, 1e-3) / self.pitch_radius
        return float(self.law.depth_at(force))

    def inertia(self, shape: Geometry) -> Float[Array, ""]:
        """Return the moment of inertia (kg·m²) of one rotor about its axis.

        `shape`: geometry of the rotor."""
        moment = shape.polar_area_moment
        if self.bore_radius is not None:
            moment = moment - jnp.pi / 2 * self.bore_radius**4
        return self.density * self.length * moment

    def mass(self, shape: Geometry) -> Float[Array, ""]:
        """Return the mass (kg) of one rotor.

        `shape`: geometry of the rotor."""
        area = shape.area
        if self.bore_radius is not None:
            area = area - jnp.pi * self.bore_radius**2
        return self.density * self.length * area

    @property
    def two_sided(self) -> bool:
        """Whether drive and coast flanks may touch at the same time.

        They may do so if the axes can leave the nominal centre distance or the flanks are not
        conjugate.
        """
        odd = self.supports, self.center_distance_error, self.outline
        moved = any(part.displaces for part in self.extra)
        return moved or any(part is not None for part in odd)

    def with_parts(self, *parts: Part) -> "Scene":
        """Return this scene with further `parts`.

        The states of these parts come last in the state of a motion. Numbers in the parts' fields
        become arrays, so that responses are differentiable with respect to them."""
        return dataclasses.replace(self, extra=(*self.extra, *_as_arrays(parts)))

    def with_law(self, law: ContactLaw) -> "Scene":
        """Return this scene with another contact law.

        Numbers in the law's fields become arrays, so that responses are differentiable with respect
        to them."""
        return dataclasses.replace(self, law=_as_arrays(law))

    def contact(self, profile: Profile) -> Contact:
        """Return the contact of `profile` in this scene."""
        if self.helix is not None:
            straight = dataclasses.replace(self, helix=None)
            return TwistedContact(straight.contact(profile), self.helix, self.slices)
        distance = None
        if self.two_sided:
            error = self.center_distance_error
            distance = 2 * profile.pitch_radius + (0.0 if error is None else error)
        contact = SearchContact.of(profile, distance, self.two_sided)
        if self.wear is None:
            return contact
        lobes = jnp.asarray(float(self.lobes))
        return WornContact(contact, wear_series(profile, self.wear), lobes)

    def gear_of(self, inertia: Float[Array, ""]) -> TimingGear | None:
        """Return the timing gear between rotors of this `inertia` (kg·m²), with its damping."""
        gear = self.gear
        if gear is None:
            return None
        # I_r = I1 I2 / (I1 + I2) of two equal rotors.
        damping = 2 * self.gear_damping_ratio * jnp.sqrt(gear.stiffness * inertia / 2)
        return eqx.tree_at(lambda g: g.damping, gear, gear.damping + damping)

    def _drive(self, load: Load) -> Drive:
        """Return the drive of a pair under `load`.

        If the motor has no torque of its own, it gets the torque of the load."""
        motor = self.motor
        if motor is None:
            return PrescribedDrive(self.speed)
        torque = jnp.where(jnp.isnan(motor.torque), load.total, motor.torque)
        return eqx.tree_at(lambda m: (m.speed, m.torque), motor, (self.speed, torque))

    def load(self, profile: Profile, shape: Geometry) -> Load:
        """Return the load on the rotors: a constant torque, or that of the gas."""
        if self.pressure is None:
            return ConstantLoad(self.load_torque)
        across = self.pressure * self.length
        # ρ1² + ρ2² = 2 (r² + s²), and the area is π times the mean of r² + s².
        mean = across * (shape.outer_radius**2 - shape.area / jnp.pi) / 2
        load = GasLoad(
            pressure_length=across, profile=profile, outer_radius=shape.outer_radius, torque=mean
        )
        if self.helix is None:
            return load
        slices = slices_of(self.helix, self.slices)
        return TwistedLoad(section=load, offsets=slices.offsets, weights=slices.weights)  # pyright: ignore[reportCallIssue]

    def axis_loads(
        self, bearings: Bearings, load: Load, gear: TimingGear | None, mass: Float[Array, ""]
    ) -> AxisLoads:
        """Return the forces on the axes other than those of the flanks.

        `load`, `gear`: those of the pair; `mass` (kg) of a rotor."""
        gas = slices = None
        if isinstance(load, TwistedLoad):
            assert self.helix is not None
            load, slices = load.section, slices_of(self.helix, self.slices)
        if isinstance(load, GasLoad):
            across = load.pressure_length
            gas = GasResultant(across, load.profile, load.outer_radius, bearings.port, slices)
        weight = GRAVITY * mass if bearings.heavy else None
        return AxisLoads(gas, gear, bearings.tooth_angle, self.pitch_radius, weight)

    def pair(self, design: Float[Array, " d"]) -> RotorPair:
        """Return the rotor pair of a design in config units, differentiable with respect to it.

        Raises `InputError` as `pair_and_shape` does."""
        return self.pair_and_shape(design)[0]

    def pair_and_tangents(
        self, design: Float[Array, " d"], directions: Float[Array, "n d"] | tuple[()] | None = None
    ) -> tuple[RotorPair, RotorPair, Geometry]:
        """Return (rotor pair, its derivatives along `directions`, geometry of one rotor).

        `design` (d,): in config units. `directions` (n, d): directions in the design space, by
        default one per parameter. With `()`, no derivatives are computed. The derivatives have the
        pair's own structure, with a leading axis (n,). Raises `InputError` as `pair_and_shape`
        does."""
        if directions is None:
            directions = jnp.eye(design.shape[0])
        return along(self.pair_and_shape, design, directions)

    def pair_and_shape(self, design: Float[Array, " d"]) -> tuple[RotorPair, Geometry]:
        """Return (rotor pair, geometry of one rotor) for a design (d,) in config units.

        Raises `InputError` if the contact cannot be simulated in this scene."""
        self = self.at(design)
        profile = self.profile(design)
        shape = geometry(profile)
        inertia = self.inertia(shape)
        contact = self.contact(profile)
        gear = self.gear_of(inertia)
        force = jnp.maximum(self.load_torque, 1e-3) / self.pitch_radius
        angle = self.law.depth_at(force) / self.pitch_radius
        for part in (gear, *self.extra):
            if part is not None and part.play is not None:
                angle = angle + part.play
        # These are units for scaling, not physical quantities, so results do not depend on them.
        force, angle = jax.lax.stop_gradient((force, angle))
        load = self.load(profile, shape)
        context = Context(
            inertia=inertia,
            mass=self.mass(shape),
            pitch_radius=self.pitch_radius,
            angle=angle,
            load_torque=load.torque,
            speed=self.speed,
        )
        supports = None if self.supports is None else self.supports.prepare(context)
        extra = tuple(part.prepare(context) for part in self.extra)
        if supports is not None and self.bearings is not None:
            extra = (*extra, self.axis_loads(self.bearings, load, gear, context.mass))
        pair = RotorPair(
            lobes=self.lobes,
            contact=contact,
            law=self.law,
            clearance=self.clearance,
            inertia=inertia,
            drive=self._drive(load),
            load=load,
            gear=gear,
            angle_scale=angle,
            force_scale=force,
            friction=self.friction,
            supports=supports,
            two_sided=self.two_sided,
            parts=extra,
            soundness=self.soundness(profile),
        )
        timescales = Timescales.of(
            self.law, pair.all_parts, inertia, force, self.pitch_radius, self.clearance
        )
        return dataclasses.replace(pair, timescales=timescales), shape


def along(
    build: Callable[[Any], tuple[Any, Any]], primal: Any, directions: Any
) -> tuple[Any, Any, Any]:
    """Return (pair, derivatives of the pair along `directions`, geometry) of `build(primal)`.

    `build`: function that returns a rotor pair, or another module, and a result that needs no
    derivatives, such as the geometry of one rotor. `directions`: tree with the structure of
    `primal` and a leading axis, which may have length 0. The derivatives have the pair's own
    structure with the same leading axis."""

    def parted(primal):
        pair, shape = build(primal)
        dynamic, static = eqx.partition(pair, eqx.is_inexact_array)
        return dynamic, (_Static(static), shape)

    leaves = jax.tree.leaves(directions)
    if not leaves or leaves[0].shape[0] == 0:
        dynamic, (static, shape) = parted(primal)
        tangents = jax.tree.map(lambda x: jnp.zeros((0, *x.shape), x.dtype), dynamic)
    else:
        push = functools.partial(jax.jvp, parted, (primal,), has_aux=True)
        each = jax.vmap(lambda t: push((t,)), out_axes=(None, 0, None))
        dynamic, tangents, (static, shape) = each(directions)
    return eqx.combine(dynamic, static.value), tangents, shape


class _Static(eqx.Module):
    """Carries a value that is not an array through a JAX transformation."""

    value: Any = eqx.field(static=True)


def _as_arrays(tree):
    return jax.tree.map(lambda x: jnp.asarray(x, float) if isinstance(x, int | float) else x, tree)
