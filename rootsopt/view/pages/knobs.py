"""Sliders of the explorer: the numbers they move, and what is computed for their values.

A knob has a name, a unit, a span and an allowed range. An `Engine` computes the geometry of a
config, and its motion near a known one."""

import functools
import math
import threading
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic.fields import FieldInfo

from rootsopt.config.explain import is_whole, limits_of, tree
from rootsopt.config.families import family_of
from rootsopt.config.reading import Config
from rootsopt.config.study import TWIST
from rootsopt.config.units import MM, unit_of, words
from rootsopt.profiles import Geometry, Profile, geometry, outline
from rootsopt.response.evaluation import Evaluator
from rootsopt.response.records import geometry_record
from rootsopt.response.reducers import alone
from rootsopt.response.result import Evaluation, Seeds, Series
from rootsopt.runtime.programs import CachedFunction
from rootsopt.scene.build import Scene
from rootsopt.scene.check import check_geometry
from rootsopt.scene.reading import design_vector
from rootsopt.scene.space import bounds_of
from rootsopt.view.pages.charts import motion, rotor

if TYPE_CHECKING:
    from rootsopt.optimize.outcome import Optimization


# Sections of the config that hold the design and its scene.
_SECTIONS = ("profile", "rotor", "contact", "scene")
_GROUPS = {
    "profile": "Profile",
    "rotor": "Rotor",
    "contact": "Contact",
    "contact.friction": "Friction",
    "contact.wear": "Wear",
    "scene": "Speed and mounting",
    "scene.load": "Load",
    "scene.motor": "Motor",
    "scene.timing_gear": "Timing gear",
    "scene.supports": "Elastic bearings",
    "scene.bearings": "Bearing loads",
    "scene.heat": "Heat",
}
_DESIGN = "Design"

# Groups at the top of the page; the others follow in the order of the config.
_ORDER = (_DESIGN, "Speed and mounting", "Load", "Motor", "Timing gear", "Contact")

# Span of a slider as multiples of the config's own value.
_AROUND = 0.2, 2.0

# Half of the span of a slider, by unit, for a value of 0; 1 for other units.
_ZERO = {"mm": 0.2, "mrad": 1.0, "°": 60.0, "K": 60.0}

# Least number of steps of a slider that is not whole.
_STEPS = 200


class Knob(NamedTuple):
    """A number of the config with its slider.

    `key`: dotted config key; an entry of a list has its number, as in `profile.coefficients_3`.
    `name`, `unit`, `help`, `group`: texts of the page. `value`: number in the config. `low`,
    `high`, `step`: span and step of the slider. `least`, `most`: allowed range, perhaps infinite.
    `whole`: whether only whole numbers are allowed."""

    key: str
    name: str
    unit: str
    help: str
    group: str
    value: float
    low: float
    high: float
    step: float
    least: float
    most: float
    whole: bool


def knobs_of(config: Config) -> list[Knob]:
    """Return the knobs of all design parameters and scene parameters that a `config` has.

    Design parameters span their bounds in an optimisation. Parts that the scene does not have, and
    keys that are not set, have no knobs."""
    knobs = [*_design(config)]
    known = {knob.key for knob in knobs}
    for key, field in tree(Config).items():
        section, name = key.partition(".")[0], key.rpartition(".")[2]
        if section not in _SECTIONS or key in known:
            continue
        # Its default follows other keys, so it has a slider only if the config sets it.
        if key == "contact.smoothing_mm" and name not in config.contact.model_fields_set:
            continue
        value = config.value(key)
        if isinstance(value, int | float) and not isinstance(value, bool):
            knobs.append(_scene(field, key, float(value)))
    order = [*_ORDER, *dict.fromkeys(knob.group for knob in knobs)]
    return sorted(knobs, key=lambda knob: order.index(knob.group))


def dotted(key: str) -> str:
    """Return the dotted config key of a design parameter, one of `Config.design_keys`."""
    return f"rotor.{key}" if key == TWIST else f"profile.{key}"


def _design(config: Config) -> Iterator[Knob]:
    """Yield the knobs of the design parameters."""
    known = {one.key: one for one in family_of(config.profile.family).parameters}
    values = zip(config.design_keys, config.design.tolist(), bounds_of(config), strict=True)
    for key, value, (low, high) in values:
        if key == TWIST:
            knob = _scene(tree(Config)[dotted(key)], dotted(key), value)
            ends = {"low": min(low, value), "high": max(high, value), "step": _step(high - low)}
            yield knob._replace(group=_DESIGN, **ends)
            continue
        owner = known.get(key) or known[key.rpartition("_")[0]]  # entries of a list are numbered
        sized = owner.limits(config.profile.pitch_radius_mm) or (owner.lowest, owner.highest)
        least, most = max(owner.lowest, sized[0]), min(owner.highest, sized[1])
        if not math.isfinite(high):
            high = _AROUND[1] * value
        low, high = max(low, least), min(high, most)
        name = words(owner.key)
        if key != owner.key:
            name = f"{name.removesuffix('s')} {key.rpartition('_')[2]}"
        yield Knob(
            dotted(key), name, unit_of(owner.key), owner.help, _DESIGN, value,
            min(low, value), max(high, value), _step(high - low), least, most, False,
        )  # fmt: skip


