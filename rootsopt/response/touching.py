"""How sure it is that flanks never touch: their reserve where scene and design scatter.

The gaps of drive and coast flanks at fixed instants of the motion are smooth functions of the
values that scatter (`tolerances.over`), while the least of them has corners. The gradients of all
gaps at the nominal values, and at each value moved by one standard deviation to either side, give
models of second order. The share of machines whose flanks touch follows from these for many
machines, and some are simulated as a check."""

import math
from typing import Any

import jax
import numpy as np
from numpy.typing import NDArray

from rootsopt.config import Config
from rootsopt.config.tolerances import Scatter
from rootsopt.config.units import UM
from rootsopt.dynamics.reserve import INSTANTS, gaps
from rootsopt.dynamics.steady import varied
from rootsopt.response.evaluation import Evaluator
from rootsopt.response.scatter import draw, shifts
from rootsopt.response.sensitivity import direction, motions_along
from rootsopt.runtime.programs import CachedFunction
from rootsopt.status import Status

MACHINES, SIMULATED = 10_000, 32
"""Number of machines that are drawn, and number of those that are simulated."""
# Standard deviation of each distribution, as a share of its width.
_SPREAD = {"normal": 1.0, "uniform": 3**-0.5, "triangular": 6**-0.5}


# Key that makes a pair two-sided, even if it is 0.
_ERROR = "scene.center_distance_error_mm"
_gaps = CachedFunction(gaps)


def touching(config: Config) -> dict[str, Any] | None:
    """Return how the reserve of the design of a `config` with `tolerances` scatters, as the record
    for the result file.

    The reserve, its standard deviation, and the least one if all values are as bad as they can be
    (to first order) are in µm; the share of `MACHINES` that touch is that by models of first and
    second order. `SIMULATED` of them check the latter. The key that costs most comes first.

    Return None without a timing gear, without `tolerances.over`, or if the motion at the nominal
    values, or at a value moved by a standard deviation, is not known."""
    assert config.tolerances is not None
    if config.scene.timing_gear is None or not config.tolerances.over:
        return None
    if config.scene.center_distance_error_mm is None:
        config = config.replaced({_ERROR: 0.0})
    scatters = config.scatters
    spreads = np.array([_SPREAD[one.kind] * one.width for one in scatters])
    look, nominal = _Look(config, scatters), np.array([one.nominal for one in scatters])
    moves = np.concatenate([np.zeros((1, len(spreads))), np.diag(spreads), -np.diag(spreads)])
    # Values (points, gaps) and gradients (points, gaps, k).
    values, slopes = (np.array(x) for x in zip(*map(look, nominal + moves), strict=True))
    if not np.all(np.isfinite(slopes)):
        return None
    count, near = len(spreads), int(np.argmin(values[0]))
    bends = (slopes[1 : 1 + count] - slopes[1 + count :]) / (2 * spreads[:, None, None])
    hessian = (np.moveaxis(bends, 0, 1) + np.moveaxis(bends, 0, 2)) / 2
    machines = draw(config, MACHINES, fresh=True) - nominal
    linear = values[0] + machines @ slopes[0].T
    second = linear + np.einsum("ni,sij,nj->ns", machines, hessian, machines, optimize=True) / 2
    first, second = np.min(linear, axis=1), np.min(second, axis=1)
    simulated = np.array([np.min(look(nominal + one)[0]) for one in machines[:SIMULATED]])
    gradient, model = slopes[0, near], second[:SIMULATED]
    lost = np.abs(gradient) * spreads
    total = float(np.sum(lost**2))
    rows = [
        {
            "key": scatters[k].key,
            "standard_deviation": float(spreads[k]),
            "contact_reserve_um_per_unit": float(gradient[k]),
            "lost_um": float(lost[k]),
            "lost_at_most_um": float(abs(gradient[k]) * scatters[k].half),
            "share_of_variance": float(lost[k] ** 2 / (total or 1.0)),
        }
        for k in np.argsort(-lost, kind="stable")
    ]
    known = np.isfinite(simulated)
    apart = np.abs(simulated - model)[known]
    reaches = np.array([one.half for one in scatters])
    return {
        "contact_reserve_um": float(values[0, near]),
        "standard_deviation_um": math.sqrt(total),
        "worst_case_um": float(np.min(values[0] - np.abs(slopes[0]) @ reaches)),
        "machines": MACHINES,
        "touching_share_first_order": float(np.mean(first < 0)),
        "touching_share": float(np.mean(second < 0)),
        "simulated": len(simulated),
        "simulated_touching": int(np.sum(simulated[known] < 0)),
        "model_touching": int(np.sum(model[known] < 0)),
        "not_known": int(np.sum(~known)),
        "greatest_difference_um": float(np.max(apart)) if apart.size else None,
        "keys": rows,
    }


class _Look:
    """Computes the gaps (µm) of `gaps` and their gradients, at values that scatter."""

    def __init__(self, config: Config, scatters: tuple[Scatter, ...]):
        self.config, self.evaluator = config, Evaluator.of(config).surveying()
        self.design, scene = config.design, self.evaluator.scene
        self.directions = [direction(config, scene, one.key, one.nominal) for one in scatters]

    def __call__(self, row: NDArray[np.float64]) -> tuple[NDArray, NDArray]:
        """Return the gaps (n,) at the values `row` (k,), and their gradients (n, k).

        All are NaN if the motion is not known."""
        (shift,) = shifts(self.config, row[None])
        evaluator, design = self.evaluator.shifted(shift.scene), self.design + shift.design
        count, found, values = len(self.directions), [], np.full(2 * INSTANTS, math.nan)
        for _, pair, tangents, motion in motions_along(evaluator, design, self.directions):
            if not (Status.of(motion.status) is Status.PERIODIC or bool(motion.held)):
                return values, np.full((len(values), count), math.nan)
            values, slopes = jax.device_get(_gaps(pair, tangents, varied(motion)))
            found.append(slopes / UM)
        return values / UM, np.concatenate(found, axis=1)[:, :count]
