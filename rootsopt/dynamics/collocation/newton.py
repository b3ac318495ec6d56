"""One step of Newton's method for an orbit and the times of its events.

The sequence of the events stays the same."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float

from rootsopt.dynamics.collocation.elements import GAUSS, Elements, in_blocks
from rootsopt.dynamics.collocation.equation import CollocatedEquation, Points
from rootsopt.dynamics.collocation.peak import Rivals
from rootsopt.dynamics.collocation.system import Columns, Lines, Step, own_column
from rootsopt.dynamics.pair import RotorPair
from rootsopt.runtime.kept import kept

# Greatest fraction of an interval's length by which one step may shorten the interval.
_ROOM = 0.7
# Change of a state (scaled) above which a Newton step is shortened.
_LONGEST = 1.0
# Step (scaled) below which Newton's method also stops if the step exceeds the second number times
# the step before. The steps then only follow rounding.
_STALLED = 1e-7, 0.5


def evaluated(
    equation: CollocatedEquation,
    at: Float[Array, " m"],
    elements: Elements,
    rivals: Rivals,
    tangents: Any,
    whole: Bool[Array, ""],
) -> tuple[Points, Float[Array, "e p r d"]]:
    """Return the equation along `elements`, and its derivatives along d directions.

    It is evaluated at the s Gauss points and the end of each element (p = s + 1), and at the
    instants `rivals`, on the element after the last one in use. `at` (m,): `numbers` of the pair,
    in place of those of the equation's pair; `tangents`: directions of the
    pair's parameters, stacked along a leading axis; `whole`: whether derivatives along them are
    needed. Otherwise they have no meaning. The arrays of the mesh must have room for one more
    element."""
    mesh, extra = elements.mesh, elements.mesh.used
    tau, state = (
        x.at[extra].set(y) for x, y in zip(elements.places, rivals.places(elements), strict=True)
    )
    roots = elements.roots.at[extra].set(rivals.roots)
    which = jnp.maximum(mesh.which[mesh.interval + 1], 0)

    def points(tau, state, roots, which):
        own = with_numbers(equation, at)
        return own.along(tau, state, roots, which, tangents, whole)

    return in_blocks(points, extra + 1, tau, state, roots, which)


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


def columns_of(elements: Elements, found: Lines, direct: Float[Array, "e p r k"]) -> Columns:
    """Return the right-hand sides of Newton's step, followed by those of k further directions.

    `found`: linearised equation; `direct`: derivatives of the equation's values along the
    directions, at constant motion."""
    count, inside = elements.state.shape[1], len(GAUSS.nodes)
    own = own_column(elements, found)
    return Columns(
        slope=jnp.concatenate([own.slope, direct[:, :inside, :count]], axis=-1),
        gap=jnp.pad(own.gap, ((0, 0), (0, 0), (0, direct.shape[-1]))),
        margin=jnp.concatenate([own.margin, direct[:, inside, -1]], axis=-1),
    )


def between(
    pair: RotorPair, neighbour: Float[Array, " m"], way: Float[Array, ""]
) -> Float[Array, " m"]:
    """Return the `numbers` of a pair between a neighbour (`way` = 0) and `pair` (1).

    `neighbour` (m,): `numbers` of the neighbour."""
    own = numbers(pair)
    return kept(jnp.where(way == 1, own, neighbour + way * (own - neighbour)))


def numbers(pair: Any) -> Float[Array, " m"]:
    """Return all floating-point numbers of a `pair` as one vector.

    XLA compiles a loop of its own for each array that it chooses, copies or mixes."""
    return ravel_pytree(eqx.filter(pair, eqx.is_inexact_array))[0]


def with_numbers(equation: CollocatedEquation, found: Float[Array, " m"]) -> CollocatedEquation:
    """Return `equation` with a pair of the same kind, given by its `numbers`."""
    own, rest = eqx.partition(equation.pair, eqx.is_inexact_array)
    pair = eqx.combine(ravel_pytree(own)[1](found), rest)
    return eqx.tree_at(lambda e: e.pair, equation, pair)


def has_stalled(size: Float[Array, ""], before: Float[Array, ""]) -> Bool[Array, ""]:
    """Return whether Newton's steps only follow rounding.

    `size`, `before`: size of the last step and of the one before (scaled)."""
    return (size < _STALLED[0]) & (size > _STALLED[1] * before)


def advanced(
    elements: Elements, step: Step, roots: Float[Array, "e p flanks 2"]
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
