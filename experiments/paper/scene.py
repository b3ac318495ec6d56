"""The quantities that the paper does not state, as numbers to search and differentiate.

`QUANTITIES` names them with plausible ranges. `respond` computes from their values the four forces
of the paper's section 4, with derivatives on periodic orbits. `polished` uses these derivatives to
solve for values that reproduce the paper's forces.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from experiments._common.scenes import FORCES, shipped
from experiments._common.simulation import evaluator_of, numbers_of
from rootsopt.config import Config
from rootsopt.response.evaluation import Evaluation, Evaluator
from rootsopt.response.sensitivity import by_scene


@dataclasses.dataclass(frozen=True)
class Quantity:
    """A quantity that the paper does not state.

    Fields: its key in the config, the plausible range in the config's unit, its name in figures.
    """

    key: str
    low: float
    high: float
    label: str


# The p quantities, in the order of all vectors of values (p,). docs/paper.md explains the ranges.
QUANTITIES = (
    Quantity("rotor.length_mm", 30.0, 400.0, "rotor length"),
    Quantity("scene.load.torque_N_m", 0.2, 9.55, "load torque"),
    Quantity("scene.timing_gear.stiffness_N_m_per_rad", 1e3, 1e6, "gear stiffness"),
    Quantity("scene.timing_gear.damping_ratio", 0.01, 1.0, "gear damping ratio"),
    Quantity("scene.timing_gear.backlash_mm", 0.02, 1.5, "gear backlash"),
    Quantity("contact.clearance_mm", 0.005, 0.5, "flank clearance"),
)
LOW, HIGH = np.array([(quantity.low, quantity.high) for quantity in QUANTITIES]).T
FAMILIES = ("cic", "ee")

# Mean and maximum contact force (N), a row per pair (`FAMILIES`), from the paper's section 4.
PAPER = np.array([[102.4, 1973.3], [1047.1, 5661.4]])

# Maximum step of `polished`, in logarithms of the quantities.
_NEAR = 0.1


def config_of(family: str, values: ArrayLike | None = None, *overrides: str) -> Config:
    """Load the shipped config of a pair, with other `values` (p,) of the quantities (config units).

    `overrides`: further changes, each `dotted.key=value`."""
    config = shipped(f"paper_{family}", *overrides)
    if values is None:
        return config
    keys = [quantity.key for quantity in QUANTITIES]
    return config.replaced(dict(zip(keys, np.asarray(values, float).tolist(), strict=True)))


@dataclasses.dataclass(frozen=True)
class Response:
    """Response of both pairs with one set of `values` (p,).

    `evaluations`: one per pair, in the order of `FAMILIES`; `slopes` (pair, mean and peak, p):
    derivatives of log(force) with respect to log(quantity), `None` unless both motions are
    periodic.
    """

    values: NDArray[np.float64]
    evaluations: tuple[Evaluation, ...]
    slopes: NDArray[np.float64] | None

    @property
    def forces(self) -> NDArray[np.float64]:
        """Mean and peak force (N) by pair (2, 2), NaN if unknown."""
        return np.array([numbers_of(one)[0] for one in self.evaluations])

    @property
    def misfit(self) -> float:
        """Largest relative difference from the paper's forces; infinite without forces."""
        worst = np.max(np.abs(self.forces / PAPER - 1))
        return float(worst) if np.isfinite(worst) else np.inf


def respond(
    values: ArrayLike, slopes: bool = True, series: bool = False, give_up_early: bool = True
) -> Response:
    """Simulate both pairs from rest with `values` (p,) in config units.

    `slopes`, `series`: whether to compute derivatives and series; `give_up_early`: whether to give
    up a motion that settles late."""
    values = np.asarray(values, float)
    evaluations, rows = [], []
    for family in FAMILIES:
        evaluator = evaluator_of(config_of(family, values), give_up_early)
        one = evaluator(series=series)
        row = _slopes(evaluator, one, values) if slopes and one.usable else None
        evaluations.append(one)
        rows += [] if row is None else [row]
    known = np.array(rows) if len(rows) == len(FAMILIES) else None
    return Response(values, tuple(evaluations), known)


def _slopes(evaluator: Evaluator, one: Evaluation, values) -> NDArray[np.float64] | None:
    """Differentiate log mean and log peak force with respect to the log quantities, (2, p).

    The result is None if the motion from the orbit's own start is not periodic."""
    found = by_scene(evaluator, one)
    if found is None:
        return None
    rows = [[found.gradient[name][q.key] for q in QUANTITIES] for name in FORCES]
    return np.array(rows) * values / numbers_of(one)[0][:, None]


def polished(
    values: ArrayLike,
    held: Sequence[int] = (),
    within: float = 1e-4,
    steps: int = 12,
) -> Response:
    """Solve for the values nearest to `values` (p,) that give the paper's forces.

    `held`: indices of quantities that do not change. The method is Gauss-Newton steps of minimum
    length in the logarithms. A step is halved until the misfit falls and both motions, from rest,
    stay periodic. The search ends when the misfit is below `within` or cannot be lowered. Returns
    the best response found, inside the plausible ranges.
    """
    free = [i for i in range(len(QUANTITIES)) if i not in held]
    low, high = np.log(LOW), np.log(HIGH)
    best = respond(values)
    for _ in range(steps):
        if best.slopes is None or best.misfit <= within:
            break
        slopes, wanted = best.slopes.reshape(4, -1), np.log(PAPER / best.forces).ravel()
        place = np.log(best.values)
        step = _least_step(slopes, wanted, free)
        # Keep a quantity at an end of its range if the step would leave the range.
        inside = [i for i in free if low[i] < place[i] + step[i] * 1e-3 < high[i]]
        step = _least_step(slopes, wanted, inside)
        step *= min(1.0, _NEAR / max(np.max(np.abs(step)), 1e-12))
        for _ in range(5):
            tried = respond(np.exp(np.clip(place + step, low, high)))
            if tried.slopes is not None and tried.misfit < best.misfit:
                break
            step /= 2
        else:
            break
        best = tried
    return best


def compensated(
    values: NDArray[np.float64], slopes: NDArray[np.float64], number: int, factor: float
) -> NDArray[np.float64]:
    """Multiply the `number`-th value by `factor`, and change the others so that forces stay the
    same.

    This holds to first order, with the smallest possible changes. Returns values (p,) inside their
    ranges.
    """
    others = [i for i in range(len(values)) if i != number]
    flat = slopes.reshape(-1, len(values))
    step = _least_step(flat, -flat[:, number] * np.log(factor), others)
    step[number] = np.log(factor)
    return np.clip(values * np.exp(step), LOW, HIGH)


def _least_step(slopes, wanted, free: Sequence[int]) -> NDArray[np.float64]:
    """Return the shortest step (p,) of `free` quantities that changes the forces as `wanted`."""
    step = np.zeros(slopes.shape[1])
    step[list(free)] = np.linalg.pinv(slopes[:, list(free)], rcond=1e-3) @ wanted
    return step
