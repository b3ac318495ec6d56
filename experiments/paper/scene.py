"""The quantities that the paper does not state, as numbers to search and differentiate.

`QUANTITIES` names them with plausible ranges. `Pairs` computes from their values the four forces of
the paper's section 4, with derivatives on periodic orbits. `polished` uses these derivatives to
solve for values that reproduce the paper's forces.
"""

import dataclasses
import functools
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike, NDArray

from experiments._common.scenes import FORCES, shipped
from experiments._common.simulation import evaluator_of
from rootsopt.config import Config
from rootsopt.config.units import MM
from rootsopt.dynamics.closed import Start, steady_motion
from rootsopt.dynamics.orbit import Orbit
from rootsopt.dynamics.pair import RotorPair
from rootsopt.response.evaluation import Evaluation, Evaluator
from rootsopt.runtime.programs import CachedFunction
from rootsopt.scene import Scene, design_vector
from rootsopt.status import Status


@dataclasses.dataclass(frozen=True)
class Quantity:
    """A quantity that the paper does not state.

    Fields: its key in the config, the plausible range in the config's unit, whether it is searched
    on a logarithmic scale, and its name in figures.
    """

    key: str
    low: float
    high: float
    logarithmic: bool
    label: str


# The p quantities, in the order of all vectors of values (p,). docs/paper.md explains the ranges.
QUANTITIES = (
    Quantity("rotor.length_mm", 30.0, 400.0, False, "rotor length (mm)"),
    Quantity("scene.load.torque_N_m", 0.2, 9.55, False, "load torque (N·m)"),
    Quantity("scene.timing_gear.stiffness_N_m_per_rad", 1e3, 1e6, True, "gear stiffness (N·m/rad)"),
    Quantity("scene.timing_gear.damping_ratio", 0.01, 1.0, True, "gear damping ratio"),
    Quantity("scene.timing_gear.backlash_mm", 0.02, 1.5, True, "gear backlash (mm)"),
    Quantity("contact.clearance_mm", 0.005, 0.5, True, "flank clearance (mm)"),
)
FAMILIES = ("cic", "ee")

# Mean and maximum contact force (N), a row per pair (`FAMILIES`), from the paper's section 4.
PAPER = np.array([[102.4, 1973.3], [1047.1, 5661.4]])

# Maximum step of `polished`, in logarithms of the quantities.
_NEAR = 0.1


def config_of(family: str, values: ArrayLike | None = None, *overrides: str) -> Config:
    """Load the shipped config of a pair, with other `values` (p,) of the quantities (config units).

    `overrides`: further changes, each `dotted.key=value`."""
    at: list[str] = []
    if values is not None:
        numbers = np.asarray(values, float).tolist()
        at = [f"{q.key}={value!r}" for q, value in zip(QUANTITIES, numbers, strict=True)]
    return shipped(f"paper_{family}", *at, *overrides)


def values_of(config: Config) -> NDArray[np.float64]:
    """Read the values (p,) of the quantities from a config, in its units."""

    def found(key: str) -> float:
        return float(functools.reduce(getattr, key.split("."), config))  # pyright: ignore[reportArgumentType]

    return np.array([found(quantity.key) for quantity in QUANTITIES])


@dataclasses.dataclass(frozen=True)
class Response:
    """Response of both pairs with one set of `values` (p,).

    `evaluations`: one per pair, in the order of `FAMILIES`; `slopes` (pair, mean and peak, p):
    derivatives of log(force) with respect to log(quantity), `None` unless both motions are
    periodic.
    """

    values: NDArray[np.float64]
    evaluations: tuple[Evaluation, Evaluation]
    slopes: NDArray[np.float64] | None

    @property
    def forces(self) -> NDArray[np.float64]:
        """Mean and peak force (N) by pair (2, 2), NaN if unknown."""
        return np.array(
            [[one.response.get(name, np.nan) for name in FORCES] for one in self.evaluations]
        )

    @property
    def misfit(self) -> float:
        """Largest relative difference from the paper's forces; infinite without forces."""
        worst = np.max(np.abs(self.forces / PAPER - 1))
        return float(worst) if np.isfinite(worst) else np.inf

    @property
    def periods(self) -> tuple[int, ...]:
        """Number of mesh periods after which the motion of each pair repeats; 0: no repetition."""
        return tuple(int(one.steady_state.get("period", 0)) for one in self.evaluations)

    @property
    def usable(self) -> bool:
        """Whether both motions are stable periodic orbits."""
        return all(one.status is Status.PERIODIC for one in self.evaluations)


