"""What a fit tells of the quantities: their errors, what the record cannot tell, what would.

All covariances are those of linearised least squares on the scales of the quantities. Without given
standard deviations they allow for errors that differ between samples (estimator HC3: J. G.
MacKinnon and H. White, Some heteroskedasticity-consistent covariance matrix estimators with
improved finite sample properties, J. Econometrics 29 (1985) 305-325)."""

import dataclasses
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import pandas
from numpy.typing import NDArray

from rootsopt.config import Config
from rootsopt.identification.channels import CHANNELS
from rootsopt.identification.model import Point
from rootsopt.identification.quantities import OFFSET
from rootsopt.identification.record import Observed
from rootsopt.identification.squares import TURN, Local, Problem
from rootsopt.status import Status

# Standard deviation of a combination, as a share of the range in which the search begins, above
# which the record does not determine it.
_LOOSE = 0.3

# Distance from a bound, as a share of this range, up to which a quantity lies at it.
_NEAR = 1e-4

# Share of a quantity in a combination below which it does not count.
_PART = 0.1
STRUCTURED = 4.0
"""Value of `structure` above which residuals are not independent."""

# Relative misfit below which residuals are errors of the simulation.
_NUMERICAL = 1e-4

# Singular value of the derivatives, as a share of the greatest, below which it is an error of the
# derivatives.
_SINGULAR = 1e-5

# Maximum number of fits that look for an end of an interval, and relative difference from the
# quantile that ends the search.
_LOOKS, _CLOSE = 6, 0.1

# Degrees of freedom from which on the errors may differ between samples (HC3).
_ENOUGH = 50

# Probability of residuals this large, with the given standard deviations, below which these are
# taken for too small.
_UNLIKELY = 0.01

# Relative error of a simulated orbit, which is the same in all samples.
_EXACT = 1e-5

# Speeds of further measurements, as multiples of the config's.
_SPEEDS = 0.5, 1.0, 2.0

# Columns of further measurements.
_FURTHER = CHANNELS[0], CHANNELS[1], CHANNELS[4], *CHANNELS[6:]

# Relative error of a further measurement if the record has none.
_USUAL = 0.01


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
    def of(cls, problem: Problem, best: Local) -> "Spread":
        """Return the spread of the `best` fit."""
        from scipy import stats  # Slow import (0.5 s).

        count, p = best.slopes.shape
        freedom, inside = count - problem.lost, np.abs(best.residual) <= TURN
        bounded = np.clip(best.residual, -TURN, TURN)
        chi, known = float(np.sum(bounded**2)), bool(np.all(np.isfinite(problem.given)))
        chance = float(stats.chi2.sf(chi, freedom)) if known and freedom > 0 else math.nan
        trusted = known and not chance < _UNLIKELY
        factor = 1 / max(float(np.mean(inside)), 0.1)
        if not trusted and freedom > 0:
            factor *= factor * chi / freedom
        # With fewer values than quantities, rows of zeros complete the combinations.
        whole = np.pad(best.slopes, ((0, max(0, p - count)), (0, 0)))
        left, sizes, rows = np.linalg.svd(whole, full_matrices=False)
        loose = (sizes < _SINGULAR * sizes[0]) | (sizes * _LOOSE < math.sqrt(factor))
        inverse, back = rows[~loose].T / sizes[~loose], left[:count, ~loose]
        plain, covariance = inverse @ inverse.T, factor * inverse @ inverse.T
        if not trusted and freedom >= _ENOUGH:
            leverage = np.minimum(np.sum(back**2, axis=1), 0.99)
            share = (inverse @ back.T) * (bounded / (1 - leverage) / np.mean(inside))
            covariance = share @ share.T
        size = np.array([np.sqrt(np.mean(problem.measured[problem.column == name] ** 2))
                         for name in problem.column])  # fmt: skip
        exact = (inverse @ back.T) * (_EXACT * math.sqrt(count) * size / best.deviation)
        covariance = covariance + exact @ exact.T
        errors, unknown = np.sqrt(np.diag(covariance)), not known and freedom <= 0
        errors[unknown | np.any(np.abs(rows[loose]) > _PART, axis=0)] = math.inf
        each = np.einsum("kp,pq,kq->k", rows, covariance, rows)
        deviations = np.where(loose, math.inf, math.nan if unknown else np.sqrt(np.abs(each)))
        factors = np.diag(covariance) / np.maximum(np.diag(plain), 1e-300)
        joint = float(np.mean((each * sizes**2)[~loose])) if np.any(~loose) else 1.0
        width = stats.norm.ppf(0.975) if trusted else stats.t.ppf(0.975, max(freedom, 1))
        order = rows[::-1], deviations[::-1]
        return cls(covariance, errors, *order, factors, joint, float(width), chance)


