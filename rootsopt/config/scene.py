"""Config sections that define what is simulated: profile, rotor, contact, scene."""

import functools
import math
import shlex
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator, Field, create_model, model_validator
from pydantic.fields import FieldInfo

from rootsopt.config import catalogue as _catalogue  # noqa: F401  (fills the table)
from rootsopt.config.families import (
    EXAMPLE_RADIUS,
    Family,
    families,
    family_of,
    parameters,
    users_of,
)
from rootsopt.config.section import (
    Among,
    Listed,
    Radius,
    Section,
    Speed,
    Torque,
    bare,
    between,
    require,
    such,
)
from rootsopt.config.units import hint

_USUAL = 0.01, 2.0
"""Usual range (pitch radii) of a profile's lengths.

If a length is outside its limits but would lie in this range in another unit, the message suggests
this unit."""


_FARTHEST = 1e5
"""Absolute value (mm) above which a coordinate of a rotor's axis is rejected."""
_Coordinate = Annotated[float, between(-_FARTHEST, _FARTHEST)]


def _is_center(value: Any) -> bool:
    """Return whether a value is the word `fit`, or two coordinates (mm)."""
    if not isinstance(value, list | tuple):
        return value == "fit"
    numbers = [x for x in value if isinstance(x, int | float) and not isinstance(x, bool)]
    return len(numbers) == len(value) == 2 and all(abs(x) <= _FARTHEST for x in numbers)


_Center = Annotated[
    Literal["fit"] | Annotated[tuple[_Coordinate, _Coordinate], Listed],
    such(
        f"fit, or x and y of the axis in mm, as in [0.1, 0.2], each at most {_FARTHEST:g}",
        _is_center,
        before=True,
    ),
]
FilePath = Annotated[str, such("a path of characters that can be printed", str.isprintable)]


class ProfileConfig(Section):
    """The rotor profile.

    An instance belongs to the subclass that `model_of` makes for its `family`, whose further keys
    are the family's parameters."""

    family: Annotated[str, Among(families)] = Field(
        description="profile family; outline: read from a file"
    )
    lobes: Annotated[int, Field(ge=2, le=6)] = Field(description="number of lobes")
    pitch_radius_mm: Radius = Field(description="pitch radius, half the centre distance")
    outline_file: FilePath | None = Field(
        None, description="outline: CSV or DXF file, relative to the config's folder"
    )
    outline_smoothing_mm: Annotated[float, between(0, 10)] | None = Field(
        None,
        description="outline: scatter (RMS) of measured points; absent: 0, the curve passes "
        "through them",
    )

    outline_center: _Center | None = Field(
        None,
        description="outline: x and y (mm) of the rotor's axis in the file, or fit: the centre of "
        "the lobes' rotational symmetry; absent: the origin",
    )
    outline_unit: Literal["mm", "cm", "m", "um", "inch"] | None = Field(
        None,
        description="outline: unit of the numbers in the file; absent: mm, or the unit that a "
        "drawing or a header states",
    )
    outline_join_mm: Annotated[float, between(1e-6, 1)] | None = Field(
        None,
        description="outline: distance (mm) between ends of a drawing's entities up to which they "
        "are joined; absent: 0.001",
    )

    def __reduce__(self) -> tuple[Any, ...]:
        # A class that is made at run time cannot be found by its name in another process.
        return _restored, (self.family, self.__getstate__())

    @property
    def parameters(self) -> dict[str, float | tuple[float, ...]]:
        """Design parameters of the config's family by key, in the units of the keys."""
        return {key: getattr(self, key) for key in family_of(self.family).keys}

    @property
    def design(self) -> NDArray[np.float64]:
        """Design parameters as an array (d,), in the units of `design_keys`."""
        return np.hstack([*self.parameters.values(), ()]).astype(float)

    @property
    def design_keys(self) -> tuple[str, ...]:
        """Names of the entries of `design`; the entries of a list are numbered from 1."""
        names: list[str] = []
        for key, value in self.parameters.items():
            numbers = range(1, 1 + len(value)) if isinstance(value, tuple) else ()
            names += [f"{key}_{number}" for number in numbers] or [key]
        return tuple(names)

    def with_design(self, design: Sequence[float]) -> "ProfileConfig":
        """Return a copy with other design parameters (d,), in the units of `design_keys`."""
        family = family_of(self.family)
        values = zip(family.parameters, family.split([*design]), strict=True)
        return self.model_copy(
            update={one.key: tuple(v) if one.count is not None else v for one, v in values}
        )

    def alone(self, key: str, value: Any) -> dict[str, Any]:
        """Return the plain section of a rotor of this size that has a parameter `key`.

        It is one of another family if the section's own does not have the key."""
        data = self.model_dump(mode="json", exclude_none=True) | {key: value}
        names = users_of(key) or ["outline"] * (key in _OUTLINE)
        if not names or self.family in names or value is None:
            return data
        size = {name: data[name] for name in ("lobes", "pitch_radius_mm")}
        example = family_of(names[0]).example or {_OUTLINE[0]: "rotor.csv"}
        return {"family": names[0], **size, **example, key: value}

    @property
    def from_file(self) -> bool:
        """Whether the profile is read from a file rather than made from parameters."""
        return family_of(self.family).maker is None

    @classmethod
    def fields(cls) -> Mapping[str, FieldInfo]:
        """Return all keys, with the parameters of all registered families before `outline_file`."""
        model = model_of(*families().values())
        names = [*cls.model_fields]
        place = names.index(_OUTLINE[0])
        order = *names[:place], *parameters(), *names[place:]
        return {name: model.model_fields[name] for name in order}

    @model_validator(mode="wrap")
    @classmethod
    def _of_family(cls, data, handler):
        """Choose the model by the family, and report keys that are missing or not its own."""
        if cls is not ProfileConfig or not isinstance(data, dict):
            return handler(data)
        known = {*parameters(), *_OUTLINE}
        data = {key: v for key, v in data.items() if v is not None or key not in known}
        name = bare(str(data.get("family")))
        family = next((one for key, one in families().items() if bare(key) == name), None)
        if family is None:
            return handler({key: value for key, value in data.items() if key not in known})
        if known | cls.model_fields.keys() >= data.keys():
            _require_own(family, data, known & data.keys())
        return model_of(family).model_validate(data)

    @model_validator(mode="after")
    def _sized(self):
        for parameter in family_of(self.family).parameters:
            key, limits = parameter.key, parameter.limits(self.pitch_radius_mm)
            value = getattr(self, key)
            if limits is None or limits[0] <= value <= limits[1]:
                continue
            low, high = limits
            word = f"at least {low:.4g}" if value < low else f"at most {high:.4g}"
            share = (low if value < low else high) / self.pitch_radius_mm
            raise ValueError(
                f"`profile.{key}` must be {word} ({share:g} pitch radii), but is {value:g}"
                + hint(key, value, *(share * self.pitch_radius_mm for share in _USUAL))
            )
        return self


