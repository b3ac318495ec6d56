"""Facts about an optimum: certificate, active branches, outcomes of the local searches."""

import dataclasses
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rootsopt.optimize.local import RESIDUAL, Certificate
from rootsopt.optimize.sqp import REASONS

if TYPE_CHECKING:
    from rootsopt.optimize.vertices import VertexOptimum

# Differences above which the optima of two local searches count as distinct: relative difference
# between objectives, and difference in one coordinate of the unit box.
_SAME = 1e-4, 0.03

_REASONS = REASONS | {
    "verification": (
        "The search found nothing better nearby, but the first-order conditions do not hold at the "
        "design: its gradients are less accurate than they ask for. If the objective depends on "
        "forces, tighten solver.accuracy."
    ),
}


class StartOutcome(NamedTuple):
    """Outcome of one local search.

    `start`: index of the search; `objective`: best objective, NaN if no usable design satisfied
    all constraints; `residual`: first-order residual, NaN if not known; `reason`: word for why the
    search ended; `evaluations`: number of evaluated designs; `design`: best design, in config units
    by key; `point` (d,): this design in the unit box."""

    start: int
    objective: float
    residual: float
    reason: str
    evaluations: int
    design: dict[str, float]
    point: NDArray[np.float64]


class Holder(NamedTuple):
    """A branch of the objective that is active at the optimum.

    `speed_rpm`: speed of the branch, NaN if there is only one speed. `objective`: value of the
    branch. `share`: its weight in the gradient of the objective.

    `rotation_deg`, `force_N`: rotation of rotor 1 (degrees from φ1 = 0) and contact force (N), if
    the branch is a local maximum of the force over time. Otherwise, both are NaN. `scene`: index
    of the scene in the sample of `tolerances`; `None` if nothing scatters."""

    speed_rpm: float
    rotation_deg: float
    force_N: float
    objective: float
    share: float
    scene: int | None = None

    def record(self) -> dict[str, float | None]:
        """Return the fields for the result file, with `None` in place of NaN.

        `scene` is left out if nothing scatters."""
        given = {k: v for k, v in self._asdict().items() if v is not None}
        return {k: None if math.isnan(v) else v for k, v in given.items()}


class Bound(NamedTuple):
    """Lower bound of the objective over all feasible designs within the bounds.

    `lower_bound`: the bound; `gap`: distance of the reported design from it; `evaluations`: number
    of designs from which it follows. `factor`, `curvature` (d,): estimated curvature of the
    objective along each parameter (unit box), already multiplied by the factor; `pairs`, `jumps`:
    number of pairs of designs that are compared, and of those too steep for a curvature. Between
    these, the objective jumps or has a concave corner. `unusable`: designs without a usable motion.
    `regions_left`, `volume_left`: number and share of the unit box of the regions that may hold a
    better design. `proven`: whether no design is better by more than 1e-4 (relative), if the
    estimate holds."""

    lower_bound: float
    gap: float
    evaluations: int
    factor: float
    curvature: tuple[float, ...]
    pairs: int
    jumps: int
    unusable: int
    regions_left: int
    volume_left: float
    proven: bool

    @property
    def assumption(self) -> str:
        """The assumption behind the bound, in a sentence."""
        listed = ", ".join(f"{one:.3g}" for one in self.curvature)
        steeper = (
            f" {self.jumps} pairs are steeper, as at a corner or a jump: across corners, bounds "
            f"fall off with {self.factor:g} times the steepest of them; none reaches over a jump."
        )
        return (
            f"The objective bends downwards by at most {listed} along the parameters (second "
            f"derivatives in the unit box): {self.factor:g} times the most seen in {self.pairs} "
            "pairs of designs, whose motions were followed from one design to the next."
        ) + steeper * bool(self.jumps)

    def record(self) -> dict[str, Any]:
        """Return the entry `optimality.global` of the result file, with `None` for no bound."""
        known = math.isfinite(self.lower_bound)
        numbers = {k: v if known or k not in ("lower_bound", "gap") else None
                   for k, v in self._asdict().items()}  # fmt: skip
        return numbers | {"curvature": [*self.curvature], "assumption": self.assumption}


class Optimum(NamedTuple):
    """One of the distinct optima that the local searches have found.

    `objective`: value at the optimum; `found`: number of searches that ended there; `design`: the
    design, in config units by key."""

    objective: float
    found: int
    design: dict[str, float]


