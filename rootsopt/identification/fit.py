"""Fits quantities of a scene to a record: many starts, local least squares, an honest answer."""

import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from rootsopt.config import Config
from rootsopt.design.space import sobol
from rootsopt.errors import InputError
from rootsopt.identification.answer import (
    STRUCTURED,
    Identification,
    Spread,
    adopted,
    caveats,
    combinations,
    further,
    parameters,
    profile,
    quality,
    relative_misfit,
    residuals,
    structure,
)
from rootsopt.identification.model import Begin, Point
from rootsopt.identification.quantities import OFFSET, fitted
from rootsopt.identification.record import observed
from rootsopt.identification.squares import TURN, Local, Problem
from rootsopt.response.attractors import closed, find
from rootsopt.response.still import reporting
from rootsopt.runtime.environment import check_precision
from rootsopt.status import Status

# Scenes that are tried for each quantity before local fits, and maximum number of simulations.
_TRIED, _MOST = 16, 256

# Relative misfit above which other coexisting motions are tried.
_POOR = 0.3

# Relative misfit above which a scene does not explain the record.
_NO_FIT = 0.7

# Distance between places from which local fits begin. Greatest multiple of the given number of
# fits: more are made while residuals do not look random.
_APART, _AGAIN = 0.15, 4

# Distance on the scales of the quantities up to which two optima are the same.
_SAME = 0.01

# Ratio of losses up to which another optimum fits nearly as well.
_NEARLY = 2.0

# Relative misfit up to which all optima fit as well as the best.
_EQUAL = 1e-3

# Probability of the residuals, with given standard deviations, above which any misfit is noise.
_CHANCE = 1e-3

# Number of local fits in which standard deviations are estimated from the residuals.
_PASSES = 3


