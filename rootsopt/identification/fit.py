"""Fits quantities of a scene to a record by local least squares from many starts."""

import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from rootsopt.config.reading import Config
from rootsopt.errors import InputError
from rootsopt.identification import answer
from rootsopt.identification.answer import Identification, Spread, relative_misfit, structure
from rootsopt.identification.model import OFFSET, Begin, Point, fitted
from rootsopt.identification.record import observed
from rootsopt.identification.squares import TURN, Fit, Problem
from rootsopt.response.attractors import closed, find
from rootsopt.response.terms import reporting
from rootsopt.runtime.environment import check_precision
from rootsopt.scene.space import sobol
from rootsopt.status import Status

# Number of scenes tried for each quantity before local fits. Maximum number of simulations. Maximum
# number of rounds of both while no fit explains the record.
_TRIED, _MOST, _ROUNDS = 16, 256, 4

# Relative misfit of averages above which a fit does not explain them. Number of fits around which
# other coexisting motions are tried.
_POOR, _PLACES = 0.05, 2

# Relative misfit above which a scene does not explain the record.
_NO_FIT = 0.7

# Distance between the starts of local fits. Distance below which two optima count as the same.
_APART, _SAME = 0.15, 0.01

# Ratio of misfits below which another optimum fits nearly as well. Misfit below which all optima
# fit as well as the best.
_NEARLY, _EQUAL = 2.0, 1e-3
_CHANCE = 1e-3

# Value of `structure` above which residuals are not independent.
_STRUCTURED = 4.0

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
    >>> identification = rootsopt.identify(config, record, {"scene.load.torque_N_m": (3.0, 8.0)})
    >>> list(identification.parameters["scene.load.torque_N_m"])[:3]
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
            config, Status.NOT_IDENTIFIED, search.lost(), search.statistics(began)
        )
    for count in range(_PASSES):
        progress(f"estimating errors, {count + 1} of {_PASSES}")
        # The length that rounds corners may follow the values.
        base = answer.adopted(reported, problem, best)
        problem = Problem.of([Point.of(base, one) for one in seen], quantities, gains, constants)
        deviation = problem.estimated(best.fit - problem.rows.measured.to_numpy())
        best = problem.fitted(best.place, best.begins, deviation) or best
    spread, curves = Spread.of(problem, best), {}
    for k, one in enumerate(quantities):
        progress(f"finding intervals, {k + 1} of {len(quantities)}")
        curves[one.key] = answer.profile(problem, best, spread, k, one.key in profiles)
    progress("finding what the record does not tell")
    rivals = search.others(problem, best, spread.factor)
    entries: dict[str, Any] = {
        "parameters": answer.parameters(problem, best, spread, curves, rivals),
        "combinations": answer.combinations(problem, spread),
        "fit": answer.quality(problem, best, spread),
        "motions": answer.motions(problem, best, search.coexisting(best)),
        "optima": rivals,
        "further": answer.further(problem, best, spread),
        "profiles": {key: curves[key] for key in profiles},
    }
    fits = (entries["fit"]["probability"] or 0.0) > _CHANCE
    fits |= entries["fit"]["relative_misfit"] < _NO_FIT
    status = Status.IDENTIFIED if fits else Status.NOT_IDENTIFIED
    scales = np.array([one.slope(x) for one, x in zip(quantities, best.values, strict=True)])
    return Identification(
        answer.adopted(config, problem, best), status,
        " ".join([status.value, *_caveats(problem, entries)]), search.statistics(began), **entries,
        covariance=spread.covariance * np.outer(scales, scales),
        residuals=answer.residuals(problem, best), best=(problem, best, spread),
    )  # fmt: skip


def _caveats(problem: Problem, entries: Mapping[str, Any]) -> Iterator[str]:
    """Yield sentences on what limits the answer, from the `entries` of the result file."""
    fit, points = entries["fit"], len(entries["motions"])
    averaged = not problem.rows.sampled.any()
    doubtful = sum(bool(one["other_motions"]) for one in entries["motions"])
    loose = [one["words"] for one in entries["combinations"] if not one["determined"]]
    away = [one for one in entries["motions"] if not one["reached_from_rest"]]
    yield f"It differs from the record by {100 * fit['relative_misfit']:.3g} % of its variation."
    for holds, sentence in (
        (
            away,
            "The record shows a motion that is not reached from rest, of period "
            f"{' and '.join({str(one['period']): 1 for one in away})}: `rootsopt attractors` "
            "finds it.",
        ),
        (
            averaged and doubtful,
            f"At {doubtful} of {points} operating points other motions coexist, and averages do "
            "not show well which was measured: the values may belong to another one (`rootsopt "
            "attractors`). Samples of relative_rotation_rad would show it.",
        ),
        (
            averaged and fit["relative_misfit"] > _POOR,
            "No fit explains the averages to within "
            f"{100 * _POOR:g} %: the scene lacks something, or the motion that was measured was "
            "missed. Do not trust the values; raise --starts, or give samples.",
        ),
        (
            fit["degrees_of_freedom"] <= 0,
            f"The record's number of values, {fit['measured_values']}, leaves nothing to estimate "
            "errors from: fit fewer quantities, or give more values and their standard deviations.",
        ),
        (loose, f"The record does not determine {'; '.join(loose)}."),
    ):
        if holds:
            yield sentence
    for one in entries["further"][:1] if loose else ():
        yield f"Measure {one['column']} over a turn at {one['scene.speed_rpm']:g} rpm as well."
    for one in problem.quantities:
        if not one.low <= one.own <= one.high:
            yield (
                f"{one.key} is {one.own:g} in the config, outside its bounds: the search began in "
                "their middle."
            )
    for key, one in entries["parameters"].items():
        if one["at_bound"]:
            yield f"{key} lies at its {one['at_bound']} bound: widen it unless it is a limit."
    for holds, sentence in (
        (
            entries["optima"],
            "Other scenes within the bounds fit nearly as well (optima): "
            f"{len(entries['optima'])}.",
        ),
        (
            fit["structure"] > _STRUCTURED,
            "Residuals of neighbouring samples are alike, so that the scene lacks something or is "
            "not the best within the bounds: the errors are too small. Raise --starts.",
        ),
        (
            fit["probability"] is not None and fit["probability"] < answer.UNLIKELY,
            "The residuals are larger than the standard deviations allow, so that the scene lacks "
            "something or these are too small: the errors are scaled up.",
        ),
    ):
        if holds:
            yield sentence


