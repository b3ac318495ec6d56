"""Derivatives of a motion from the steps a solver has taken.

Once the steps of a motion are known, each step can be linearised independently. Many steps are
therefore linearised together, as arrays. Only the product of the small matrices is sequential. The
result is the derivative of the discrete motion on these steps, exact to rounding: the variational
equation, solved by the same method.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

_CHUNK = 32
"""Number of steps linearised together. A larger number is faster per step, but wastes more work in
the chunk in which the motion ends."""


def one_step(
    solver: diffrax.AbstractERK,
    term: diffrax.ODETerm,
    begin: Float[Array, ""],
    end: Float[Array, ""],
    y: Float[Array, " m"],
    args: Any,
) -> tuple[Float[Array, " m"], Float[Array, "stages m"]]:
    """Take one step of `solver` from `begin` to `end`. Return y at `end`, and dy/dτ at the stages.

    `term`: diffrax term of the equation; `y` (m,): value at `begin`; `args`: arguments for `term`.
    The first stage is at `begin`, the last at `end`."""
    # The same sums as in the solver's own step, without error estimate and special cases: several
    # times cheaper to compile.
    tableau = solver.tableau
    assert isinstance(tableau, diffrax.ButcherTableau)
    stages = int(np.max(np.nonzero(tableau.b_sol))) + 1
    lower = np.zeros((stages + 1, stages))
    for row, entries in enumerate(tableau.a_lower[: stages - 1], start=1):
        lower[row, :row] = entries
    # The end is one more stage, so that the equation is compiled once.
    lower[stages] = tableau.b_sol[:stages]
    times = np.concatenate([[0.0], tableau.c])[:stages]
    lower, times = (jnp.asarray(x, y.dtype) for x in (lower, np.append(times, 1.0)))
    step = end - begin

    def stage(carry, row):
        slopes, *_ = carry
        index, entries, time = row
        inside = y + step * jnp.sum(entries[:, None] * slopes, axis=0)
        slope = term.vf(begin + time * step, inside, args)
        return (slopes.at[index].set(slope, mode="drop"), inside, slope), None

    slopes = jnp.zeros((stages, *y.shape), y.dtype)
    start = slopes, y, slopes[0]
    (slopes, after, slope), _ = lax.scan(stage, start, (jnp.arange(stages + 1), lower, times))
    return after, jnp.concatenate([slopes, slope[None]])


class Linear(NamedTuple):
    """Values with their derivatives.

    `value` (rows,); `by_state` (rows, n): with respect to the n entries of a state;
    `by_parameters` (rows, d): along d directions of the parameters.
    """

    value: Float[Array, " rows"]
    by_state: Float[Array, "rows n"]
    by_parameters: Float[Array, "rows d"]

    def after(self, before: Float[Array, "n columns"]) -> Float[Array, "rows columns"]:
        """Return the derivatives of the values along the n + d columns (chain rule).

        `before` (n, n + d): derivatives of the state along the same columns."""
        # A sum: for matrices this small, calling a matrix product costs more.
        moved = jnp.sum(self.by_state[:, :, None] * before[None], axis=1)
        return moved.at[:, self.by_state.shape[1] :].add(self.by_parameters)


def linearized(
    function: Callable[[Float[Array, " m"], Any], Float[Array, " rows"]],
    y: Float[Array, " m"],
    parameters: Any,
    directions: Any,
    count: int,
) -> Linear:
    """Return the value of `function(y, parameters)` with its derivatives.

    Derivatives are with respect to the first `count` = n entries of y, and along d `directions` of
    the parameters (stacked along a leading axis; d may be 0)."""
    # All directions in one pass, so that common terms are computed once.
    number = jax.tree.leaves(directions)[0].shape[0]
    unit = jnp.eye(count + number, y.shape[0], dtype=y.dtype).at[count:].set(0.0)
    moved = jax.tree.map(
        lambda x: jnp.concatenate([jnp.zeros((count, *x.shape[1:]), x.dtype), x]), directions
    )

    def push(tangent, moved):
        return jax.jvp(function, (y, parameters), (tangent, moved))

    value, slope = jax.vmap(push, out_axes=(None, -1))(unit, moved)
    return Linear(value, slope[..., :count], slope[..., count:])


def propagated(
    linear_step: Callable[[Int[Array, ""], Float[Array, " rows"]], Linear],
    start: Float[Array, "m columns"],
    last: Int[Array, ""],
    branch: Int[Array, ""],
    aside: int,
) -> tuple[Float[Array, "m columns"], Float[Array, "n columns"], Linear]:
    """Return derivatives after a sequence of linearised steps, and after side steps.

    `linear_step(k, there)` linearises step k. Its rows are y, then any further values. y holds the
    n entries of the state, then integrals. No row depends on the integrals. `start` (m, n + d):
    derivatives of y before the first step, along n directions of the initial state and d
    parameters.

    Side steps do not belong to the motion. Side step -1 starts where the step `branch` starts.
    `aside` further side steps, numbered -2, -3 …, start at the end of side step -1. For these, the
    argument `there` holds the rows at the end of side step -1; for all other steps it is zero.

    The result has three members: the derivatives of y (m, n + d) after the step `last`; the
    derivatives of the state (n, n + d) after side step -1; and the linearised side steps -2, -3 …
    (stacked).
    """
    linear_step = jax.jit(linear_step)  # traced once
    shape = jax.eval_shape(linear_step, last, start[:, 0])
    count = shape.by_state.shape[1]

    def advance(carry, step):
        y, held = carry
        k, step = step
        held = jnp.where(k == branch, y, held)
        moved = step.after(y[:count])[: y.shape[0]].at[count:].add(y[count:])
        return (jnp.where((k >= 0) & (k <= last), moved, y), held), None

    # Side step -1 comes first, since the other side steps need its result.
    lanes = jnp.arange(_CHUNK)

    def chunk(carry):
        number, motion, branching, beside = carry
        place = number * _CHUNK + lanes
        known = number > 0
        k = jnp.where(known, place - 1 - aside, place - 1)
        k = jnp.where((number == 1) & (lanes < aside), -2 - lanes, k)
        steps = jax.vmap(linear_step, (0, None))(jnp.minimum(k, last), branching.value)
        motion, _ = lax.scan(advance, motion, (k, steps))

        def kept(place):
            return jax.tree.map(lambda x: x[place], steps)

        def choose(condition, new, old):
            return jax.tree.map(lambda x, y: jnp.where(condition, x, y), new, old)

        branching = choose(known, branching, kept(0))
        beside = choose(number == 1, kept(slice(aside)), beside)
        return number + 1, motion, branching, beside

    nothing = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shape)
    several = jax.tree.map(lambda x: jnp.stack([x] * aside), nothing)
    begin = jnp.zeros((), last.dtype), (start, start), nothing, several
    _, (y, held), branching, beside = lax.while_loop(
        lambda carry: (carry[0] < 2) | (carry[0] * _CHUNK - 1 - aside <= last), chunk, begin
    )
    return y, branching.after(held[:count])[:count], beside
