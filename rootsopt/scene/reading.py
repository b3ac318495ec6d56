"""Converts a config into the parts of a scene: SI quantities, contact law, parts, fluid, solver."""

from pathlib import Path
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rootsopt.config.reading import Config
from rootsopt.config.scene import BearingsConfig, TimingGearConfig
from rootsopt.config.units import DEG, MM, RPM, UM
from rootsopt.contact.law import ImpactLaw
from rootsopt.dynamics.integrator import Integrator, Solver
from rootsopt.dynamics.orbit import Measures
from rootsopt.dynamics.parts.machine import Friction, GearErrors, MotorDrive, Supports, TimingGear
from rootsopt.measured.table import transmission_error

# Limit on the number of solver steps for a whole orbit, as a multiple of the number that the config
# allows per mesh period. An orbit has several mesh periods, and many short steps near its kinks.
_ORBIT_STEPS = 4


def design_vector(config: Config) -> Float[Array, " d"]:
    """Return the config's design parameters (d,) in config units; d = 3 for CIC, 0 for EE."""
    return jnp.asarray(config.design)


def physical_quantities(config: Config) -> dict[str, Any]:
    """Return all physical quantities of a config in SI units, keyed by `Scene` field names.

    They include the IMPACT contact law and the parts, and what leakage and the bearings need."""
    rotor, scene, contact = config.rotor, config.scene, config.contact
    gear, heat, wear = scene.timing_gear, scene.heat, contact.wear
    clearance, error = contact.clearance_mm, scene.center_distance_error_mm
    if wear is not None:
        clearance += 2 * wear.offset_mm
    if heat is not None:
        # Rotors that grow in proportion mesh as before. Only the housing's growth relative to
        # theirs matters: it changes the centre distance.
        error = (error or 0.0) + 2 * config.profile.pitch_radius_mm * heat.strain
    return {
        "pitch_radius": jnp.asarray(config.profile.pitch_radius_mm * MM),
        "length": jnp.asarray(rotor.length_mm * MM),
        "density": jnp.asarray(rotor.density_kg_m3),
        "clearance": jnp.asarray(clearance * MM),
        "speed": jnp.asarray(scene.speed_rpm * RPM),
        "load_torque": jnp.asarray(config.load_torque),
        "gear_damping_ratio": jnp.asarray(0.0 if gear is None else gear.damping_ratio),
        "bore_radius": _optional(rotor.bore_mm, MM / 2),
        "helix": _optional(rotor.helix_deg if config.twist_free else rotor.helix_deg or None, DEG),
        "wear": None if wear is None else jnp.asarray(wear.depth_mm * MM),
        "pressure": _optional(scene.load.pressure_difference_Pa),
        "center_distance_error": _optional(error, MM),
        "medium": medium_of(config),
        "bearings": bearings_of(config),
        "law": ImpactLaw(
            stiffness=jnp.asarray(contact.stiffness_N_per_mm_e / MM**contact.exponent),
            exponent=jnp.asarray(contact.exponent),
            damping=jnp.asarray(contact.max_damping_N_s_per_mm / MM),
            full_damping_depth=jnp.asarray(contact.full_damping_depth_mm * MM),
            smoothing=jnp.asarray(contact.rounding_mm * MM),
        ),
        "gear": gear_of(config),
        **parts_of(config),
    }


def gear_of(config: Config) -> TimingGear | None:
    """Return the timing gear of a config in SI units; `None` if the config has no gear.

    The damping is 0 here. `Scene` adds the damping that follows from the damping ratio, because it
    depends on the rotors' inertia."""
    gear, radius = config.scene.timing_gear, config.profile.pitch_radius_mm * MM
    if gear is None:
        return None
    return TimingGear(
        stiffness=jnp.asarray(gear.stiffness_N_m_per_rad),
        damping=jnp.asarray(0.0),
        half_backlash=jnp.asarray(gear.backlash_mm * MM / (2 * radius)),
        rounding=jnp.asarray(config.contact.rounding_mm * MM / radius),
        offset=_optional(config.scene.phase_error_mrad, 1e-3),
        errors=_errors_of(gear, config.scene.bearings, radius) if gear.errs else None,
    )


