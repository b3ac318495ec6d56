"""First-order sensitivities of a steady motion to the quantities of its scene.

A quantity is a number of the config, such as the load torque. The rotor pair depends on each
quantity, and the forces depend on the pair. The derivatives of the forces come from the orbit, by
the same compiled program as the derivatives with respect to the design.

The gaps of drive and coast flanks at fixed instants of the motion are smooth functions of the
values that scatter (`tolerances.over`). Their least value has corners. Models of second order
follow from their gradients at the nominal values, and at each value moved by one standard deviation
to either side. These models give the share of many machines whose flanks touch. Some machines are
simulated as a check.
"""

import dataclasses
import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from numpy.typing import NDArray

from rootsopt.config.reading import Config
from rootsopt.config.tolerances import Scatter
from rootsopt.config.units import LENGTHS, MICROMETRE, OTHERS, UM
from rootsopt.dynamics.maxima import local_maxima
from rootsopt.dynamics.pair import RotorPair
from rootsopt.dynamics.reserve import INSTANTS, gaps
from rootsopt.dynamics.steady import Steady, varied
from rootsopt.response.evaluation import Evaluator
from rootsopt.response.result import Evaluation, Seed, Seeds, begun
from rootsopt.response.scatter import draw, shifts
from rootsopt.runtime.programs import CachedFunction
from rootsopt.scene.build import Scene, along
from rootsopt.status import Status

# Relative step of the difference quotients that approximate the derivatives of the scene with
# respect to a quantity. Their error is small, since the scene depends almost linearly on its
# quantities.
_STEP = 1e-6
_PERCENT = 0.01


class Quantity(NamedTuple):
    """A quantity of a scene on which the contact forces depend.

    `key`: dotted config key; `name`: description in words; `unit` of `value` and `step`; `value`:
    number in the config; `step`: change for which the table states the effect.
    """

    key: str
    name: str
    unit: str
    value: float
    step: float


def quantities(config: Config) -> list[Quantity]:
    """Return the quantities that the sensitivity table lists for the scene of `config`.

    The table states the effect of a change by 1 µm for clearance, backlash and centre distance
    error. For all other quantities, the change is 1 %. Quantities of parts that the scene does not
    have are left out. So are quantities that are 0, except the first three."""
    lengths = [
        Quantity(key, name, "mm", value, MICROMETRE)
        for key, name in LENGTHS
        if (value := config.value(key)) is not None
    ]
    return lengths + [
        Quantity(key, name, unit, value, _PERCENT * value)
        for key, name, unit in OTHERS
        if (value := config.value(key))
    ]


def direction(
    config: Config, scene: Scene, key: str, value: float
) -> tuple[Scene, NDArray[np.float64]]:
    """Return the derivatives of the scene's arrays and of the design (d,) with respect to a key.

    `key`: dotted config key of a number; `value`: this number in the `config`. The first result is
    a `Scene`, the second in config units."""
    size = _STEP * (abs(value) or 1.0)
    other = config.moved({key: value + size})
    if key.startswith("profile."):
        still = jax.tree.map(np.zeros_like, eqx.filter(scene, eqx.is_inexact_array))
        return still, (other.design - config.design) / size

    def change(before, after):
        return (np.asarray(after, np.float64) - np.asarray(before, np.float64)) / size

    # Outline and solver stay the same, so that their derivatives are 0.
    arrays = (eqx.filter(scene.renewed(one), eqx.is_inexact_array) for one in (config, other))
    return jax.tree.map(change, *arrays), np.zeros(len(config.design))


@CachedFunction
def along_values(scene: Scene, design, directions: Scene, turns):
    """Return the rotor pair of a design, and its derivatives along several directions.

    `directions`, `turns` (n, d): results of `direction`, stacked along a leading axis."""
    arrays, rest = eqx.partition(scene, eqx.is_inexact_array)

    def build(values):
        return eqx.combine(values[0], rest).pair_and_shape(values[1])

    return along(build, (arrays, design), (directions, turns))[:2]


