"""Quantities to fit, and predictions of the record with derivatives with respect to them."""

import dataclasses
import functools
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from numpy.typing import NDArray

from rootsopt.config.explain import limits_of, tree
from rootsopt.config.reading import Config
from rootsopt.config.tolerances import scatterable, unknown_key
from rootsopt.config.units import NAMES
from rootsopt.dynamics.steady import Steady, varied
from rootsopt.errors import InputError
from rootsopt.identification.record import CHANNELS, Observed, channels_at
from rootsopt.response.ensemble import Ensemble, fitted_slope, neighbours
from rootsopt.response.evaluation import Evaluator
from rootsopt.response.records import apart_program, apart_record, orbit_record
from rootsopt.response.reducers import HERE, as_done
from rootsopt.response.result import ERRORS, Seed
from rootsopt.response.sensitivity import direction, motions_along
from rootsopt.response.sweeps.plan import Interval, axis_of
from rootsopt.response.sweeps.points import configured
from rootsopt.scene.check import check_geometry
from rootsopt.scene.space import bounds_of
from rootsopt.status import Status

OFFSET = "rotation_offset_deg"
"""The quantity of a record whose rotation is measured from an unknown angle: its reading minus the
rotation of rotor 1 (°)."""

# Ratio of bounds above which a search moves on a logarithmic scale.
_WIDE = 30.0

# Range in which a search begins without bounds. The config's value is divided and multiplied by the
# first number. For a value of 0, the range is the second number, a share of the allowed range.
_AROUND, _SMALL = 5.0, 0.02


class Fitted(NamedTuple):
    """A quantity to fit.

    `key` in the config, or `OFFSET`; `low`, `high`: bounds; `begin`, `end`: range in which a search
    begins, inside the bounds; `own`: the config's value; `log`: whether the scale is logarithmic.
    On this scale, the range is 0 … 1."""

    key: str
    low: float
    high: float
    begin: float
    end: float
    own: float
    log: bool

    def scaled(self, value: float) -> float:
        """Return the place of a `value` on the scale."""
        if self.log:
            return math.log(value / self.begin) / math.log(self.end / self.begin)
        return (value - self.begin) / (self.end - self.begin)

    @property
    def first(self) -> float:
        """Place where a search begins: that of the config's value, or the middle if it lies outside
        the range."""
        return self.scaled(self.own) if self.begin <= self.own <= self.end else 0.5

    def value(self, place: float) -> float:
        """Return the value at a `place` on the scale, within the bounds."""
        if self.log:
            value = self.begin * math.exp(place * math.log(self.end / self.begin))
        else:
            value = self.begin + place * (self.end - self.begin)
        return min(max(value, self.low), self.high)

    def slope(self, value: float) -> float:
        """Return the derivative of the value with respect to its place on the scale."""
        if self.log:
            return value * math.log(self.end / self.begin)
        return self.end - self.begin

    @property
    def name(self) -> str:
        """Name of the quantity in words."""
        return NAMES.get(self.key) or self.key.rpartition(".")[2].replace("_", " ")


def fitted(
    config: Config, keys: Mapping[str, Any] | Iterable[str], given: Iterable[str]
) -> tuple[Config, list[Fitted]]:
    """Return (config that has all quantities, the quantities to fit).

    `keys`: see `identify`; `given`: keys whose values the record holds. Raises `InputError` for a
    key that cannot be fitted, or for bounds outside its range."""
    wanted = {}
    for text, pair in keys.items() if isinstance(keys, Mapping) else ((key, None) for key in keys):
        key, equals, bounds = str(text).partition("=")
        key = key.strip()
        if key in wanted:
            raise InputError(f"`{key}` must be fitted once, but is named twice; remove one")
        wanted[key] = _bounds(key, bounds) if equals else pair
    if not wanted:
        raise InputError(
            "no quantity to fit is named; name one, as in scene.timing_gear.backlash_mm=0.02:0.4"
        )
    for key in {*wanted} & {*given}:
        raise InputError(
            f"`{key}` must not be fitted, because the record has a column of its values; remove "
            "one of them"
        )
    quantities = []
    for key, pair in wanted.items():
        config, one = _fitted(config, key, pair)
        quantities.append(one)
    return config, quantities


def _bounds(key: str, text: str) -> Any:
    """Return the bounds in a text, as in `0.02:0.4`."""
    values = axis_of(key, text)
    if not isinstance(values, Interval):
        raise InputError(
            f"`{key}` must have two bounds, as in {key}=0.1:0.5, but has {text!r}; correct them"
        )
    return values.low, values.high