_OUTLINE = tuple(key for key in ProfileConfig.model_fields if key.startswith("outline_"))


@functools.cache
def model_of(*owners: Family) -> type[ProfileConfig]:
    """Return the section's model for a registered family, or for several at once."""
    fields: Any = {
        one.key: one.field(family.name for family in owners if one.key in family.keys)
        for owner in owners
        for one in owner.parameters
    }
    return create_model("ProfileConfig", __base__=ProfileConfig, **fields)


def _restored(family: str, state: dict[str, Any]) -> ProfileConfig:
    """Return a pickled section."""
    model = model_of(family_of(family))
    section = model.__new__(model)
    section.__setstate__(state)
    return section


def _require_own(family: Family, data: Mapping[str, Any], given: set[str]) -> None:
    """Raise `ValueError` if `given` keys are foreign to a family, or if keys of it are missing.

    The message lists the overrides that complete the section `data`. Missing keys get the values of
    the family's example at this pitch radius, and so do keys that another family shares: its values
    may not fit."""
    from_file = family.maker is None
    own, required = (_OUTLINE, _OUTLINE[:1]) if from_file else (family.keys, family.keys)
    foreign = [key for key in (*parameters(), *_OUTLINE) if key in given and key not in own]
    missing = [key for key in required if key not in given]
    if not foreign and not missing:
        return
    radius = data.get("pitch_radius_mm")
    values: dict[str, Any] = {key: "null" for key in foreign}
    scale = radius / EXAMPLE_RADIUS if isinstance(radius, int | float) else 1.0
    for key in family.keys if foreign and missing and family.keys else missing:
        value = family.example.get(key, "FILE")
        value = f"{value * scale:.4g}" if key.endswith("_mm") else value
        values[key] = [*value] if isinstance(value, tuple) else value
    first = f"`profile.{[*foreign, *missing][0]}` " + (
        f"does not belong to family {family.name}; for this family, add"
        if foreign
        else f"is required for family {family.name}; add, for example,"
    )
    sets = [shlex.quote(f"profile.{key}={value}") for key, value in values.items()]
    raise ValueError(" --set ".join((first, *sets)))


class RotorConfig(Section):
    """The rotor as a rigid body: length, density, bore, helix."""

    length_mm: Annotated[float, between(1, 2e4)] = Field(description="axial length")
    density_kg_m3: Annotated[float, between(50, 3e4)] = Field(description="density")
    bore_mm: Annotated[float, between(0.1, 1e4)] | None = Field(
        None, description="diameter of the bore; absent: none"
    )
    helix_deg: Annotated[float, Field(ge=-360, le=360)] = Field(
        0.0,
        description="twist over the length, positive in the rotor's own sense of rotation",
    )


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


def _none_for_auto(value: Any) -> Any:
    """Return `None` for the word `auto`, and any other value unchanged."""
    return None if value == "auto" else value


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
        Annotated[float, between(0, 1)] | None, BeforeValidator(_none_for_auto)
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

    torque_N_m: Torque | None = Field(None, description="constant torque against rotor 2")
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

    torque_N_m: Torque | None = Field(
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


_MOST_EYE, _MOST_TURN = 1000.0, 360.0
"""Greatest eccentricity (µm) of a gear, and greatest magnitude of its angle (°)."""


def _each_gear(low: float, high: float) -> Any:
    """Return the type of a number from `low` to `high` for the gear of rotor 1, or of one for each
    gear."""

    def fits(value: Any) -> bool:
        listed = isinstance(value, list | tuple)
        values = value if listed else [value]
        plain = all(isinstance(x, int | float) and not isinstance(x, bool) for x in values)
        return plain and len(values) == 1 + listed and all(low <= x <= high for x in values)

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
