"""Local search by sequential quadratic programming, for an objective with corners.

The corners come from maxima over smooth branches. Each branch and each limit of a force has a
quadratic model (`rootsopt.optimize.local`). A step minimises the greatest model within a trust
region, subject to the constraints of the geometry themselves. The method is sequential
quadratically constrained quadratic programming. Source: Anitescu, A superlinearly convergent
sequential quadratically constrained quadratic programming algorithm for degenerate nonlinear
programming, SIAM Journal on Optimization 12 (2002) 949-978. A violation has a price (exact penalty,
Nocedal and Wright, Numerical Optimization, 2006, section 18.5), so that every step exists.

A search has converged if models with freshly measured Hessians promise no decrease of the objective
in the whole neighbourhood (`_WIDE`). A small first-order residual alone says little about the
value: a long valley or a saddle has one, too.

A point without an objective shortens the trust region and is never the result."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rootsopt.optimize.local import (
    RESIDUAL,
    Certificate,
    Limits,
    Linearization,
    Look,
    Models,
    certify,
)

# Half width of the trust region (unit box): at the start, greatest, and that below which the
# search ends.
_FIRST, _GREATEST, _LEAST = 0.1, 0.5, 1e-5

# Half width (unit box) of the neighbourhood in which a converged search promises no decrease.
_WIDE = 0.05

# Distance (unit box) from the point where the Hessians were measured above which they are
# measured again before a search has converged.
_FRESH = 0.02

# First-order residual above which a search goes on, although its models promise no decrease.
_FLAT = RESIDUAL / 2

# Number of steps tried in order to lower this residual.
_TRIES = 3

# Difference of two objectives below which the smaller residual decides which point is better.
# Evaluations of the same design differ by up to this amount if their first guesses of the orbit
# differ (3e-8 on CIC rotors, 1e-7 on five arcs).
_NOISE = 1e-7

# Least magnitude of the objective to which decreases are related.
_SMALL = 0.1

# Price of a violation: the least (at the start, and later above twice the sum of all multipliers),
# and the greatest.
_PRICE, _MOST = 2.0, 1e5


class Stops(NamedTuple):
    """Criteria for the end of a local search.

    `gain`: promised relative decrease of the objective below which the search ends, once the
    first-order conditions hold; `enough`: promised decrease below which it has converged if further
    steps fail; `feasibility`: scaled violation below which a point is feasible; `evaluations`:
    maximum number of evaluated points; `asked`: function that returns whether to end at once."""

    gain: float = 1e-9
    enough: float = 3e-6
    feasibility: float = 1e-6
    evaluations: int = 200
    asked: Callable[[], bool] = lambda: False


class Descent(NamedTuple):
    """Outcome of a local search.

    `point` (d,): the best feasible point, or the least infeasible one. `local`: objective and
    constraints there, `None` if the start was not usable. `certificate`: first-order conditions
    there. `reason`: key of `REASONS`. `evaluations`: number of evaluated points. `promised`:
    decrease of the objective that the models still promise nearby, NaN if not known."""

    point: NDArray[np.float64]
    local: Linearization | None
    certificate: Certificate | None
    reason: str
    evaluations: int
    promised: float = float("nan")


REASONS = {
    "converged": "No design nearby is better, and the first-order conditions hold.",
    "evaluations": (
        "The evaluations ran out before the search had converged. Raise optimizer.iterations."
    ),
    "no_progress": (
        "The models of the search promise a better design nearby, but no step finds one: the "
        "gradients are less accurate than needed, or the motion changes its kind beside the "
        "design. Tighten solver.accuracy, or raise optimizer.starts."
    ),
    "infeasible": "No point near the start satisfies all constraints. Relax a constraint.",
    "unusable": "The start has no usable steady state. Choose another one.",
    "interrupted": "The search was stopped before its end.",
}
"""Reasons why a local search ends: each word with its explanation and advice."""


class EndError(Exception):
    """Raised to end a search whose evaluations have run out, or that was asked to stop."""


class _Descent:
    """A local search: the models at its best point, a trust region, and the price of a violation.

    `look`: function that evaluates the problem at a point; `models`: those at the start; `stops`:
    criteria for the end."""

    def __init__(self, look: Look, models: Models, stops: Stops):
        self.look, self.models, self.stops = look, models, stops
        self.reach, self.price, self.evaluations = _FIRST, _PRICE, 1
        self.promised, self.measured = float("nan"), np.full(len(models.point), np.inf)

    @property
    def certificate(self) -> Certificate:
        """First-order conditions at the best point."""
        return certify(self.models.local, self.models.point)

    @property
    def fresh(self) -> bool:
        """Whether the Hessians were measured near the best point."""
        return bool(np.max(np.abs(self.models.point - self.measured)) <= _FRESH)

    @property
    def violated(self) -> bool:
        """Whether the best point violates a constraint."""
        return self.models.local.violation > self.stops.feasibility

    def run(self) -> str:
        """Search until the end, and return its reason, a key of `REASONS`."""
        while True:
            step, decrease = self._step()
            moving = decrease >= _NOISE and self.reach >= _LEAST
            if not self.fresh and not (moving and self.promised > self.stops.enough):
                self._measure()
            elif moving and self.promised > self.stops.gain:
                self._moves(step, decrease)
            elif reason := self._ended(step, decrease):
                return reason

    def _ended(self, step: NDArray[np.float64], decrease: float) -> str | None:
        """Return why a search that can hardly move ends, or `None` if it continues.

        `step`, `decrease`: as `_step` returns them."""
        if self.promised > self.stops.enough and self.reach < _WIDE:
            # Steps may have failed because of rounding: use the models in the whole neighbourhood.
            self.reach = _WIDE
            step, decrease = self._step()
        if self.violated and self.promised <= self.stops.enough and self.price < _MOST:
            self.price *= 10
            return None
        if self.violated or self.promised > self.stops.enough:
            return "infeasible" if self.violated else "no_progress"
        small = self.promised <= self.stops.gain and self.certificate.residual <= _FLAT
        return "converged" if small or not self._polished(step, decrease) else None

    def _polished(self, step: NDArray[np.float64], decrease: float) -> bool:
        """Return whether a step of negligible `decrease` leads to a smaller first-order residual.

        `step`, `decrease`: as `_step` returns them. A step that fails corrects the models. A few
        steps are therefore tried while the first-order conditions do not hold."""
        for _ in range(_TRIES if self.certificate.residual > _FLAT else 1):
            if decrease <= 0 or self._moves(step, decrease):
                return decrease > 0
            step, decrease = self._step()
        return False

    def _step(self) -> tuple[NDArray[np.float64], float]:
        """Return the next step (d,), and the decrease of the merit that the models promise for it.

        `promised` becomes the relative decrease within the neighbourhood `_WIDE`: more than that of
        the step if the trust region cuts the step short."""
        models, reach = self.models, self.reach
        self.price = max(self.price, min(_MOST, _PRICE + 2 * self.certificate.total))
        axes = reach / 2 * np.eye(len(models.point))
        step = models.best(reach, self.price, [*axes, *-axes] if self.fresh else ())
        decrease = self._merit(models.local) - models.merit(step, self.price)
        cut = np.max(np.abs(step)) > 0.9 * reach
        ahead = decrease * max(1.0, _WIDE / reach) if cut else decrease
        self.promised = ahead / max(abs(models.local.objective), _SMALL)
        return step, float(decrease)

    def _merit(self, local: Linearization) -> float:
        return local.objective + self.price * local.violation

    def _measure(self) -> None:
        """Measure the Hessians at the best point, for models of the whole neighbourhood."""
        self.measured, self.reach = self.models.point, max(self.reach, _WIDE)
        self.models.measure(self._at)

    def _moves(self, step: NDArray[np.float64], decrease: float) -> bool:
        """Try a `step` (d,), and return whether it leads to a better point.

        `decrease`: decrease that the models promise. The achieved share of it sets the trust
        region, unless rounding dominates."""
        point, length = np.clip(self.models.point + step, 0.0, 1.0), float(np.max(np.abs(step)))
        local = self._at(point)
        share, better = -np.inf, False
        if local is not None:
            gained, before = self._merit(self.models.local) - self._merit(local), self.certificate
            share, moved = gained / decrease, self.models.moved(point, local)
            flatter = certify(local, point).residual < before.residual
            better = bool(share > 0.05 or (decrease < _NOISE and gained > -_NOISE and flatter))
            self.models = moved if better else self.models
        if share < 0.25 and decrease >= _NOISE:
            self.reach = length / 4
        elif share > 0.75 and length > 0.9 * self.reach:
            self.reach = min(2 * self.reach, _GREATEST)
        return better

    def _at(self, point: NDArray[np.float64]) -> Linearization | None:
        """Return the problem at a `point` (d,).

        Raises `EndError` if the search should end."""
        if self.stops.asked() or self.evaluations >= self.stops.evaluations:
            raise EndError
        self.evaluations += 1
        return self.look(point)


def descend(
    look: Look,
    start: NDArray[np.float64],
    stops: Stops | None = None,
    limits: Limits | None = None,
) -> Descent:
    """Search for a local minimum from `start` (d,) in the unit box.

    `look`: function that evaluates the problem at a point; `stops`: criteria for the end, by
    default `Stops()`; `limits`: function for the constraints alone, if it costs much less."""
    stops = Stops() if stops is None else stops
    start = np.clip(np.asarray(start, dtype=np.float64), 0.0, 1.0)
    first = look(start)
    if first is None:
        return Descent(start, None, None, "unusable", 1)
    search = _Descent(look, Models(start, first, limits), stops)
    try:
        reason = search.run()
    except EndError:
        reason = "interrupted" if stops.asked() else "evaluations"
    best = search.models
    ended = reason, search.evaluations, search.promised
    return Descent(best.point, best.local, search.certificate, *ended)
