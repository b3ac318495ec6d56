"""Newton's method for an orbit and the times of its events, whose sequence stays the same."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from rootsopt.dynamics.collocation.blocks import in_blocks
from rootsopt.dynamics.collocation.elements import Elements
from rootsopt.dynamics.collocation.equation import CollocatedEquation, Points
from rootsopt.dynamics.collocation.gauss import GAUSS
from rootsopt.dynamics.collocation.system import (
    Columns,
    Lines,
    Step,
    chained,
    condensed,
    own_column,
)
from rootsopt.dynamics.pair import RotorPair

_TURNS = 16
"""Maximum number of Newton steps."""
_ROOM = 0.7
"""Greatest fraction of an interval's length by which one step may shorten the interval."""
_LONGEST = 1.0
"""Change of a state (scaled) above which a Newton step is shortened."""
_WAY = 1e-3
"""Fraction of the way to the new pair over which the predictor takes its difference."""
_STALLED = 1e-7, 0.5
"""Step (scaled) below which Newton's method also stops if the step exceeds the second number times
the step before. The steps then only follow rounding."""
_TURNED = 0.1
"""Change of a root (rad) above which it is limited to this value."""


class Converged(NamedTuple):
    """Result of Newton's method.

    `elements`: the orbit; `size`: greatest change in the last step, of the states (scaled) and of
    the event times (mesh periods); `stalled`: whether steps no longer shrink because they only
    follow rounding; `turns`: number of steps; `force` (e, s): contact force (N) at the Gauss
    points.
    """

    elements: Elements
    size: Float[Array, ""]
    stalled: Bool[Array, ""]
    turns: Int[Array, ""]
    force: Float[Array, "e s"]


def evaluated(equation: CollocatedEquation, elements: Elements) -> Points:
    """Return the equation at the s Gauss points and the end of each element (p = s + 1)."""
    mesh = elements.mesh
    tau, state = elements.places
    which = jnp.maximum(mesh.which[mesh.interval + 1], 0)

    def points(*places):
        return equation.points(*places)

    return in_blocks(points, mesh.used, tau, state, elements.roots, which)


def lines(elements: Elements, points: Points) -> Lines:
    """Return the linearised equation of `elements`; `points`: result of `evaluated`."""
    count = elements.state.shape[1]
    inside = len(GAUSS.nodes)
    return Lines(
        miss=points.values[:, :inside, :count] - elements.slopes,
        slopes=points.slopes[:, :inside, :count],
        margin=points.values[:, inside, -1],
        bend=points.slopes[:, inside, -1],
    )


def solved_step(elements: Elements, found: Lines, columns: Columns) -> Step:
    """Solve the linearised equation `found` for several right-hand sides (`columns`)."""
    return chained(elements, found, columns, condensed(elements, found, columns))


def newton(
    equation: CollocatedEquation,
    elements: Elements,
    tolerance: Float[Array, ""],
    neighbour: RotorPair,
    predict: Bool[Array, ""],
) -> Converged:
    """Solve for the orbit near `elements`, until the last step is at most `tolerance` (scaled).

    Where rounding keeps steps above the tolerance, the method ends when they no longer shrink.
    `predict`: whether `elements` is an orbit of the similar pair `neighbour`. The first step is
    then along the tangent of the family of orbits that leads to the equation's pair (predictor).
    Newton's first step would be evaluated at penetrations of the wrong size, since the flanks have
    moved. The tangent is Newton's step for a pair a small way (`_WAY`) towards the new one,
    divided by this way."""

    def go_on(now):
        # A size of NaN also ends the loop.
        return (now.turns < _TURNS) & (now.size > tolerance) & ~now.stalled

    def turn(now):
        at = now.elements
        way = jnp.where(predict & (now.turns == 0), _WAY, 1.0)
        points = evaluated(between(equation, neighbour, way), at)
        found = lines(at, points)
        own = jax.tree.map(lambda x: x / way, own_column(at, found))
        roots = at.roots + jnp.clip((points.roots - at.roots) / way, -_TURNED, _TURNED)
        moved, size, _ = advanced(at, solved_step(at, found, own), roots)
        stalled = has_stalled(size, now.size)
        return Converged(moved, size, stalled, now.turns + 1, points.force[:, : len(GAUSS.nodes)])

    force = jnp.zeros(elements.slopes.shape[:2], elements.state.dtype)
    infinite = jnp.full_like(elements.state[0, 0], jnp.inf)
    no = jnp.zeros((), bool)
    start = Converged(elements, infinite, no, jnp.zeros((), int), force)
    return lax.while_loop(go_on, turn, start)


def between(
    equation: CollocatedEquation, neighbour: RotorPair, way: Float[Array, ""]
) -> CollocatedEquation:
    """Return `equation` for a pair between `neighbour` (`way` = 0) and its own pair (1)."""
    new, static = eqx.partition(equation.pair, eqx.is_inexact_array)
    old = eqx.filter(neighbour, eqx.is_inexact_array)
    here = jax.tree.map(lambda x, y: jnp.where(way == 1, x, y + way * (x - y)), new, old)
    return eqx.tree_at(lambda e: e.pair, equation, eqx.combine(here, static))


def has_stalled(size: Float[Array, ""], before: Float[Array, ""]) -> Bool[Array, ""]:
    """Return whether Newton's steps only follow rounding.

    `size`, `before`: size of the last step and of the one before (scaled)."""
    return (size < _STALLED[0]) & (size > _STALLED[1] * before)


def advanced(
    elements: Elements, step: Step, roots: Float[Array, "e p sides 2"]
) -> tuple[Elements, Float[Array, ""], Float[Array, ""]]:
    """Return the elements after a Newton step, the size of the step, and the share taken of it.

    `roots`: new `Elements.roots`. The step is shortened if it would shrink an interval too much. It
    is also shortened if it is too long for the linearised equation."""
    mesh = elements.mesh
    times, states, slopes = step.times[:, 0], step.state[..., 0], step.slopes[..., 0]
    room, change = jnp.diff(mesh.times), jnp.diff(times)
    shrinks = (change < 0) & (room > 0)
    share = jnp.where(shrinks, _ROOM * room / jnp.where(shrinks, -change, 1.0), 1.0)
    largest = jnp.max(jnp.abs(states))
    share = jnp.minimum(jnp.min(share), 1.0)
    share = jnp.minimum(share, _LONGEST / jnp.maximum(largest, _LONGEST))
    moved = Elements(
        mesh._replace(times=mesh.times + share * times),
        elements.state + share * states,
        elements.slopes + share * slopes,
        roots,
    )
    return moved, jnp.maximum(largest, jnp.max(jnp.abs(times))), share
