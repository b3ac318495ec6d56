"""From config to model: units, profile, rotor pair.

A design is a vector of the config's design parameters in the config's own units
(`FAMILY_KEYS`; none for EE), so gradients come out per config unit.
"""

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike, NDArray

from rootsopt import families
from rootsopt.config import Config
from rootsopt.contact.gap import Contact
from rootsopt.contact.impact import ImpactLaw
from rootsopt.contact.law import ContactLaw
from rootsopt.contact.linear import LinearContact
from rootsopt.contact.map import MapContact
from rootsopt.contact.search import SearchContact
from rootsopt.contact.segments import NodeContact
from rootsopt.dynamics.flow import Integrator
from rootsopt.dynamics.measures import Measures
from rootsopt.dynamics.pace import Pace
from rootsopt.dynamics.pair import RotorPair
from rootsopt.dynamics.parts import (
    ConstantLoad,
    Context,
    Drive,
    Friction,
    GasLoad,
    Load,
    MotorDrive,
    Part,
    PrescribedDrive,
    Supports,
    TimingGear,
)
from rootsopt.dynamics.steady import Solver
from rootsopt.errors import InputError
from rootsopt.families import MM
from rootsopt.profiles import Geometry, Outline, Profile, geometry, outline
from rootsopt.programs import Program

_ORBIT_STEPS = 4
"""Steps allowed for a whole orbit, in units of those for a mesh period."""
_ROLLS, _RELATIVES = 384, 16
"""Map of a model nobody has sized."""


