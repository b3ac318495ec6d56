"""Predictions of a scene for a record, with derivatives with respect to the quantities to fit."""

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from numpy.typing import NDArray

from rootsopt.config.reading import Config
from rootsopt.dynamics.steady import Steady, varied
from rootsopt.errors import InputError
from rootsopt.identification.quantities import OFFSET, Fitted, values_at
from rootsopt.identification.record import CHANNELS, Observed, channels_at
from rootsopt.response.ensemble import Ensemble, fitted_slope, neighbours
from rootsopt.response.evaluation import Evaluator
from rootsopt.response.records import apart_program, apart_record, orbit_record
from rootsopt.response.reducers import HERE, as_done
from rootsopt.response.result import ERRORS, Seed
from rootsopt.response.sensitivity import direction, motions_along
from rootsopt.response.sweeps.points import configured
from rootsopt.scene.check import check_geometry
from rootsopt.status import Status

Begin = Seed | NDArray[np.float64] | None
"""Start of the search for a motion: a known motion, or an array (2,) of ε (rad) and dε/dt (rad/s)
at φ1 = 0. None: the state that the record shows, or rest if it shows none. For averages: states
(members, n) of an ensemble."""
REST = np.zeros(2)
"""Where a motion from rest begins."""


class Predicted(NamedTuple):
    """Predictions for the n rows and c columns that were measured at an operating point.

    `status` of the motion; `values` (n, c) and `slopes` (n, c, p): None if there is no motion to
    trust, slopes with respect to the p quantities; `errors` (n, c): standard errors of averages, 0
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
        found = cls(configured(config, seen.values), seen)
        check_geometry(found.config)
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
        return found

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
        found = {}
        for tried in range(0, int(motion.period), pair.repeats) if lead is None else [lead]:
            all_of = channels_at(pair, tangents, varied(motion), turned + tried)
            found[tried] = [x[:, places] for x in all_of]
        lead = min(found, key=lambda k: np.sum(np.nansum((found[k][0] - measured) ** 2, 0) / size))
        return *found[lead], lead

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

        def rows(found: Any) -> list[float]:
            return [found.response.get(name, np.nan) for name in self.seen.names]

        here = averaged(values, begin)
        if here.status is not Status.AVERAGED:
            return Predicted(here.status)
        place = [one.scaled(x) for one, x in zip(quantities, values, strict=True)]
        around, steps = neighbours(np.clip(place, 0.0, 1.0), self.config.ensemble)
        found = [rows(averaged(values_at(quantities, one), here.start)) for one in around]
        scales = [one.slope(x) for one, x in zip(quantities, values, strict=True)]
        slopes = fitted_slope(np.array(found), steps)[0] / np.array(scales)
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
