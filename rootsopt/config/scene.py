"""Config sections for everything that is simulated except the rotor: contact, scene, pump.

The smoothing length of a scene follows from its values if the config gives none (`following_mm`).
"""

import math
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, model_validator

from rootsopt.config.rotor import FilePath
from rootsopt.config.section import (
    Listed,
    Section,
    Speed,
    between,
    is_number,
    require,
    such,
)

# Magnitude of a load or motor torque (N·m).
_Torque = Annotated[float, between(0, 1e7)]


class FrictionConfig(Section):
    """Coulomb friction between the flanks, with transition speeds as in multibody programs."""

    static: Annotated[float, Field(ge=0, le=2)] = Field(0.2, description="static coefficient")
    kinetic: Annotated[float, Field(ge=0, le=2)] = Field(0.1, description="kinetic coefficient")
    stiction_speed_mm_s: Annotated[float, between(1e-3, 1e6)] = Field(
        100.0, description="sliding speed at which the static coefficient is reached"
    )
    friction_speed_mm_s: Annotated[float, between(1e-3, 1e7)] = Field(
        1000.0, description="sliding speed above which the coefficient is the kinetic one"
    )

    @model_validator(mode="after")
    def _ordered(self):
        require(
            self.static >= self.kinetic,
            "`contact.friction.static` must be at least `contact.friction.kinetic` = "
            f"{self.kinetic:g}, but is {self.static:g}; raise it, or lower the other",
        )
        require(
            self.friction_speed_mm_s > self.stiction_speed_mm_s,
            "`contact.friction.friction_speed_mm_s` must be greater than "
            f"`contact.friction.stiction_speed_mm_s` = {self.stiction_speed_mm_s:g}, but is "
            f"{self.friction_speed_mm_s:g}; raise it, or lower the other",
        )
        return self


class WearConfig(Section):
    """Material that the flanks have lost since they were drawn, or gained by a coating."""

    offset_mm: Annotated[float, Field(ge=-1, le=1)] = Field(
        0.0, description="thickness that each rotor has lost everywhere; negative: a coating"
    )
    depth_mm: Annotated[float, between(0, 1)] = Field(
        0.0, description="greatest wear of both flanks together; Archard's law distributes it"
    )


class ContactConfig(Section):
    """The IMPACT contact law, clearance and friction of the flanks."""

    stiffness_N_per_mm_e: Annotated[float, between(1, 1e11)] = Field(
        description="stiffness K of the force K·δ^e, penetration δ in mm"
    )
    exponent: Annotated[float, Field(ge=1, le=5)] = Field(
        description="exponent e of the penetration"
    )
    max_damping_N_s_per_mm: Annotated[float, between(0, 1e4)] = Field(
        description="damping coefficient, reached at full_damping_depth_mm"
    )
    full_damping_depth_mm: Annotated[float, between(1e-7, 10)] = Field(
        description="penetration at which the damping is full"
    )
    clearance_mm: Annotated[float, between(0, 10)] = Field(
        0.0, description="clearance, added to every flank gap"
    )
    smoothing_mm: Annotated[
        Annotated[float, between(0, 1)] | None,
        BeforeValidator(lambda value: None if value == "auto" else value),
    ] = Field(
        None,
        description="length that rounds the corners of contact law and timing gear; 0: no "
        "rounding; absent or auto: 1e-4, or less where gear or flanks deflect little under the "
        "load",
    )
    friction: FrictionConfig | None = Field(None, description="absent: frictionless flanks")
    wear: WearConfig | None = Field(None, description="absent: flanks as drawn")

    @property
    def rounding_mm(self) -> float:
        """Smoothing length (mm). It is set in every complete config."""
        assert self.smoothing_mm is not None
        return self.smoothing_mm


class LoadConfig(Section):
    """The load: a constant torque on rotor 2, or gas pressure on both rotors."""

    torque_N_m: _Torque | None = Field(None, description="constant torque against rotor 2")
    pressure_difference_Pa: Annotated[float, between(0, 1e8)] | None = Field(
        None, description="gas pressure across the pair, instead of a constant torque"
    )

    @model_validator(mode="after")
    def _one(self):
        require(
            (self.torque_N_m is None) != (self.pressure_difference_Pa is None),
            "`scene.load` must hold either `torque_N_m` or `pressure_difference_Pa`, but holds "
            + ("neither; add one" if self.torque_N_m is None else "both; set one to null"),
        )
        return self


