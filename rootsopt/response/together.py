"""Evaluate many scenes at once as arrays, where that is faster than one after the other.

On an accelerator, the motions of all scenes of one structure are computed together (`vmap`). On a
CPU, all motions would then take as many iterations as the longest one, and all branches that any of
them takes.

The motions of one design from different initial states are computed in the same way, and averaged.
"""

import functools
import os
import time
from collections.abc import Hashable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float
from numpy.typing import NDArray

from rootsopt.dynamics.closed import examined
from rootsopt.dynamics.flow import one_period, strobe
from rootsopt.dynamics.integrator import Integrator
from rootsopt.dynamics.pair import RotorPair
from rootsopt.dynamics.steady import Steady
from rootsopt.response.evaluation import Evaluator, build, motion_from
from rootsopt.response.result import Evaluation, begun
from rootsopt.runtime.programs import CachedFunction
from rootsopt.scene.reading import design_vector
from rootsopt.scene.space import sobol
from rootsopt.status import Status


def pays() -> bool:
    """Return whether this device evaluates many scenes faster together than one after the other."""
    return jax.default_backend() != "cpu"


def evaluate_together(evaluators: Sequence[Evaluator]) -> list[Evaluation]:
    """Evaluate the own design of each evaluator's config from rest, without series.

    Scenes of the same structure (parts, number of lobes, solver) are computed together."""
    began = time.perf_counter()
    built = [build(one.scene, design_vector(one.config)) for one in evaluators]
    groups: dict[Hashable, list[int]] = {}
    inputs = []
    for number, (one, (pair, tangents, _)) in enumerate(zip(evaluators, built, strict=True)):
        solver = one.solver
        begin = begun(pair, None, solver.max_orbit)
        arguments = pair, tangents, begin, one.scene.pitch_radius, solver
        arrays, others = eqx.partition(arguments, eqx.is_array)
        inputs.append((arrays, others))
        groups.setdefault(_kind(arrays, others), []).append(number)
    evaluations: dict[int, Evaluation] = {}
    for members in groups.values():
        stacked = jax.tree.map(lambda *x: jnp.stack(x), *(inputs[k][0] for k in members))
        motions: Steady = jax.device_get(_motions(stacked, inputs[members[0]][1]))
        for row, number in enumerate(members):
            motion = jax.tree.map(lambda x, row=row: x[row], motions)
            if not int(motion.window.done):
                motion = motion._replace(window=None)
            one = evaluators[number]
            evaluations[number] = one.evaluation(
                design_vector(one.config), built[number], motion, began, False
            )
    return [evaluations[number] for number in range(len(evaluators))]


def _kind(arrays: Any, others: Any) -> Hashable:
    """Return a key that is equal for scenes that can be stepped together."""
    leaves, tree = jax.tree.flatten(arrays)
    shapes = tuple((x.shape, str(x.dtype)) for x in leaves)
    return tree, shapes, tuple(jax.tree.leaves(others))


@CachedFunction
def _motions(arrays, others) -> Steady:
    def one(arrays):
        pair, tangents, start, radius, solver = eqx.combine(arrays, others)
        motion = motion_from(pair, tangents, start, radius, solver)
        return examined(pair, motion, solver)

    return jax.vmap(one)(arrays)


# Number of members in one call of the compiled program.
_MEMBERS = 4
# Longest period (mesh periods) of a motion that is recognised as repeating.
_LONGEST = 8
# Scaled difference between states below which a motion counts as repeating.
_REPEATS = 1e-2


class Members(NamedTuple):
    """Results of m motions of one design.

    `means` (m, 3): mean force (N), mean square (N²) and mean of the peaks of all mesh periods (N);
    `drift`: mean force in the second half of the window minus that in the first (N); `greatest`:
    greatest force (N); `depth`: greatest penetration (m; negative: least gap); `states` (m, n):
    last scaled states; `repeats` (m, k): whether the last states repeat after each of k periods, 1
    … 8 mesh periods or whole turns (`RotorPair.orders`);
    `lost`, `stalled`: see `RotorPair`; `solved`: whether the solver succeeded."""

    means: Float[Array, "m 3"]
    drift: Float[Array, " m"]
    greatest: Float[Array, " m"]
    depth: Float[Array, " m"]
    states: Float[Array, "m n"]
    repeats: Bool[Array, "m k"]
    lost: Bool[Array, " m"]
    stalled: Bool[Array, " m"]
    solved: Bool[Array, " m"]

    @property
    def status(self) -> Status:
        """AVERAGED if no member has failed, else the status of the failure.

        Failures are checked in this order: the solver failed; the forces are not finite; the motor
        stalled; the lobes passed through each other."""
        failures = {
            Status.SOLVER_FAILED: not np.all(self.solved),
            Status.NON_FINITE: not np.all(np.isfinite(self.means)),
            Status.STALLED: np.any(self.stalled),
            Status.PASSED_THROUGH: np.any(self.lost),
        }
        return next((status for status, met in failures.items() if met), Status.AVERAGED)

    @property
    def responses(self) -> NDArray[np.float64]:
        """Array (3, 2) with rows for mean, peak and RMS force (N): the value, then its standard
        error.

        The standard errors are those of means over independent members. The standard error of the
        RMS is correct to first order.
        """
        values, errors = mean_and_error(np.asarray(self.means, np.float64))
        mean, square, peak = values
        rms = np.sqrt(square)
        by_rms = errors[1] / (2 * rms) if rms > 0 else 0.0
        return np.array([[mean, errors[0]], [peak, errors[2]], [rms, by_rms]])