def motions_along(
    evaluator: Evaluator,
    design: NDArray[np.float64],
    directions: Sequence[tuple[Scene, NDArray[np.float64]]],
    start: Seeds = None,
) -> Iterator[tuple[int, RotorPair, RotorPair, Steady]]:
    """Yield the steady motion with derivatives along some of the `directions` at a time.

    Each result is (number of these directions, pair, its derivatives, motion). `design` (d,): in
    config units; `directions`: results of `direction`; `start`: where the first search begins.
    There are as many directions at a time as design parameters, to reuse the compiled programs; the
    last ones may be padded."""
    size, longest = max(1, len(design)), evaluator.scene.solver.max_orbit
    for begin in range(0, len(directions), size):
        some = directions[begin : begin + size]
        blank = [jax.tree.map(np.zeros_like, some[0])] * (size - len(some))
        stacked = jax.tree.map(lambda *x: np.stack(x), *some, *blank)
        pair, tangents = along_values(evaluator.scene, design, *stacked)
        motion = evaluator.motion(pair, tangents, begun(pair, start, longest))
        yield len(some), pair, tangents, motion
        if begin + size < len(directions):
            start = Seed.of(motion, pair)


def by_scene(evaluator: Evaluator, evaluation: Evaluation) -> Evaluation | None:
    """Return `evaluation` with gradients with respect to the quantities of the scene.

    They replace the gradients with respect to the design: in `gradient` (N per config unit, keyed
    by config key), and in `maxima`. The result is None if the steady motion from the evaluation's
    start is not periodic, or does not have the same number of maxima."""
    config, measures = evaluator.config, evaluator.scene.solver.measures
    design = np.array(list(evaluation.design.values()))
    wanted = quantities(config)
    directions = [direction(config, evaluator.scene, one.key, one.value) for one in wanted]
    gradient: dict[str, dict[str, float]] = {}
    slopes, maxima, done = [], evaluation.maxima, 0
    for count, pair, tangents, motion in motions_along(
        evaluator, design, directions, evaluation.start
    ):
        if Status.of(motion.status) is not Status.PERIODIC:
            return None
        rows = np.column_stack([motion.orbit.response, motion.orbit.sensitivity])
        named = measures.named(rows, int(motion.period))
        for name in evaluation.response.keys() & named.keys():
            slope = map(float, named[name][1][:count])
            row = gradient.setdefault(name, {})
            row |= {one.key: x for one, x in zip(wanted[done:], slope, strict=False)}
        done += count
        if maxima is not None:
            again = local_maxima(pair, tangents, varied(motion))
            if again.times.shape != maxima.times.shape:
                return None
            slopes.append(again.slopes[:, :count])
    if maxima is not None:
        maxima = maxima._replace(slopes=np.concatenate(slopes, axis=1))
    return dataclasses.replace(evaluation, gradient=gradient, maxima=maxima)


MACHINES, SIMULATED = 10_000, 32
"""Number of machines that are drawn, and number of those that are simulated."""
# Standard deviation of each distribution, as a share of its width.
_SPREAD = {"normal": 1.0, "uniform": 3**-0.5, "triangular": 6**-0.5}


# Key that makes a pair two-sided, even if it is 0.
_ERROR = "scene.center_distance_error_mm"
_gaps = CachedFunction(gaps)


def touching(config: Config) -> dict[str, Any] | None:
    """Return the scatter of a design's reserve under `tolerances`, for the result file.

    The entries are the reserve, its standard deviation and its least value over all values that can
    occur, each to first order (µm); the share of `MACHINES` machines that touch, by models of first
    and second order; a check of the latter, for which `SIMULATED` machines are simulated; and the
    cost of each key, the costliest first.

    Return None without a timing gear or without `tolerances.over`. Also return None if the motion
    at the nominal values, or at a value moved by a standard deviation, is not known."""
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
        count, gradients, values = len(self.directions), [], np.full(2 * INSTANTS, math.nan)
        for _, pair, tangents, motion in motions_along(evaluator, design, self.directions):
            if not (Status.of(motion.status) is Status.PERIODIC or bool(motion.held)):
                return values, np.full((len(values), count), math.nan)
            values, slopes = jax.device_get(_gaps(pair, tangents, varied(motion)))
            gradients.append(slopes / UM)
        return values / UM, np.concatenate(gradients, axis=1)[:, :count]
