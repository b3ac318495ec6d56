"""Configuration: YAML in, typed settings out.

The only place that knows file formats. Keys carry their units; conversion to SI happens
in `rootsopt.model`. Anything wrong with a file, a key or a value raises `InputError`
with one message that names the key, the value and what is allowed.
"""

import difflib
import re
from pathlib import Path
from typing import Annotated, Any, Literal

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from rootsopt.errors import InputError

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]

DESIGN_KEYS = ("pressure_angle_deg", "involute_length_mm", "tip_arc_angle_deg")
"""The design parameters of a CIC rotor, as named in the config."""
FAMILY_KEYS: dict[str, tuple[str, ...]] = {
    "cic": DESIGN_KEYS,
    "ee": (),
    "arc": ("arc_center_mm",),
    "arc_involute": ("pressure_angle_deg", "involute_length_mm"),
    "four_arcs": ("arc_center_mm", "tip_arc_radius_mm", "tip_arc_turn_deg"),
    "five_arcs": (
        "outer_radius_mm",
        "tip_arc_angle_deg",
        "tip_arc_radius_mm",
        "tip_arc_turn_deg",
    ),
    "ellipse": ("ellipse_center_mm", "ellipse_height_mm"),
}
"""Profile families with their design parameters, as named in the config."""


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


def _tuples(data: Any) -> Any:
    """Keys of a section with tuples for lists: YAML has no tuples."""
    if isinstance(data, dict):
        return {k: tuple(v) if isinstance(v, list) else v for k, v in data.items()}
    return data


def _number(key: Any) -> Any:
    """A number for a word that is one."""
    try:
        return float(key) if isinstance(key, str) else key
    except ValueError:
        return key


class ProfileConfig(_Section):
    """The rotor profile."""

    family: Literal["cic", "ee", "arc", "arc_involute", "four_arcs", "five_arcs", "ellipse"] = (
        Field(description="profile family")
    )
    lobes: Annotated[int, Field(ge=2, le=6)] = Field(description="number of lobes")
    pitch_radius_mm: Positive = Field(description="pitch radius; centre distance is twice that")
    pressure_angle_deg: Annotated[float, Field(gt=0, lt=90)] | None = Field(
        None, description="cic, arc_involute: pressure angle of the involute"
    )
    involute_length_mm: Positive | None = Field(
        None, description="cic, arc_involute: involute parameter u"
    )
    tip_arc_angle_deg: Annotated[float, Field(ge=0, lt=45)] | None = Field(
        None, description="cic, five_arcs: half angle of the tip land"
    )
    arc_center_mm: Positive | None = Field(
        None, description="arc, four_arcs: distance of the tip arc's centre from the axis"
    )
    tip_arc_radius_mm: Positive | None = Field(
        None, description="four_arcs, five_arcs: radius of the tip arc"
    )
    tip_arc_turn_deg: Annotated[float, Field(gt=0, lt=180)] | None = Field(
        None, description="four_arcs, five_arcs: normal angle at which the tip arc ends"
    )
    outer_radius_mm: Positive | None = Field(None, description="five_arcs: radius of the tip land")
    ellipse_center_mm: NonNegative | None = Field(
        None, description="ellipse: distance of the ellipse's centre from the axis"
    )
    ellipse_height_mm: Positive | None = Field(
        None, description="ellipse: semi-axis along the lobe"
    )

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


class RotorConfig(_Section):
    """The rotor as a body."""

    length_mm: Positive = Field(description="axial length")
    density_kg_m3: Positive = Field(description="density")


