"""Sections of a config that say what is simulated: profile, rotor, contact, scene."""

from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, model_validator

from rootsopt.config.section import Radius, Section, Speed, Torque, between
from rootsopt.config.units import hint
from rootsopt.config.words import shown

DESIGN_KEYS = ("pressure_angle_deg", "involute_length_mm", "tip_arc_angle_deg")
"""The design parameters of a CIC rotor, as named in the config."""
FAMILY_KEYS: dict[str, tuple[str, ...]] = {
    "cic": DESIGN_KEYS,
    "ee": (),
    "arc": ("arc_center_mm",),
    "arcs_epicycloid": ("arc_center_mm", "tip_arc_angle_deg", "edge_radius_mm"),
    "arc_involute": ("pressure_angle_deg", "involute_length_mm"),
    "four_arcs": ("arc_center_mm", "tip_arc_radius_mm", "tip_arc_turn_deg"),
    "five_arcs": (
        "outer_radius_mm",
        "tip_arc_angle_deg",
        "tip_arc_radius_mm",
        "tip_arc_turn_deg",
    ),
    "circle_epicycloid": ("rolling_radius_mm", "tip_arc_turn_deg"),
    "hypo_epicycloid": ("tip_arc_angle_deg",),
    "extended_cycloid": ("trochoid_ratio",),
    "ellipse": ("ellipse_center_mm", "ellipse_height_mm"),
    "outline": (),
    "free_form": ("tip_arc_angle_deg", "coefficients"),
}
"""Profile families with their design parameters, as named in the config."""
LIST_KEYS = ("coefficients",)
"""Keys that hold a list of design parameters, each last of its family."""


_LONGEST = 5e4
_Length = Annotated[float, between(1e-3, _LONGEST)]
_SHARES = 0.002, 10.0
"""Least and greatest length of a profile, in pitch radii."""
_USUAL = 0.01, 2.0
"""The same for lengths of usual size."""
_Share = Annotated[float, between(-1, 1)]


class ProfileConfig(Section):
    """The rotor profile."""

    family: Literal[
        "cic",
        "ee",
        "arc",
        "arcs_epicycloid",
        "arc_involute",
        "four_arcs",
        "five_arcs",
        "circle_epicycloid",
        "hypo_epicycloid",
        "extended_cycloid",
        "ellipse",
        "free_form",
        "outline",
    ] = Field(description="profile family; outline: from a file")
    lobes: Annotated[int, Field(ge=2, le=6)] = Field(description="number of lobes")
    pitch_radius_mm: Radius = Field(description="pitch radius; centre distance is twice that")
    pressure_angle_deg: Annotated[float, Field(ge=1, lt=90)] | None = Field(
        None, description="cic, arc_involute: pressure angle of the involute"
    )
    involute_length_mm: Annotated[float, between(1e-9, 1e4)] | None = Field(
        None, description="cic, arc_involute: involute parameter u"
    )
    tip_arc_angle_deg: Annotated[float, Field(ge=0, lt=45)] | None = Field(
        None,
        description="cic, five_arcs, arcs_epicycloid, hypo_epicycloid, free_form: half angle of "
        "the tip land",
    )
    arc_center_mm: _Length | None = Field(
        None,
        description="arc, arcs_epicycloid, four_arcs: distance of the arc's centre from the axis",
    )
    tip_arc_radius_mm: _Length | None = Field(
        None, description="four_arcs, five_arcs: radius of the tip arc"
    )
    tip_arc_turn_deg: Annotated[float, Field(ge=1, lt=180)] | None = Field(
        None,
        description="four_arcs, five_arcs, circle_epicycloid: normal angle where the tip arc ends",
    )
    outer_radius_mm: _Length | None = Field(None, description="five_arcs: radius of the tip land")
    edge_radius_mm: _Length | None = Field(
        None, description="arcs_epicycloid: radius of the edge between tip land and arc"
    )
    rolling_radius_mm: _Length | None = Field(
        None, description="circle_epicycloid: radius of the rolling circle"
    )
    trochoid_ratio: Annotated[float, between(1e-3, 10)] | None = Field(
        None,
        description="extended_cycloid: distance of the drawing point from the rolling circle's "
        "centre at the tip, in its radii",
    )
    ellipse_center_mm: Annotated[float, between(0, _LONGEST)] | None = Field(
        None, description="ellipse: distance of the ellipse's centre from the axis"
    )
    ellipse_height_mm: _Length | None = Field(None, description="ellipse: semi-axis along the lobe")
    coefficients: Annotated[tuple[_Share, ...], Field(min_length=3, max_length=64)] | None = Field(
        None,
        description="free_form: fall of the pressure angle per turn of the normal, from tip to "
        "pitch circle, 3 to 64 numbers up to 1 (arc about a pitch point); 0: involute, down to -1",
    )

    outline_file: str | None = Field(
        None, description="outline: CSV or DXF file, relative to the config's folder"
    )
    outline_smoothing_mm: Annotated[float, between(0, 10)] | None = Field(
        None, description="outline: scatter (RMS) of measured points; absent: 0, through them"
    )

    @model_validator(mode="before")
    @classmethod
    def _list(cls, data):
        if isinstance(data, dict) and isinstance(given := data.get("coefficients"), list):
            return data | {"coefficients": tuple(given)}
        return data

    @model_validator(mode="after")
    def _sized(self):
        for key in _SIZED:
            value, limits = getattr(self, key), length_limits(key, self.pitch_radius_mm)
            if value is None or limits is None or limits[0] <= value <= limits[1]:
                continue
            low, high = limits
            word = f"at least {low:.4g}" if value < low else f"at most {high:.4g}"
            share = _SHARES[0] if value < low else _SHARES[1]
            raise ValueError(
                f"`profile.{key}` must be {word} ({share:g} pitch radii), but is {value:g}"
                + hint(key, value, *(share * self.pitch_radius_mm for share in _USUAL))
            )
        return self

    @model_validator(mode="after")
    def _from_file(self):
        if self.outline_file is not None and not self.outline_file.isprintable():
            raise ValueError(
                "`profile.outline_file` must be the path of a file, but is "
                f"{shown(self.outline_file)}, which has characters that cannot be printed"
            )
        if self.family == "outline":
            if self.outline_file is None:
                raise ValueError("`profile.outline_file` is required for family outline")
            return self
        for key in ("outline_file", "outline_smoothing_mm"):
            if getattr(self, key) is not None:
                raise ValueError(
                    f"`profile.{key}` does not belong to family {self.family}; remove it, or set "
                    "`profile.family` to outline"
                )
        return self

    @model_validator(mode="after")
    def _family_keys(self):
        own = FAMILY_KEYS[self.family]
        for key in dict.fromkeys(key for keys in FAMILY_KEYS.values() for key in keys):
            given = getattr(self, key) is not None
            if key in own and not given:
                raise ValueError(f"`profile.{key}` is required for family {self.family}")
            if key not in own and given:
                raise ValueError(
                    f"`profile.{key}` does not belong to family {self.family}; remove it"
                )
        return self


