"""Config sections for studies of several scenes, or of several objectives.

The section `tolerances` states how values of scene and design scatter in manufacture, `assumptions`
the ranges of assumed values of a pump's operation, and `pareto` the terms of a trade-off."""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Annotated, Any, Literal, NamedTuple, get_args

from pydantic import Field, model_validator

from rootsopt.config.section import Listed, Section, bare, between, require, such, taken
from rootsopt.config.units import named, near, shown

_RELATIVE = "relative_"
_Kind = Literal[
    "normal", "uniform", "triangular", "relative_normal", "relative_uniform", "relative_triangular"
]

# Names of the distributions. The width of a `relative_` one is a fraction of the key's value.
_DISTRIBUTIONS = get_args(_Kind)
_Distribution = Annotated[
    dict[_Kind, Annotated[float, Field(gt=0, le=1e9)]],
    such("one distribution, as in {normal: 0.002}", lambda given: len(given) == 1),
]
_SECTIONS = ("rotor", "contact", "scene")

# Keys in `_SECTIONS` that cannot scatter: they are not quantities of the simulated pair.
_NOT_PHYSICAL = ("rotor.helix_deg", "contact.smoothing_mm")

# Name of the kind of `Scatter` for keys whose values `conditions` list.
_LISTED = "listed"

# Mounting errors in the section `scene`. Their nominal value is 0 unless a config gives it.
_MOUNTING = "center_distance_error_mm", "phase_error_mrad"

# Common words for quantities, each with the key that the user probably means.
_PLAIN = {
    "profile_offset": "contact.clearance_mm",
    "clearance": "contact.clearance_mm",
    "center_distance": "scene.center_distance_error_mm",
    "center_distance_mm": "scene.center_distance_error_mm",
    "backlash": "scene.timing_gear.backlash_mm",
    "phase": "scene.phase_error_mrad",
    "load": "scene.load.torque_N_m",
    "speed": "scene.speed_rpm",
    "friction": "contact.friction.kinetic",
}


class Scatter(NamedTuple):
    """Distribution of one key of the config. It is symmetric about the config's own value.

    `key`: dotted key; `kind`: `normal`, `uniform` or `triangular`; `nominal`: the config's value;
    `width`: standard deviation of a normal distribution before it is cut off, else half its range;
    `half`: distance from the nominal value beyond which no value lies. All numbers are in the
    key's unit.
    """

    key: str
    kind: str
    nominal: float
    width: float
    half: float


# Standard deviations at which normal distributions are cut off.
_CUT = 4.0