def identify(  # Keywords of the public interface, each independent of the others.
    config: Config,
    data: Any,
    keys: Mapping[str, Any] | Iterable[str],
    *,
    gains: Sequence[Sequence[str]] = (),
    constants: Sequence[str] = (),
    profiles: Sequence[str] = (),
    starts: int = 4,
    seed: int = 0,
    progress: Callable[[str], None] = lambda what: None,
) -> Identification:
    """Fit quantities of the scene of a `config` to measured `data`.

    `data`: path of a CSV file, columns by name (a mapping or an `xarray.Dataset`), or a list of
    these. Columns named after config keys, such as `scene.speed_rpm`, are operating points. With a
    column `rotation_deg` or `time_s`, the others are samples of a motion (`relative_rotation_rad`,
    `relative_speed_rad_s`, `drive_flank_force_N`, `coast_flank_force_N`, `contact_force_N`,
    `penetration_m`, `gear_torque_N_m`, `shaft_torque_N_m`). Without it, they are averages, a row
    per point (`mean_force_N`, `peak_force_N`, `rms_force_N`, `line_2_force_N`, reserves and torques
    of the gear). `NAME_std` holds standard deviations of a column; without them, the errors are
    estimated from the residuals. An empty cell holds nothing.

    `keys`: dotted config keys with bounds (low, high) in the key's unit, or `None` for the range
    that the key allows; or texts, as `scene.timing_gear.backlash_mm=0.02:0.4`. The key
    `rotation_offset_deg` is the reading of `rotation_deg` at φ1 = 0.

    `gains`: groups of columns that share an unknown gain; `constants`: columns to which an unknown
    constant is added; `profiles`: keys whose profile likelihood to compute; `starts`: number of
    local fits; `seed` of the scenes in which they begin; `progress` is called with what is done.

    The status of the result is `identified`, or `not_identified` if no scene within the bounds has
    a motion that explains the record. Raises `InputError` for a column or key that cannot be used,
    RuntimeError if JAX is not set to double precision.

    >>> import jax
    >>> import rootsopt
    >>> jax.config.update("jax_enable_x64", True)
    >>> config = rootsopt.load_config("cic_drawn")
    >>> record = {"scene.speed_rpm": [2000.0, 3000.0], "mean_force_N": [87.95, 76.25]}
    >>> found = rootsopt.identify(config, record, {"scene.load.torque_N_m": (3.0, 8.0)})
    >>> list(found.parameters["scene.load.torque_N_m"])[:3]
    ['value', 'standard_error', 'interval_95']
    """
    check_precision()
    began, seen = time.perf_counter(), observed(config, data)
    config, quantities = fitted(config, keys, [key for one in seen for key in one.values])
    if unknown := {*profiles} - {one.key for one in quantities}:
        raise InputError(f"a profile must be that of a fitted key, but `{unknown.pop()}` is not")
    if any(one.timed for one in seen) and "scene.speed_rpm" in {one.key for one in quantities}:
        raise InputError(
            "`scene.speed_rpm` cannot be fitted to samples over time_s, whose rotation follows "
            "from it; give rotation_deg"
        )
    averages = dict.fromkeys(name for one in seen if not one.sampled for name in one.names)
    reported = reporting(config, [*averages], "--data")
    problem = Problem.of([Point.of(reported, one) for one in seen], quantities, gains, constants)
    search = _Search(problem, starts, seed, progress)
    best = search.run()
    if best is None:
        return Identification(
            config, {}, np.zeros((0, 0)), [], {}, [], [], {}, {}, Status.NOT_IDENTIFIED,
            search.lost(), search.statistics(began),
        )  # fmt: skip
    for count in range(_PASSES):
        progress(f"estimating errors, {count + 1} of {_PASSES}")
        # The length that rounds corners may follow the values.
        base = adopted(reported, problem, best)
        problem = Problem.of([Point.of(base, one) for one in seen], quantities, gains, constants)
        deviation = problem.estimated(best.fit - problem.measured)
        best = problem.fitted(best.place, best.begins, deviation) or best
    spread = Spread.of(problem, best)
    progress("finding what the record does not tell")
    quality_of, told = quality(problem, best, spread), combinations(problem, spread)
    curves = {}
    for k, one in enumerate(quantities):
        progress(f"finding intervals, {k + 1} of {len(quantities)}")
        curves[one.key] = profile(problem, best, spread, k, one.key in profiles)
    rivals = search.others(problem, best, spread.factor)
    known = parameters(problem, best, spread, curves, rivals)
    next_, chance = further(problem, best, spread), quality_of["probability"]
    fits = quality_of["relative_misfit"] < _NO_FIT or (chance or 0.0) > _CHANCE
    status = Status.IDENTIFIED if fits else Status.NOT_IDENTIFIED
    scales = np.array([one.slope(x) for one, x in zip(quantities, best.values, strict=True)])
    return Identification(
        config=adopted(config, problem, best),
        parameters=known,
        covariance=spread.covariance * np.outer(scales, scales),
        combinations=told,
        fit=quality_of,
        optima=rivals,
        further=next_,
        profiles={key: curves[key] for key in profiles},
        residuals=residuals(problem, best),
        status=status,
        message=" ".join([status.value, *caveats(quality_of, known, told, rivals, next_)]),
        statistics=search.statistics(began),
        best=(problem, best, spread),
    )


