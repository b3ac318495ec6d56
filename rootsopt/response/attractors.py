"""Coexisting stable motions (attractors), and which initial states lead to them (basins).

Quiet and noisy motions of a Roots pair can exist side by side (Mason, Homer, Wilson, J. Sound
Vib. 308 (2007) 431-440). A grid of initial states (ε, dε/dt) is simulated until each has settled.
States that end on the same cycle are grouped, and each cycle is closed and reported once.
"""

import dataclasses
from collections.abc import Callable, Iterable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import NDArray

from rootsopt.config.reading import Config
from rootsopt.config.units import MM
from rootsopt.dynamics.flow import strobe
from rootsopt.dynamics.integrator import Integrator
from rootsopt.dynamics.pair import RotorPair
from rootsopt.dynamics.steady import transient_status
from rootsopt.dynamics.window import BLOCK, Transient, settle, settled_within
from rootsopt.response.evaluation import Evaluator, Motions
from rootsopt.response.records import message_of
from rootsopt.response.reducers import mean
from rootsopt.response.result import Evaluation
from rootsopt.response.terms import objective_weights
from rootsopt.runtime.programs import CachedFunction
from rootsopt.runtime.threads import on_all_cores
from rootsopt.scene.reading import design_vector
from rootsopt.status import Status

# Maximum length of a cycle (mesh periods) that the search recognises, unless the equation repeats
# only after several mesh periods (`RotorPair.whole`).
_LONGEST = 8
# Scaled distance above which two motions always count as different.
_APART = 0.3
# Maximum number of motions that are evaluated, in addition to the motion from rest.
_TRIES = 24
# Penetration of the flanks (multiples of the static penetration) up to which the grid extends.
_DEPTHS = 3.0
# Statuses of motions that do not count as attractors: there is no such pair, the mesh was lost, or
# the simulation failed.
_LOST = (
    *(Status.UNSOUND, Status.PASSED_THROUGH, Status.STALLED),
    *(Status.SOLVER_FAILED, Status.NON_FINITE),
)
_GONE = {status.code: status.label for status in _LOST}


@dataclasses.dataclass(frozen=True)
class Attractor:
    """One of several coexisting motions.

    `evaluation` of the motion; `share` of the grid's initial states that lead to this motion;
    `reached`: whether the start from rest leads to this motion; `cycle` (k, n): stroboscopic states
    of the motion, scaled, once each time the equation repeats.
    """

    evaluation: Evaluation
    share: float
    reached: bool
    cycle: NDArray[np.float64]


@dataclasses.dataclass(frozen=True)
class Basins:
    """The motions to which a grid of initial states leads.

    `relative` (rad) and `rate` (rad/s): axes of the grid; `leads_to` (rates, relatives): index of
    the attractor for each initial state, or -1 if it leads to none; `attractors`: closed orbits
    first, then chaotic or unsettled motions (see their status), each kind in order of decreasing
    share; `rest`: evaluation from rest; `lost`: shares of initial states that lead to no attractor,
    keyed by status label; `angle_scale` (rad), `mesh_period` (s): units of scaled states. In
    `lost`, the label `not_settled` is for motions that could not be assigned to an attractor.
    """

    relative: NDArray[np.float64]
    rate: NDArray[np.float64]
    leads_to: NDArray[np.int64]
    attractors: tuple[Attractor, ...]
    rest: Evaluation
    lost: dict[str, float]
    angle_scale: float
    mesh_period: float

    @property
    def status(self) -> Status:
        """PERIODIC if every initial state leads to a stable periodic motion, IDLE if no flank
        touches in any of these motions. Otherwise, the status of a motion that is neither."""
        motions = [attractor.evaluation for attractor in self.attractors]
        failures = [status for status in _LOST if self.lost.get(status.label)]
        failures += [one.status for one in motions if not closed(one)]
        failures += [Status.NOT_SETTLED] if any(self.lost.values()) else []
        apart = all(one.status is Status.IDLE for one in motions)
        return [*failures, Status.IDLE if apart and motions else Status.PERIODIC][0]

    def records(self) -> list[dict[str, Any]]:
        """Return one record per attractor for the result file."""
        return [
            {"share": one.share, "reached": one.reached} | one.evaluation.record()
            for one in self.attractors
        ]

    def summary(self) -> list[dict[str, Any]]:
        """Return one table row per attractor."""
        return [
            {
                "share": one.share,
                "reached": one.reached,
                "status": one.evaluation.status.label,
                "period": one.evaluation.steady_state.get("period"),
                "floquet_multiplier": one.evaluation.steady_state.get("floquet_multiplier"),
                "mean_force_N": one.evaluation.response.get("mean_force_N"),
                "peak_force_N": one.evaluation.response.get("peak_force_N"),
            }
            for one in self.attractors
        ]