def parameters(
    problem: Problem,
    best: Local,
    spread: Spread,
    profiles: Mapping[str, Any],
    optima: Sequence[Mapping[str, Any]],
) -> dict[str, dict[str, Any]]:
    """Return the entry `parameters` of the result file: value, errors and bounds by key.

    `profiles`: results of `profile` by key; `optima`: other scenes. The intervals include those
    that fit as well as the best."""
    found, box = {}, zip(*problem.box, strict=True)
    near = [row for row in optima if row["increase"] < spread.width**2]
    for k, (one, (low, high)) in enumerate(zip(problem.quantities, box, strict=True)):
        ends = profiles[one.key]["interval_95"]
        sides = {"lower": best.place[k] - low, "upper": high - best.place[k]}
        found[one.key] = {
            "value": float(best.values[k]),
            "standard_error": float(spread.errors[k] * one.slope(best.values[k])),
            "interval_95": [
                pick([ends[side], *(row["values"][one.key] for row in near)])
                for side, pick in enumerate((min, max))
            ],
            "bounds": [one.low, one.high],
            "at_bound": next((side for side, room in sides.items() if room < _NEAR), None),
        }
    return found


def combinations(problem: Problem, spread: Spread) -> list[dict[str, Any]]:
    """Return the entry `combinations` of the result file, those that are not determined first."""
    found = []
    for row, deviation in zip(spread.combinations, spread.deviations, strict=True):
        row = row * np.sign(row[np.argmax(np.abs(row))])
        parts = {one.key: float(x) for one, x in zip(problem.quantities, row, strict=True)
                 if abs(x) > _PART}  # fmt: skip
        names = {one.key: one.name for one in problem.quantities}
        ups, downs = ([names[key] for key, x in parts.items() if x * side > 0] for side in (1, -1))
        words = " and ".join(ups) + (" together" if len(ups) > 1 else "")
        words += f", against {' and '.join(downs)}" if downs else ""
        found.append({
            "words": words, "parts": parts, "standard_error": float(deviation),
            "determined": not math.isinf(deviation),
        })  # fmt: skip
    return found


def relative_misfit(problem: Problem, best: Local) -> float:
    """Return the RMS difference between fit and record as a share of the record's variation, or of
    its averages, without the greatest 5 %."""
    away = np.sort(np.abs(best.residual * best.deviation / problem.scale))
    return float(np.sqrt(np.mean(away[: math.ceil(0.95 * len(away))] ** 2)))


def structure(problem: Problem, best: Local) -> float:
    """Return by how many standard errors neighbouring samples have residuals alike: where a scene
    lacks something, or is the wrong one, they are not independent."""
    sampled = np.array([point.seen.sampled for point in problem.points])[problem.place]
    total, count = 0.0, 0
    if relative_misfit(problem, best) < _NUMERICAL:
        return 0.0
    for place in range(len(problem.points)):
        for name in problem.points[place].seen.names:
            mine = (problem.place == place) & (problem.column == name) & sampled
            some = np.clip(best.residual[mine], -TURN, TURN)
            size = np.mean(some**2) if some.size else 0.0
            total += float(np.sum(some[1:] * some[:-1]) / size) if size else 0.0
            count += some.size
    return total / math.sqrt(max(count, 1))


def quality(problem: Problem, best: Local, spread: Spread) -> dict[str, Any]:
    """Return the entry `fit` of the result file: how well the scene fits."""
    names = np.unique(problem.column)
    each = best.deviation / problem.scale
    gains = [", ".join(group) for group in problem.gains]
    gains += [f"{name}, constant" for name in problem.constants]
    return {
        "measured_values": len(problem.measured),
        "degrees_of_freedom": len(problem.measured) - problem.lost,
        "relative_misfit": relative_misfit(problem, best),
        "relative_errors": {str(name): float(np.median(each[problem.column == name]))
                            for name in names},
        "outliers": int(np.count_nonzero(np.abs(best.residual) > TURN + 1)),
        "structure": structure(problem, best),
        "probability": None if math.isnan(spread.chance) else spread.chance,
        "gains": dict(zip(gains, map(float, best.gains), strict=True)),
    }  # fmt: skip


