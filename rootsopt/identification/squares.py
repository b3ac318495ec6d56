"""Least squares: residuals of a record, gains eliminated linearly, and local fits.

The loss is that of Huber, so that outliers count less (P. J. Huber, Robust estimation of a location
parameter, Ann. Math. Stat. 35 (1964) 73-101). Unknown gains and constants of a column enter
linearly and are eliminated by variable projection with the simplification of Kaufman (L. Kaufman, A
variable projection method for solving separable nonlinear least squares problems, BIT 15 (1975)
49-57)."""

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rootsopt.errors import InputError
from rootsopt.identification.model import Begin, Point, predict
from rootsopt.identification.quantities import Fitted, values_at

TURN = 3.0
"""Residual, in standard deviations, above which the loss grows linearly."""

# Least size of an average that its relative error refers to, as a share of its column's RMS.
_LEAST = 0.1

# Maximum number of scenes in a local fit.
_STEPS = 40

# Number of times that residuals beyond `TURN` standard deviations are clipped to estimate one.
_CLIPS = 8

# Number of values of a column from which on it has a standard deviation of its own.
_MANY = 30

# Least variation of samples, as a share of their RMS, that their errors refer to.
_STILL = 1e-4

# Least standard deviation, as a share of the scale.
_FINEST = 1e-6


