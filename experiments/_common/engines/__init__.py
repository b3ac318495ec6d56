"""Independent simulators of a CIC pair, for comparison with rootsopt.

`scipy_nodes` uses SciPy with node-to-segment contact. `numba_pair` is compiled by Numba. Both
differentiate by central differences. This module contains what both share: the scene in SI units,
the constants of rotor and motion, and the result. `transient` is rootsopt's own integration without
closed orbits.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from rootsopt.config import Config

_MM = 1e-3
_DEG = math.pi / 180

# A CIC design: pressure angle (deg), involute length (mm), tip arc angle (deg).
Design = Sequence[float]

# Steps (deg, mm, deg) of the central differences. Around the paper's baseline, the truncation
# error is 1e-4 of the gradient, at worst 1e-3. Forces at tolerances looser than 1e-7 are noisy
# and need steps two to four times as long.
FD_STEPS = (0.05, 0.025, 0.05)


class Scene(NamedTuple):
    """Everything except the design, in SI units.

    Rotors: lobes, pitch radius (m), rotor length (m), density (kg/m³). Contact: IMPACT stiffness
    (N/m^e), exponent, damping (N·s/m), depth of full damping (m), smoothing (m), clearance (m).
    Operation: speed of rotor 1 (rad/s), load torque (N·m). Timing gear: stiffness (N·m/rad; 0: no
    gear), half the backlash (rad), rounding of the ends of the backlash (rad).
    """

    lobes: int
    pitch_radius: float
    length: float
    density: float
    stiffness: float
    exponent: float
    damping: float
    full_damping_depth: float
    smoothing: float
    clearance: float
    speed: float
    load_torque: float
    gear_stiffness: float
    gear_damping_ratio: float
    half_backlash: float
    gear_rounding: float

    @classmethod
    def of(cls, config: Config) -> "Scene":
        """Return the scene of a config.

        Raises `ValueError` unless its family is cic and its only parts are a constant load and a
        timing gear.
        """
        if config.profile.family != "cic":
            raise ValueError(f"`profile.family` must be 'cic', but is {config.profile.family!r}")
        contact, scene, gear = config.contact, config.scene, config.scene.timing_gear
        torque = scene.load.torque_N_m
        parts = contact.friction, contact.wear, scene.supports, scene.bearings, scene.heat
        more = scene.motor, scene.phase_error_mrad, scene.center_distance_error_mm
        if any((*parts, *more, config.rotor.helix_deg)) or torque is None:
            raise ValueError(
                "`scene` must hold only a constant load and a timing gear; remove its other parts"
            )
        radius = config.profile.pitch_radius_mm * _MM
        return cls(
            lobes=config.profile.lobes,
            pitch_radius=radius,
            length=config.rotor.length_mm * _MM,
            density=config.rotor.density_kg_m3,
            stiffness=contact.stiffness_N_per_mm_e / _MM**contact.exponent,
            exponent=contact.exponent,
            damping=contact.max_damping_N_s_per_mm / _MM,
            full_damping_depth=contact.full_damping_depth_mm * _MM,
            smoothing=contact.rounding_mm * _MM,
            clearance=contact.clearance_mm * _MM,
            speed=scene.speed_rpm * 2 * math.pi / 60,
            load_torque=torque,
            gear_stiffness=gear.stiffness_N_m_per_rad if gear else 0.0,
            gear_damping_ratio=gear.damping_ratio if gear else 0.0,
            half_backlash=gear.backlash_mm * _MM / (2 * radius) if gear else 0.0,
            gear_rounding=contact.rounding_mm * _MM / radius,
        )


class Rotor(NamedTuple):
    """Constants of a CIC rotor (m, rad); see `rootsopt.profiles.cic`.

    `land_end`: normal angle at which the land ends and the arc starts; `arc_radius`, `arc_center`:
    radius of the arc, and distance of its centre from the axis; `arc_end`, `involute_end`: normal
    angles at which arc and involute end.
    """

    lobes: int
    radius: float
    alpha: float
    half_pitch: float
    land_end: float
    arc_end: float
    involute_end: float
    base_radius: float
    arc_center: float
    arc_radius: float


def rotor_of(scene: Scene, design: Design) -> Rotor:
    """Return the constants of the rotor of a design."""
    alpha, length, tip = design[0] * _DEG, design[1] * _MM, design[2] * _DEG
    r, half = scene.pitch_radius, math.pi / (2 * scene.lobes)
    start = half - length / (r * math.sin(alpha))
    offset = start - tip
    return Rotor(
        lobes=scene.lobes,
        radius=r,
        alpha=alpha,
        half_pitch=half,
        land_end=tip,
        arc_end=start + math.pi / 2 - alpha,
        involute_end=half + math.pi / 2 - alpha,
        base_radius=r * math.cos(alpha),
        arc_center=r * math.cos(alpha) / math.cos(alpha - offset),
        arc_radius=length / math.tan(alpha) + r * math.sin(offset) / math.cos(alpha - offset),
    )


class Motion(NamedTuple):
    """Constants of the equation of motion in a `scene`.

    `period`: mesh period (s), the unit of time; `turn`: rotation (rad) of rotor 1 in a mesh period;
    `angle_scale`: unit of ε (rad); `angle_limit`: |ε| (rad) above which a motion ends;
    `force_scale`: unit of force (N); `agility`: scaled acceleration per torque (1/(N·m));
    `gear_damping`: damping of the timing gear (N·m·s/rad).
    """

    scene: Scene
    period: float
    turn: float
    angle_scale: float
    angle_limit: float
    force_scale: float
    agility: float
    gear_damping: float


def motion_of(scene: Scene, polar_area_moment: float) -> Motion:
    """Return the constants of the motion of rotors with `polar_area_moment` (m⁴)."""
    inertia = scene.density * scene.length * polar_area_moment
    period = 2 * math.pi / (scene.lobes * scene.speed)
    force = max(scene.load_torque, 1e-3) / scene.pitch_radius
    depth = (force / scene.stiffness) ** (1 / scene.exponent)
    angle = depth / scene.pitch_radius + scene.half_backlash
    return Motion(
        scene=scene,
        period=period,
        turn=2 * math.pi / scene.lobes,
        angle_scale=angle,
        angle_limit=math.pi / (8 * scene.lobes),
        force_scale=force,
        agility=period**2 / (angle * inertia),
        # The damping ratio refers to the reduced inertia of two equal rotors.
        gear_damping=2 * scene.gear_damping_ratio * math.sqrt(scene.gear_stiffness * inertia / 2),
    )


@dataclasses.dataclass(frozen=True)
class Result:
    """Result of one simulation.

    Fields: mean, peak and RMS contact force (N) over the window, and the largest |ε| (rad) in it.
    """

    mean: float
    peak: float
    rms: float
    reached: float


class Engine(Protocol):
    """A simulator of a scene."""

    def simulate(self, design: Design) -> Result:
        """Start from ε = 0, dε/dt = 0 at φ = 0, settle, then average over the window."""
        ...

    def forces(self, design: Design) -> NDArray[np.float64]:
        """Return mean and peak contact force (2,) in N."""
        found = self.simulate(design)
        return np.array([found.mean, found.peak])


def central_differences(
    forces: Callable[[Design], NDArray[np.float64]], design: Design, steps: Sequence[float]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the forces (n,) of a design (d,), and their derivatives (n, d) per config unit.

    Central differences need 2 d further simulations; `steps` (d,): in config units."""
    base, ways = np.asarray(design), np.diag(steps)
    ends = [(forces((base + way).tolist()), forces((base - way).tolist())) for way in ways]
    columns = [(up - down) / (2 * step) for (up, down), step in zip(ends, steps, strict=True)]
    return forces(design), np.stack(columns, axis=1)