def further(problem: Problem, best: Local, spread: Spread) -> list[dict[str, Any]]:
    """Return the entry `further` of the result file: measurements that would help, best first.

    Each is a column over one turn, at one of some speeds, with the relative error of the record."""
    estimated = len(problem.measured) > problem.lost
    relative = max(float(np.median(best.deviation / problem.scale)), 1e-3) if estimated else _USUAL
    known = best.slopes.T @ best.slopes / spread.factor
    scales = [one.slope(x) for one, x in zip(problem.quantities, best.values, strict=True)]
    turned = np.arange(256) * 360 / 256
    table = pandas.DataFrame({"rotation_deg": turned} | {name: 0.0 * turned for name in _FURTHER})
    found = []
    for share in _SPEEDS:
        first = problem.points[0]
        speed = share * first.config.scene.speed_rpm
        seen = Observed("", {}, table, _FURTHER, True)
        point = Point(first.config.moved({"scene.speed_rpm": speed}), seen)
        if first.config.objective.motion == "ensemble":
            return []
        one = point.predicted(problem.quantities, best.values, best.begins[0])
        if one.values is None:
            continue
        for k, name in enumerate(_FURTHER):
            size = relative * float(np.std(one.values[:, k]))
            if (name in problem.column and share == 1) or not size:
                continue
            more = one.slopes[:, k] * np.array(scales) / size
            after = np.linalg.pinv(known + more.T @ more, hermitian=True)
            errors = np.sqrt(np.diag(after))
            sure = np.linalg.eigvalsh(known + more.T @ more)[0]
            found.append({
                "column": name, "scene.speed_rpm": speed,
                "least_certain_combination": float(1 / np.sqrt(max(sure, 1e-300))),
                "standard_errors": {q.key: float(e * s) for q, e, s in
                                    zip(problem.quantities, errors, scales, strict=True)},
            })  # fmt: skip
    return sorted(found, key=lambda one: one["least_certain_combination"])[:3]


def profile(
    problem: Problem, best: Local, spread: Spread, number: int, fine: bool
) -> dict[str, Any]:
    """Return an entry of `profiles` of the result file: the quantity `number` at several values,
    all others fitted again. Twice the loss rises by less than a quantile of χ² in its interval.

    `fine`: whether to fit at further values, from which the course of the loss can be drawn."""
    one, (low, high) = problem.quantities[number], (side[number] for side in problem.box)
    center, error, factor = best.place[number], spread.errors[number], spread.factors[number]
    rows, ends = [{"increase": 0.0, "values": _named(problem, best.values)}], []

    def root(away: float) -> float:
        """Return the root of the increase at a distance from the best value, NaN if not known."""
        place = best.place + away / error**2 * spread.covariance[:, number]
        place[number] = center + away
        found = problem.fitted(place, best.begins, best.deviation, held=[number])
        if found is None:
            return math.nan
        rise = max(0.0, float(2 * (found.cost - best.cost) / factor))
        rows.append({"increase": rise, "values": _named(problem, found.values)})
        return math.sqrt(rise)

    for side in (-1, 1):
        room = high - center if side > 0 else center - low
        inside, outside, reach = 0.0, room, min(spread.width * error, room)
        for _ in range(_LOOKS if math.isfinite(error) else 0):
            risen = root(side * reach)
            if risen < spread.width:
                inside = reach
            else:  # Beyond the end, or without a motion to trust.
                outside = reach
            if abs(risen / spread.width - 1) < _CLOSE or inside == room or math.isnan(risen):
                outside = reach
                break
            # A valley of the loss may be long and flat, and end at a wall.
            reach = reach * np.clip(spread.width / max(risen, 1e-3), 0.1, 10.0)
            margin = 0.1 * (outside - inside) if outside < room else 0.0
            reach = min(max(reach, inside + margin), outside - margin)
        reach = outside
        ends.append(float(one.value(center + side * reach)))
        for share in (0.25, 0.5, 0.75, 1.5) if fine and math.isfinite(error) else ():
            root(side * min(share * reach, room))
    rows.sort(key=lambda row: row["values"][one.key])
    return {"interval_95": ends, "points": rows}


def _named(problem: Problem, values: NDArray[np.float64]) -> dict[str, float]:
    """Return the `values` (p,) of the quantities by key."""
    return {one.key: float(x) for one, x in zip(problem.quantities, values, strict=True)}


def caveats(
    fit: Mapping[str, Any],
    known: Mapping[str, Mapping[str, Any]],
    told: Sequence[Mapping[str, Any]],
    rivals: Sequence[Any],
    next_: Sequence[Mapping[str, Any]],
) -> Iterator[str]:
    """Yield sentences on what limits the answer, from the entries of the result file."""
    yield f"It differs from the record by {100 * fit['relative_misfit']:.3g} % of its variation."
    loose = [one["words"] for one in told if not one["determined"]]
    if fit["degrees_of_freedom"] <= 0:
        yield (
            f"The record has {fit['measured_values']} values, which leave nothing to estimate "
            "errors from: fit fewer quantities, or give more values and their standard deviations."
        )
    if loose:
        yield f"The record does not determine {'; '.join(loose)}."
        for one in next_[:1]:
            yield f"Measure {one['column']} over a turn at {one['scene.speed_rpm']:g} rpm as well."
    for key, one in known.items():
        if one["at_bound"]:
            yield f"{key} lies at its {one['at_bound']} bound: widen it unless it is a limit."
    if rivals:
        yield f"Other scenes within the bounds fit nearly as well (optima): {len(rivals)}."
    if fit["structure"] > STRUCTURED:
        yield (
            "Residuals of neighbouring samples are alike, so that the scene lacks something or is "
            "not the best within the bounds: the errors are too small. Raise --starts."
        )
    if fit["probability"] is not None and fit["probability"] < _UNLIKELY:
        yield (
            "The residuals are larger than the standard deviations allow, so that the scene lacks "
            "something or these are too small: the errors are scaled up."
        )