class Local(NamedTuple):
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
    an unknown gain; `constants`: columns to which an unknown constant is added. The n measured
    values stand one after the other: `measured` (n,); `given` (n,): standard deviations, NaN if not
    known; `scale` (n,): size of what varies in their column; `place` (n,): number of the point;
    `column` (n,): name."""

    points: tuple[Point, ...]
    quantities: tuple[Fitted, ...]
    gains: tuple[tuple[str, ...], ...]
    constants: tuple[str, ...]
    measured: NDArray[np.float64]
    given: NDArray[np.float64]
    scale: NDArray[np.float64]
    place: NDArray[np.int64]
    column: NDArray[Any]

    @classmethod
    def of(
        cls,
        points: Sequence[Point],
        quantities: Sequence[Fitted],
        gains: Sequence[Sequence[str]],
        constants: Sequence[str],
    ) -> "Problem":
        """Return the problem.

        Raises `InputError` if a name in `gains` or `constants` is not that of a column."""
        seen = [point.seen for point in points]
        columns = [np.broadcast_to(one.names, one.measured.shape) for one in seen]
        places = [np.full(one.measured.shape, k) for k, one in enumerate(seen)]
        measured, given, column, place = (
            np.concatenate(
                [x[np.isfinite(one.measured)] for x, one in zip(some, seen, strict=True)]
            )
            for some in ([x.measured for x in seen], [x.deviations for x in seen], columns, places)
        )
        for name in (*(name for group in gains for name in group), *constants):
            if name not in column:
                raise InputError(
                    f"a gain or constant must belong to a column of the record "
                    f"({', '.join(np.unique(column))}), but is that of {name}; correct it"
                )
        sampled, scale = np.array([one.sampled for one in seen])[place], np.zeros_like(measured)
        for name in np.unique(column):
            mine = column == name
            varies = np.std(measured[mine]) if sampled[mine].any() else 0.0
            size = np.sqrt(np.mean(measured[mine] ** 2))
            scale[mine] = max(varies, _STILL * size) if varies else size
        # A column of zeros has the scale of the others with its unit.
        kinds = np.array([name.rpartition("_")[2] for name in column])
        for kind in np.unique(kinds):
            mine = kinds == kind
            scale[mine & (scale == 0)] = np.max(scale[mine]) or 1.0
        # Averages have relative errors, samples those of their column.
        scale = np.where(sampled, scale, np.maximum(np.abs(measured), _LEAST * scale))
        groups = tuple(map(tuple, gains))
        return cls(
            tuple(points), tuple(quantities), groups, tuple(constants),
            measured, given, scale, place, column,
        )  # fmt: skip

    @property
    def lost(self) -> int:
        """Number of degrees of freedom that quantities, gains and constants take."""
        return len(self.quantities) + len(self.gains) + len(self.constants)

    @property
    def box(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Lower and upper bounds (p,) on the scales of the quantities."""
        low, high = zip(
            *((x.scaled(x.low), x.scaled(x.high)) for x in self.quantities), strict=True
        )
        return np.array(low), np.array(high)

    def estimated(self, away: NDArray[np.float64] | None = None) -> NDArray[np.float64]:
        """Return the standard deviations (n,): those given, else from the differences `away` (n,)
        between prediction and record, or without these, the scale.

        Columns of few values share one relative deviation."""
        found, open_ = self.given.copy(), np.isnan(self.given)
        if away is None:
            return np.where(open_, self.scale, found)
        freed = np.sqrt(len(away) / max(len(away) - self.lost, 1))
        groups = [np.flatnonzero(open_ & (self.column == name)) for name in np.unique(self.column)]
        few = np.concatenate([one for one in groups if len(one) < _MANY] or [[]]).astype(int)
        for mine in [few, *(one for one in groups if len(one) >= _MANY)]:
            sizes = (away / self.scale)[mine] ** 2
            size = np.mean(sizes) if len(mine) else 0.0
            for _ in range(_CLIPS if len(mine) >= _MANY else 0):
                size = np.mean(np.minimum(sizes, TURN**2 * size))
            found[mine] = max(np.sqrt(size) * freed, _FINEST) * self.scale[mine]
        return found

    def at(
        self,
        place: NDArray[np.float64],
        begins: Sequence[Begin],
        deviation: NDArray[np.float64],
        turn: float,
    ) -> tuple[Local | None, list[Any]]:
        """Return the fit at a `place` (p,), None if a motion is not usable, and what is predicted.

        `deviation` (n,): standard deviations; `turn`: residual at which the loss turns linear."""
        values, p = values_at(self.quantities, place), len(place)
        found = predict(self.points, self.quantities, values, begins)
        if any(one.values is None for one in found):
            return None, found
        known = [np.isfinite(point.seen.measured) for point in self.points]

        def joined(parts: list[Any]) -> NDArray[np.float64]:
            whole = (np.broadcast_to(x, (*k.shape, *np.shape(x)[2:]))[k]
                     for x, k in zip(parts, known, strict=True))  # fmt: skip
            return np.concatenate([*whole])

        predicted, slopes = joined([x.values for x in found]), joined([x.slopes for x in found])
        deviation = np.hypot(deviation, joined([x.errors for x in found]))
        if not (np.all(np.isfinite(predicted)) and np.all(np.isfinite(slopes))):
            return None, found
        scales = [one.slope(x) for one, x in zip(self.quantities, values, strict=True)]
        slopes = slopes.reshape(-1, p) * np.array(scales) / deviation[:, None]
        fit, gains = predicted, np.zeros(0, float)
        if self.gains or self.constants:
            shared = [np.isin(self.column, group) for group in self.gains]
            columns = [np.where(mine, predicted, 0.0) for mine in shared]
            columns += [(self.column == name).astype(float) for name in self.constants]
            basis = np.stack(columns, axis=1) / deviation[:, None]
            fixed = np.where(np.any(shared, axis=0), 0.0, predicted) if shared else predicted
            gains = np.linalg.lstsq(basis, (self.measured - fixed) / deviation, rcond=None)[0]
            fit = fixed + deviation * (basis @ gains)
            for mine, gain in zip(shared, gains, strict=False):
                slopes = np.where(mine[:, None], gain * slopes, slopes)
            frame = np.linalg.svd(basis, full_matrices=False)[0]
            slopes = slopes - frame @ (frame.T @ slopes)
        residual = (fit - self.measured) / deviation
        size = np.abs(residual)
        cost = np.sum(np.where(size <= turn, size**2 / 2, turn * (size - turn / 2)))
        begin = [one.begin for one in found]
        return Local(
            place, values, float(cost), residual, slopes, fit, gains, begin, deviation
        ), found

    def fitted(
        self,
        place: NDArray[np.float64],
        begins: Sequence[Begin],
        deviation: NDArray[np.float64],
        turn: float = TURN,
        held: Sequence[int] = (),
    ) -> Local | None:
        """Return the end of a local fit from a `place` (p,); None if no motion is usable there.

        `held`: indices of quantities that do not change; other arguments as in `at`."""
        from scipy.optimize import least_squares  # Slow import (0.5 s).

        low, high = self.box
        free = [k for k in range(len(place)) if k not in held]
        # The search stays inside the bounds.
        room = 1e-9 * (high - low)
        place = np.clip(place, low + room, high - room)
        known: dict[bytes, Local] = {}
        nearest = [*begins]

        def at(some: NDArray[np.float64]) -> Local | None:
            if (name := some.tobytes()) not in known:
                whole = place.copy()
                whole[free] = some
                found, _ = self.at(whole, nearest, deviation, turn)
                if found is None:
                    return None
                nearest[:], known[name] = found.begins, found
            return known[name]

        def residual(some: NDArray[np.float64]) -> NDArray[np.float64]:
            found = at(some)
            return np.full(len(self.measured), np.nan) if found is None else found.residual

        def slopes(some: NDArray[np.float64]) -> NDArray[np.float64]:
            return known[some.tobytes()].slopes[:, free]

        first = at(place[free])
        if first is None or not free:
            return first
        done = least_squares(
            residual, place[free], slopes,  # pyright: ignore[reportArgumentType]
            bounds=(low[free], high[free]), x_scale="jac", loss="huber", f_scale=turn,
            xtol=1e-8, ftol=1e-10, gtol=1e-12, max_nfev=_STEPS,
        )  # fmt: skip
        return at(done.x)