class _Search:
    """Finds the scene that fits best, by local fits that start from the best of many scenes."""

    def __init__(self, problem: Problem, starts: int, seed: int, progress: Callable[[str], None]):
        self.problem, self.starts, self.seed, self.progress = problem, starts, seed, progress
        self.deviation, known = problem.estimated(), problem.rows.given.notna().all()
        self.turn = TURN if known else 1.0
        self.ends: list[Fit] = []
        self.failed: list[Status] = []
        self.tried = 0
        self.others_at: list[tuple[NDArray[np.float64], list[int]]] = []

    def run(self) -> Fit | None:
        """Return the best fit; None if no scene has a usable motion at all points."""
        points, p, known = self.problem.points, len(self.problem.quantities), []
        count = int(np.clip(_MOST // len(points), 8, _TRIED * p))
        first = np.array([one.first for one in self.problem.quantities])
        places = [first, *sobol(_ROUNDS * count, self.seed, p)]
        while places and not self._explained:
            some, places = places[: count + 1], places[count + 1 :]
            for place in some:
                self.tried += 1
                self.progress(f"trying scenes, {self.tried}")
                known += self._at(place, [None] * len(points))
            known.sort(key=lambda one: one.cost)
            for _ in range(min(self.starts, len(known))):
                # If possible, a fit begins at a place where no other fit has begun or ended.
                self._fit(known[0])
                begun = [known.pop(0).place, *(one.place for one in self.ends)]
                known.sort(
                    key=lambda one: min(np.max(np.abs(one.place - x)) for x in begun) < _APART
                )
        # Averages do not show which of several motions was measured.
        averaged = not self.problem.rows.sampled.any()
        if points[0].config.objective.motion != "ensemble":
            for one in self._best[: 1 if self._explained else _PLACES]:
                if averaged or not self._explained:
                    self._fit_other_motions(one)
        return next(iter(self._best), None)

    @property
    def _best(self) -> list[Fit]:
        """The ends of the fits, the best one first."""
        return sorted(self.ends, key=lambda one: one.cost)

    @property
    def _explained(self) -> bool:
        """Whether the residuals of the best fit look random (samples) or are small (averages)."""
        for one in self._best[:1]:
            random = structure(self.problem, one) < _STRUCTURED
            small = relative_misfit(self.problem, one) < _POOR
            return random and (small or bool(self.problem.rows.sampled.any()))
        return False

    def _at(self, place: NDArray[np.float64], begins: Sequence[Begin]) -> list[Fit]:
        fit, lost = self.problem.at(place, begins, self.deviation, self.turn)
        self.failed += lost
        return [] if fit is None else [fit]

    def _fit(self, one: Fit) -> None:
        self.progress(f"fitting from the best scenes, {len(self.ends) + 1}")
        end = self.problem.fitted(one.place, one.begins, self.deviation, self.turn)
        self.ends += [] if end is None else [end]

    def _fit_other_motions(self, one: Fit) -> None:
        """Repeat the fit `one` from its scene, with the other motions that coexist there."""
        named = zip(self.problem.quantities, one.values, strict=True)
        values = {q.key: float(x) for q, x in named if q.key != OFFSET}
        each: list[list[Any]] = []
        for point, own in zip(self.problem.points, one.begins, strict=True):
            self.progress("trying other motions")
            config, evaluator = point.moved(values)
            attractors = find(evaluator, jnp.asarray(config.design)).attractors
            starts = [x.evaluation.start for x in attractors if closed(x.evaluation)]
            each.append(starts or [own])
        self.others_at.append((one.place, [len(some) - 1 for some in each]))
        for k in range(max(map(len, each))):
            for other in self._at(one.place, [some[min(k, len(some) - 1)] for some in each]):
                if np.max(np.abs(other.fit - one.fit) / self.problem.rows.scale) > _EQUAL:
                    self._fit(other)

    def coexisting(self, best: Fit) -> Sequence[int | None]:
        """Return how many other motions there are at each point of the `best` fit.

        They are counted at the nearest scene in which a search looked for them; None without such a
        scene."""
        near = sorted(self.others_at, key=lambda one: np.max(np.abs(one[0] - best.place)))
        return near[0][1] if near else [None] * len(best.begins)

    def others(self, problem: Problem, best: Fit, factor: float) -> list[dict[str, Any]]:
        """Return the entry `optima` of the result file: other scenes that fit nearly as well.

        `factor`: see `Spread`."""
        kept, misfit = [best], relative_misfit(problem, best)

        def new(one: Fit) -> bool:
            return all(np.max(np.abs(one.place - other.place)) > _SAME for other in kept)

        for one in filter(new, self.ends):
            end = problem.fitted(one.place, one.begins, best.deviation) or best
            if new(end) and relative_misfit(problem, end) <= max(_NEARLY * misfit, _EQUAL):
                kept.append(end)
        return [{"relative_misfit": relative_misfit(problem, one),
                 "increase": 2 * (one.cost - best.cost) / factor,
                 "values": answer.named(problem, one.values)}
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
