"""Notes on values that are allowed but unusual.

A value far outside the usual range is often one in another unit. The ranges are wide: they hold for
micro pumps and for boosters of a metre. Many scale with the rotor's size: for rotors of one size,
torque, speed and mass differ by a factor of ten between machines, but a wrong unit changes them a
thousandfold."""

import math
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

from rootsopt.config.families import parameters
from rootsopt.config.section import is_number
from rootsopt.config.study import TWIST
from rootsopt.config.units import MM, RPM, hint, unit_of

if TYPE_CHECKING:
    from rootsopt.config.reading import Config

# One bar (Pa).
_BAR = 1e5


def _sizes(config: "Config") -> dict[str, float]:
    """Return the sizes that usual ranges follow, by name, in the units of the keys that use them.

    Mass and inertia are those of a solid cylinder on the pitch circle. Torques follow from 1 bar,
    because the config's own load may be 0 or wrong; `force` at the pitch circle carries the load.
    `rolling`: speed at which the pitch circles roll at 1 m/s. `critical`: critical damping of a
    rotor on its bearings; `impact`: that of the flanks, where their damping is full."""
    radius, supports = config.profile.pitch_radius_mm, config.scene.supports
    law = config.contact
    steepness = law.exponent * law.full_damping_depth_mm ** (law.exponent - 1)
    disc, torque = math.pi * radius**2, config.gas_torque(_BAR)
    volume = disc * config.rotor.length_mm * 1e-3
    mass = volume * 1e-6 * config.rotor.density_kg_m3
    stiffness = 0.0 if supports is None else supports.stiffness_N_per_mm / MM
    return {
        "one": 1.0,
        "radius": radius,
        "disc": disc,
        "volume": volume,
        "inertia": mass * (radius * MM) ** 2 / 2,
        "rolling": 1 / (radius * MM * RPM),
        "bar": torque,
        "slope": torque / (config.scene.speed_rpm * RPM),
        "critical": 2 * math.sqrt(stiffness * mass) * MM,
        "impact": 2 * math.sqrt(law.stiffness_N_per_mm_e * steepness / MM * mass / 4) * MM,
        "force": config.load_torque / (radius * MM),
    }


class Usual(NamedTuple):
    """Usual range of a quantity: `low` to `high`, times a `size` of the config (see `_sizes`)."""

    low: float
    high: float
    size: str = "one"

    def ends(self, config: "Config") -> tuple[float, float]:
        """Return the range in the unit of the key."""
        size = _sizes(config)[self.size]
        return self.low * size, self.high * size


_PRESSURE = Usual(300, 5e6)
_TORQUE = Usual(1e-3, 50, "bar")
_SPEED = Usual(0.2, 120, "rolling")
_GAP = Usual(1e-5, 0.035, "radius")
_MARGIN = Usual(1e-3, 1, "radius")
_TWIST = Usual(4, 360)
_WARMING = Usual(0.5, 250)
_EXPANSION = Usual(5e-7, 5e-5)
_RADIUS = Usual(1, 2, "radius")
USUAL: dict[str, Usual] = {
    "profile.pitch_radius_mm": Usual(8, 1000),
    "profile.outline_smoothing_mm": Usual(1e-5, 0.2),
    "profile.outline_join_mm": Usual(1e-6, 0.2),
    "rotor.length_mm": Usual(0.1, 20, "radius"),
    "rotor.density_kg_m3": Usual(500, 2.2e4),
    "rotor.bore_mm": Usual(0.02, 2, "radius"),
    "rotor.helix_deg": _TWIST,
    "contact.stiffness_N_per_mm_e": Usual(1e3, 1e9),
    "contact.max_damping_N_s_per_mm": Usual(1e-3, 5, "impact"),
    "contact.full_damping_depth_mm": Usual(1e-4, 0.5),
    "contact.clearance_mm": _GAP,
    "contact.smoothing_mm": Usual(5e-7, 0.02),
    "contact.friction.stiction_speed_mm_s": Usual(0.5, 5e3),
    "contact.friction.friction_speed_mm_s": Usual(2, 5e4),
    "contact.wear.offset_mm": _GAP,
    "contact.wear.depth_mm": _GAP,
    "scene.speed_rpm": _SPEED,
    "scene.motor.torque_N_m": _TORQUE,
    "scene.motor.slope_N_m_s_per_rad": Usual(1e-3, 1e3, "slope"),
    "scene.motor.inertia_kg_m2": Usual(1e-3, 1e3, "inertia"),
    "scene.load.torque_N_m": _TORQUE,
    "scene.load.pressure_difference_Pa": _PRESSURE,
    "scene.timing_gear.stiffness_N_m_per_rad": Usual(50, 1e6, "bar"),
    "scene.timing_gear.damping_ratio": Usual(1e-3, 1),
    "scene.timing_gear.backlash_mm": _GAP,
    "scene.timing_gear.eccentricity_um": Usual(0.5, 500),
    "scene.timing_gear.eccentricity_angle_deg": Usual(0.2, 360),
    "scene.supports.stiffness_N_per_mm": Usual(50, 2e5, "radius"),
    "scene.supports.damping_N_s_per_mm": Usual(1e-3, 5, "critical"),
    "scene.bearings.gear_pressure_angle_deg": Usual(5, 45),
    "scene.bearings.port_deg": Usual(1, 90),
    "scene.bearings.bearing_distance_mm": Usual(0.02, 10, "radius"),
    "scene.bearings.gear_distance_mm": Usual(0.02, 20, "radius"),
    "scene.heat.rotor_warming_K": _WARMING,
    "scene.heat.housing_warming_K": _WARMING,
    "scene.heat.rotor_expansion_per_K": _EXPANSION,
    "scene.heat.housing_expansion_per_K": _EXPANSION,
    "scene.center_distance_error_mm": _GAP,
    "scene.phase_error_mrad": Usual(2e-3, 40),
    "objective.speeds_rpm": _SPEED,
    "constraints.undercut_margin_min_mm": _MARGIN,
    "constraints.seal_width_min_mm": _MARGIN,
    "constraints.outer_radius_min_mm": _RADIUS,
    "constraints.outer_radius_max_mm": _RADIUS,
    "pump.viscosity_mPa_s": Usual(5e-3, 2e5),
    "pump.pressure_difference_Pa": _PRESSURE,
    "pump.tip_clearance_mm": _GAP,
    "pump.end_clearance_mm": _GAP,
    "pump.radial_allowance_mm": _GAP,
    "pump.gas.inlet_pressure_Pa": Usual(20, 5e6),
    "pump.gas.temperature_K": Usual(200, 800),
    "pump.gas.gas_constant_J_per_kg_K": Usual(30, 4500),
    "drawing.tolerance_mm": _GAP,
    "drawing.inset_mm": _GAP,
}
"""Usual range of each key with a unit, other than design parameters."""

