"""Errors of fitted quantities, what the record leaves open, and which measurements would help.

All covariances are those of linearised least squares on the scales of the quantities. Without given
standard deviations they allow for errors that differ between samples (estimator HC3: J. G.
MacKinnon and H. White, Some heteroskedasticity-consistent covariance matrix estimators with
improved finite sample properties, J. Econometrics 29 (1985) 305-325)."""

import dataclasses
import functools
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas
from numpy.typing import NDArray

from rootsopt.config.reading import Config
from rootsopt.identification.model import OFFSET, REST, Point
from rootsopt.identification.record import CHANNELS, Observed
from rootsopt.identification.squares import TURN, Fit, Problem
from rootsopt.status import Status

# Standard deviation of a combination (share of the range in which the search begins) above which
# the record does not determine it. Share of a quantity in a combination below which the quantity is
# ignored.
_LOOSE, _PART = 0.3, 0.1

# Distance from a bound (share of this range) below which a quantity counts as being at the bound.
_NEAR = 1e-4

# Relative error of a simulated orbit, the same in all samples. Relative misfit below which
# residuals count as such errors.
_EXACT, _NUMERICAL = 1e-5, 1e-4

# Singular value of the derivatives (share of the greatest) below which it counts as numerical
# error.
_SINGULAR = 1e-5

# Error (share of the distance from the best value) of the end of an interval. Factor by which this
# distance grows until it encloses the end.
_CLOSE, _WIDER = 0.03, 2.0

# Number of degrees of freedom from which errors may differ between samples (HC3).
_MANY = 50
UNLIKELY = 0.01
"""Probability of the residuals below which the given standard deviations count as too small."""

# Relative difference of predictions below which two motions count as the same.
_SAME = 1e-3

# Speeds of further measurements, as multiples of the config's, and their relative error if the
# record has none.
_SPEEDS, _USUAL = (0.5, 1.0, 2.0), 0.01

# Entries of the result file.
_ENTRIES = "parameters", "combinations", "fit", "motions", "optima", "further", "profiles"

# Columns of the samples that further measurements may record.
_FURTHER = CHANNELS[0], CHANNELS[1], CHANNELS[4], *CHANNELS[6:]


@dataclasses.dataclass(frozen=True)
class Spread:
    """How well a record determines p quantities, on their scales.

    `covariance` (p, p); `errors` (p,): standard errors, infinite for a quantity that takes part in
    a combination that is not determined; `combinations` (p, p): a row each, least certain first;
    `deviations` (p,): their standard deviations, infinite if not determined, NaN if the record
    leaves none to estimate; `factors` (p,): variances over those of independent residuals of size
    1, `factor`: the same for all together; `width`: half of a 95 % interval over the standard
    error; `chance`: probability of residuals this large, NaN without given standard deviations."""

    covariance: NDArray[np.float64]
    errors: NDArray[np.float64]
    combinations: NDArray[np.float64]
    deviations: NDArray[np.float64]
    factors: NDArray[np.float64]
    factor: float
    width: float
    chance: float

    @classmethod
    def of(cls, problem: Problem, best: Fit) -> "Spread":
        """Return the spread of the `best` fit."""
        from scipy import stats  # Slow import (0.5 s).

        (count, p), rows = best.slopes.shape, problem.rows
        freedom, known = count - problem.lost, bool(rows.given.notna().all())
        bounded = np.clip(best.residual, -TURN, TURN)
        inside = max(float(np.mean(bounded == best.residual)), 0.1)
        chi = float(bounded @ bounded)
        chance = float(stats.chi2.sf(chi, freedom)) if known and freedom > 0 else math.nan
        trusted = known and not chance < UNLIKELY
        factor = 1 / inside if trusted or freedom <= 0 else chi / freedom / inside**2
        # With fewer values than quantities, rows of zeros complete the combinations.
        whole = np.pad(best.slopes, ((0, max(0, p - count)), (0, 0)))
        left, sizes, ways = np.linalg.svd(whole, full_matrices=False)
        loose = (sizes < _SINGULAR * sizes[0]) | (sizes * _LOOSE < math.sqrt(factor))
        inverse, back = ways[~loose].T / sizes[~loose], left[:count, ~loose]
        plain, share = inverse @ inverse.T, inverse @ back.T
        covariance = factor * plain
        if not trusted and freedom >= _MANY:
            leverage = np.minimum(np.sum(back**2, axis=1), 0.99)
            each = share * (bounded / (1 - leverage) / inside)
            covariance = each @ each.T
        size = rows.measured.groupby(rows.column).transform(lambda x: np.sqrt(np.mean(x**2)))
        exact = share * (_EXACT * math.sqrt(count) * size.to_numpy() / best.deviation)
        covariance = covariance + exact @ exact.T
        # HC3 is unreliable where few samples depend on a quantity. The greater of both errors is
        # therefore used.
        errors = np.sqrt(np.maximum(np.diag(covariance), factor * np.diag(plain)))
        factors = errors**2 / np.maximum(np.diag(plain), 1e-300)
        unknown = not known and freedom <= 0
        errors[unknown | np.any(np.abs(ways[loose]) > _PART, axis=0)] = math.inf
        each = np.einsum("kp,pq,kq->k", ways, covariance, ways)
        deviations = np.where(loose, math.inf, math.nan if unknown else np.sqrt(np.abs(each)))
        joint = float(np.mean((each * sizes**2)[~loose])) if np.any(~loose) else 1.0
        width = stats.norm.ppf(0.975) if trusted else stats.t.ppf(0.975, max(freedom, 1))
        order = ways[::-1], deviations[::-1]
        return cls(covariance, errors, *order, factors, joint, float(width), chance)