def mean_and_error(values: NDArray[np.float64]):
    """Return the mean of independent `values` over the first axis, and the mean's standard
    error."""
    spread = np.std(values, axis=0, ddof=1)
    return np.mean(values, axis=0), spread / np.sqrt(len(values))


def initial_states(pair: RotorPair, members: int, seed: int) -> NDArray[np.float64]:
    """Return scaled states (members, n), in which ε and dε/dt are a scrambled Sobol sequence.

    |ε| ranges up to the pair's `angle_scale` (half the backlash plus the static penetration).
    |dε/dt| ranges up to the speed that the load causes across the whole range of ε, or 1 (scaled)
    if that is greater. `seed`: seed of the sequence.
    """
    acceleration = float(pair.load.torque / pair.inertia * pair.mesh_period**2 / pair.angle_scale)
    fastest = max(2 * np.sqrt(acceleration), 1.0)
    play = (2 * sobol(members, seed, 2) - 1) * np.array([1.0, fastest])
    return pair.at_start(play)


def prepare_members(pair: RotorPair, integrator: Integrator) -> None:
    """Compile the program that `run_members` needs for `pair` on CPUs, in the background."""
    states = jax.ShapeDtypeStruct((_MEMBERS, pair.states), pair.angle_scale.dtype)
    count = jax.ShapeDtypeStruct((), int)
    _in_turn.prepare(pair, states, count, count, integrator)


def run_members(
    pairs: Sequence[RotorPair],
    states: NDArray[np.float64] | Float[Array, "m n"],
    settle: int,
    periods: int,
    integrator: Integrator,
) -> list[Members]:
    """Return the `Members` of each of `pairs`, all from the same scaled `states` (m, n).

    `integrator` of the motions; `settle`: mesh periods before the window; `periods`: mesh periods
    of the window. On CPUs one thread per core simulates a few members at a time, so that few
    members wait for a slower one. On other devices all members are stepped together."""
    states = np.asarray(states, pairs[0].angle_scale.dtype)
    counts = np.asarray(settle), np.asarray(periods)
    if jax.default_backend() != "cpu":
        stacked = jax.tree.map(lambda *x: jnp.stack(x), *pairs)
        together = jax.device_get(_together(stacked, states, *counts, integrator))
        return [jax.tree.map(lambda x, i=i: x[i], together) for i in range(len(pairs))]
    # Parts of equal size share a compiled program. The last part is filled with the last member.
    count = len(states)
    parts = -(-count // _MEMBERS)
    rows = np.minimum(np.arange(parts * _MEMBERS), count - 1).reshape(parts, _MEMBERS)

    def part(task):
        pair, rows = task
        return jax.device_get(_in_turn(pair, states[rows], *counts, integrator))

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        done = list(pool.map(part, [(pair, row) for pair in pairs for row in rows]))
    return [
        jax.tree.map(lambda *x: np.concatenate(x)[:count], *done[k : k + parts])
        for k in range(0, len(done), parts)
    ]


def member(
    pair: RotorPair, state: Float[Array, " n"], settle: Any, periods: Any, integrator: Integrator
) -> Members:
    """Simulate one motion from the scaled `state` (n,) and return its result.

    `settle`: mesh periods before the window; `periods`: mesh periods of the window. `integrator` of
    the motion. The fields of the result lack the leading axis of `Members`. This is a pure
    function."""
    dtype = state.dtype
    none, low = jnp.zeros((), dtype), jnp.full((), -jnp.inf, dtype)

    def pass_by(index, carry):
        state, solved = carry
        out = strobe(pair.later(index), state, 1, integrator)
        return out.states[-1], solved & out.solved

    half = periods // 2

    def count(index, carry):
        state, solved, means, drift, greatest, depth, memory = carry
        out = one_period(pair.later(settle).later(index), state, integrator)
        return (
            out.end,
            solved & out.solved,
            means + out.response,
            drift + jnp.sign(2 * index - (periods - 1)) * out.response[0],
            jnp.maximum(greatest, out.response[2]),
            jnp.maximum(depth, out.depth),
            jnp.concatenate([memory[1:], out.end[None]]),
        )

    settled = lax.fori_loop(0, settle, pass_by, (state, jnp.ones((), bool)))
    longest = pair.whole(_LONGEST)
    memory = jnp.full((2 * longest + 1, *state.shape), jnp.inf, dtype)
    start = *settled, jnp.zeros(3, dtype), none, none, low, memory
    end, solved, means, drift, greatest, depth, memory = lax.fori_loop(0, periods, count, start)
    orders = range(pair.repeats, longest + 1, pair.repeats)
    apart = jnp.stack([jnp.max(jnp.abs(memory[k:] - memory[:-k])[-k - 1 :]) for k in orders])
    return Members(
        means=means / periods,
        drift=drift / jnp.maximum(half, 1),
        greatest=greatest,
        depth=depth,
        states=end,
        repeats=apart < _REPEATS,
        lost=pair.lost(end),
        stalled=pair.stalled(end),
        solved=solved,
    )


@CachedFunction
def _in_turn(pair, states, settle, periods, integrator) -> Members:
    return lax.map(lambda state: member(pair, state, settle, periods, integrator), states)


@CachedFunction
def _together(pairs, states, settle, periods, integrator) -> Members:
    run = functools.partial(member, settle=settle, periods=periods, integrator=integrator)
    return jax.vmap(lambda pair: jax.vmap(lambda state: run(pair, state))(states))(pairs)
