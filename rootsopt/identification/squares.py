"""Least squares: residuals of a record, gains eliminated linearly, and local fits.

The loss is that of Huber, so that outliers count less (P. J. Huber, Robust estimation of a location
parameter, Ann. Math. Stat. 35 (1964) 73-101). Unknown gains and constants of a column enter
linearly and are eliminated by variable projection with the simplification of Kaufman (L. Kaufman, A
variable projection method for solving separable nonlinear least squares problems, BIT 15 (1975)
49-57)."""

import dataclasses
import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas
from numpy.typing import NDArray

from rootsopt.errors import InputError
from rootsopt.identification.model import Begin, Fitted, Point, predict, values_at
from rootsopt.status import Status

TURN = 3.0
"""Residual, in standard deviations, above which the loss grows linearly."""

# Least size of an average, and least variation of samples, to which relative errors refer, as
# shares of their column's RMS.
_LEAST, _STILL = 0.1, 1e-4

# Maximum number of scenes in a local fit. Number of times that residuals are clipped at `TURN`
# standard deviations to estimate one.
_STEPS, _CLIPS = 40, 8

# Number of values of a column from which it has a standard deviation of its own.
_MANY = 30
_FINEST = 1e-6


class Fit(NamedTuple):
    """A scene, and how well it fits.

    `place` (p,): on the scales of the quantities; `values` (p,): in their units; `cost`: sum of the
    loss; `residual` (n,): differences from the record over standard deviations; `slopes` (n, p):
    their derivatives with respect to the place; `fit` (n,): predicted values; `gains`: best gains,
    then constants; `begins`: where the motions of neighbours begin; `deviation` (n,): standard
    deviations."""

    place: NDArray[np.float64]
    values: NDArray[np.float64]
    cost: float
    residual: NDArray[np.float64]
    slopes: NDArray[np.float64]
    fit: NDArray[np.float64]
    gains: Any
    begins: list[Begin]
    deviation: NDArray[np.float64]