# Usual ranges of design parameters that differ from those of their unit.
_DESIGN = {"pressure_angle_deg": Usual(5, 85), "tip_arc_turn_deg": Usual(3, 180), TWIST: _TWIST}

# Usual range of a design parameter, by unit.
_UNITS = {"mm": Usual(5e-3, 2, "radius"), "°": Usual(0.2, 180)}

# Usual ranges of limited quantities, by the ends of their names.
_TERMS = {
    "_force_N": Usual(1e-2, 1e3, "force"),
    "_radius_mm": Usual(0.02, 2, "radius"),
    "area_mm2": Usual(0.2, 4, "disc"),
    "displaced_volume_cm3": Usual(0.2, 5, "volume"),
    "polar_inertia_kg_m2": Usual(0.1, 5, "inertia"),
}


def usual_of(key: str) -> Usual | None:
    """Return the usual range of a dotted key; `None` for a key without a unit."""
    section, _, name = key.rpartition(".")
    if section == "optimizer.bounds" or (section == "profile" and name in parameters()):
        return _DESIGN.get(name) or _UNITS.get(unit_of(name))
    if key.startswith("constraints.terms."):
        return next((usual for end, usual in _TERMS.items() if name.endswith(end)), None)
    return USUAL.get(key)


def notes(config: "Config") -> tuple[str, ...]:
    """Return one sentence on each unusual value of a config, in the order of the config.

    Defaults have no note. Neither has 0, which is the same in every unit."""
    given = dict(_numbers(config))
    texts = [_note(config, key, key, value) for key, value in given.items()]
    return tuple(filter(None, (*texts, *_listed(config, given))))


def notes_on_swept(config: "Config", values: Mapping[str, Any]) -> tuple[str, ...]:
    """Return notes on the greatest of the `values` of each dotted key of a sweep."""
    texts = (_note(config, key, f"--over {key}", _greatest(many)) for key, many in values.items())
    return tuple(filter(None, texts))


def _listed(config: "Config", given: Mapping[str, float]) -> Iterator[str]:
    """Yield notes on values in `tolerances.conditions` other than those `given`, by key.

    Distributions are omitted: they are centred on the config's own value."""
    conditions = {} if config.tolerances is None else config.tolerances.conditions
    for name, values in conditions.items():
        for key, value in values.items():
            if value != given.get(key):
                yield _note(config, key, f"tolerances.conditions.{name}.{key}", value)


def _note(config: "Config", key: str, shown: str, value: float) -> str:
    """Return the note on the `value` of a `key`, or "" if it is usual. `shown`: key in the note."""
    usual = usual_of(key)
    low, high = (0.0, math.inf) if usual is None else usual.ends(config)
    if not value or not high or low <= abs(value) <= high:
        return ""
    unit = unit_of(key)
    return (
        f"`{shown}` is {value:g}{unit and f' {unit}'}, which is allowed, but unusual for this "
        f"rotor (usually {float(f'{low:.2g}'):g} to {float(f'{high:.2g}'):g})"
        + (hint(key, abs(value), low, high) or "; check its unit")
    )


def _numbers(section: Any, prefix: str = "") -> Iterator[tuple[str, float]]:
    """Yield (dotted key, number) of all keys in a `section` whose value is not the default.

    Of several numbers, such as bounds, yield the one with the greatest magnitude."""
    for name, field in type(section).model_fields.items():
        value, key = getattr(section, name), prefix + name
        if hasattr(type(value), "model_fields"):
            yield from _numbers(value, f"{key}.")
        elif key in ("constraints.terms", "optimizer.bounds"):
            numbers = ((f"{key}.{one}", _greatest(sides)) for one, sides in value.items())
            yield from ((one, number) for one, number in numbers if number)
        elif value != field.default and (number := _greatest(value)):
            yield key, number


def _greatest(value: Any) -> float:
    """Return the number of the greatest magnitude in a value, 0 without a number."""
    value = [*value.values()] if isinstance(value, dict) else value
    many = value if isinstance(value, list | tuple) else [value]
    return max(filter(is_number, many), key=abs, default=0.0)