def _errors_of(
    gear: TimingGearConfig, bearings: BearingsConfig | None, radius: float
) -> GearErrors:
    """Return the errors of a timing gear at the pitch `radius` (m).

    Raises `InputError` if the table of the transmission error cannot be used."""
    sizes, angles = gear.run_out
    knots = measured = None
    if gear.transmission_error_file is not None:
        turned, powers = transmission_error(Path(gear.transmission_error_file))
        knots, measured = jnp.asarray(turned), jnp.asarray(powers / radius)
    return GearErrors(
        eccentricity=jnp.asarray(sizes) * UM / radius,
        angle=jnp.asarray(angles) * DEG,
        tooth_angle=_optional(bearings and bearings.gear_pressure_angle_deg, DEG),
        knots=knots,
        measured=measured,
    )


def parts_of(config: Config) -> dict[str, Any]:
    """Return the motor, friction and supports of a config, keyed by `Scene` field names.

    A part that the config does not have is `None`. Numbers that `Scene` sets later, such as those
    that depend on the design, are NaN."""
    scene, friction = config.scene, config.contact.friction
    missing = jnp.asarray(float("nan"))
    return {
        "motor": None
        if scene.motor is None
        else MotorDrive(
            speed=missing,
            torque=missing
            if scene.motor.torque_N_m is None
            else jnp.asarray(scene.motor.torque_N_m),
            slope=jnp.asarray(scene.motor.slope_N_m_s_per_rad),
            inertia=jnp.asarray(scene.motor.inertia_kg_m2),
        ),
        "friction": None
        if friction is None
        else Friction(
            static=jnp.asarray(friction.static),
            kinetic=jnp.asarray(friction.kinetic),
            stiction_speed=jnp.asarray(friction.stiction_speed_mm_s * MM),
            friction_speed=jnp.asarray(friction.friction_speed_mm_s * MM),
        ),
        "supports": None
        if scene.supports is None
        else Supports(
            stiffness=jnp.asarray(scene.supports.stiffness_N_per_mm / MM),
            damping=jnp.asarray(scene.supports.damping_N_s_per_mm / MM),
            mass=missing,
            radius=missing,
        ),
    }


def solver_of(config: Config) -> Solver:
    """Return the solver for the steady motion, with the config's settings."""
    settings = config.solver
    method, steps = settings.method, settings.max_steps_per_period
    return Solver(
        transient=Integrator(method, jnp.asarray(settings.transient_tolerance), steps),
        orbit=Integrator(method, jnp.asarray(settings.orbit_tolerance), _ORBIT_STEPS * steps),
        measures=measures(config),
        max_periods=jnp.asarray(float(settings.max_mesh_periods)),
        probe_chaos=jnp.asarray(1.0),
        max_orbit=settings.max_orbit_periods,
        variation=config.response.reserve,
    )


def measures(config: Config) -> Measures:
    """Return the measures of the force that a config's report or objective needs."""
    objective = config.objective
    weighted = [order for order, weight in objective.line_weights.items() if weight]
    orders = dict.fromkeys([*config.response.lines, *weighted])
    norm = objective.peak_norm
    return Measures(np.array([*orders], float), None if norm is None else jnp.asarray(norm))


def _optional(value: float | None, unit: float = 1.0) -> Float[Array, ""] | None:
    return None if value is None else jnp.asarray(value * unit)


# One millipascal-second (Pa·s).
_MPA_S = 1e-3


