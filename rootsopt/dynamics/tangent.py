"""Derivatives of a motion from the steps a solver has taken.

Once the steps of a motion are known, each can be linearised apart from the others: many at
a time, as arrays, rather than one after another beside the motion. What is left in
sequence is a product of small matrices. The result is the derivative of the discrete motion
on these steps, exact to rounding (the variational equation under the same method).
"""

from collections.abc import Callable
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

# Steps linearised together: enough to work at vector speed, few enough not to waste much
# where the motion ends inside a chunk.
_CHUNK = 32


def one_step(
    solver: diffrax.AbstractSolver,
    term: diffrax.ODETerm,
    begin: Float[Array, ""],
    end: Float[Array, ""],
    y: Float[Array, " m"],
    args: Any,
) -> Float[Array, " m"]:
    """State after one step of `solver` from `begin` to `end`."""
    if not isinstance(solver, diffrax.AbstractERK):
        memory = solver.init(term, begin, end, y, args)
        return solver.step(term, begin, end, y, args, memory, made_jump=False)[0]
    # The same sums as the solver's own step, without its error estimate and the machinery
    # for everything a step can be: several times cheaper to compile.
    tableau = solver.tableau
    assert isinstance(tableau, diffrax.ButcherTableau)
    stages = int(np.max(np.nonzero(tableau.b_sol))) + 1
    lower = np.zeros((stages, stages))
    for row, entries in enumerate(tableau.a_lower[: stages - 1], start=1):
        lower[row, :row] = entries
    times = np.concatenate([[0.0], tableau.c])[:stages]
    lower, times, weights = (
        jnp.asarray(x, y.dtype) for x in (lower, times, tableau.b_sol[:stages])
    )
    step = end - begin

    def stage(slopes, row):
        index, entries, time = row
        inside = y + step * jnp.sum(entries[:, None] * slopes, axis=0)
        slope = term.vf(begin + time * step, inside, args)
        return slopes.at[index].set(slope), None

    slopes = jnp.zeros((stages, *y.shape), y.dtype)
    slopes, _ = lax.scan(stage, slopes, (jnp.arange(stages), lower, times))
    return y + step * jnp.sum(weights[:, None] * slopes, axis=0)


def linearized(
    function: Callable[[Float[Array, " m"], Any], Float[Array, "*out"]],
    y: Float[Array, " m"],
    parameters: Any,
    directions: Any,
    count: int,
) -> tuple[Float[Array, "*out"], Float[Array, "*out n"], Float[Array, "*out d"]]:
    """Value of `function(y, parameters)` with its derivatives in the first `count` = n
    entries of y and along the `directions` of the parameters (stacked, maybe none)."""
    # All directions in one pass, so that what they share is computed once.
    number = jax.tree.leaves(directions)[0].shape[0]
    unit = jnp.eye(count + number, y.shape[0], dtype=y.dtype).at[count:].set(0.0)
    moved = jax.tree.map(
        lambda x: jnp.concatenate([jnp.zeros((count, *x.shape[1:]), x.dtype), x]), directions
    )

    def push(tangent, moved):
        return jax.jvp(function, (y, parameters), (tangent, moved))

    value, slope = jax.vmap(push, out_axes=(None, -1))(unit, moved)
    return value, slope[..., :count], slope[..., count:]


def propagated(
    linear_step: Callable[
        [Int[Array, ""]],
        tuple[Float[Array, " m"], Float[Array, "m n"], Float[Array, "m d"]],
    ],
    start: Float[Array, "m columns"],
    last: Int[Array, ""],
    branch: Int[Array, ""],
) -> tuple[Float[Array, "m columns"], Float[Array, " m"], Float[Array, "m columns"]]:
    """Derivatives of y along the n unit directions of the initial state and d parameters:
    after the step `last`, and with the value itself after the step last + 1, which does
    not go on from there but branches off before the step `branch`.

    `linear_step(k)` gives the state after step k and its derivatives in the n first entries
    before it, and along the parameters; the other entries are integrals that feed back on
    nothing. `start`: derivatives before the first step.
    """
    shapes = jax.eval_shape(linear_step, last)
    count = shapes[1].shape[1]

    def advance(carry, step):
        y, held, value, aside = carry
        k, reached, by_state, by_parameters = step
        held = jnp.where(k == branch, y, held)
        before = jnp.where(k > last, held, y)
        # Written as a sum: a matrix product this small costs more in its call.
        moved = jnp.sum(by_state[:, :, None] * before[None, :count, :], axis=1)
        moved = moved.at[count:].add(before[count:]).at[:, count:].add(by_parameters)
        y = jnp.where(k <= last, moved, y)
        branched = k == last + 1
        value, aside = jnp.where(branched, reached, value), jnp.where(branched, moved, aside)
        return (y, held, value, aside), None

    def chunk(carry):
        first, *carried = carry
        k = first + jnp.arange(_CHUNK)
        steps = jax.vmap(linear_step)(jnp.minimum(k, last + 1))
        carried, _ = lax.scan(advance, tuple(carried), (k, *steps))
        return first + _CHUNK, *carried

    nothing = jnp.zeros(shapes[0].shape, shapes[0].dtype)
    begin = jnp.zeros((), last.dtype), start, start, nothing, start
    _, y, _, value, aside = lax.while_loop(lambda carry: carry[0] <= last + 1, chunk, begin)
    return y, value, aside