@dataclasses.dataclass(frozen=True)
class Optimality:
    """Facts about the optimum of a search.

    `certificate`: first-order conditions at the verified design. `reason`: "converged", or a word
    for why the search had not. `promised`: relative decrease of the objective that the search still
    expected nearby, NaN if not known. `holders`: branches of the objective that are active there.
    `starts`: outcomes of the local searches. `sensitivities`: one row per quantity of the scene,
    with its effect on the forces. `bound`: lower bound over all designs, or `None`. `vertex`: other
    vertices of the limits if the optimum is at one, else `None`."""

    certificate: Certificate
    reason: str
    promised: float
    holders: Sequence[Holder]
    starts: Sequence[StartOutcome]
    sensitivities: Sequence[dict[str, Any]] = ()
    bound: Bound | None = None
    vertex: "VertexOptimum | None" = None

    @property
    def converged(self) -> bool:
        """Whether the first-order conditions hold and no design nearby is better."""
        return self.reason == "converged"

    @property
    def message(self) -> str:
        """Reason why the search stopped (`reason`) in a sentence, with advice for the user."""
        return _REASONS[self.reason]

    @property
    def optima(self) -> list[Optimum]:
        """Distinct optima of the converged local searches, the best first."""
        return distinct([one for one in self.starts if one.reason == "converged"])

    def record(self) -> dict[str, Any]:
        """Return the entry `optimality` of the result file."""
        optima = self.optima
        whole: dict[str, Any] = {} if self.bound is None else {"global": self.bound.record()}
        if self.vertex is not None:
            whole["vertex"] = self.vertex.record()
        if self.bound is None or not self.bound.proven:
            whole["unseen"] = unseen(sum(one.found for one in optima), len(optima))
        return whole | {
            "method": "slsqp",
            "converged": self.converged,
            "reason": self.reason,
            "message": self.message,
            "residual": self.certificate.residual,
            "required_residual": RESIDUAL,
            "violation": self.certificate.violation,
            "promised_decrease": None if math.isnan(self.promised) else self.promised,
            "held_by": [one.record() for one in self.holders],
            "starts": [
                {
                    "start": one.start,
                    "objective": None if math.isnan(one.objective) else one.objective,
                    "residual": None if math.isnan(one.residual) else one.residual,
                    "reason": one.reason,
                    "evaluations": one.evaluations,
                    "design": one.design,
                }
                for one in self.starts
            ],
            "optima": [one._asdict() for one in optima],
            "sensitivities": [*self.sensitivities],
        }


def judged(reason: str, holds: bool) -> str:
    """Return why a search ended (`reason`), corrected by the simulation of its design from rest.

    `holds`: whether the first-order conditions hold there. If they do not, a search that
    seemed to have converged has not; any other reason stays."""
    return reason if holds or reason != "converged" else "verification"


def distinct(starts: Sequence[StartOutcome]) -> list[Optimum]:
    """Return the distinct optima among the outcomes of local searches, the best first.

    Two searches have found the same optimum if both their objectives and their points agree."""
    groups: list[list[StartOutcome]] = []
    relative, near = _SAME
    for one in sorted(starts, key=lambda one: one.objective):
        for group in groups:
            first = group[0]
            alike = abs(one.objective - first.objective) <= relative * abs(first.objective)
            if alike and np.max(np.abs(one.point - first.point)) <= near:
                group.append(one)
                break
        else:
            groups.append([one])
    return [Optimum(group[0].objective, len(group), group[0].design) for group in groups]


def unseen(searches: int, optima: int) -> dict[str, float | None]:
    """Return Bayesian estimates of the optima that the local searches have not found.

    `searches`: number N of local searches that ended at an optimum; `optima`: number W of distinct
    optima. The result repeats both, and has two estimates. Each is `None` where the rule knows
    nothing: if N is too small, or if the probability would be 1 or more:

    - `expected_optima`: posterior mean W (N - 1) / (N - W - 2) of the number of optima;
    - `share_of_starts`: posterior mean W (W + 1) / (N (N - 1)) of the probability that one more
      start leads to a new optimum.

    The formulas assume that the starts are drawn independently and that the number of optima is not
    known beforehand. Source: Boender and Rinnooy Kan, Bayesian stopping rules for multistart global
    optimization methods, Mathematical Programming 37 (1987) 59-80."""
    n, w = searches, optima
    share = w * (w + 1) / (n * (n - 1)) if n > 1 else 1.0
    return {
        "searches": n,
        "optima": w,
        "expected_optima": w * (n - 1) / (n - w - 2) if n > w + 2 else None,
        "share_of_starts": share if share < 1.0 else None,
    }