def find(
    evaluator: Evaluator,
    design: Float[Array, " d"] | None = None,
    known: Iterable[NDArray[np.float64]] = (),
    series: bool = False,
) -> Basins:
    """Find the attractors of `design` (config units; default: the config's own) and their basins.

    The config's `attractors` section sets the grid. `known`: further initial states (n,), scaled,
    on motions of a neighbouring design, whose basins the grid may miss. `evaluator` evaluates each
    attractor; `series`: whether to compute the series of each attractor.
    """
    config = evaluator.config
    design = design_vector(config) if design is None else jnp.asarray(design)
    rest = evaluator.reached(design, None, series)
    pair = evaluator.pair(design)
    scale, period = float(pair.angle_scale), float(pair.mesh_period)
    relative, rate = _axes(config, pair)
    grid = np.stack(np.meshgrid(relative / scale, rate * period / scale), axis=-1).reshape(-1, 2)
    grid = pair.at_start(grid)
    starts = np.concatenate([grid, *(np.atleast_2d(state) for state in known)])
    ends, failures = _settled(evaluator, pair, starts)
    sorter = _Sorter(evaluator, design, series)
    sorter.add(rest, np.zeros(grid.shape[1]))
    for k in range(len(starts)):
        sorter.place(jax.tree.map(lambda x, k=k: x[k], ends), int(failures[k]))
    numbers = np.asarray(sorter.numbers[: len(grid)])
    shares = np.bincount(numbers[numbers >= 0], minlength=len(sorter.evaluations)) / len(grid)
    kept = [i for i, one in enumerate(sorter.evaluations) if one.status not in _LOST]
    kept.sort(key=lambda i: (not sorter.periodic(i), -shares[i]))
    attractors = tuple(
        Attractor(sorter.evaluations[i], float(shares[i]), i == 0, sorter.cycles[i]) for i in kept
    )
    rank = np.full(len(shares) + 1, -1)
    rank[kept] = np.arange(len(kept))
    lost = [label for label, number in zip(sorter.lost, numbers, strict=False) if number < 0]
    return Basins(
        relative=relative,
        rate=rate,
        leads_to=rank[numbers].reshape(len(rate), len(relative)),
        attractors=attractors,
        rest=rest,
        lost={label: lost.count(label) / len(grid) for label in dict.fromkeys(lost)},
        angle_scale=scale,
        mesh_period=period,
    )


def closed(evaluation: Evaluation) -> bool:
    """Return whether the motion is a closed orbit, with contact or without (`idle`)."""
    return evaluation.usable and evaluation.state is not None