def _scene(field: FieldInfo, key: str, value: float) -> Knob:
    """Return the knob of any other number of the config."""
    (least, most), whole = limits_of(field).ends, is_whole(field)
    low, high = (least, most) if whole else _span(key, value, least < 0)
    low, high = max(low, least), min(high, most)
    section, _, name = key.rpartition(".")
    return Knob(
        key, words(name), unit_of(name), field.description or "",
        _GROUPS.get(section, section), value, min(low, value), max(high, value),
        1.0 if whole else _step(high - low), least, most, whole,
    )  # fmt: skip


def _span(key: str, value: float, signed: bool) -> tuple[float, float]:
    """Return the span of a slider around a `value`, before the key's limits are applied.

    `signed`: whether the key may be negative; its slider then reaches as far below 0 as above."""
    reach = max(_AROUND[1] * abs(value), _ZERO.get(unit_of(key), 1.0) * (signed or not value))
    return -reach if signed else _AROUND[0] * value, reach


def _step(width: float) -> float:
    """Return the greatest step 1, 2 or 5 × 10^k of which at least `_STEPS` fit into `width`."""
    if width <= 0:
        return 1.0
    power = 10.0 ** math.floor(math.log10(width / _STEPS))
    return max(one * power for one in (1, 2, 5) if one * power * _STEPS <= width * (1 + 1e-9))


# Number of points of a drawn outline, as in the CSV files of the other commands.
_POINTS = 240

# Maximum number of revolutions of a motion that are shown.
_TURNS = 4

# Relative difference of mean, peak and RMS force below which two motions count as the same.
_AGREES = 1e-3


class Shape(NamedTuple):
    """Geometry of a config.

    `outline` (n, 2): closed outline (mm); `record`: the entry `geometry` of the result file;
    `pair`: the rotor, and its frames in perfect rolling, as in `rootsopt.view.pages.charts`;
    `profile`: the profile itself."""

    outline: NDArray[np.float64]
    record: dict[str, float]
    pair: dict[str, Any]
    profile: Profile


class Engine:
    """Evaluates configs that differ little from a first one, `given`.

    `optimize`: the function `rootsopt.optimize_design`, passed as an argument, so that pages do not
    import the search.

    Several sessions in several threads can share an engine. `ready` is set once the first config
    has been evaluated, so that its programs are compiled."""

    def __init__(self, given: Config, optimize: Callable[..., "Optimization"]):
        self.given, self.optimize = given, optimize
        self.ready = threading.Event()

    @functools.cached_property
    def base(self) -> Config:
        """The config that the sliders change: `given` at the scene's own speed only.

        Raises `InputError` if its profile is not sound."""
        check_geometry(self.given)
        return alone(self.given)

    def shape(self, config: Config) -> Shape:
        """Return the geometry of a `config`.

        Raises `InputError` if its profile is not sound."""
        check_geometry(config)
        scene = Scene.from_config(config)
        profile, record = _shape(scene, design_vector(config))
        shown = np.asarray(outline(profile, points=_POINTS)) / MM
        pair = {"rotor": rotor(config, shown[::4]), "motion": motion(profile)}
        return Shape(shown, geometry_record(scene, record), pair, profile)

    def near(self, config: Config, start: Seeds) -> Evaluation:
        """Return the evaluation of a `config` from the `start` of a similar one.

        This is quick: no integration confirms the motion, and a motion that does not settle is
        abandoned after a quarter of the allowed transient."""
        return Evaluator.of(config).surveying().unconfirmed()(start=start)

    def from_rest(self, config: Config) -> Evaluation:
        """Return the evaluation of a `config` from rest, as `rootsopt simulate` computes it."""
        return Evaluator.of(config)()

    def prepare(self) -> None:
        """Compile the programs in this thread, and set `ready`."""
        config = self.base
        evaluator = Evaluator.of(config).unconfirmed()
        evaluator.prepare()
        self.shape(config)
        evaluation = evaluator()
        if evaluation.usable:
            self.near(config, evaluation.start)
        self.ready.set()


@CachedFunction
def _shape(scene: Scene, design) -> tuple[Profile, Geometry]:
    """Return profile and geometry of a design (d,) in config units."""
    profile = scene.profile(design)
    return profile, geometry(profile)


def cut(series: Series) -> Series:
    """Return the first revolutions of a long motion."""
    kept = series.rotation - series.rotation[0] < 2 * np.pi * _TURNS
    values: dict[str, Any] = {k: None if x is None else x[kept] for k, x in vars(series).items()}
    return Series(**values)


def same_motion(one: Evaluation, other: Evaluation) -> bool:
    """Return whether two evaluations of a config describe the same motion, by their forces."""
    if one.status is not other.status or one.response.keys() != other.response.keys():
        return False
    pairs = ((value, other.response[name]) for name, value in one.response.items())
    return all(abs(a - b) <= _AGREES * max(abs(a), abs(b), 1e-12) for a, b in pairs)