class FrictionConfig(_Section):
    """Coulomb friction between the flanks, with the transitions of multibody programs."""

    static: Annotated[float, Field(ge=0, le=2)] = Field(0.2, description="static coefficient")
    kinetic: Annotated[float, Field(ge=0, le=2)] = Field(0.1, description="kinetic coefficient")
    stiction_speed_mm_s: Positive = Field(
        100.0, description="sliding speed at which the static coefficient is reached"
    )
    friction_speed_mm_s: Positive = Field(
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


class ContactConfig(_Section):
    """The IMPACT contact law."""

    stiffness_N_per_mm_e: Positive = Field(description="K of K·δ^e, δ in mm")
    exponent: Annotated[float, Field(ge=1, le=5)] = Field(description="e")
    max_damping_N_s_per_mm: NonNegative = Field(description="C, reached at full depth")
    full_damping_depth_mm: Positive = Field(description="d")
    clearance_mm: NonNegative = Field(0.0, description="added to every flank gap")
    smoothing_mm: NonNegative = Field(
        1e-4, description="rounding of the law's corners; 0 is the law as it stands"
    )
    friction: FrictionConfig | None = Field(None, description="absent: frictionless flanks")


class LoadConfig(_Section):
    """What opposes the rotors: a constant torque on rotor 2, or gas on both."""

    torque_N_m: NonNegative | None = Field(None, description="constant torque against rotor 2")
    pressure_difference_Pa: NonNegative | None = Field(
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


class MotorConfig(_Section):
    """Motor on rotor 1, with a straight torque-speed line, for `drive: torque`."""

    torque_N_m: NonNegative | None = Field(
        None, description="torque at scene.speed_rpm; absent: what the load takes there"
    )
    slope_N_m_s_per_rad: Positive = Field(
        description="torque lost for every rad/s above scene.speed_rpm"
    )
    inertia_kg_m2: NonNegative = Field(0.0, description="added to that of rotor 1")


class SupportsConfig(_Section):
    """Bearings that give way, the same for both rotors."""

    stiffness_N_per_mm: Positive = Field(description="of a rotor in its housing, any way")
    damping_N_s_per_mm: NonNegative = Field(description="damping of the same motion")


class TimingGearConfig(_Section):
    """Timing gear between the rotors."""

    stiffness_N_m_per_rad: Positive = Field(description="torsional stiffness")
    damping_ratio: NonNegative = Field(0.0, description="ζ on the two rotors' inertia")
    backlash_mm: NonNegative = Field(description="total play at the pitch radius")


class SceneConfig(_Section):
    """What drives and loads the pair."""

    speed_rpm: Positive = Field(description="speed of rotor 1; of a motor, that of its torque_N_m")
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


class SolverConfig(_Section):
    """How the scene is solved."""

    fidelity: Literal["search", "map", "linear", "nodes", "auto"] = Field(
        "search",
        description="contact: search at every call (reference), C² map of the gap, linear in "
        "the relative rotation, the paper's nodes against segments, or auto: these settings "
        "as accuracy needs",
    )
    accuracy: Annotated[float, Field(ge=1e-6, le=0.1)] = Field(
        1e-3, description="relative error of mean and peak force that auto may leave"
    )
    nodes: Annotated[int, Field(ge=16, le=20_000)] = Field(
        400, description="nodes per flank of fidelity nodes"
    )
    map_error: Annotated[float, Field(ge=1e-6, le=0.1)] = Field(
        1e-4, description="error of the map's penetration, relative to the static one"
    )
    map_rolls: Annotated[int, Field(ge=16, le=4096)] | None = Field(
        None, description="map points over the roll angle; absent: as map_error needs"
    )
    map_relatives: Annotated[int, Field(ge=12, le=1024)] | None = Field(
        None, description="map points over the relative rotation; absent: as map_error needs"
    )
    method: Literal["tsit5", "dopri5", "dopri8", "kvaerno3", "kvaerno5"] = Field(
        "tsit5", description="explicit: tsit5, dopri5, dopri8; implicit: kvaerno3, kvaerno5"
    )
    rtol: Annotated[float, Field(ge=1e-12, le=1e-2)] = Field(
        1e-8, description="tolerance on the orbit and its statistics"
    )
    transient_rtol: Annotated[float, Field(ge=1e-12, le=1e-2)] = Field(
        1e-7, description="tolerance while the transient passes"
    )
    max_steps_per_period: Annotated[int, Field(ge=64, le=10**6)] = Field(
        4096, description="solver steps allowed per mesh period"
    )
    max_mesh_periods: Annotated[int, Field(ge=16, le=10**6)] = Field(
        640, description="how long the transient may last"
    )
    max_orbit_periods: Annotated[int, Field(ge=1, le=8)] = Field(
        8, description="longest periodic orbit looked for, in mesh periods"
    )
    gradient: Literal["forward", "reverse"] = Field(
        "forward", description="differentiation mode; both give the same gradient"
    )
    precision: Literal["float64", "float32"] = Field(
        "float64", description="of the integration; float32 holds tolerances down to 2e-6"
    )


class ObjectiveConfig(_Section):
    """Weighted sum of measures of the contact force, each relative to the baseline."""

    mean_weight: NonNegative = Field(0.5, description="weight of the mean contact force")
    peak_weight: NonNegative = Field(0.5, description="weight of the peak contact force")
    rms_weight: NonNegative = Field(0.0, description="weight of the RMS contact force")
    line_weights: dict[Positive, NonNegative] = Field(
        default_factory=dict,
        description="weights of spectral lines, {order: weight}, order in mesh frequencies",
    )
    motion: Literal["reached", "worst", "weighted", "ensemble"] = Field(
        "reached",
        description="motion that counts: the one reached from rest, the worst of those that "
        "coexist, all weighted by their share of initial states, or an average over an "
        "ensemble, which a chaotic scene needs",
    )
    peak_norm: Annotated[float, Field(ge=4, le=64)] | None = Field(
        None, description="p of the p-norm that stands for the peak in the search; absent: the peak"
    )
    speeds_rpm: tuple[Positive, ...] = Field(
        (), description="speeds the objective is taken over, as [2000, 3000]; none: the scene's"
    )
    speed_weights: tuple[Positive, ...] = Field(
        (), description="weights of these speeds in the objective; none: equal ones"
    )
    over_speeds: Literal["weighted", "worst"] = Field(
        "weighted", description="what these speeds come to: their weighted mean or the worst"
    )

    @model_validator(mode="before")
    @classmethod
    def _orders(cls, data):
        data = _tuples(data)
        # The name of a key that `--set` gives, and of one in JSON, is a word.
        if isinstance(data, dict) and isinstance(data.get("line_weights"), dict):
            lines = {_number(k): v for k, v in data["line_weights"].items()}
            return data | {"line_weights": lines}
        return data

    @model_validator(mode="after")
    def _some_weight(self):
        lines = sum(self.line_weights.values())
        if self.mean_weight + self.peak_weight + self.rms_weight + lines <= 0:
            raise ValueError(
                "`objective.mean_weight`, `objective.peak_weight`, `objective.rms_weight` and "
                "`objective.line_weights` must not all be 0"
            )
        if self.motion == "ensemble" and (lines > 0 or self.peak_norm is not None):
            raise ValueError(
                "`objective.line_weights` and `objective.peak_norm` belong to a periodic motion; "
                "remove them or set `objective.motion` to reached, worst or weighted"
            )
        return self

    @model_validator(mode="after")
    def _speeds(self):
        speeds, weights = self.speeds_rpm, self.speed_weights
        if len(set(speeds)) != len(speeds) or len(speeds) > 32:
            raise ValueError(
                f"`objective.speeds_rpm` must be at most 32 different speeds, but is {list(speeds)}"
            )
        worst = self.over_speeds == "worst"
        if not speeds and (weights or worst):
            key = "speed_weights" if weights else "over_speeds"
            raise ValueError(
                f"`objective.{key}` belongs to `objective.speeds_rpm`, which has no speed; add "
                "some or remove it"
            )
        if weights and len(weights) != len(speeds):
            raise ValueError(
                f"`objective.speed_weights` must be {len(speeds)} numbers, one for each of "
                f"`objective.speeds_rpm`, but is {list(weights)}"
            )
        if weights and worst:
            raise ValueError(
                "`objective.speed_weights` belongs to `objective.over_speeds` weighted, but that "
                "is worst; remove one of them"
            )
        if speeds and self.motion == "ensemble":
            raise ValueError(
                "`objective.speeds_rpm` must be empty for `objective.motion` ensemble, but is "
                f"{list(speeds)}: the noise of an average is judged at one speed; optimise at one, "
                "and look at the others with `rootsopt sweep`"
            )
        return self


class ResponseConfig(_Section):
    """What is reported beside mean, peak and RMS of the contact force."""

    lines: tuple[Positive, ...] = Field(
        (), description="spectral lines of the force, orders in mesh frequencies, as [1, 2]"
    )

    @model_validator(mode="before")
    @classmethod
    def _lists(cls, data):
        return _tuples(data)

    @model_validator(mode="after")
    def _few(self):
        if len(set(self.lines)) != len(self.lines) or len(self.lines) > 32:
            raise ValueError(
                f"`response.lines` must be at most 32 different orders, but is {list(self.lines)}"
            )
        return self


class AttractorsConfig(_Section):
    """Initial states tried to find the motions that coexist."""

    relatives: Annotated[int, Field(ge=1, le=1000)] = Field(
        12, description="initial relative rotations tried"
    )
    rates: Annotated[int, Field(ge=1, le=1000)] = Field(
        9, description="initial relative speeds tried"
    )
    relative_range_mrad: tuple[float, float] | None = Field(
        None, description="(low, high) of the relative rotation; absent: the play and contact"
    )
    rate_range_rad_s: tuple[float, float] | None = Field(
        None, description="(low, high) of the relative speed; absent: as impacts reach"
    )

    @model_validator(mode="before")
    @classmethod
    def _pairs(cls, data):
        return _tuples(data)

    @model_validator(mode="after")
    def _ordered(self):
        for key in ("relative_range_mrad", "rate_range_rad_s"):
            pair = getattr(self, key)
            if pair is not None and not pair[0] < pair[1]:
                raise ValueError(
                    f"`attractors.{key}` must be two increasing numbers, but is {list(pair)}"
                )
        return self


class EnsembleConfig(_Section):
    """Motions averaged over where a single one means nothing."""

    members: Annotated[int, Field(ge=4, le=100_000)] = Field(
        16, description="motions from different initial states, per design"
    )
    settle_periods: Annotated[int, Field(ge=0, le=10**6)] = Field(
        64, description="mesh periods before a motion counts"
    )
    periods: Annotated[int, Field(ge=1, le=10**6)] = Field(
        64, description="mesh periods of a motion that count"
    )
    designs: Annotated[int, Field(ge=12, le=4096)] = Field(
        32, description="designs around one, in pairs, from which its gradient is estimated"
    )
    spread: Annotated[float, Field(gt=0, le=0.5)] = Field(
        0.1,
        description="standard deviation of these designs, as a share of the bounds, which they "
        "stay within",
    )
    seed: Annotated[int, Field(ge=0)] = Field(0, description="seed of states and designs")


class SweepConfig(_Section):
    """The speeds of `rootsopt sweep`."""

    speed_rpm: dict[Literal["from", "to", "points"], Positive] | None = Field(
        None,
        description="{from: 300, to: 6000, points: 39}; absent: `objective.speeds_rpm`, and "
        "without these 39 from a tenth of to twice the scene's speed",
    )

    @model_validator(mode="after")
    def _range(self):
        wanted = self.speed_rpm
        if wanted is None:
            return self
        whole = wanted.get("points", 0)
        ordered = wanted.get("from", 0) < wanted.get("to", 0)
        if len(wanted) < 3 or not (ordered and whole == int(whole) and 2 <= whole <= 10_000):
            raise ValueError(
                "`sweep.speed_rpm` must be {from: .., to: .., points: ..} with from below to and "
                f"2 to 10000 points, but is {wanted}"
            )
        return self


class ConstraintsConfig(_Section):
    """What an optimised design must satisfy."""

    area_efficiency_min: Literal["baseline"] | Annotated[float, Field(ge=0, lt=1)] = Field(
        "baseline", description="floor of the area efficiency"
    )
    undercut_margin_min_mm: NonNegative = Field(0.0, description="floor of the undercut margin")
    seal_width_min_mm: NonNegative = Field(
        0.0, description="floor of the tip land's whole arc length"
    )


class BoundsConfig(_Section):
    """Box of the search, (low, high) for each design parameter."""

    pressure_angle_deg: tuple[float, float] = Field((25.0, 45.0))
    involute_length_mm: tuple[float, float] | None = Field(
        None, description="default: 10 % to 100 % of the longest involute"
    )
    tip_arc_angle_deg: tuple[float, float] = Field((0.5, 8.0))

    @model_validator(mode="before")
    @classmethod
    def _pairs(cls, data):
        return _tuples(data)

    @model_validator(mode="after")
    def _ordered(self):
        limits = {
            "pressure_angle_deg": (1.0, 80.0),
            "involute_length_mm": (1e-6, 1e6),
            "tip_arc_angle_deg": (0.0, 44.0),
        }
        for key, (least, most) in limits.items():
            pair = getattr(self, key)
            if pair is not None and not least <= pair[0] < pair[1] <= most:
                raise ValueError(
                    f"`optimizer.bounds.{key}` must be two increasing numbers in "
                    f"[{least:g}, {most:g}], but is {list(pair)}"
                )
        return self


class OptimizerConfig(_Section):
    """How the design is searched."""

    method: Literal["adam", "rmsprop", "sgd"] = Field(
        "adam", description="optax update rule: adam, rmsprop, sgd"
    )
    learning_rate: Positive = Field(0.05, description="step in the unit box of the bounds")
    iterations: Annotated[int, Field(ge=1, le=10000)] = Field(40, description="per start")
    starts: Annotated[int, Field(ge=1, le=64)] = Field(2, description="local searches")
    screening: Annotated[int, Field(ge=0, le=4096)] = Field(
        48, description="designs screened to place the starts; 0 starts at the baseline only"
    )
    seed: Annotated[int, Field(ge=0)] = Field(0, description="seed of the screening sample")
    bounds: BoundsConfig = Field(default_factory=lambda: BoundsConfig.model_validate({}))


class Config(_Section):
    """Everything a run needs."""

    profile: ProfileConfig
    rotor: RotorConfig
    contact: ContactConfig
    scene: SceneConfig
    solver: SolverConfig = Field(default_factory=lambda: SolverConfig.model_validate({}))
    objective: ObjectiveConfig = Field(default_factory=lambda: ObjectiveConfig.model_validate({}))
    constraints: ConstraintsConfig = Field(
        default_factory=lambda: ConstraintsConfig.model_validate({})
    )
    response: ResponseConfig = Field(default_factory=lambda: ResponseConfig.model_validate({}))
    attractors: AttractorsConfig = Field(
        default_factory=lambda: AttractorsConfig.model_validate({})
    )
    ensemble: EnsembleConfig = Field(default_factory=lambda: EnsembleConfig.model_validate({}))
    sweep: SweepConfig = Field(default_factory=lambda: SweepConfig.model_validate({}))
    optimizer: OptimizerConfig = Field(default_factory=lambda: OptimizerConfig.model_validate({}))

    @property
    def needs_search(self) -> tuple[str, ...]:
        """Keys of parts that need the place of contact, which only a search has."""
        parts = {
            "contact.friction": self.contact.friction,
            "scene.supports": self.scene.supports,
            "scene.center_distance_error_mm": self.scene.center_distance_error_mm,
        }
        return tuple(key for key, part in parts.items() if part is not None)

    @model_validator(mode="after")
    def _searched(self):
        fidelity = self.solver.fidelity
        if self.needs_search and fidelity not in ("search", "auto"):
            raise ValueError(
                f"`solver.fidelity` must be search (or auto) with `{self.needs_search[0]}`, which "
                f"needs the place of contact, but is {fidelity}"
            )
        return self

    def to_yaml(self) -> str:
        """The resolved config, every default written out."""
        data = self.model_dump(mode="json", exclude_none=True)
        return yaml.safe_dump(data, sort_keys=False, allow_unicode=True)


class _Loader(yaml.SafeLoader):
    """YAML with `1e5` as a number and without silently overwritten keys."""

    def construct_mapping(self, node, deep=False):
        seen = set()
        for key_node, _ in node.value:
            key = self.construct_object(key_node, deep=True)
            try:
                repeated = key in seen
            except TypeError:
                raise yaml.constructor.ConstructorError(
                    None, None, f"a key must be a plain name, but is {key!r}", key_node.start_mark
                ) from None
            if repeated:
                raise yaml.constructor.ConstructorError(
                    None, None, f"the key {key!r} stands twice", key_node.start_mark
                )
            seen.add(key)
        return super().construct_mapping(node, deep)


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(
        r"^[-+]?(?:[0-9][0-9_]*\.?[0-9_]*(?:[eE][-+]?[0-9]+)|[0-9][0-9_]*\.[0-9_]*"
        r"|\.[0-9_]+(?:[eE][-+]?[0-9]+)?|\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN))$"
    ),
    list("-+0123456789."),
)


def load(path: str | Path, overrides: list[str] | tuple[str, ...] = ()) -> Config:
    """Read a config file and apply `dotted.key=value` overrides.

    Raises `InputError` for anything wrong with file, keys or values.
    """
    return parse(_read(Path(path)), overrides, source=str(path))


def parse(text: str, overrides: list[str] | tuple[str, ...] = (), source: str = "config") -> Config:
    """Like `load`, from YAML text."""
    data = _yaml(text, source)
    if data is None:
        data = {}
    if not isinstance(data, dict):
        raise InputError(
            f"{source}: must hold sections such as `profile:` and `scene:`, but is a "
            f"{type(data).__name__}"
        )
    for override in overrides:
        _override(data, override)
    try:
        return Config.model_validate(data)
    except ValidationError as error:
        raise InputError(f"{source}: {_explain(error)}") from None


def _read(path: Path) -> str:
    try:
        return path.read_bytes().decode("utf-8")
    except FileNotFoundError:
        raise InputError(f"{path}: there is no such file; give the path of a config") from None
    except IsADirectoryError:
        raise InputError(f"{path}: is a folder; give the path of a config file") from None
    except UnicodeDecodeError as error:
        raise InputError(
            f"{path}: is not UTF-8 text (byte {error.start}); save it as UTF-8"
        ) from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from None


def _yaml(text: str, source: str) -> Any:
    try:
        return yaml.load(text, Loader=_Loader)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        mark = getattr(error, "problem_mark", None)
        place = f" (line {mark.line + 1})" if mark is not None else ""
        problem = getattr(error, "problem", None) or str(error).splitlines()[0]
        raise InputError(f"{source}: is not valid YAML{place}: {problem}") from None


def _override(data: dict, override: str) -> None:
    key, equals, value = override.partition("=")
    parts = key.strip().split(".")
    if not equals or not all(parts):
        raise InputError(
            f"--set {override!r}: must be dotted.key=value, as in scene.speed_rpm=1500"
        )
    target = data
    for i, part in enumerate(parts[:-1]):
        inner = target.get(part)
        if inner is None:
            inner = target[part] = {}
        if not isinstance(inner, dict):
            raise InputError(f"--set {override!r}: `{'.'.join(parts[: i + 1])}` holds no keys")
        target = inner
    target[parts[-1]] = _yaml(value, f"--set {override!r}")


def _explain(error: ValidationError) -> str:
    """One sentence for the first, most telling problem."""
    problems = sorted(error.errors(), key=lambda e: e["type"] != "extra_forbidden")
    first = problems[0]
    place = [str(p) for p in first["loc"] if not _is_branch(p)]
    key = ".".join(place)
    kind, value, context = first["type"], first.get("input"), first.get("ctx", {})
    if kind == "extra_forbidden":
        return _unknown(place)
    if kind == "missing":
        field = _field(place)
        note = f" ({field.description})" if field is not None and field.description else ""
        return f"`{key}` is missing{note}; add it"
    if kind == "value_error":
        return str(context["error"])
    return f"`{key}` must be {_allowed(kind, context, first['msg'])}, but is {value!r}"


def _is_branch(part) -> bool:
    """Whether a part of a pydantic location names a union branch rather than a key."""
    text = str(part)
    return "[" in text or text in ("float", "int", "tuple")


def _allowed(kind: str, context: dict, message: str) -> str:
    words = {
        "float_type": "a number",
        "float_parsing": "a number",
        "int_type": "a whole number",
        "int_from_float": "a whole number",
        "finite_number": "a finite number",
        "model_type": "a section with keys of its own",
        "string_type": "a word",
        "dict_type": "keys with values, as {a: 1, b: 2}",
        "tuple_type": "a list of numbers, as [1, 2]",
    }
    if kind in words:
        return words[kind]
    signs = {"gt": "greater than", "ge": "at least", "lt": "less than", "le": "at most"}
    for name, word in signs.items():
        if name in context:
            return f"{word} {context[name]:g}"
    if kind == "literal_error":
        return f"one of {context['expected']}"
    return message[0].lower() + message[1:]


def _section(place: list[str]) -> type[BaseModel] | None:
    model: type[BaseModel] | None = Config
    for part in place:
        field = model.model_fields.get(part) if model is not None else None
        if field is None:
            return None
        model = _model_of(field.annotation)
    return model


def _model_of(annotation: Any) -> type[BaseModel] | None:
    candidates = [annotation, *getattr(annotation, "__args__", ())]
    for candidate in candidates:
        if isinstance(candidate, type) and issubclass(candidate, BaseModel):
            return candidate
    return None


def _field(place: list[str]):
    model = _section(place[:-1])
    return model.model_fields.get(place[-1]) if model is not None else None


def _unknown(place: list[str]) -> str:
    key = ".".join(place)
    model = _section(place[:-1])
    names = list(model.model_fields) if model is not None else []
    near = difflib.get_close_matches(place[-1], names, n=1, cutoff=0.5)
    elsewhere = [k for k in _all_keys(Config) if k.split(".")[-1] == place[-1]]
    if elsewhere:
        return f"`{key}` is not a known key; did you mean `{elsewhere[0]}`?"
    if near:
        return f"`{key}` is not a known key; did you mean `{'.'.join([*place[:-1], near[0]])}`?"
    return f"`{key}` is not a known key; valid here: {', '.join(names)}"


def _all_keys(model: type[BaseModel], prefix: str = ""):
    for name, field in model.model_fields.items():
        inner = _model_of(field.annotation)
        yield f"{prefix}{name}"
        if inner is not None:
            yield from _all_keys(inner, f"{prefix}{name}.")


def describe_keys() -> str:
    """One line per key with unit and meaning, for `--help`."""
    lines = []
    for key in _all_keys(Config):
        place = key.split(".")
        field = _field(place)
        if field is None or _model_of(field.annotation) is not None:
            continue
        lines.append(f"  {key:<42} {field.description or ''}".rstrip())
    return "\n".join(lines)