def parameters(
    problem: Problem,
    best: Fit,
    spread: Spread,
    profiles: Mapping[str, Any],
    optima: Sequence[Mapping[str, Any]],
) -> dict[str, dict[str, Any]]:
    """Return the entry `parameters` of the result file: value, errors and bounds by key.

    `profiles`: results of `profile` by key; `optima`: other scenes. The intervals include those
    that fit as well as the best."""
    estimates, box = {}, zip(*problem.box, strict=True)
    near = [row for row in optima if row["increase"] < spread.width**2]
    for k, (one, (low, high)) in enumerate(zip(problem.quantities, box, strict=True)):
        ends = profiles[one.key]["interval_95"]
        sides = {"lower": best.place[k] - low, "upper": high - best.place[k]}
        estimates[one.key] = {
            "value": float(best.values[k]),
            "standard_error": float(spread.errors[k] * one.slope(best.values[k])),
            "interval_95": [
                pick([ends[side], *(row["values"][one.key] for row in near)])
                for side, pick in enumerate((min, max))
            ],
            "bounds": [one.low, one.high],
            "at_bound": next((side for side, room in sides.items() if room < _NEAR), None),
        }
    return estimates


def combinations(problem: Problem, spread: Spread) -> list[dict[str, Any]]:
    """Return the entry `combinations` of the result file, undetermined ones first."""
    summaries, names = [], {one.key: one.name for one in problem.quantities}
    for row, deviation in zip(spread.combinations, spread.deviations, strict=True):
        row = row * np.sign(row[np.argmax(np.abs(row))])
        parts = {key: float(x) for key, x in zip(names, row, strict=True) if abs(x) > _PART}
        ups, downs = ([names[key] for key, x in parts.items() if x * side > 0] for side in (1, -1))
        words = " and ".join(ups) + (" together" if len(ups) > 1 else "")
        words += f", against {' and '.join(downs)}" if downs else ""
        summaries.append({
            "words": words, "parts": parts, "standard_error": float(deviation),
            "determined": not math.isinf(deviation),
        })  # fmt: skip
    return summaries


def relative_misfit(problem: Problem, best: Fit) -> float:
    """Return the relative RMS difference between fit and record, without the greatest 5 %. It is a
    share of the record's variation, or of its averages."""
    away = np.sort(np.abs(best.residual * best.deviation / problem.rows.scale.to_numpy()))
    return float(np.sqrt(np.mean(away[: math.ceil(0.95 * len(away))] ** 2)))


def structure(problem: Problem, best: Fit) -> float:
    """Return the correlation between residuals of neighbouring samples, in standard errors.
    Residuals are not independent if the scene lacks something or is the wrong one."""
    if relative_misfit(problem, best) < _NUMERICAL:
        return 0.0
    rows = problem.rows.assign(away=np.clip(best.residual, -TURN, TURN)).query("sampled")
    groups = rows.sort_values("rotation_deg", kind="stable").groupby(["place", "column"])
    each = [one.to_numpy() for _, one in groups["away"]]
    total = sum(x[1:] @ x[:-1] / np.mean(x**2) for x in each if np.any(x))
    return float(total / math.sqrt(max(len(rows), 1)))


def quality(problem: Problem, best: Fit, spread: Spread) -> dict[str, Any]:
    """Return the entry `fit` of the result file: how well the scene fits."""
    relative = (best.deviation / problem.rows.scale).groupby(problem.rows.column).median()
    gains = [", ".join(group) for group in problem.gains]
    gains += [f"{name}, constant" for name in problem.constants]
    return {
        "measured_values": len(problem.rows),
        "degrees_of_freedom": len(problem.rows) - problem.lost,
        "relative_misfit": relative_misfit(problem, best),
        "relative_errors": relative.to_dict(),
        "outliers": int(np.count_nonzero(np.abs(best.residual) > TURN + 1)),
        "structure": structure(problem, best),
        "probability": None if math.isnan(spread.chance) else spread.chance,
        "gains": dict(zip(gains, map(float, best.gains), strict=True)),
    }