@dataclasses.dataclass(frozen=True)
class Identification:
    """The scene that fits a record best, and how sure it is.

    `config`: the config with the fitted values; `parameters`: by key, `value`, `standard_error`
    (infinite if the record does not determine it), `interval_95`, `bounds` and `at_bound`;
    `covariance` (p, p): of the values, in their units, in the order of `parameters`;
    `combinations`, `optima`, `further`, `profiles`: as in the result file; `fit`: how well the
    scene fits; `residuals`: columns of residuals.csv; `status` and `message`.

    >>> import jax
    >>> import rootsopt
    >>> jax.config.update("jax_enable_x64", True)
    >>> config = rootsopt.load_config("cic_drawn")
    >>> record = {"scene.speed_rpm": [2000.0, 3000.0], "mean_force_N": [87.95, 76.25]}
    >>> key = "scene.load.torque_N_m"
    >>> found = rootsopt.identify(config, record, {key: (3.0, 8.0)})
    >>> found.status.label
    'identified'
    """

    config: Config
    parameters: dict[str, dict[str, Any]]
    covariance: NDArray[np.float64]
    combinations: list[dict[str, Any]]
    fit: dict[str, Any]
    optima: list[dict[str, Any]]
    further: list[dict[str, Any]]
    profiles: dict[str, dict[str, Any]]
    residuals: Mapping[str, Sequence[Any]]
    status: Status
    message: str
    statistics: dict[str, Any]
    best: tuple[Problem, Local, Spread] | None = dataclasses.field(default=None, repr=False)

    def increase(self, values: Mapping[str, float]) -> float:
        """Return by how much twice the loss is greater at other `values` (by key).

        For the true values it is distributed as χ², with a degree of freedom for each combination
        that is determined. It is infinite if there is no motion to trust."""
        assert self.best is not None
        problem, best, spread = self.best
        place = np.array([one.scaled(values[one.key]) for one in problem.quantities])
        found, _ = problem.at(place, best.begins, best.deviation, TURN)
        return math.inf if found is None else 2 * (found.cost - best.cost) / spread.factor

    @property
    def correlation(self) -> NDArray[np.float64]:
        """Correlation (p, p) of the values."""
        size = np.sqrt(np.diag(self.covariance))
        return self.covariance / np.where(size > 0, np.outer(size, size), np.inf)

    def record(self) -> dict[str, Any]:
        """Return the record for the result file."""
        keys = [*self.parameters]

        def named(rows: NDArray[np.float64]) -> dict[str, dict[str, float]]:
            return {a: dict(zip(keys, row, strict=True))
                    for a, row in zip(keys, rows.tolist(), strict=True)}  # fmt: skip

        names = "parameters", "combinations", "fit", "optima", "further", "profiles"
        found = {name: getattr(self, name) for name in names}
        found |= {"correlation": named(self.correlation), "covariance": named(self.covariance)}
        end = {"status": self.status.label, "message": self.message}
        return found | end | {"statistics": self.statistics}


def residuals(problem: Problem, best: Local) -> dict[str, Sequence[Any]]:
    """Return the columns of residuals.csv: a row for each measured value."""
    seen = [point.seen for point in problem.points]
    keys = dict.fromkeys(key for one in seen for key in one.values)
    rows: list[dict[str, Any]] = []
    for one in seen:
        for line, turned, row in zip(one.table.index, one.column(), one.measured, strict=True):
            place = {"source": one.source, "line": int(line)}
            place |= {key: one.values.get(key) for key in keys}
            place |= {"rotation_deg": float(turned) if one.sampled else None}
            rows += [place | {"column": name} for name, x in zip(one.names, row, strict=True)
                     if np.isfinite(x)]  # fmt: skip
    columns: dict[str, Sequence[Any]] = {key: [row[key] for row in rows] for key in rows[0]}
    return columns | {
        "measured": problem.measured.tolist(),
        "fitted": best.fit.tolist(),
        "standard_deviation": best.deviation.tolist(),
        "residual": best.residual.tolist(),
    }


def adopted(config: Config, problem: Problem, best: Local) -> Config:
    """Return a config with the fitted values."""
    values = {one.key: float(x) for one, x in zip(problem.quantities, best.values, strict=True)}
    values.pop(OFFSET, None)
    return config.replaced(values) if values else config