class _Sorter:
    """Assigns each transient to the motion that it has led to.

    `evaluations` and `cycles`: the known motions and their stroboscopic states; `numbers`: for each
    transient the index of its motion, or -1 after a failure; `lost`: for each transient the label
    of its failure, or "".
    """

    def __init__(self, evaluator: Evaluator, design, series: bool):
        self.evaluator, self.design, self.series = evaluator, design, series
        self.evaluations: list[Evaluation] = []
        self.cycles: list[NDArray[np.float64]] = []
        self.numbers: list[int] = []
        self.lost: list[str] = []
        self.tries = 0

    def periodic(self, number: int) -> bool:
        return closed(self.evaluations[number])

    def add(self, evaluation: Evaluation, end) -> int:
        """Return the number of an evaluated motion; add the motion to the list if it is new.

        `end` (n,): scaled state from which the evaluation began."""
        cycle = np.atleast_2d(end)
        if closed(evaluation):
            pair = self.evaluator.pair(self.design)
            states = _cycle(pair, evaluation.state, self.evaluator.scene.solver.orbit)
            cycle = np.asarray(states)[: evaluation.steady_state["period"] : pair.repeats]
            number = self._same(cycle[0])
        else:
            number = self._like(evaluation.status)
        if number is not None:
            return number
        self.evaluations.append(evaluation)
        self.cycles.append(cycle)
        return len(self.evaluations) - 1

    def place(self, end: Transient, failure: int) -> None:
        """Record the motion that a transient has led to; `failure`: its `transient_status`."""
        number, label = (-1, _GONE[failure]) if failure in _GONE else self._motion(end)
        self.numbers.append(number)
        self.lost.append(label)

    def _motion(self, end: Transient) -> tuple[int, str]:
        settled = int(end.period) > 0
        number = self._same(end.state) if settled else self._like(Status.CHAOTIC)
        if number is None and self.tries < _TRIES:
            self.tries += 1
            state = np.asarray(end.state, np.float64)
            evaluation = self.evaluator.reached(self.design, state, self.series)
            number = self.add(evaluation, state)
        if number is None:
            return -1, Status.NOT_SETTLED.label
        status = self.evaluations[number].status
        return (-1, status.label) if status in _LOST else (number, "")

    def _same(self, state) -> int | None:
        """Return the number of the known cycle that contains `state` (scaled), or None.

        States are compared to within the accuracy of a transient."""
        tolerance = float(settled_within(self.evaluator.scene.solver.transient.rtol))
        best, number = np.inf, None
        for i in filter(self.periodic, range(len(self.evaluations))):
            memory = 1 - self.evaluations[i].steady_state["floquet_multiplier"]
            near = min(max(10 * tolerance / max(memory, 1e-3), 0.02), _APART)
            distance = np.min(np.max(np.abs(self.cycles[i] - state), axis=1))
            if distance < min(near, best):
                best, number = distance, i
        return number

    def _like(self, status: Status) -> int | None:
        """Return the number of the known non-periodic motion with this `status`, or None."""
        alike = (i for i, one in enumerate(self.evaluations) if one.status is status)
        return next((i for i in alike if not self.periodic(i)), None)