def best_steps(
    forces: Callable[[Design], NDArray[np.float64]], design: Design, truth: NDArray[np.float64]
) -> tuple[list[float], float]:
    """Return the steps of the central differences, `FD_STEPS` or thrice those, that err less.

    `truth` (n, d): the gradients of the forces. The second result is the factor, 1 or 3."""
    choices = {factor: [factor * step for step in FD_STEPS] for factor in (1.0, 3.0)}

    def error(factor: float) -> float:
        off = np.abs(central_differences(forces, design, choices[factor])[1] - truth)
        return float(np.max(off.max(axis=1) / np.abs(truth).max(axis=1)))

    factor = min(choices, key=error)
    return choices[factor], factor


# The contact law and the rounded ends of the backlash


def ramp(x: float, width: float) -> float:
    if x >= width:
        return max(x, 0.0)
    t = max(x, 0.0) / width
    return width * t * t * (2 - t)


def smooth_step(x: float) -> float:
    t = min(max(x, 0.0), 1.0)
    return t * t * (3 - 2 * t)


def balanced_ramp(x: float, width: float) -> float:
    """Return a smooth ramp, as `ramp`, but with the same integral as max(0, x)."""
    t = min(max(x, 0.0) / width, 1.0) if width > 0 else 1.0
    return max(x, 0.0) if t == 1 else width * t * t * (4.5 - 6 * t + 2.5 * t * t)


def balanced_step(x: float) -> float:
    """Return a smooth step, as `smooth_step`, but with the same integral as a step at 0."""
    t = min(max(x, 0.0), 1.0)
    return t * t * (18 - 32 * t + 15 * t * t)


def impact(scene: Scene, depth: float, rate: float) -> float:
    """Return the IMPACT force (N) at a penetration (m) that grows at `rate` (m/s)."""
    if depth <= 0:
        return 0.0
    delta = ramp(depth, scene.smoothing)
    elastic = scene.stiffness * delta**scene.exponent
    damped = scene.damping * smooth_step(delta / scene.full_damping_depth) * rate
    share = min(scene.smoothing / scene.full_damping_depth, 1.0)
    return ramp(elastic + damped, share * elastic)


def gear_torque(motion: Motion, relative: float, rate: float) -> float:
    """Return the torque (N·m) of the timing gear against ε (rad) and its rate (rad/s)."""
    scene = motion.scene
    excess = abs(relative) - scene.half_backlash
    if excess <= 0:
        return 0.0
    engaged = balanced_step(excess / scene.gear_rounding) if scene.gear_rounding > 0 else 1.0
    spring = scene.gear_stiffness * balanced_ramp(excess, scene.gear_rounding)
    return math.copysign(spring, relative) + motion.gear_damping * engaged * rate