def length_limits(key: str, pitch_radius_mm: float) -> tuple[float, float] | None:
    """Least and greatest value of a length of a profile that goes with the pitch radius."""
    if key not in _SIZED:
        return None
    least = 0.0 if key in _MAY_BE_SMALL else _SHARES[0] * pitch_radius_mm
    return least, _SHARES[1] * pitch_radius_mm


_SIZED = (
    "arc_center_mm",
    "tip_arc_radius_mm",
    "outer_radius_mm",
    "edge_radius_mm",
    "rolling_radius_mm",
    "ellipse_center_mm",
    "ellipse_height_mm",
)
"""Lengths of a profile that go with the pitch radius."""
_MAY_BE_SMALL = "ellipse_center_mm", "edge_radius_mm"
"""Those without a floor here; that of an edge is the family's own."""


class RotorConfig(Section):
    """The rotor as a body."""

    length_mm: Annotated[float, between(1, 2e4)] = Field(description="axial length")
    density_kg_m3: Annotated[float, between(50, 3e4)] = Field(description="density")
    bore_mm: Annotated[float, between(0.1, 1e4)] | None = Field(
        None, description="diameter of the bore; absent: none"
    )
    helix_deg: Annotated[float, Field(ge=-360, le=360)] = Field(
        0.0, description="twist over the length, for CAD; only straight rotors are simulated"
    )


class FrictionConfig(Section):
    """Coulomb friction between the flanks, with the transitions of multibody programs."""

    static: Annotated[float, Field(ge=0, le=2)] = Field(0.2, description="static coefficient")
    kinetic: Annotated[float, Field(ge=0, le=2)] = Field(0.1, description="kinetic coefficient")
    stiction_speed_mm_s: Annotated[float, between(1e-3, 1e6)] = Field(
        100.0, description="sliding speed at which the static coefficient is reached"
    )
    friction_speed_mm_s: Annotated[float, between(1e-3, 1e7)] = Field(
        1000.0, description="sliding speed from which on the coefficient is the kinetic one"
    )

    @model_validator(mode="after")
    def _ordered(self):
        if self.friction_speed_mm_s <= self.stiction_speed_mm_s:
            raise ValueError(
                "`contact.friction.friction_speed_mm_s` must be greater than "
                f"`contact.friction.stiction_speed_mm_s` = {self.stiction_speed_mm_s:g}, but is "
                f"{self.friction_speed_mm_s:g}"
            )
        return self


def _none_for_auto(value: Any) -> Any:
    """None for the word `auto`."""
    return None if value == "auto" else value