def _fitted(config: Config, key: str, pair: Any) -> tuple[Config, Fitted]:
    if pair is not None and not (np.shape(pair) == (2,) and np.all(np.isfinite(pair))):
        raise InputError(f"`{key}` must have two finite bounds, but has {pair}; correct them")
    if pair is not None and not pair[0] < pair[1]:
        raise InputError(
            f"`{key}` must have a lower bound below the upper one, but has {pair[0]:g} and "
            f"{pair[1]:g}; correct them"
        )
    if key == OFFSET:
        half = 180.0 / config.profile.lobes
        low, high = pair or (-half, half)
        return config, Fitted(key, low, high, low, high, min(max(0.0, low), high), False)
    if config.value(key) is None and key in tree(Config):
        try:
            config = configured(config, {key: sum(pair) / 2 if pair else 0.0})
        except InputError:
            if pair:
                raise
            raise InputError(
                f"`{key}` has no value in the config; give it one, or bounds as {key}=0.1:0.5"
            ) from None
    values = scatterable(config)
    if key not in values:
        raise InputError(unknown_key(key, values, tree(Config), "--fit"))
    own = values[key]
    low, high = map(float, pair or _allowed(config, key))
    for end in (low, high):
        config.check_values({key: end})
    if pair:
        log = low > 0 and high > _WIDE * low
        return config, Fitted(key, low, high, low, high, own, log)
    begin, end = sorted((own / _AROUND, own * _AROUND))
    if own == 0:
        begin, end = _SMALL * low, _SMALL * high
    begin, end = max(begin, low), min(end, high)
    return config, Fitted(key, low, high, begin, end, own, low > 0)


def _allowed(config: Config, key: str) -> tuple[float, float]:
    """Return the bounds of a design parameter, or the range that the key allows."""
    if key.startswith("profile."):
        names = [f"profile.{name}" for name in config.design_keys]
        low, high = bounds_of(config)[names.index(key)]
        own = scatterable(config)[key]
        return min(low, own), max(high, own)
    low, high = limits_of(tree(Config)[key]).ends
    if not (math.isfinite(low) and math.isfinite(high)):
        raise InputError(f"`{key}` has no usual range; give bounds, as in {key}=0.1:0.5")
    return low, high