class TolerancesConfig(Section):
    """Scatter of scene and design, for a robust optimum. Without this section, nothing scatters."""

    over: dict[str, _Distribution] = Field(
        default_factory=dict,
        description="distribution by key, as {contact.clearance_mm: {normal: 0.002}}; normal: "
        "standard deviation; uniform, triangular: half width; relative_...: the same as a fraction "
        "of the key's value",
    )
    conditions: dict[str, dict[str, Annotated[float, between(-1e9, 1e9)]]] = Field(
        default_factory=dict,
        description="scenes by name, instead of `over` and a sample: values of keys, as "
        "{new: {}, worn: {contact.wear.depth_mm: 0.03}}",
    )
    samples: Annotated[int, Field(ge=2, le=1024)] = Field(
        16, description="scenes simulated for each design of the search: a fixed Sobol sample"
    )
    combine: Literal["mean_plus_k_sigma", "quantile", "worst"] = Field(
        "mean_plus_k_sigma",
        description="objective over these scenes: mean plus k standard deviations, a quantile, or "
        "the worst scene",
    )
    k: Annotated[float, between(0, 10)] = Field(
        2.0, description="standard deviations added to the mean"
    )
    quantile: Annotated[float, Field(ge=0.5, lt=1)] = Field(
        0.95, description="share of the scenes whose objective lies below the quantile"
    )
    limits: Literal["every", "combined"] = Field(
        "every",
        description="where limits of forces and reserves must hold: in every one of these scenes, "
        "or as `combine` combines them, such as the mean plus k standard deviations",
    )
    check_samples: Annotated[int, Field(ge=0, le=100_000)] = Field(
        1000,
        description="other random scenes in which baseline, nominal and robust optimum are "
        "compared; 0: no comparison",
    )

    @model_validator(mode="before")
    @classmethod
    def _flat(cls, data):
        if not isinstance(data, dict):
            return data
        if isinstance(over := data.get("over"), dict):
            data = data | {"over": entries(over, _DISTRIBUTIONS)}
        scenes = data.get("conditions")
        if not isinstance(scenes, dict) or not scenes:
            return data
        flat = {
            name: _dotted(values, lambda _: False) if isinstance(values, dict) else values
            for name, values in scenes.items()
        }
        # With `conditions`, no sample is drawn.
        return data | {"conditions": flat, "samples": max(2, len(flat)), "check_samples": 0}

    @model_validator(mode="after")
    def _one_each(self):
        over, count = self.over, len(self.conditions)
        require(
            not (over and count),
            "`tolerances` must hold either `over` or `conditions`, but holds both; remove one",
        )
        require(
            count != 1,
            f"`tolerances.conditions` must name two or more scenes, but names {count}; add one, "
            "as new: {}",
        )
        require(
            bool(over or count),
            "`tolerances.over` must name at least one key, as in {contact.clearance_mm: "
            "{normal: 0.002}}; add one or remove `tolerances`",
        )
        return self

    @property
    def changed(self) -> tuple[str, ...]:
        """Keys that some of the `conditions` change."""
        return tuple(dict.fromkeys(key for one in self.conditions.values() for key in one))

    @property
    def keys(self) -> tuple[str, ...]:
        """Keys that scatter, or that a condition changes."""
        return (*self.over, *self.changed)

    def scatters(self, values: Mapping[str, float]) -> tuple[Scatter, ...]:
        """Return the distributions, in the order of the config.

        `values`: the config's own value of each key. Raises ValueError for a relative distribution
        of a key whose value is 0."""
        scatters = []
        for key in self.changed:
            nominal = values[key]
            half = max(abs(one.get(key, nominal) - nominal) for one in self.conditions.values())
            scatters.append(Scatter(key, _LISTED, nominal, half, half))
        for key, given in self.over.items():
            ((name, width),) = given.items()
            kind = name.removeprefix(_RELATIVE)
            nominal = values[key]
            require(
                kind == name or nominal != 0,
                f"`tolerances.over.{key}` must be {kind}, not {name}, because `{key}` is 0; give "
                "the width in the key's unit",
            )
            size = width * abs(nominal) if kind != name else width
            half = _CUT * size if kind == "normal" else size
            scatters.append(Scatter(key, kind, nominal, size, half))
        return tuple(scatters)

    def extremes(self, values: Mapping[str, float]) -> Iterator[tuple[str, dict[str, float], str]]:
        """Yield scenes that must be valid, each as (requirement, its values by key, remedy).

        They are the `conditions`, and the ends of the distributions. `values`: as for `scatters`.
        """
        for name, given in self.conditions.items():
            what = f"the scene `{name}` of `tolerances.conditions` must be a valid one"
            yield what, given, "correct its values"
        for one in self.scatters(values) if self.over else ():
            remedy = f"narrow the distribution or move the nominal value, {one.nominal:.6g}"
            for end in (one.nominal - one.half, one.nominal + one.half):
                what = f"`tolerances.over.{one.key}` lets the key reach {end:.6g}"
                yield what, {one.key: end}, remedy


def scatterable(config: Any, design: bool = True) -> dict[str, float]:
    """Return the values of a config that may scatter, by dotted key.

    They are the numerical values in its sections `rotor`, `contact` and `scene`, and with `design`
    its design parameters. An entry of a list is numbered from 1, as in `profile.coefficients_2`."""
    values: dict[str, float] = {}

    def walk(section: Section, prefix: str) -> None:
        for name in type(section).model_fields:
            value = getattr(section, name)
            if isinstance(value, Section):
                walk(value, f"{prefix}{name}.")
            elif isinstance(value, float) and prefix + name not in _NOT_PHYSICAL:
                values[prefix + name] = value

    for name in _SECTIONS:
        walk(getattr(config, name), f"{name}.")
    profile = config.profile
    if not design:
        return values
    designs = zip(profile.design_keys, profile.design, strict=True)
    return values | {f"profile.{key}": float(value) for key, value in designs}