def _axes(config: Config, pair: RotorPair) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the axes of the grid: the initial ε (rad) and dε/dt (rad/s).

    ε covers the clearance and the backlash, and `_DEPTHS` static penetrations beyond.
    |dε/dt| ranges up to twice the greater of two speeds. The first is the speed that the load
    causes across the range of ε. The second is the speed that crosses this range within a mesh
    period."""
    wanted = config.attractors
    radius = config.profile.pitch_radius_mm * MM
    load = max(float(pair.load.torque), 1e-3)
    depth = float(pair.law.depth_at(jnp.asarray(load / radius)))
    play = (float(pair.clearance) + _DEPTHS * depth) / radius
    if pair.gear is not None:
        play += float(pair.gear.half_backlash)
    fall = np.sqrt(4 * play * load / float(pair.inertia))
    most = 2 * max(fall, 2 * play / float(pair.mesh_period))
    return _spread(play, wanted.relatives), _spread(most, wanted.rates)


def _spread(most: float, count: int) -> NDArray[np.float64]:
    """Return `count` equidistant numbers from -`most` to `most`; 0 if `count` is 1."""
    return np.linspace(-most, most, count) if count > 1 else np.zeros(1)


def _settled(evaluator: Evaluator, pair: RotorPair, starts) -> tuple[Transient, Any]:
    """Return the ends of the transients from m scaled states, and their `transient_status`.

    `starts` (m, n): scaled states. Both results have a leading axis (m,)."""
    integrator = evaluator.scene.solver.transient
    dtype = pair.angle_scale.dtype
    limit = np.asarray(max(evaluator.config.solver.max_mesh_periods // 4, 8 * BLOCK))
    tolerance = np.asarray(settled_within(integrator.rtol), dtype)
    most = evaluator.scene.solver.max_orbit
    states = np.asarray(starts, dtype)
    settings = integrator, tolerance, limit, most
    if jax.default_backend() == "cpu":
        ends = on_all_cores(lambda part: _in_turn(pair, part, *settings), states)
    else:
        ends = _together(pair, states, *settings)
    return jax.device_get(ends)


def _end(pair, state, integrator, tolerance, limit, most):
    limit = jnp.where(pair.sound, limit, 0)
    end = settle(pair, state, integrator, tolerance, limit, most)
    return end, transient_status(pair, end)


@CachedFunction
def _in_turn(pair, states, *settings):
    return jax.lax.map(lambda state: _end(pair, state, *settings), states)


@CachedFunction
def _together(pair, states, *settings):
    return jax.vmap(lambda state: _end(pair, state, *settings))(states)


@CachedFunction
def _cycle(pair: RotorPair, state, integrator: Integrator):
    """Return the scaled states (k, n) at the starts of successive mesh periods, from `state` on, as
    many as the longest cycle has."""
    count = pair.whole(_LONGEST) - 1
    return jnp.concatenate([state[None], strobe(pair, state, count, integrator).states])


@dataclasses.dataclass(frozen=True)
class Coexisting(Motions):
    """All coexisting motions of a design.

    With `objective.motion: worst`, the result describes the motion with the greatest weighted sum
    of the objective's measures. Each measure is relative to the evaluator's reference: a response,
    usually the baseline's. The default reference is the greatest value among the motions.

    With `objective.motion: weighted`, response and gradient are averages, weighted by the shares of
    initial states. The gradient treats these shares as constant. A motion without contact
    contributes force 0 and gradient 0.

    If an initial state leads to a motion that is not stable and periodic, the evaluation has the
    status of that motion, and no gradient.
    """

    def evaluated(self, evaluator: Evaluator, design: Any, start: Any, series: bool) -> Evaluation:
        """Evaluate a design. `start` (m, n): scaled states on motions of a neighbouring design."""
        known = () if start is None else tuple(np.atleast_2d(start))
        return _of(evaluator, find(evaluator, design, known, series))


def _of(evaluator: Evaluator, basins: Basins) -> Evaluation:
    orbits = [a for a in basins.attractors if closed(a.evaluation)]
    if not orbits:
        return basins.rest
    chosen = max(orbits, key=_badness(evaluator, orbits)).evaluation
    rivals = tuple(a.evaluation for a in orbits if a.evaluation is not chosen)
    if evaluator.config.objective.motion == "weighted":
        shares = [a.share for a in orbits]
        # On a coarse grid, the `known` states may be the only ones that lead to an orbit.
        chosen, rivals = mean(chosen, [a.evaluation for a in orbits], shares), ()
    status = basins.status
    return dataclasses.replace(
        chosen,
        rivals=rivals,
        gradient=chosen.gradient if status.usable else {},
        steady_state=chosen.steady_state | {"attractors": basins.summary()},
        status=status,
        message=message_of(evaluator.config, status),
        start=np.stack([np.asarray(a.evaluation.state) for a in orbits]),
    )


def _badness(evaluator: Evaluator, attractors: list[Attractor]) -> Callable[[Attractor], float]:
    weights = objective_weights(evaluator.config)
    responses = [a.evaluation.response for a in attractors]
    greatest = {k: max(r[k] for r in responses) for k in weights}
    (reference,) = evaluator.references or (greatest,)

    def badness(attractor: Attractor) -> float:
        response = attractor.evaluation.response
        # Skip a measure that is 0 in the reference. If the reference is the baseline's,
        # `Problem.of` has rejected it.
        return sum(w * response[k] / reference[k] for k, w in weights.items() if reference[k] > 0)

    return badness