def values_at(quantities: Sequence[Fitted], place: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the values (p,) of the quantities at a `place` (p,) on their scales."""
    return np.array([one.value(x) for one, x in zip(quantities, place, strict=True)])


Begin = Seed | NDArray[np.float64] | None
"""Start of the search for a motion: a known motion, or an array (2,) of ε (rad) and dε/dt (rad/s)
at φ1 = 0. None: the state that the record shows, or rest if it shows none. For averages: states
(members, n) of an ensemble."""
REST = np.zeros(2)
"""Where a motion from rest begins."""


class Predicted(NamedTuple):
    """Predictions for the n rows and c columns that were measured at an operating point.

    `status` of the motion; `values` (n, c) and `slopes` (n, c, p): None without a usable motion,
    slopes with respect to the p quantities; `errors` (n, c): standard errors of averages, 0
    for orbits; `begin`: where the search for the motion of a neighbouring scene begins; `orbit`:
    its period, multipliers and residual, as in the result file."""

    status: Status
    values: Any = None
    slopes: Any = None
    errors: Any = None
    begin: Begin = None
    orbit: Mapping[str, Any] = {}


@dataclasses.dataclass(frozen=True)
class Point:
    """An operating point of the record: its `config`, and the measurements there (`seen`)."""

    config: Config
    seen: Observed

    @classmethod
    def of(cls, config: Config, seen: Observed) -> "Point":
        """Return the point. Raises `InputError` if its values do not fit the config."""
        point = cls(configured(config, seen.values), seen)
        check_geometry(point.config)
        gear = [name for name in seen.names if "gear" in name or "reserve" in name]
        if gear and config.scene.timing_gear is None:
            raise InputError(
                f"{seen.source}: the column {gear[0]} needs the section `scene.timing_gear`; add "
                "it, or remove the column"
            )
        averaged = config.objective.motion == "ensemble"
        if averaged and (seen.sampled or not {*seen.names} <= {*ERRORS}):
            raise InputError(
                f"{seen.source}: must have columns among {', '.join(ERRORS)} only for "
                "`objective.motion` ensemble; remove the others, or set it to reached"
            )
        return point

    @functools.cached_property
    def evaluator(self) -> Evaluator:
        """The evaluator of the config, for a search over many scenes."""
        return Evaluator.of(self.config).surveying()

    def moved(self, named: dict[str, float]) -> tuple[Config, Evaluator]:
        """Return config and evaluator with other values of some keys, which are not checked."""
        config = self.config.moved(named)
        scene = self.evaluator.scene.renewed(config)
        return config, dataclasses.replace(self.evaluator, scene=scene, config=config)

    def predicted(
        self, quantities: Sequence[Fitted], values: NDArray[np.float64], begin: Begin
    ) -> Predicted:
        """Return the predictions for the `values` (p,) of the quantities; see `Predicted`."""
        if self.config.objective.motion == "ensemble":
            return self._averaged(quantities, values, begin)
        named = {one.key: float(x) for one, x in zip(quantities, values, strict=True)}
        keys, offset = [*named], named.pop(OFFSET, 0.0)
        config, evaluator = self.moved(named)
        # Without another quantity than the offset, the motion still needs a direction.
        moving = named or {"rotor.density_kg_m3": config.rotor.density_kg_m3}
        ways = [direction(config, evaluator.scene, *one) for one in moving.items()]
        start: Any = begin
        if not isinstance(begin, Seed):
            pair = evaluator.pair(config.design)
            units = np.array([1.0, float(pair.mesh_period)]) / float(pair.angle_scale)
            if begin is None:
                start = self.seen.state(pair.lobes, pair.repeats, float(pair.mesh_period), offset)
            start = pair.at_start((REST if start is None else start) * units)
        seed, lead, columns, value = None, None, [], np.zeros(0)
        for count, pair, tangents, motion in motions_along(evaluator, config.design, ways, start):
            status = Status.of(motion.status)
            if not (status is Status.PERIODIC or bool(motion.held)):
                return Predicted(status)
            seed = Seed.of(motion, pair) if seed is None else seed
            if self.seen.sampled:
                turned = (self.seen.column() - offset) / 360 * pair.lobes
                value, slope, lead = self._sampled(pair, tangents, motion, turned, lead)
                by_offset = -pair.lobes / 360 * slope[..., -1:]
            else:
                value, slope = self._over_orbit(evaluator, pair, tangents, motion)
                by_offset = np.zeros_like(slope[..., :1])
            columns.append(slope[..., :count])
        slopes = np.concatenate([*columns, by_offset], axis=-1)
        places = [[*named, OFFSET].index(key) for key in keys] if named else [-1]
        orbit = orbit_record(motion.orbit, int(motion.period))
        return Predicted(status, value, slopes[..., places], np.zeros(value.shape), seed, orbit)

    def _sampled(self, pair, tangents, motion: Steady, turned, lead: int | None):
        """Return samples (n, c), their derivatives (n, c, d + 1), and the lead of the motion over
        the record (mesh periods). A motion that repeats after several mesh periods may begin at any
        of them."""
        measured = self.seen.measured
        places = [CHANNELS.index(name) for name in self.seen.names]
        size = np.nansum(measured**2, axis=0)
        size = np.where(size > 0, size, np.inf)
        leads = {}
        for tried in range(0, int(motion.period), pair.repeats) if lead is None else [lead]:
            all_of = channels_at(pair, tangents, varied(motion), turned + tried)
            leads[tried] = [x[:, places] for x in all_of]
        lead = min(leads, key=lambda k: np.sum(np.nansum((leads[k][0] - measured) ** 2, 0) / size))
        return *leads[lead], lead

    def _over_orbit(self, evaluator: Evaluator, pair, tangents, motion: Steady):
        """Return averages over an orbit (1, c), with their derivatives (1, c, d)."""
        rows = np.column_stack([motion.orbit.response, motion.orbit.sensitivity])
        if Status.of(motion.status) is Status.IDLE:
            rows = np.zeros_like(rows)
        known = evaluator.scene.solver.measures.named(rows, int(motion.period))
        if {*self.seen.names} - {*known}:
            held = jax.device_get(apart_program(pair, tangents, varied(motion)))
            known |= apart_record(held, float(evaluator.scene.pitch_radius))
        unknown = np.nan, np.full(rows.shape[1] - 1, np.nan)
        values, slopes = zip(*(known.get(name, unknown) for name in self.seen.names), strict=True)
        return np.array([values]), np.array([slopes])

    def _averaged(
        self, quantities: Sequence[Fitted], values: NDArray[np.float64], begin: Begin
    ) -> Predicted:
        """Return averages over an ensemble of motions, with derivatives. These are least-squares
        slopes through neighbouring scenes, all simulated from the same states."""

        def averaged(values: NDArray[np.float64], states: Any) -> Any:
            named = {one.key: float(x) for one, x in zip(quantities, values, strict=True)}
            config, evaluator = self.moved(named)
            whole = dataclasses.replace(evaluator, motions=Ensemble(), survey=True)
            return whole.without_gradient()(config.design, states, series=False)

        def rows(averages: Any) -> list[float]:
            return [averages.response.get(name, np.nan) for name in self.seen.names]

        here = averaged(values, begin)
        if here.status is not Status.AVERAGED:
            return Predicted(here.status)
        place = [one.scaled(x) for one, x in zip(quantities, values, strict=True)]
        around, steps = neighbours(np.clip(place, 0.0, 1.0), self.config.ensemble)
        averages = [rows(averaged(values_at(quantities, one), here.start)) for one in around]
        scales = [one.slope(x) for one, x in zip(quantities, values, strict=True)]
        slopes = fitted_slope(np.array(averages), steps)[0] / np.array(scales)
        errors = np.array([[here.steady_state[ERRORS[name]] for name in self.seen.names]])
        return Predicted(here.status, np.array([rows(here)]), slopes[None], errors, here.start)


def predict(
    points: Sequence[Point],
    quantities: Sequence[Fitted],
    values: NDArray[np.float64],
    begins: Sequence[Begin],
) -> list[Predicted]:
    """Return the predictions at each of the `points` for the `values` (p,) of the quantities.

    `begins`: where the search for each motion begins."""

    def work(number: int) -> Predicted:
        return points[number].predicted(quantities, values, begins[number])

    return [
        one for _, one in sorted(as_done(work, range(len(points)), min(HERE.slots, len(points))))
    ]
