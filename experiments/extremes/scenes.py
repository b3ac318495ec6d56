"""Scenes at and between the limits of a config, as a random cloud and as a grid.

A `Kind` holds everything that determines the compiled program: family, lobes, parts, solver. All
scenes of a kind therefore share one program.
"""

import dataclasses
import functools
import itertools
import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from experiments._common.scenes import shipped
from rootsopt.config import DESIGN_KEYS, Config

# Longest involute that a config accepts, in units of u_max.
_OVERLENGTH = 1.02

# Ranges of the random values by config key, uniform in the logarithm.
SPANS: dict[str, tuple[float, float]] = {
    "contact.stiffness_N_per_mm_e": (1e3, 1e9),
    "contact.max_damping_N_s_per_mm": (1e-4, 10.0),
    "contact.full_damping_depth_mm": (1e-5, 1.0),
    "contact.smoothing_mm": (1e-6, 0.1),
    "scene.speed_rpm": (1.0, 6e4),
    "scene.load.torque_N_m": (1e-3, 1e3),
    "scene.timing_gear.backlash_mm": (1e-4, 1.0),
    "scene.timing_gear.stiffness_N_m_per_rad": (1e2, 1e6),
    "rotor.length_mm": (1.0, 1e3),
    "solver.rtol": (1e-12, 1e-2),
    "solver.transient_rtol": (1e-12, 1e-2),
}

# Ranges by config key for scenes of the kind `pump`: gas load and motor replace the constant
# load.
PUMP_SPANS: dict[str, tuple[float, float]] = {
    "scene.load.pressure_difference_Pa": (1.0, 1e7),
    "scene.motor.slope_N_m_s_per_rad": (1e-3, 10.0),
    "scene.motor.inertia_kg_m2": (1e-6, 1.0),
    "scene.supports.stiffness_N_per_mm": (1e2, 1e7),
    "scene.supports.damping_N_s_per_mm": (1e-3, 1e3),
    "contact.friction.kinetic": (1e-3, 2.0),
    "contact.friction.stiction_speed_mm_s": (1.0, 1e4),
    "contact.clearance_mm": (1e-4, 0.1),
}

# Largest assembly errors by config key, of either sign; drawn over four decades.
SIGNED = {"scene.center_distance_error_mm": 1.0, "scene.phase_error_mrad": 100.0}
EXPONENT = 1.0, 3.0
MAY_VANISH = (
    "contact.max_damping_N_s_per_mm",
    "scene.load.torque_N_m",
    "scene.timing_gear.backlash_mm",
    "scene.load.pressure_difference_Pa",
    "scene.motor.inertia_kg_m2",
    "scene.supports.damping_N_s_per_mm",
    "contact.friction.kinetic",
    "contact.clearance_mm",
)

# Values of the grid by config key: ends and middle of the ranges. All other values are those of
# the shipped CIC scene.
GRID: dict[str, tuple[float, ...]] = {
    "contact.stiffness_N_per_mm_e": (1e3, 1e6, 1e9),
    "contact.exponent": (1.0, 2.0, 3.0),
    "contact.max_damping_N_s_per_mm": (0.0, 0.1, 10.0),
    "scene.speed_rpm": (1.0, 30.0, 1e3, 6e4),
    "scene.load.torque_N_m": (0.0, 1.0, 1e3),
    "scene.timing_gear.backlash_mm": (0.0, 0.03, 1.0),
    "contact.full_damping_depth_mm": (1e-5, 1e-2, 1.0),
}


@dataclasses.dataclass(frozen=True)
class Kind:
    """Properties that all scenes of one compiled program share.

    `scene`: `plain` (flanks alone), `gear`, or `pump` (all parts).
    """

    method: str = "tsit5"
    lobes: int = 3
    family: str = "cic"
    scene: str = "gear"

    @property
    def label(self) -> str:
        """Name of the kind in tables."""
        scene = "" if self.scene == "gear" else f", {self.scene}"
        # The label seeds the draw; the published scenes belong to these words.
        return f"{self.family} {self.lobes}, search, {self.method}, float64{scene}"

    @property
    def states(self) -> int:
        """Number of states of the equation of motion."""
        return 11 if self.scene == "pump" else 2


@functools.cache
def _base(kind: Kind) -> Config:
    return shipped("pump" if kind.scene == "pump" else kind.family)