class ContactConfig(Section):
    """The IMPACT contact law."""

    stiffness_N_per_mm_e: Annotated[float, between(1, 1e11)] = Field(
        description="K of K·δ^e, δ in mm"
    )
    exponent: Annotated[float, Field(ge=1, le=5)] = Field(description="e")
    max_damping_N_s_per_mm: Annotated[float, between(0, 1e4)] = Field(
        description="C, reached at full depth"
    )
    full_damping_depth_mm: Annotated[float, between(1e-7, 10)] = Field(description="d")
    clearance_mm: Annotated[float, between(0, 10)] = Field(
        0.0, description="added to every flank gap"
    )
    smoothing_mm: Annotated[
        Annotated[float, between(0, 1)] | None, BeforeValidator(_none_for_auto)
    ] = Field(
        None,
        description="rounding of the corners of law and gear; 0: as they stand; absent or auto: "
        "1e-4, or less where the load twists the gear or dents the flanks little",
    )
    friction: FrictionConfig | None = Field(None, description="absent: frictionless flanks")

    @property
    def rounding_mm(self) -> float:
        """The smoothing length of a whole config, in which none is left open."""
        assert self.smoothing_mm is not None
        return self.smoothing_mm


class LoadConfig(Section):
    """What opposes the rotors: a constant torque on rotor 2, or gas on both."""

    torque_N_m: Torque | None = Field(None, description="constant torque against rotor 2")
    pressure_difference_Pa: Annotated[float, between(0, 1e8)] | None = Field(
        None, description="instead of a constant torque: gas pressure across the pair"
    )

    @model_validator(mode="after")
    def _one(self):
        if (self.torque_N_m is None) == (self.pressure_difference_Pa is None):
            raise ValueError(
                "`scene.load` must hold either `torque_N_m` or `pressure_difference_Pa`, but holds "
                + ("neither; add one" if self.torque_N_m is None else "both; set one to null")
            )
        return self


class MotorConfig(Section):
    """Motor on rotor 1, with a straight torque-speed line, for `drive: torque`."""

    torque_N_m: Torque | None = Field(
        None, description="torque at scene.speed_rpm; absent: what the load takes there"
    )
    slope_N_m_s_per_rad: Annotated[float, between(1e-6, 1e6)] = Field(
        description="torque lost for every rad/s above scene.speed_rpm"
    )
    inertia_kg_m2: Annotated[float, between(0, 1e5)] = Field(
        0.0, description="added to that of rotor 1"
    )


class SupportsConfig(Section):
    """Bearings that give way, the same for both rotors."""

    stiffness_N_per_mm: Annotated[float, between(1, 1e9)] = Field(
        description="of a rotor in its housing, any way"
    )
    damping_N_s_per_mm: Annotated[float, between(0, 1e6)] = Field(
        description="damping of the same motion"
    )


class TimingGearConfig(Section):
    """Timing gear between the rotors."""

    stiffness_N_m_per_rad: Annotated[float, between(1e-2, 1e10)] = Field(
        description="torsional stiffness"
    )
    damping_ratio: Annotated[float, between(0, 100)] = Field(
        0.0, description="ζ on the two rotors' inertia"
    )
    backlash_mm: Annotated[float, between(0, 50)] = Field(
        description="total play at the pitch radius"
    )


class SceneConfig(Section):
    """What drives and loads the pair."""

    speed_rpm: Speed = Field(description="speed of rotor 1; of a motor, that of its torque_N_m")
    drive: Literal["prescribed", "torque"] = Field(
        "prescribed", description="how rotor 1 is driven: at its speed, or by scene.motor"
    )
    motor: MotorConfig | None = Field(None, description="belongs to drive torque")
    load: LoadConfig
    timing_gear: TimingGearConfig | None = Field(None, description="absent: flanks alone")
    supports: SupportsConfig | None = Field(None, description="absent: rigid bearings")
    center_distance_error_mm: Annotated[float, Field(ge=-1, le=1)] | None = Field(
        None, description="centre distance beyond twice the pitch radius"
    )
    phase_error_mrad: Annotated[float, Field(ge=-100, le=100)] | None = Field(
        None, description="relative rotation at the middle of the timing gear's backlash"
    )

    @model_validator(mode="after")
    def _belong(self):
        if (self.drive == "torque") != (self.motor is not None):
            raise ValueError(
                "`scene.motor` is missing; `scene.drive` = torque needs it, with "
                "`slope_N_m_s_per_rad`"
                if self.motor is None
                else "`scene.motor` belongs to `scene.drive` = torque; remove it or set that"
            )
        if self.phase_error_mrad is not None and self.timing_gear is None:
            raise ValueError(
                "`scene.phase_error_mrad` is an error of mounting `scene.timing_gear`; add that "
                "or remove it"
            )
        return self