@dataclasses.dataclass(frozen=True)
class Problem:
    """A record and the quantities to fit.

    `points`: operating points; `quantities`: what is fitted; `gains`: groups of columns that share
    an unknown gain; `constants`: columns to which an unknown constant is added; `rows`: table of
    the n measured values, as `Observed.rows`, with the number of the point (`place`) and the size
    of what varies in their column (`scale`)."""

    points: tuple[Point, ...]
    quantities: tuple[Fitted, ...]
    gains: tuple[tuple[str, ...], ...]
    constants: tuple[str, ...]
    rows: pandas.DataFrame

    @classmethod
    def of(
        cls,
        points: Sequence[Point],
        quantities: Sequence[Fitted],
        gains: Sequence[Sequence[str]] = (),
        constants: Sequence[str] = (),
    ) -> "Problem":
        """Return the problem.

        Raises `InputError` if a name in `gains` or `constants` is not that of a column."""
        each = [point.seen.rows().assign(place=k) for k, point in enumerate(points)]
        rows = pandas.concat(each, ignore_index=True)
        names, measured = sorted({*rows.column}), rows.groupby("column")["measured"]
        for name in itertools.chain(*gains, constants):
            if name not in names:
                raise InputError(
                    f"a gain or constant must belong to a column of the record "
                    f"({', '.join(names)}), but is that of {name}; correct it"
                )
        size: Any = measured.transform(lambda x: np.sqrt(np.mean(x**2)))
        varies = measured.transform(lambda x: np.std(x.to_numpy()))
        scale = size.where(~rows.sampled, varies.clip(lower=_STILL * size))
        # A column of zeros takes the greatest scale of the columns with its unit.
        like = scale.groupby(rows.column.str.rpartition("_")[2]).transform("max")
        scale = scale.mask(scale == 0, like).replace(0.0, 1.0)
        # Averages have relative errors, samples those of their column.
        scale = scale.where(rows.sampled, np.maximum(rows.measured.abs(), _LEAST * scale))
        groups = tuple(map(tuple, gains))
        return cls(
            tuple(points), tuple(quantities), groups, tuple(constants), rows.assign(scale=scale)
        )

    @property
    def lost(self) -> int:
        """Number of degrees of freedom that quantities, gains and constants take."""
        return len(self.quantities) + len(self.gains) + len(self.constants)

    @property
    def box(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Lower and upper bounds (p,) on the scales of the quantities."""
        ends = np.array([(x.scaled(x.low), x.scaled(x.high)) for x in self.quantities])
        return ends[:, 0], ends[:, 1]

    def estimated(self, away: NDArray[np.float64] | None = None) -> NDArray[np.float64]:
        """Return the standard deviations (n,).

        Those not given are estimated from the differences `away` (n,) between prediction and
        record. If `away` is `None`, they are set to `scale`. Columns of few values share one
        relative deviation."""
        scale, deviations = self.rows.scale.to_numpy(), self.rows.given.to_numpy(copy=True)
        unknown = np.isnan(deviations)
        if away is None:
            return np.where(unknown, scale, deviations)
        share, of = (away / scale) ** 2, self.rows.column[unknown]
        freed = np.sqrt(len(away) / max(len(away) - self.lost, 1))
        groups = of.where(of.groupby(of).transform("size") >= _MANY, "")
        for mine in (one.index for _, one in groups.groupby(groups)):
            size = np.mean(share[mine])
            for _ in range(_CLIPS):
                size = np.mean(np.minimum(share[mine], TURN**2 * size))
            deviations[mine] = max(np.sqrt(size) * freed, _FINEST) * scale[mine]
        return deviations

    def at(
        self,
        place: NDArray[np.float64],
        begins: Sequence[Begin],
        deviation: NDArray[np.float64],
        turn: float = TURN,
    ) -> tuple[Fit | None, list[Status]]:
        """Return the fit at a `place` (p,), None if a motion is not usable, and the statuses of
        such motions.

        `deviation` (n,): standard deviations; `turn`: residual at which the loss turns linear."""
        values, rows = values_at(self.quantities, place), self.rows
        predictions = predict(self.points, self.quantities, values, begins)
        if lost := [one.status for one in predictions if one.values is None]:
            return None, lost
        known = [np.isfinite(point.seen.measured) for point in self.points]
        fit, slopes, errors = (
            np.concatenate([getattr(x, name)[k] for x, k in zip(predictions, known, strict=True)])
            for name in ("values", "slopes", "errors")
        )
        if not (np.all(np.isfinite(fit)) and np.all(np.isfinite(slopes))):
            return None, [Status.NON_FINITE]
        deviation, gains = np.hypot(deviation, errors), np.zeros(0)
        slopes = slopes * [one.slope(x) for one, x in zip(self.quantities, values, strict=True)]
        slopes /= deviation[:, None]
        if self.gains or self.constants:
            shared = [rows.column.isin(group).to_numpy() for group in self.gains]
            columns = [np.where(mine, fit, 0.0) for mine in shared]
            columns += [(rows.column == name).to_numpy(float) for name in self.constants]
            basis, fixed = (
                np.stack(columns, axis=1) / deviation[:, None],
                fit - sum(columns[: len(shared)]),
            )
            gains = np.linalg.lstsq(basis, (rows.measured - fixed) / deviation)[0]
            fit = fixed + deviation * (basis @ gains)
            for mine, gain in zip(shared, gains, strict=False):
                slopes[mine] *= gain
            frame = np.linalg.svd(basis, full_matrices=False)[0]
            slopes = slopes - frame @ (frame.T @ slopes)
        residual = (fit - rows.measured.to_numpy()) / deviation
        size = np.abs(residual)
        cost = np.sum(np.where(size <= turn, size**2 / 2, turn * (size - turn / 2)))
        begin = [one.begin for one in predictions]
        return Fit(place, values, float(cost), residual, slopes, fit, gains, begin, deviation), []

    def fitted(
        self,
        place: NDArray[np.float64],
        begins: Sequence[Begin],
        deviation: NDArray[np.float64],
        turn: float = TURN,
        held: Sequence[int] = (),
    ) -> Fit | None:
        """Return the end of a local fit from a `place` (p,); None if no motion is usable there.

        `held`: indices of quantities that do not change; other arguments as in `at`."""
        from scipy.optimize import least_squares  # Slow import (0.5 s).

        low, high = self.box
        free = np.delete(np.arange(len(place)), held)
        # The search stays inside the bounds.
        room = 1e-9 * (high - low)
        place = np.clip(place, low + room, high - room)
        known: dict[bytes, Fit] = {}
        nearest = [*begins]

        def at(some: NDArray[np.float64]) -> Fit | None:
            if (name := some.tobytes()) not in known:
                whole = place.copy()
                whole[free] = some
                fit, _ = self.at(whole, nearest, deviation, turn)
                if fit is None:
                    return None
                nearest[:], known[name] = fit.begins, fit
            return known[name]

        def residual(some: NDArray[np.float64]) -> NDArray[np.float64]:
            fit = at(some)
            return np.full(len(self.rows), np.nan) if fit is None else fit.residual

        def slopes(some: NDArray[np.float64]) -> NDArray[np.float64]:
            return known[some.tobytes()].slopes[:, free]

        first = at(place[free])
        if first is None or not len(free):
            return first
        done = least_squares(
            residual, place[free], slopes,  # pyright: ignore[reportArgumentType]
            bounds=(low[free], high[free]), x_scale="jac", loss="huber", f_scale=turn,
            xtol=1e-8, ftol=1e-10, gtol=1e-12, max_nfev=_STEPS,
        )  # fmt: skip
        return at(done.x)