def config_of(kind: Kind, values: dict[str, float]) -> Config:
    """Return the shipped config of a kind with `values`, by dotted key."""
    data = _base(kind).model_dump()
    fixed = {
        "profile.lobes": kind.lobes,
        "solver.method": kind.method,
    }
    for key, value in (fixed | values).items():
        *place, name = key.split(".")
        section = data
        for part in place:
            section = section[part]
        section[name] = value
    if kind.scene == "plain":
        data["scene"]["timing_gear"] = None
    return Config.model_validate(data)


def _design(draw: np.random.Generator, lobes: int, radius: float) -> dict[str, float]:
    """Draw pressure angle, involute length u and tip arc; a fifth of each lies on a limit.

    `radius`: pitch radius (mm). Returns values by config key."""
    half = 90 / lobes
    while True:
        angle = draw.choice([1.0, 89.0]) if draw.uniform() < 0.2 else draw.uniform(1, 89)
        ends = 0.0, half * (1 - 1e-6)
        tip = draw.choice(ends) if draw.uniform() < 0.2 else draw.uniform(*ends)
        reach = radius * math.sin(math.radians(angle))
        longest = reach * math.radians(half - tip) * _OVERLENGTH
        longest = min(longest, reach * math.tan(math.radians(angle)))
        shortest = reach * math.radians(half - tip - 2 * angle) + 1e-6 * radius
        shortest = max(shortest, 0.01 * longest)
        if shortest < longest:
            break
    share = draw.choice([0.0, 1.0]) if draw.uniform() < 0.3 else draw.uniform()
    return {
        "profile.pressure_angle_deg": float(angle),
        "profile.tip_arc_angle_deg": float(tip),
        "profile.involute_length_mm": float(shortest + share * (longest - shortest)),
    }


def _assembly(draw: np.random.Generator, values: dict[str, float]) -> dict[str, float]:
    """Draw assembly errors and friction. Returns values by config key.

    Friction depends on other `values` of the scene."""
    kinetic = values["contact.friction.kinetic"]
    stiction = values["contact.friction.stiction_speed_mm_s"]
    found = {
        "contact.friction.static": min(2.0, kinetic * float(draw.uniform(1, 3))),
        "contact.friction.friction_speed_mm_s": stiction * float(draw.uniform(1.01, 20)),
    }
    for key, greatest in SIGNED.items():
        size = greatest * 10 ** draw.uniform(-4, 0)
        found[key] = float(size * draw.choice([-1, 1]))
    return found


def cloud(kind: Kind, count: int, seed: int) -> Iterator[Config]:
    """Yield `count` random scenes of a kind. Values that may be 0 are 0 in a tenth of the
    scenes."""
    draw = np.random.default_rng([seed, *kind.label.encode()])
    radius = _base(kind).profile.pitch_radius_mm
    spans = SPANS
    if kind.scene == "plain":
        spans = {key: v for key, v in SPANS.items() if "timing_gear" not in key}
    elif kind.scene == "pump":
        spans = SPANS | PUMP_SPANS
        spans = {key: v for key, v in spans.items() if key != "scene.load.torque_N_m"}
    for _ in range(count):
        values = {
            key: float(math.exp(draw.uniform(math.log(low), math.log(high))))
            for key, (low, high) in spans.items()
        }
        for key in spans:
            if key in MAY_VANISH and draw.uniform() < 0.1:
                values[key] = 0.0
        if kind.scene == "pump":
            values |= _assembly(draw, values)
        if kind.scene != "plain":
            values["scene.timing_gear.damping_ratio"] = float(draw.uniform(0, 1))
        values["contact.exponent"] = float(draw.uniform(*EXPONENT))
        if kind.family == "cic":
            values |= _design(draw, kind.lobes, radius)
        yield config_of(kind, values)


def grid(kind: Kind) -> Iterator[Config]:
    """Yield the scenes of a kind for every combination of the values in `GRID`."""
    for values in itertools.product(*GRID.values()):
        yield config_of(kind, dict(zip(GRID, values, strict=True)))


def row_of(config: Config) -> dict[str, float]:
    """Return the numbers of a scene by dotted config key."""
    data: Any = config.model_dump()
    keys = [
        *SPANS,
        *PUMP_SPANS,
        *SIGNED,
        "contact.exponent",
        *(f"profile.{key}" for key in DESIGN_KEYS),
    ]
    row = {}
    for key in keys:
        value = data
        for part in key.split("."):
            value = value.get(part) if value is not None else None
        row[key] = math.nan if value is None else float(value)
    return row
