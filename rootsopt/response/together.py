"""Evaluate many scenes at once as arrays, where that is faster than one after the other.

On an accelerator, the motions of all scenes of one structure are computed together (`vmap`). On a
CPU they would then take as many iterations as the longest, and all branches that one of them takes.
"""

import time
from collections.abc import Hashable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from rootsopt.dynamics.closed import examined
from rootsopt.dynamics.steady import Steady
from rootsopt.response.evaluation import Evaluation, Evaluator, motion_from
from rootsopt.response.starts import begun
from rootsopt.runtime.programs import CachedFunction


def pays() -> bool:
    """Return whether this device evaluates many scenes faster together than one after the other."""
    return jax.default_backend() != "cpu"


def evaluate_together(evaluators: Sequence[Evaluator]) -> list[Evaluation]:
    """Evaluate the own design of each evaluator's config from rest, without series.

    Scenes of the same structure (parts, number of lobes, solver) are computed together."""
    began = time.perf_counter()
    built = [one.assembled() for one in evaluators]
    groups: dict[Hashable, list[int]] = {}
    inputs = []
    for number, (one, (pair, tangents, _)) in enumerate(zip(evaluators, built, strict=True)):
        solver = one.solver
        begin = begun(pair, None, solver.max_orbit)
        arguments = pair, tangents, begin, one.scene.pitch_radius, solver
        arrays, others = eqx.partition(arguments, eqx.is_array)
        inputs.append((arrays, others))
        groups.setdefault(_kind(arrays, others), []).append(number)
    found: dict[int, Evaluation] = {}
    for members in groups.values():
        stacked = jax.tree.map(lambda *x: jnp.stack(x), *(inputs[k][0] for k in members))
        motions: Steady = jax.device_get(_motions(stacked, inputs[members[0]][1]))
        for row, number in enumerate(members):
            motion = jax.tree.map(lambda x, row=row: x[row], motions)
            if not int(motion.window.done):
                motion = motion._replace(window=None)
            found[number] = evaluators[number].evaluation(built[number], motion, began)
    return [found[number] for number in range(len(evaluators))]


def _kind(arrays: Any, others: Any) -> Hashable:
    """Return a key that is equal for scenes that can be stepped together."""
    leaves, tree = jax.tree.flatten(arrays)
    shapes = tuple((x.shape, str(x.dtype)) for x in leaves)
    return tree, shapes, tuple(jax.tree.leaves(others))


@CachedFunction
def _motions(arrays, others) -> Steady:
    def one(arrays):
        pair, tangents, start, radius, solver = eqx.combine(arrays, others)
        found = motion_from(pair, tangents, start, radius, solver)
        return examined(pair, found, solver)

    return jax.vmap(one)(arrays)