class Scene(eqx.Module):
    """Everything but the design, in SI units: builds a rotor pair from a design.

    Physical quantities are leaves that one may differentiate with respect to, choices are static,
    so that one compiled program serves every scene of the same kind. `solver`: how its steady
    motion is found.
    """

    family: str = eqx.field(static=True)
    lobes: int = eqx.field(static=True)
    fidelity: str = eqx.field(static=True)
    precision: str = eqx.field(static=True)
    map_size: tuple[int, int] = eqx.field(static=True)
    nodes: int = eqx.field(static=True)
    straight: bool = eqx.field(static=True)
    design_size: int = eqx.field(static=True)
    pitch_radius: Float[Array, ""]
    length: Float[Array, ""]
    density: Float[Array, ""]
    law: ContactLaw
    clearance: Float[Array, ""]
    speed: Float[Array, ""]
    load_torque: Float[Array, ""]
    gear: TimingGear | None
    gear_damping_ratio: Float[Array, ""]
    deepest: Float[Array, ""]
    solver: Solver
    bore_radius: Float[Array, ""] | None = None
    pressure: Float[Array, ""] | None = None
    motor: MotorDrive | None = None
    friction: Friction | None = None
    supports: Supports | None = None
    center_distance_error: Float[Array, ""] | None = None
    outline: Outline | None = None
    extra: tuple[Part, ...] = ()

    @classmethod
    def from_config(cls, config: Config, deepest: float | None = None) -> "Scene":
        """Return the scene of a config; `deepest` (rad < 0) is the relative rotation that the
        contact map must reach, estimated from the scene when not given. (The map has a middling
        size where the config leaves that open; `evaluate` chooses it by `solver.map_error`.)

        Raises RuntimeError where the config asks for a precision JAX is not set to."""
        contact, scene, solver = config.contact, config.scene, config.solver
        check_precision(solver.precision)
        radius = config.profile.pitch_radius_mm * MM
        scale = contact.exponent
        law = ImpactLaw(
            stiffness=jnp.asarray(contact.stiffness_N_per_mm_e / MM**scale),
            exponent=jnp.asarray(scale),
            damping=jnp.asarray(contact.max_damping_N_s_per_mm / MM),
            full_damping_depth=jnp.asarray(contact.full_damping_depth_mm * MM),
            smoothing=jnp.asarray(contact.rounding_mm * MM),
        )
        gear = None
        damping_ratio = 0.0
        if scene.timing_gear is not None:
            damping_ratio = scene.timing_gear.damping_ratio
            gear = TimingGear(
                stiffness=jnp.asarray(scene.timing_gear.stiffness_N_m_per_rad),
                damping=jnp.asarray(0.0),
                half_backlash=jnp.asarray(scene.timing_gear.backlash_mm * MM / (2 * radius)),
                rounding=jnp.asarray(contact.rounding_mm * MM / radius),
                offset=_optional(scene.phase_error_mrad, 1e-3),
            )
        if deepest is None:
            deepest = _expected_rotation(config)
        return cls(
            family=config.profile.family,
            lobes=config.profile.lobes,
            fidelity=solver.fidelity,
            precision=solver.precision,
            map_size=(solver.map_rolls or _ROLLS, solver.map_relatives or _RELATIVES),
            nodes=solver.nodes,
            straight=config.rotor.helix_deg == 0,
            design_size=len(design_keys(config)),
            pitch_radius=jnp.asarray(radius),
            length=jnp.asarray(config.rotor.length_mm * MM),
            density=jnp.asarray(config.rotor.density_kg_m3),
            law=law,
            clearance=jnp.asarray(contact.clearance_mm * MM),
            speed=jnp.asarray(scene.speed_rpm * 2 * math.pi / 60),
            load_torque=jnp.asarray(config.load_torque),
            gear=gear,
            gear_damping_ratio=jnp.asarray(damping_ratio),
            deepest=jnp.asarray(deepest),
            solver=solver_of(config),
            bore_radius=_optional(config.rotor.bore_mm, MM / 2),
            pressure=_optional(scene.load.pressure_difference_Pa),
            center_distance_error=_optional(scene.center_distance_error_mm, MM),
            outline=families.outline(config.profile),
            **_parts(config),
        )

    def profile(self, design: Float[Array, " d"]) -> Profile:
        """The profile of a design given in config units."""
        if self.outline is not None:
            return self.outline
        return families.profile_of(self.family, self.lobes, self.pitch_radius, design)

    @property
    def static_depth(self) -> float:
        """Penetration (m) that carries the load at the pitch radius."""
        force = jnp.maximum(self.load_torque, 1e-3) / self.pitch_radius
        return float(self.law.depth_at(force))

    def inertia(self, shape: Geometry) -> Float[Array, ""]:
        """Polar moment of inertia of one rotor about its axis (kg·m²)."""
        moment = shape.polar_area_moment
        if self.bore_radius is not None:
            moment = moment - jnp.pi / 2 * self.bore_radius**4
        return self.density * self.length * moment

    def mass(self, shape: Geometry) -> Float[Array, ""]:
        """Mass of one rotor (kg)."""
        area = shape.area
        if self.bore_radius is not None:
            area = area - jnp.pi * self.bore_radius**2
        return self.density * self.length * area

    @property
    def both(self) -> bool:
        """Whether drive and coast flanks may touch at once: the axes may be elsewhere than at the
        nominal centre distance, or the flanks are not conjugate."""
        odd = self.supports, self.center_distance_error, self.outline
        moved = any(part.displaces for part in self.extra)
        return moved or any(part is not None for part in odd)

    def with_parts(self, *parts: Part) -> "Scene":
        """This scene with further parts, which follow the others in the state of a motion.

        Numbers that are their fields become arrays; responses are differentiable with respect to
        them."""
        return dataclasses.replace(self, extra=(*self.extra, *_as_arrays(parts)))

    def with_law(self, law: ContactLaw) -> "Scene":
        """This scene with another contact law, whose numbers become arrays."""
        return dataclasses.replace(self, law=_as_arrays(law))

    def contact(self, profile: Profile) -> Contact:
        """Gap and levers of `profile` at this scene's fidelity."""
        if self.fidelity == "map":
            return MapContact.of(profile, self.deepest, *self.map_size)
        if self.fidelity == "linear":
            return LinearContact.of(profile)
        if self.fidelity == "nodes":
            return NodeContact.of(profile, self.nodes)
        if self.fidelity == "auto":
            raise InputError(
                "`solver.fidelity` must be chosen before a pair is built, but is auto; call "
                "rootsopt.response.choice.choose first"
            )
        if not self.both:
            return SearchContact.of(profile)
        error = self.center_distance_error
        distance = 2 * profile.pitch_radius + (0.0 if error is None else error)
        return SearchContact.of(profile, distance, two_sided=True)

    def _drive(self, load: Load) -> Drive:
        """The drive; a motor without a torque of its own is given what the load takes."""
        motor = self.motor
        if motor is None:
            return PrescribedDrive(self.speed)
        torque = jnp.where(jnp.isnan(motor.torque), load.total, motor.torque)
        return eqx.tree_at(lambda m: (m.speed, m.torque), motor, (self.speed, torque))

    def _load(self, profile: Profile, shape: Geometry) -> Load:
        if self.pressure is None:
            return ConstantLoad(self.load_torque)
        across = self.pressure * self.length
        # ρ1² + ρ2² = 2 (r² + s²), and the area is π times the mean of r² + s².
        mean = across * (shape.outer_radius**2 - shape.area / jnp.pi) / 2
        return GasLoad(
            pressure_length=across, profile=profile, outer_radius=shape.outer_radius, torque=mean
        )

    def pair(self, design: Float[Array, " d"]) -> RotorPair:
        """The rotor pair of a design in config units, differentiable in it."""
        return self.pair_and_shape(design)[0]

    def pair_and_tangents(
        self, design: Float[Array, " d"], directions: Float[Array, "n d"] | tuple[()] | None = None
    ) -> tuple[RotorPair, RotorPair, Geometry]:
        """The rotor pair, its derivatives along the `directions` of the design (by default those of
        its parameters; () for none) stacked along a leading axis in the pair's own structure, and
        the rotor's geometry."""
        if directions is None:
            directions = jnp.eye(design.shape[0])
        return along(lambda design: self.pair_and_shape(design), design, directions)

    def pair_and_shape(self, design: Float[Array, " d"]) -> tuple[RotorPair, Geometry]:
        """The rotor pair and the geometry of one rotor.

        Raises `InputError` for twisted rotors: along their length every phase of the mesh is met
        at once, which the pair of this package knows nothing of."""
        if not self.straight:
            raise InputError(
                "`rotor.helix_deg` must be 0 for a simulation, which is of straight rotors; set "
                "it to 0 to simulate straight rotors of the same section, or draw the twisted "
                "ones with `rootsopt profile`"
            )
        profile = self.profile(design)
        shape = geometry(profile)
        inertia = self.inertia(shape)
        contact = self.contact(profile)
        gear = self.gear
        if gear is not None:
            # I_r = I1 I2 / (I1 + I2) of two equal rotors.
            damping = 2 * self.gear_damping_ratio * jnp.sqrt(gear.stiffness * inertia / 2)
            gear = eqx.tree_at(lambda g: g.damping, gear, damping)
        force = jnp.maximum(self.load_torque, 1e-3) / self.pitch_radius
        angle = self.law.depth_at(force) / self.pitch_radius
        for part in (gear, *self.extra):
            if part is not None and part.play is not None:
                angle = angle + part.play
        # Units, no quantities: nothing depends on them.
        force, angle = jax.lax.stop_gradient((force, angle))
        load = self._load(profile, shape)
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
            two_sided=self.both,
            parts=extra,
        )
        pace = Pace.of(self.law, pair.all_parts, inertia, force, self.pitch_radius, self.clearance)
        pair = dataclasses.replace(pair, pace=pace)
        if self.precision == "float32":
            # Built in double precision; single only where it is integrated.
            pair = jax.tree.map(_single, pair)
        return pair, shape