def mounted(data: Any) -> Any:
    """Return a config's plain values, with 0 for mounting errors that scatter but are absent.

    Return `data` unchanged if it does not have the form of a config, or if no such error scatters.
    """
    scene, over = taken(data, "scene"), taken(data, "tolerances.over")
    if not isinstance(over, dict) or not isinstance(scene, dict):
        return data
    scatter = [name for name in _MOUNTING if f"scene.{name}" in entries(over, _DISTRIBUTIONS)]
    absent = {name: 0.0 for name in scatter if scene.get(name) is None}
    return data | {"scene": scene | absent} if absent else data


def unknown_key(
    key: str, valid: Mapping[str, float], known: Mapping[str, Any], place: str = "tolerances.over"
) -> str:
    """Return a message for a key at a `place`, such as an entry of a section, that cannot vary.

    `valid`: result of `scatterable`; `known`: all keys of a config."""
    text = f"`{place}` must name numbers of this config's scene, but names `{named(key)}`"
    if key in known and key.split(".")[0] in _SECTIONS and key not in _NOT_PHYSICAL:
        return (
            f"{text}, which the config does not have as a number; give `{key}` its nominal value "
            "first"
        )
    if key in known:
        designs = any(one.startswith("profile.") for one in valid)
        more = ", and the design parameters of profile" if designs else ""
        return f"{text}, which cannot vary; valid are numbers of rotor, contact and scene{more}"
    return text + (_near(key, valid) or f"; valid are {', '.join(valid)}")


def _near(word: str, words: Any) -> str:
    """Return a guess at which of the `words` the user meant, as the end of a message, or ""."""
    meant = _PLAIN.get(word.replace("centre", "center"))
    if meant is not None:
        return f"; did you mean `{meant}`?"
    last = {one.split(".")[-1]: one for one in words}
    if word.split(".")[-1] in last and word not in words:
        return f"; did you mean `{last[word.split('.')[-1]]}`?"
    guess = near(word, words, cutoff=0.5)
    return f"; did you mean `{guess}`?" if guess else ""


def _dotted(data: dict, is_value: Callable[[dict], bool], prefix: str = "") -> dict[str, Any]:
    """Return {dotted key: value} from nested sections.

    A later value replaces an earlier one of the same key. `is_value`: whether a dictionary is the
    value of a key rather than a section."""
    values: dict[str, Any] = {}
    for key, value in data.items():
        nested = isinstance(value, dict) and not is_value(value)
        inner = _dotted(value, is_value, f"{prefix}{key}.") if nested else {f"{prefix}{key}": value}
        values |= inner
    return values


def entries(over: dict, kinds: Iterable[str]) -> dict[str, Any]:
    """Return {dotted key: {kind: numbers}}, from nested sections as overrides with dots make them.

    `kinds`: valid words for a kind; others, and values of another form, stay as they are."""
    words = {bare(word): word for word in kinds}

    def is_value(given: dict) -> bool:
        return not any(one is None or isinstance(one, dict) for one in given.values())

    def named_right(given: Any) -> Any:
        if not isinstance(given, dict):
            return given
        return {words.get(bare(str(kind)), kind): width for kind, width in given.items()}

    return {key: named_right(given) for key, given in _dotted(over, is_value).items()}


_Pair = Annotated[
    tuple[Annotated[float, between(-1e9, 1e9)], ...],
    Listed,
    such("two increasing numbers", lambda pair: len(pair) == 2 and pair[0] < pair[1]),
]
_Spread = Annotated[
    dict[Literal["factor", "range"], _Pair],
    such("one range, as in {factor: [0.8, 1.2]}", lambda given: len(given) == 1),
]
_CLEARANCE = "contact.clearance_mm"

# Usual ranges, as multiples of the config's value, of quantities that a designer seldom knows.
_FACTORS = {
    "scene.speed_rpm": (0.8, 1.2),
    "scene.load.torque_N_m": (0.6, 1.6),
    "scene.load.pressure_difference_Pa": (0.6, 1.6),
    "scene.timing_gear.stiffness_N_m_per_rad": (0.5, 2.0),
    "scene.timing_gear.backlash_mm": (0.5, 1.5),
    "scene.timing_gear.damping_ratio": (0.6, 1.4),
    "contact.stiffness_N_per_mm_e": (0.7, 1.4),
}

# Half of the usual range of the clearance: the greater of the first number (mm) and the second one
# (fraction of the config's value).
_CLEARANCES = 0.015, 0.5


class Span(NamedTuple):
    """Range of one assumed quantity: `key` and the ends `low` and `high`, in the key's unit."""

    key: str
    low: float
    high: float

    @property
    def ends(self) -> tuple[float, float]:
        """Both ends."""
        return self.low, self.high