class MotorConfig(Section):
    """The motor on rotor 1 for `drive: torque`, with a linear torque-speed characteristic."""

    torque_N_m: _Torque | None = Field(
        None, description="torque at scene.speed_rpm; absent: equal to the load there"
    )
    slope_N_m_s_per_rad: Annotated[float, between(1e-6, 1e6)] = Field(
        description="loss of torque per rad/s above scene.speed_rpm"
    )
    inertia_kg_m2: Annotated[float, between(0, 1e5)] = Field(
        0.0, description="moment of inertia, added to that of rotor 1"
    )


class SupportsConfig(Section):
    """Elastic bearings, the same for both rotors."""

    stiffness_N_per_mm: Annotated[float, between(1, 1e9)] = Field(
        description="radial stiffness of a rotor in its housing, equal in all directions"
    )
    damping_N_s_per_mm: Annotated[float, between(0, 1e6)] = Field(
        description="radial damping, equal in all directions"
    )


class BearingsConfig(Section):
    """The rotors' bearings, and their loads other than those of the flanks: gas, gear teeth,
    weight.

    With `scene.supports`, these forces also move the axes."""

    gear_pressure_angle_deg: Annotated[float, Field(ge=0, le=45)] = Field(
        20.0, description="pressure angle of the timing gear's teeth"
    )
    weight: bool = Field(False, description="whether the rotors' weight acts, downwards")
    port_deg: Annotated[float, Field(ge=-90, le=90)] = Field(
        0.0, description="angle before the bore's lowest point at which a pocket opens"
    )
    bearing_distance_mm: Annotated[float, Field(ge=0, le=1e4)] = Field(
        20.0, description="axial distance of each bearing from the nearer end face of the rotor"
    )
    gear_distance_mm: Annotated[float, Field(ge=0, le=1e4)] = Field(
        50.0, description="axial distance of the timing gear from the nearer end face"
    )
    kind: Literal["ball", "roller"] = Field(
        "roller", description="kind of bearing; sets the exponent of the equivalent load"
    )


class HeatConfig(Section):
    """Thermal growth of rotors and housing since they were measured. Each has one temperature."""

    rotor_warming_K: Annotated[float, Field(ge=-200, le=500)] = Field(
        0.0, description="rise of the rotors' temperature"
    )
    housing_warming_K: Annotated[float, Field(ge=-200, le=500)] = Field(
        0.0, description="rise of the housing's temperature"
    )
    rotor_expansion_per_K: Annotated[float, between(0, 1e-4)] = Field(
        1.1e-5, description="thermal expansion of the rotors; default: cast iron, steel"
    )
    housing_expansion_per_K: Annotated[float, between(0, 1e-4)] = Field(
        1.1e-5, description="thermal expansion of the housing"
    )

    @property
    def strain(self) -> float:
        """Growth of the housing minus that of the rotors, as a fraction of any length."""
        housing = self.housing_expansion_per_K * self.housing_warming_K
        return housing - self.rotor_expansion_per_K * self.rotor_warming_K


# Greatest eccentricity (µm) of a gear, and greatest magnitude of its angle (°).
_MOST_EYE, _MOST_TURN = 1000.0, 360.0


def _each_gear(low: float, high: float) -> Any:
    """Return the type of a number from `low` to `high` for the gear of rotor 1, or of one for each
    gear."""

    def fits(value: Any) -> bool:
        listed = isinstance(value, list | tuple)
        values = value if listed else [value]
        within = all(is_number(x) and low <= x <= high for x in values)
        return within and len(values) == 1 + listed

    return Annotated[
        Annotated[float, between(low, high)] | Annotated[tuple[float, float], Listed],
        such(f"a number from {low:g} to {high:g}, or one for each gear", fits, before=True),
    ]