def motions(problem: Problem, best: Fit, others: Sequence[int | None]) -> list[dict[str, Any]]:
    """Return the entry `motions` of the result file, empty for an ensemble. For each point, it
    states the motion that fits, whether it is reached from rest, and the number of `others`."""
    rows = []
    for point, begin, count in zip(problem.points, best.begins, others, strict=True):
        mine, rest = (point.predicted(problem.quantities, best.values, x) for x in (begin, REST))
        if mine.values is None or not mine.orbit:
            continue
        same = rest.values is not None and np.allclose(
            rest.values, mine.values, rtol=0, atol=_SAME * np.max(np.abs(mine.values), axis=0)
        )
        where = {"at": point.seen.values, **mine.orbit}
        rows.append(where | {"reached_from_rest": bool(same), "other_motions": count})
    return rows


def further(problem: Problem, best: Fit, spread: Spread) -> list[dict[str, Any]]:
    """Return the entry `further` of the result file: measurements that would help, best first.

    Each is a column over one turn, at one of several speeds, with the relative error of the
    record."""
    estimated = len(problem.rows) > problem.lost
    relative = float((best.deviation / problem.rows.scale).median()) if estimated else _USUAL
    known = best.slopes.T @ best.slopes / spread.factor
    scales = [one.slope(x) for one, x in zip(problem.quantities, best.values, strict=True)]
    turned, config = np.arange(256) * 360 / 256, problem.points[0].config
    table = pandas.DataFrame({"rotation_deg": turned} | {name: 0.0 * turned for name in _FURTHER})
    measurements = []
    for share in _SPEEDS if config.objective.motion != "ensemble" else ():
        speed = share * config.scene.speed_rpm
        point = Point(
            config.moved({"scene.speed_rpm": speed}), Observed("", {}, table, _FURTHER, True)
        )
        one = point.predicted(problem.quantities, best.values, best.begins[0])
        if one.values is None:
            continue
        for k, name in enumerate(_FURTHER):
            size = max(relative, 1e-3) * float(np.std(one.values[:, k]))
            if (name in {*problem.rows.column} and share == 1) or not size:
                continue
            more = one.slopes[:, k] * np.array(scales) / size
            after = known + more.T @ more
            errors = np.sqrt(np.diag(np.linalg.pinv(after, hermitian=True)))
            sure = max(float(np.linalg.eigvalsh(after)[0]), 1e-300)
            measurements.append({
                "column": name, "scene.speed_rpm": speed,
                "least_certain_combination": sure**-0.5,
                "standard_errors": named(problem, errors * scales),
            })  # fmt: skip
    return sorted(measurements, key=lambda one: one["least_certain_combination"])[:3]


def profile(problem: Problem, best: Fit, spread: Spread, number: int, fine: bool) -> dict[str, Any]:
    """Return the profile likelihood of quantity `number`, an entry `profiles` of the result file.

    At each of several values of the quantity, all others are fitted again. In the confidence
    interval, twice the loss exceeds its minimum by less than a quantile of χ². `fine`: whether to
    fit at further values, for a smooth curve of the loss."""
    from scipy.optimize import root_scalar  # Slow import (0.5 s).

    one, (low, high) = problem.quantities[number], (side[number] for side in problem.box)
    center, error, factor = best.place[number], spread.errors[number], spread.factors[number]
    rows, ends = [{"increase": 0.0, "values": named(problem, best.values)}], []

    @functools.cache
    def risen(away: float) -> float:
        """Return √(increase) - √(quantile) at a distance from the best value."""
        if away == 0:
            return -spread.width
        place = best.place + away / error**2 * spread.covariance[:, number]
        place[number] = center + away
        fit = problem.fitted(place, best.begins, best.deviation, held=[number])
        if fit is None:  # Without a usable motion, the interval ends.
            return spread.width
        rise = max(0.0, float(2 * (fit.cost - best.cost) / factor))
        rows.append({"increase": rise, "values": named(problem, fit.values)})
        return math.sqrt(rise) - spread.width

    for side, room in ((-1, center - low), (1, high - center)):
        reach, inside = min(spread.width * error, room), 0.0
        if math.isfinite(error):
            # The loss may have a long, flat valley that ends at a steep wall.
            while risen(side * reach) < 0 and reach < room:
                reach, inside = min(_WIDER * reach, room), reach
            if risen(side * reach) > 0:
                ends_between, near = (side * inside, side * reach), _CLOSE * reach
                reach = side * root_scalar(risen, bracket=ends_between, xtol=near).root
            for share in (0.25, 0.5, 0.75, 1.5) if fine else ():
                risen(side * min(share * reach, room))
        ends.append(float(one.value(center + side * reach)))
    rows.sort(key=lambda row: row["values"][one.key])
    return {"interval_95": ends, "points": rows}