class _Search:
    """Looks for the scene that fits best, by local fits from the best of many scenes."""

    def __init__(self, problem: Problem, starts: int, seed: int, progress: Callable[[str], None]):
        self.problem, self.starts, self.seed, self.progress = problem, starts, seed, progress
        self.deviation, known = problem.estimated(), np.all(np.isfinite(problem.given))
        self.turn = TURN if known else 1.0
        self.ends: list[Local] = []
        self.failed: list[Status] = []
        self.tried = 0

    def run(self) -> Local | None:
        """Return the best fit; None if no scene has a motion to trust at all points."""
        problem, p = self.problem, len(self.problem.quantities)
        begins = [point.begin for point in problem.points]
        count = int(np.clip(_MOST // len(problem.points), 8, _TRIED * p))
        own, known = [one.scaled(one.own) for one in problem.quantities], []
        for place in [own, *sobol(count, self.seed, p)]:
            self.tried += 1
            self.progress(f"trying scenes, {self.tried} of {count + 1}")
            known += self._at(np.array(place), begins)
        known.sort(key=lambda one: one.cost)
        best = None
        while known and len(self.ends) < self.starts * (1 if self._explains(best) else _AGAIN):
            self._fit(known[:1])
            # The next fit begins elsewhere, as long as there is another place.
            begun = [known.pop(0).place, *(one.place for one in self.ends)]
            away = [min(np.max(np.abs(one.place - x)) for x in begun) < _APART for one in known]
            known = [one for _, one in sorted(zip(away, known, strict=True), key=lambda x: x[0])]
            best = min(self.ends, key=lambda one: one.cost, default=None)
        if best is not None and relative_misfit(problem, best) > _POOR:
            self._fit(self._other_motions(best))
        return min(self.ends, key=lambda one: one.cost, default=None)

    def _explains(self, best: Local | None) -> bool:
        """Return whether what the `best` fit leaves of the record looks random."""
        return best is not None and structure(self.problem, best) < STRUCTURED

    def _at(self, place: NDArray[np.float64], begins: Sequence[Begin]) -> list[Local]:
        found, told = self.problem.at(place, begins, self.deviation, self.turn)
        self.failed += [one.status for one in told if one.values is None]
        return [] if found is None else [found]

    def _fit(self, begins: Sequence[Local]) -> None:
        for one in begins:
            self.progress(f"fitting from the best scenes, {len(self.ends) + 1}")
            end = self.problem.fitted(one.place, one.begins, self.deviation, self.turn)
            self.ends += [] if end is None else [end]

    def _other_motions(self, best: Local) -> list[Local]:
        """Return the best fits with other coexisting motions, where the record does not show the
        state in which to begin."""
        named = zip(self.problem.quantities, best.values, strict=True)
        values = {one.key: float(x) for one, x in named if one.key != OFFSET}
        found = [best]
        for k, point in enumerate(self.problem.points):
            if not point.seen.sampled or point.begin is not None:
                continue
            self.progress("trying other motions")
            config, evaluator = point.moved(values)
            for one in find(evaluator, jnp.asarray(config.design)).attractors:
                begins = [*found[0].begins]
                begins[k] = one.evaluation.start if closed(one.evaluation) else begins[k]
                found += self._at(best.place, begins)
            found = [min(found, key=lambda one: one.cost)]
        return [] if found[0] is best else found

    def others(self, problem: Problem, best: Local, factor: float) -> list[dict[str, Any]]:
        """Return the entry `optima` of the result file: other scenes that fit nearly as well.

        `factor`: see `Spread`."""
        kept, misfit = [best], relative_misfit(problem, best)

        def new(place: NDArray[np.float64]) -> bool:
            return all(np.max(np.abs(place - other.place)) > _SAME for other in kept)

        for one in self.ends:
            if not new(one.place):
                continue
            end = problem.fitted(one.place, one.begins, best.deviation)
            if end is None or relative_misfit(problem, end) > max(_NEARLY * misfit, _EQUAL):
                continue
            kept += [end] if new(end.place) else []
        keys = [one.key for one in problem.quantities]
        return [{"relative_misfit": relative_misfit(problem, one),
                 "increase": 2 * (one.cost - best.cost) / factor,
                 "values": dict(zip(keys, one.values.tolist(), strict=True))}
                for one in kept[1:]]  # fmt: skip

    def lost(self) -> str:
        """Return why there is no fit, and what to do."""
        counts = [f"{one.label}: {count}" for one, count in Counter(self.failed).most_common()]
        return (
            f"In none of the {self.tried} scenes tried within the bounds is there a periodic "
            f"motion at all points of the record ({', '.join(counts)}). Narrow the bounds, or, for "
            "chaotic motions, give averages and set objective.motion to ensemble."
        )

    def statistics(self, began: float) -> dict[str, Any]:
        """Return the entry `statistics` of the result file; `began`: start (s, `perf_counter`)."""
        seconds = time.perf_counter() - began
        return {"scenes_tried": self.tried, "fits": len(self.ends), "seconds": seconds}