class TimingGearConfig(Section):
    """The timing gear between the rotors: torsional stiffness, damping, backlash, and its errors
    over a turn."""

    stiffness_N_m_per_rad: Annotated[float, between(1e-2, 1e10)] = Field(
        description="torsional stiffness"
    )
    damping_ratio: Annotated[float, between(0, 100)] = Field(
        0.0,
        description="damping coefficient over 2 √(k I): k the stiffness, I = I1 I2 / (I1 + I2) "
        "the rotors' reduced inertia; with drive: prescribed, where only rotor 2 swings, the ratio "
        "to critical damping is 0.71 times this",
    )
    backlash_mm: Annotated[float, between(0, 50)] = Field(
        description="total backlash at the pitch radius"
    )
    eccentricity_um: _each_gear(0, _MOST_EYE) | None = Field(
        None,
        description="distance of the gear's centre from the axis of rotor 1, or a list of those of "
        "both gears; absent: gears without errors",
    )
    eccentricity_angle_deg: _each_gear(-_MOST_TURN, _MOST_TURN) = Field(
        0.0,
        description="direction of the eccentricity where a lobe of rotor 1 points at rotor 2, from "
        "the line to the other axis in the rotor's sense of rotation; or a list for both gears",
    )
    transmission_error_file: FilePath | None = Field(
        None,
        description="CSV file of the gear's measured transmission error over a turn of rotor 1, "
        "relative to the config's folder, with the columns rotation_deg and error_um",
    )

    @model_validator(mode="after")
    def _erring(self):
        require(
            self.eccentricity_um is not None or self.eccentricity_angle_deg == 0,
            "`scene.timing_gear.eccentricity_um` is missing; `eccentricity_angle_deg` needs it: "
            "add it, or remove the angle",
        )
        return self

    @property
    def errs(self) -> bool:
        """Whether the gear has errors over a turn."""
        return self.eccentricity_um is not None or self.transmission_error_file is not None

    @property
    def run_out(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Eccentricities (µm) of both gears, and their angles (°)."""
        pair = self.eccentricity_um or 0.0, self.eccentricity_angle_deg
        one, other = (one if isinstance(one, tuple) else (one, 0.0) for one in pair)
        return one, other


class SceneConfig(Section):
    """Drive, load, timing gear and bearings of the pair, and its mounting errors."""

    speed_rpm: Speed = Field(
        description="speed of rotor 1; with a motor, the speed at which it gives its torque_N_m"
    )
    drive: Literal["prescribed", "torque"] = Field(
        "prescribed", description="how rotor 1 is driven: at constant speed, or by scene.motor"
    )
    motor: MotorConfig | None = Field(None, description="only with drive: torque")
    load: LoadConfig
    timing_gear: TimingGearConfig | None = Field(None, description="absent: no timing gear")
    supports: SupportsConfig | None = Field(None, description="absent: rigid bearings")
    bearings: BearingsConfig | None = Field(None, description="absent: no bearing loads")
    heat: HeatConfig | None = Field(None, description="absent: all at the same temperature")
    center_distance_error_mm: Annotated[float, Field(ge=-1, le=1)] | None = Field(
        None, description="centre distance minus twice the pitch radius"
    )
    phase_error_mrad: Annotated[float, Field(ge=-100, le=100)] | None = Field(
        None, description="relative rotation at the centre of the timing gear's backlash"
    )

    @model_validator(mode="after")
    def _belong(self):
        require(
            (self.drive == "torque") == (self.motor is not None),
            "`scene.motor` is missing; `scene.drive` = torque needs it, with `slope_N_m_s_per_rad`"
            if self.motor is None
            else "`scene.motor` belongs to `scene.drive` = torque; remove `scene.motor` or set "
            "`scene.drive`",
        )
        require(
            self.phase_error_mrad is None or self.timing_gear is not None,
            "`scene.phase_error_mrad` is a mounting error of `scene.timing_gear`, which is "
            "missing; add the gear or remove the error",
        )
        gear, bearings = self.timing_gear, self.bearings
        if gear is None or bearings is None:
            return self
        closes = (
            2e-3 * sum(gear.run_out[0]) * math.tan(math.radians(bearings.gear_pressure_angle_deg))
        )
        require(
            closes <= gear.backlash_mm,
            "`scene.timing_gear.backlash_mm` must be at least what the eccentricities close, "
            f"{closes:.4g}, but is {gear.backlash_mm:g}, so that the teeth bind; raise it, or "
            "lower `scene.timing_gear.eccentricity_um`",
        )
        return self


_Clearance = Annotated[float, between(0, 10)]


class GasConfig(Section):
    """An ideal gas, compressed by the pump."""

    inlet_pressure_Pa: Annotated[float, between(1e-3, 1e8)] = Field(description="suction pressure")
    temperature_K: Annotated[float, between(50, 2000)] = Field(
        293.15, description="temperature of the gas that leaks"
    )
    gas_constant_J_per_kg_K: Annotated[float, between(10, 5000)] = Field(
        287.05, description="specific gas constant; default: air"
    )
    heat_ratio: Annotated[float, between(1.01, 1.7)] = Field(
        1.4, description="ratio of specific heats"
    )


class PumpConfig(Section):
    """Fluid, pressures and clearances of the pump, for its leakage. Nothing here is simulated."""

    viscosity_mPa_s: Annotated[float, between(1e-4, 1e6)] = Field(
        description="dynamic viscosity of the fluid"
    )
    pressure_difference_Pa: Annotated[float, between(0, 1e8)] | None = Field(
        None, description="discharge minus suction pressure; absent: that of scene.load"
    )
    tip_clearance_mm: _Clearance | None = Field(
        None, description="gap between rotor tip and housing; absent: no leakage there"
    )
    tips_in_series: Annotated[int, Field(ge=1, le=3)] = Field(
        1, description="number of tips of a rotor that seal in series"
    )
    end_clearance_mm: _Clearance | None = Field(
        None, description="gap between each end face and its cover; absent: no leakage there"
    )
    radial_allowance_mm: Annotated[float, between(-1, 10)] = Field(
        0.0, description="radius by which both rotors are smaller than their profile everywhere"
    )
    gas: GasConfig | None = Field(None, description="absent: the fluid is a liquid")

    @model_validator(mode="after")
    def _driven(self):
        require(
            self.gas is None or self.pressure_difference_Pa != 0,
            "`pump.pressure_difference_Pa` must be greater than 0 with `pump.gas`, but is 0",
        )
        return self


# Maximum default smoothing length (mm). A limit from `_SMOOTHING_SHARES` can be smaller.
_MOST_SMOOTHING = 1e-4

# Maximum default smoothing length, as a fraction of each of three lengths.
#
# `twist`: deflection of the timing gear under the full load, at the pitch radius. With a longer
# smoothing length, the gear would work in the rounded edge of its backlash, where its stiffness
# differs. `depth`: penetration of the flanks under the full load. `damping`: penetration at which
# the damping is full.
_SMOOTHING_SHARES = {"twist": 0.05, "depth": 0.02, "damping": 0.1}

# Minimum default smoothing length (mm).
#
# A shorter length would need more solver steps and make the gradient less accurate.
_LEAST_SMOOTHING = 1e-6

# Load torque (N·m) below which the smoothing length does not depend on the load.
_LEAST_TORQUE = 1e-3


def following_mm(
    contact: ContactConfig,
    gear: TimingGearConfig | None,
    load_torque: float,
    pitch_radius_mm: float,
) -> float:
    """Return the default smoothing length (mm) of a scene, with two significant digits.

    `load_torque`: torque on rotor 2 (N·m). `pitch_radius_mm`: pitch radius (mm).

    This smoothing changes the forces by less than 1e-4 of their values."""
    torque = max(load_torque, _LEAST_TORQUE)
    force = torque / (pitch_radius_mm * 1e-3)
    depth = (force / contact.stiffness_N_per_mm_e) ** (1 / contact.exponent)
    lengths = [
        _MOST_SMOOTHING,
        _SMOOTHING_SHARES["depth"] * depth,
        _SMOOTHING_SHARES["damping"] * contact.full_damping_depth_mm,
    ]
    if gear is not None:
        share = _SMOOTHING_SHARES["twist"] * torque / gear.stiffness_N_m_per_rad
        lengths.append(share * pitch_radius_mm)
    shortest = max(min(lengths), _LEAST_SMOOTHING)
    # Two digits keep the written config readable.
    return float(f"{shortest:.1e}") if math.isfinite(shortest) else _MOST_SMOOTHING