def named(problem: Problem, values: NDArray[np.float64]) -> dict[str, float]:
    """Return the `values` (p,) of the quantities by key."""
    return dict(zip((one.key for one in problem.quantities), map(float, values), strict=True))


@dataclasses.dataclass(frozen=True)
class Identification:
    """The scene that fits a record best, and how sure it is.

    `config`: the config with the fitted values; `parameters`: by key, `value`, `standard_error`
    (infinite if the record does not determine it), `interval_95`, `bounds` and `at_bound`;
    `covariance` (p, p): of the values, in their units, in the order of `parameters`;
    `combinations`, `motions`, `optima`, `further`, `profiles`: as in the result file; `fit`: how
    well the scene fits; `residuals`: columns of residuals.csv; `status` and `message`.

    >>> import jax
    >>> import rootsopt
    >>> jax.config.update("jax_enable_x64", True)
    >>> config = rootsopt.load_config("cic_drawn")
    >>> record = {"scene.speed_rpm": [2000.0, 3000.0], "mean_force_N": [87.95, 76.25]}
    >>> key = "scene.load.torque_N_m"
    >>> identification = rootsopt.identify(config, record, {key: (3.0, 8.0)})
    >>> identification.status.label
    'identified'
    """

    config: Config
    status: Status
    message: str
    statistics: dict[str, Any]
    parameters: dict[str, dict[str, Any]] = dataclasses.field(default_factory=dict)
    combinations: list[dict[str, Any]] = dataclasses.field(default_factory=list)
    fit: dict[str, Any] = dataclasses.field(default_factory=dict)
    motions: list[dict[str, Any]] = dataclasses.field(default_factory=list)
    optima: list[dict[str, Any]] = dataclasses.field(default_factory=list)
    further: list[dict[str, Any]] = dataclasses.field(default_factory=list)
    profiles: dict[str, dict[str, Any]] = dataclasses.field(default_factory=dict)
    residuals: Mapping[str, Sequence[Any]] = dataclasses.field(default_factory=dict)
    covariance: NDArray[np.float64] = dataclasses.field(default_factory=lambda: np.zeros((0, 0)))
    best: tuple[Problem, Fit, Spread] | None = dataclasses.field(default=None, repr=False)

    def increase(self, values: Mapping[str, float]) -> float:
        """Return the increase of twice the loss from its minimum to other `values` (by key).

        For the true values it follows a χ² distribution, with one degree of freedom per combination
        that is determined. It is infinite without a usable motion."""
        assert self.best is not None
        problem, best, spread = self.best
        place = np.array([one.scaled(values[one.key]) for one in problem.quantities])
        fit, _ = problem.at(place, best.begins, best.deviation)
        return math.inf if fit is None else 2 * (fit.cost - best.cost) / spread.factor

    @property
    def correlation(self) -> NDArray[np.float64]:
        """Correlation (p, p) of the values."""
        size = np.sqrt(np.diag(self.covariance))
        return self.covariance / np.where(size > 0, np.outer(size, size), np.inf)

    def record(self) -> dict[str, Any]:
        """Return the record for the result file."""
        entries, keys = {name: getattr(self, name) for name in _ENTRIES}, [*self.parameters]
        for name in ("correlation", "covariance"):
            entries[name] = pandas.DataFrame(getattr(self, name), keys, keys).to_dict("index")
        end = {"status": self.status.label, "message": self.message}
        return entries | end | {"statistics": self.statistics}


def residuals(problem: Problem, best: Fit) -> dict[str, Sequence[Any]]:
    """Return the columns of residuals.csv: a row for each measured value."""
    rows = problem.rows.drop(columns=["given", "sampled", "scale", "place"]).assign(
        fitted=best.fit, standard_deviation=best.deviation, residual=best.residual
    )
    rows = rows.astype(object).where(rows.notna(), None)
    return {str(key): column.tolist() for key, column in rows.items()}


def adopted(config: Config, problem: Problem, best: Fit) -> Config:
    """Return a config with the fitted values."""
    values = {key: x for key, x in named(problem, best.values).items() if key != OFFSET}
    return config.replaced(values) if values else config