class Gas(eqx.Module):
    """An ideal gas: `inlet_pressure` (Pa), `temperature` (K), `gas_constant` (J/(kg·K)) and
    `heat_ratio`, the ratio of its specific heats."""

    inlet_pressure: Float[Array, ""]
    temperature: Float[Array, ""]
    gas_constant: Float[Array, ""]
    heat_ratio: Float[Array, ""]


class Medium(eqx.Module):
    """What leakage needs beyond a simulation, in SI units.

    `viscosity` (Pa·s); `pressure_difference` (Pa), discharge minus suction. `tip_clearance`,
    `end_clearance` (m), `None`: no leakage there; `tips`: tips that seal in series.
    `radial_allowance` (m): radius by which both rotors are smaller everywhere. `strain`: growth of
    the housing minus that of the rotors, as a fraction of any length; `None`: all have the same
    temperature. `gas`: `None` for a liquid."""

    viscosity: Float[Array, ""]
    pressure_difference: Float[Array, ""]
    tip_clearance: Float[Array, ""] | None
    end_clearance: Float[Array, ""] | None
    radial_allowance: Float[Array, ""]
    strain: Float[Array, ""] | None
    gas: Gas | None
    tips: int = eqx.field(static=True)


def medium_of(config: Config) -> Medium | None:
    """Return the medium of a config; `None` if it has no section `pump`."""
    pump = config.pump
    if pump is None:
        return None
    gas, tip = pump.gas, pump.tip_clearance_mm
    wear, heat = config.contact.wear, config.scene.heat
    if wear is not None and tip is not None:
        tip = tip + wear.offset_mm
    return Medium(
        viscosity=jnp.asarray(pump.viscosity_mPa_s * _MPA_S),
        pressure_difference=jnp.asarray(pump.pressure_difference_Pa),
        tip_clearance=_optional(tip, MM),
        end_clearance=_optional(pump.end_clearance_mm, MM),
        radial_allowance=jnp.asarray(pump.radial_allowance_mm * MM),
        strain=None if heat is None else jnp.asarray(heat.strain),
        gas=None
        if gas is None
        else Gas(
            inlet_pressure=jnp.asarray(gas.inlet_pressure_Pa),
            temperature=jnp.asarray(gas.temperature_K),
            gas_constant=jnp.asarray(gas.gas_constant_J_per_kg_K),
            heat_ratio=jnp.asarray(gas.heat_ratio),
        ),
        tips=pump.tips_in_series,
    )


GRAVITY = 9.80665
"""Standard acceleration of free fall (m/s²)."""
# Exponents of the life of bearings (ISO 281).
_EXPONENTS = {"ball": 3.0, "roller": 10 / 3}


class Bearings(eqx.Module):
    """Two bearings per rotor, equally far from its end faces, and the gear beyond one.

    `tooth_angle` (rad): pressure angle of the timing gear; `port` (rad): angle before the lowest
    point of the bore at which a pocket opens to discharge; `distance` (m): of each bearing from the
    nearer end face; `gear_distance` (m): of the timing gear from the end face at z = L/2;
    `exponent`: p of the equivalent load, (mean |F|^p)^(1/p); `heavy`: whether the rotors' weight
    counts."""

    tooth_angle: Float[Array, ""]
    port: Float[Array, ""]
    distance: Float[Array, ""]
    gear_distance: Float[Array, ""]
    exponent: float = eqx.field(static=True)
    heavy: bool = eqx.field(static=True)


def bearings_of(config: Config) -> Bearings | None:
    """Return the bearings of a config; `None` if it has no section `scene.bearings`."""
    given = config.scene.bearings
    if given is None:
        return None
    return Bearings(
        tooth_angle=jnp.asarray(given.gear_pressure_angle_deg * DEG),
        port=jnp.asarray(given.port_deg * DEG),
        distance=jnp.asarray(given.bearing_distance_mm * MM),
        gear_distance=jnp.asarray(given.gear_distance_mm * MM),
        exponent=_EXPONENTS[given.kind],
        heavy=given.weight,
    )