def along(
    build: Callable[[Any], tuple[RotorPair, Geometry]], primal: Any, directions: Any
) -> tuple[RotorPair, RotorPair, Geometry]:
    """The rotor pair and geometry that `build(primal)` gives, and the pair's derivatives along the
    `directions` of the primal (stacked along a leading axis; there may be none), stacked likewise
    in the pair's own structure."""

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
    """Carries what is not an array through a transformation."""

    value: Any = eqx.field(static=True)


def _single(leaf):
    return leaf.astype(jnp.float32) if eqx.is_inexact_array(leaf) else leaf


def _as_arrays(tree):
    """`tree` with arrays in place of numbers."""
    return jax.tree.map(lambda x: jnp.asarray(x, float) if isinstance(x, int | float) else x, tree)


def _optional(value: float | None, unit: float = 1.0) -> Float[Array, ""] | None:
    return None if value is None else jnp.asarray(value * unit)


def _parts(config: Config) -> dict[str, Any]:
    """The parts of a model that a design does not change; what it does is filled in with it."""
    scene, friction = config.scene, config.contact.friction
    parts: dict[str, Any] = {}
    missing = jnp.asarray(float("nan"))
    if scene.motor is not None:
        torque = scene.motor.torque_N_m
        parts["motor"] = MotorDrive(
            speed=missing,
            torque=missing if torque is None else jnp.asarray(torque),
            slope=jnp.asarray(scene.motor.slope_N_m_s_per_rad),
            inertia=jnp.asarray(scene.motor.inertia_kg_m2),
        )
    if friction is not None:
        parts["friction"] = Friction(
            static=jnp.asarray(friction.static),
            kinetic=jnp.asarray(friction.kinetic),
            stiction_speed=jnp.asarray(friction.stiction_speed_mm_s * MM),
            friction_speed=jnp.asarray(friction.friction_speed_mm_s * MM),
        )
    if scene.supports is not None:
        parts["supports"] = Supports(
            stiffness=jnp.asarray(scene.supports.stiffness_N_per_mm / MM),
            damping=jnp.asarray(scene.supports.damping_N_s_per_mm / MM),
            mass=missing,
            radius=missing,
        )
    return parts