class Pairs:
    """Evaluates both pairs for values of the quantities, with shared compiled programs.

    `give_up_early`: whether to give up a motion that settles late.
    """

    def __init__(self, give_up_early: bool = False):
        self.give_up_early = give_up_early

    def __call__(
        self,
        values: ArrayLike,
        slopes: bool = True,
        series: bool = False,
    ) -> Response:
        """Simulate both pairs from rest with `values` (p,) in config units.

        `slopes`, `series`: whether to compute derivatives and series."""
        values = np.asarray(values, float)
        evaluations, rows = [], []
        for family in FAMILIES:
            config = config_of(family, values)
            evaluator = evaluator_of(config, self.give_up_early)
            one = evaluator(series=series)
            evaluations.append(one)
            if slopes and one.usable:
                rows.append(_slopes(evaluator, one, values))
        complete = len(rows) == len(FAMILIES)
        first, second = evaluations
        return Response(values, (first, second), np.stack(rows) if complete else None)


def _slopes(evaluator: Evaluator, one: Evaluation, values) -> NDArray[np.float64]:
    """Differentiate log mean and log peak force with respect to the log quantities, (2, p)."""
    design, state = design_vector(evaluator.config), jnp.asarray(one.state)
    orbit = _orbit(evaluator.scene, design, jnp.asarray(values), state)
    mean, _, peak = np.asarray(orbit.response)
    by_mean, _, by_peak = np.asarray(orbit.sensitivity)
    return np.stack([by_mean / mean, by_peak / peak]) * values


def pair_of(model: Scene, design, values: Float[Array, " p"]) -> RotorPair:
    """Return the rotor pair of a `design` with `values` (p,) of the quantities (config units)."""
    length, torque, stiffness, damping_ratio, backlash, clearance = values
    half = backlash * MM / (2 * model.pitch_radius)
    gear = eqx.tree_at(lambda g: (g.stiffness, g.half_backlash), model.gear, (stiffness, half))
    tuned = dataclasses.replace(
        model,
        length=length * MM,
        load_torque=torque,
        gear=gear,
        gear_damping_ratio=damping_ratio,
        clearance=clearance * MM,
    )
    return tuned.pair(design)


@CachedFunction
def _orbit(model: Scene, design, values: Float[Array, " p"], state) -> Orbit:
    """Close the orbit, with derivatives with respect to the values."""

    def arrays(values):
        return eqx.filter(pair_of(model, design, values), eqx.is_inexact_array)

    push = functools.partial(jax.jvp, arrays, (values,))
    tangents = jax.vmap(lambda direction: push((direction,))[1])(jnp.eye(values.shape[0]))
    pair, solver = pair_of(model, design, values), model.solver
    start = Start.at(pair, pair.in_si(state), solver.max_orbit)
    return steady_motion(pair, tangents, start, model.pitch_radius, solver).orbit


def polished(
    pairs: Pairs,
    values: ArrayLike,
    held: Sequence[int] = (),
    within: float = 1e-4,
    steps: int = 12,
    target: NDArray[np.float64] = PAPER,
) -> Response:
    """Solve for the values nearest to `values` (p,) that give the `target` forces (2, 2) in N.

    `held`: indices of quantities that do not change. The method is Gauss-Newton steps of minimum
    length in the logarithms. A step is halved until the misfit falls and both motions, from rest,
    stay periodic. The search ends when the misfit is below `within` or cannot be lowered. Returns
    the best response found, inside the plausible ranges.
    """
    free = [i for i in range(len(QUANTITIES)) if i not in held]
    low, high = (np.log([getattr(q, end) for q in QUANTITIES]) for end in ("low", "high"))
    best = pairs(values)
    for _ in range(steps):
        if best.slopes is None or best.misfit <= within:
            break
        wanted = np.log(target / best.forces).ravel()
        place = np.log(best.values)
        step = _least_step(best.slopes.reshape(4, -1), wanted, free)
        # Keep a quantity at an end of its range if the step would leave the range.
        inside = [i for i in free if low[i] < place[i] + step[i] * 1e-3 < high[i]]
        step = _least_step(best.slopes.reshape(4, -1), wanted, inside)
        step *= min(1.0, _NEAR / max(np.max(np.abs(step)), 1e-12))
        for _ in range(5):
            at = np.clip(place + step, low, high)
            tried = pairs(np.exp(at))
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
    low, high = ([getattr(q, end) for q in QUANTITIES] for end in ("low", "high"))
    return np.clip(values * np.exp(step), low, high)


def _least_step(slopes, wanted, free: Sequence[int]) -> NDArray[np.float64]:
    """Return the shortest step (p,) of `free` quantities that changes the forces as `wanted`."""
    step = np.zeros(slopes.shape[1])
    step[list(free)] = np.linalg.pinv(slopes[:, list(free)], rcond=1e-3) @ wanted
    return step