class AssumptionsConfig(Section):
    """Scenes around that of the config, in which an optimum is compared with the baseline."""

    over: dict[str, _Spread | None] = Field(
        default_factory=dict,
        description="ranges by key, as {scene.speed_rpm: {factor: [0.8, 1.2]}, "
        "contact.clearance_mm: {range: [0, 0.04]}}; factor: of the key's value; null: not varied; "
        "other keys keep their usual range",
    )
    scenes: Annotated[int, Field(ge=0, le=1024)] = Field(
        32, description="random scenes, beside the ends of each range; 0: no comparison"
    )
    combine: Literal["mean", "worst", "regret"] = Field(
        "mean",
        description="with objective.over assumptions: mean or worst objective over these scenes, "
        "or the greatest distance from the best design known in a scene",
    )

    @model_validator(mode="before")
    @classmethod
    def _flat(cls, data):
        over = data.get("over") if isinstance(data, dict) else None
        kinds = "factor", "range"
        return data | {"over": entries(over, kinds)} if isinstance(over, dict) else data

    def spans(self, values: Mapping[str, float], every: bool = True) -> tuple[Span, ...]:
        """Return the ranges of the keys that the config has; those given in the config come last.

        `values`: the config's own value of each key that can vary; `every`: whether to include the
        usual ranges. A range without an extent is left out, such as a factor of 0."""
        here = values.get(_CLEARANCE, 0.0)
        half = max(_CLEARANCES[0], _CLEARANCES[1] * here)
        usual: dict[str, Any] = {key: {"factor": pair} for key, pair in _FACTORS.items()}
        usual |= {_CLEARANCE: {"range": (max(0.0, here - half), here + half)}}
        spans = []
        for key, given in ((usual if every else {}) | self.over).items():
            if key not in values or given is None:
                continue
            ((kind, ends),) = given.items()
            size = values[key] if kind == "factor" else 1.0
            low, high = sorted(size * end for end in ends)
            if not math.isclose(low, high, abs_tol=1e-300):
                spans.append(Span(key, low, high))
        return tuple(spans)


class ParetoConfig(Section):
    """The terms that `rootsopt pareto` trades against each other, and the number of points."""

    terms: Annotated[
        tuple[str, ...],
        Listed,
        such(
            "two or three different terms, as [peak_force_N, area_efficiency]",
            lambda terms: len(set(terms)) == len(terms) in (2, 3),
        ),
    ] = Field(
        ("peak_force_N", "area_efficiency"),
        description="two or three quantities: forces and lines as in `response`, geometry as in "
        "`geometry`, displaced_volume_cm3, theoretical_flow_l_min, flow_ripple, "
        "gear_backlash_max_mm, angular_play_min_mrad, leakage_fraction, delivered_flow_l_min, "
        "flank_gap_min_um, flank_gap_mean_um, bearing_load_equivalent_N, bearing_load_max_N, "
        "axial_force_max_N, tilting_moment_max_N_m, static_bearing_load_equivalent_N, "
        "static_bearing_load_max_N, or registered terms",
    )
    senses: dict[str, Literal["min", "max"]] = Field(
        default_factory=dict,
        description="sense of a term, as {seal_width_mm: min}, where it should differ from the "
        "term's own: max for area_efficiency, displaced_volume_cm3, theoretical_flow_l_min, "
        "delivered_flow_l_min, gear_backlash_max_mm, flank_gap_min_um, flank_gap_mean_um, "
        "seal_width_mm, root_radius_mm and undercut_margin_mm, min for all others",
    )
    points: Annotated[int, Field(ge=3, le=101)] = Field(
        11, description="points along the front of two terms, its ends included"
    )
    divisions: Annotated[int, Field(ge=2, le=20)] = Field(
        5,
        description="steps between two ends of three terms: n steps give (n + 1) (n + 2) / 2 "
        "points",
    )
    refinements: Annotated[int, Field(ge=0, le=100)] = Field(
        12, description="greatest number of further points where neighbours lie far apart"
    )

    @model_validator(mode="after")
    def _own(self):
        for name in self.senses:
            require(
                name in self.terms,
                f"`pareto.senses` must name terms of `pareto.terms` ({', '.join(self.terms)}), "
                f"but names {shown(name)}; add the term, or remove its sense",
            )
        return self