def _expected_rotation(config: Config) -> float:
    """Relative rotation (rad, negative) a scene is expected to reach: the backlash and
    clearance taken up, plus an impact ten times the static contact force."""
    contact, scene = config.contact, config.scene
    radius = config.profile.pitch_radius_mm
    play = contact.clearance_mm
    if scene.timing_gear is not None:
        play += scene.timing_gear.backlash_mm / 2
    force = 20 * max(config.load_torque, 0.01) / (radius * MM)
    depth = (force / contact.stiffness_N_per_mm_e) ** (1 / contact.exponent)
    return -min((1.3 * play + 1.5 * depth) / radius, math.pi / (8 * config.profile.lobes))


def design_vector(config: Config) -> Float[Array, " d"]:
    """The config's design parameters in config units: (3,) for CIC, (0,) for EE."""
    return families.design_of(config.profile)


def design_keys(config: Config) -> tuple[str, ...]:
    """Names of the entries of `design_vector`."""
    return families.keys_of(config.profile)


def outline_mm(config: Config, design: ArrayLike | None = None) -> NDArray[np.float64]:
    """Closed counter-clockwise outline (n, 2) in mm of a design, by default the config's."""
    design = design_vector(config) if design is None else jnp.asarray(design)
    profile = _profile(Scene.from_config(config), design)
    return np.asarray(outline(profile, points=240)) / MM


_profile = Program(Scene.profile)


def integrators(config: Config) -> tuple[Integrator, Integrator]:
    """(transient, orbit) integrators of a config.

    An orbit has several mesh periods, and many short steps about its kinks."""
    solver = config.solver
    steps = solver.max_steps_per_period
    return (
        Integrator(solver.method, jnp.asarray(solver.transient_rtol), steps),
        Integrator(solver.method, jnp.asarray(solver.rtol), _ORBIT_STEPS * steps),
    )


def solver_of(config: Config) -> Solver:
    """How a config asks for its steady motion to be found."""
    settings = config.solver
    transient, orbit = integrators(config)
    return Solver(
        transient=transient,
        orbit=orbit,
        measures=measures(config),
        max_periods=jnp.asarray(float(settings.max_mesh_periods)),
        examine=jnp.asarray(1.0),
        max_orbit=settings.max_orbit_periods,
        precision=settings.precision,
    )


def check_precision(precision: str) -> None:
    """Raise RuntimeError unless JAX is set to this `precision` (float64 or float32)."""
    if precision == "float64" and not jax.config.read("jax_enable_x64"):
        raise RuntimeError(
            "JAX computes in single precision here: call "
            'jax.config.update("jax_enable_x64", True) before anything else, or set '
            "solver.precision to float32"
        )


def measures(config: Config) -> Measures:
    """What of the force a config asks for, in its report or its objective."""
    objective = config.objective
    weighted = [order for order, weight in objective.line_weights.items() if weight]
    orders = dict.fromkeys([*config.response.lines, *weighted])
    norm = objective.peak_norm
    return Measures(np.array([*orders], float), None if norm is None else jnp.asarray(norm))


def check_geometry(config: Config) -> None:
    """Raise `InputError` unless the config's profile can be made and meshes, and leaves room for
    the bore."""
    _check_profile(config)
    bore = config.rotor.bore_mm
    if bore is None:
        return
    root = float(_shape(Scene.from_config(config), design_vector(config)).root_radius) / MM
    if bore >= 2 * root:
        raise InputError(
            f"`rotor.bore_mm` must be less than {2 * root:.6g} (the root circle), but is "
            f"{bore:g}; make it smaller"
        )


@Program
def _shape(model: Scene, design):
    """Geometry of a design in config units."""
    return geometry(model.profile(design))


def _check_profile(config: Config) -> None:
    """Raise `InputError` unless the config's profile can be made and meshes."""
    families.check(config.profile)
