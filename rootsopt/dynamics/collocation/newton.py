"""One step of Newton's method for an orbit and the times of its events.

The sequence of the events stays the same. The last step yields the forces of the closed orbit, its
monodromy matrix, and the derivatives of the forces. Those with respect to parameters solve the same
linear equations as Newton's step. The right-hand sides are the derivatives of the equation and of
the margins. Events move with the parameters, and elements move with the events. Therefore no kink
or jump crosses a Gauss point."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int

from rootsopt.dynamics.collocation.elements import GAUSS, POINTS, Elements, in_blocks, summed
from rootsopt.dynamics.collocation.equation import CollocatedEquation, Points
from rootsopt.dynamics.collocation.peak import Peak, Rivals
from rootsopt.dynamics.collocation.system import Columns, Lines, Step, moved_at, moved_places
from rootsopt.dynamics.linear import spectral_radius
from rootsopt.dynamics.orbit import Orbit

# Greatest fraction of an interval's length by which one step may shorten the interval.
_ROOM = 0.7
# Change of a state (scaled) above which a Newton step is shortened.
_LONGEST = 1.0


def evaluated(
    equation: CollocatedEquation,
    at: Float[Array, " m"],
    elements: Elements,
    rivals: Rivals,
    tangents: Any,
    whole: Bool[Array, ""],
) -> tuple[Points, Float[Array, "e p r d"]]:
    """Return the equation along `elements`, and its derivatives along d directions.

    It is evaluated at the s Gauss points and the end of each element (p = s + 1). The instants
    `rivals` are evaluated too, as those of the element after the last one in use. `at` (m,):
    `numbers` of the pair, in place of those of the equation's pair; `tangents`: directions of the
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
    return Lines(
        miss=points.values[:, :POINTS, :count] - elements.slopes,
        slopes=points.slopes[:, :POINTS, :count],
        margin=points.values[:, POINTS, -1],
        bend=points.slopes[:, POINTS, -1],
    )


def columns_of(elements: Elements, linearised: Lines, direct: Float[Array, "e p r k"]) -> Columns:
    """Return the right-hand sides of Newton's step, followed by those of k further directions.

    `linearised`: linearised equation; `direct`: derivatives of the equation's values along the
    directions, at constant motion."""
    count = elements.state.shape[1]
    rise = GAUSS.whole(elements.slopes)
    reached = elements.state + elements.mesh.lengths[:, None] * rise
    gap = (reached - elements.following)[..., None]
    return Columns(
        slope=jnp.concatenate([linearised.miss[..., None], direct[:, :POINTS, :count]], axis=-1),
        gap=jnp.pad(gap, ((0, 0), (0, 0), (0, direct.shape[-1]))),
        margin=jnp.concatenate([linearised.margin[:, None], direct[:, POINTS, -1]], axis=-1),
    )


def numbers(pair: Any) -> Float[Array, " m"]:
    """Return all floating-point numbers of a `pair` as one vector.

    XLA compiles a separate loop for each array that it selects, copies or mixes."""
    return ravel_pytree(eqx.filter(pair, eqx.is_inexact_array))[0]


def with_numbers(equation: CollocatedEquation, vector: Float[Array, " m"]) -> CollocatedEquation:
    """Return `equation` with a pair of the same kind, given by its `numbers`."""
    own, rest = eqx.partition(equation.pair, eqx.is_inexact_array)
    pair = eqx.combine(ravel_pytree(own)[1](vector), rest)
    return eqx.tree_at(lambda e: e.pair, equation, pair)


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


# Distance (fraction of an element's length) between two instants below which they count as one.
_COINCIDE = 1e-6


def forces_of(
    equation: CollocatedEquation,
    elements: Elements,
    peak: Peak,
    evaluated: tuple[Points, Float[Array, "e p r k"]],
    step: Step,
    corrected: Elements,
) -> Orbit:
    """Return the closed orbit of the motion `elements`, with its forces and their derivatives.

    `peak`: result of `peak_of`; `evaluated`: equation along the orbit (`newton.evaluated`), and
    direct changes of its values in the columns of `step`; `step`: a last correction of the motion,
    followed by its changes along directions of the parameters; `corrected`: the orbit after the
    correction."""
    points, direct = evaluated
    change = _changes(elements, points, direct, step)
    raw, changes = _averages(equation, elements, points, change, step)
    unit = lax.stop_gradient(equation.pair.force_scale)
    averages, factors = equation.measures.values(raw, unit)
    by_averages = changes * factors[:, None]
    by_height = unit * _by_height(equation, elements, peak, (points, direct, change), step)
    values = jnp.concatenate([averages[:2], unit * peak.force[None], averages[2:]])
    slopes = jnp.concatenate([by_averages[:2], by_height[None], by_averages[2:]])
    variation = None
    if equation.variation:
        columns = (x[..., 1:] for x in (step.state, step.slopes, step.times))
        variation = Step(*columns, monodromy=step.monodromy)
    first = origin(elements)
    return Orbit(
        state=corrected.state[first],
        residual=jnp.max(jnp.abs(step.state[..., 0])),
        monodromy=step.monodromy,
        multiplier=spectral_radius(step.monodromy),
        response=values + slopes[:, 0],
        sensitivity=slopes[:, 1:],
        moved=step.state[first, :, 1:],
        depth=jnp.max(jnp.where(elements.mesh.filled[:, None], points.depth, -jnp.inf)),
        newton_steps=jnp.zeros((), int),
        disagreement=jnp.asarray(jnp.inf),
        variation=variation,
    )


def _changes(elements: Elements, points: Points, direct, step: Step) -> Float[Array, "e s r k"]:
    """Return the changes of the equation's values at the Gauss points, which move with the orbit,
    in all columns of `step`; `direct`: changes at constant motion."""
    times, states = moved_places(elements, step)
    moves = [times, *jnp.moveaxis(states, 2, 0)]
    bend = points.slopes[:, :POINTS]
    change = summed(bend[..., k, None] * move[:, :, None] for k, move in enumerate(moves))
    return change + direct[:, :POINTS]


def _averages(equation: CollocatedEquation, elements: Elements, points: Points, change, step: Step):
    """Return the averages of the integrands over the orbit, and their changes (averages, columns).

    `points`: equation along the orbit; `change`: its changes at the Gauss points (`_changes`), in
    the columns of `step`."""
    mesh = elements.mesh
    left, right = step.times[mesh.interval], step.times[mesh.interval + 1]
    longer = (mesh.right - mesh.left)[:, None] * (right - left)
    count = elements.state.shape[1]
    rates = slice(count, count + equation.rates)
    part, by_part = GAUSS.whole(points.values[:, :POINTS, rates]), GAUSS.whole(change[:, :, rates])
    used = mesh.filled[:, None]
    total = jnp.sum(jnp.where(used, mesh.lengths[:, None] * part, 0.0), axis=0)
    moved = mesh.lengths[:, None, None] * by_part + part[..., None] * longer[:, None]
    moved = jnp.sum(jnp.where(used[..., None], moved, 0.0), axis=0)
    if not equation.pair.free:
        return total / mesh.period, moved / mesh.period
    duration, kept = total[-1], total[:-1] / total[-1]
    return kept, (moved[:-1] - kept[:, None] * moved[-1]) / duration


def _by_height(equation: CollocatedEquation, elements: Elements, peak: Peak, evaluated, step):
    """Return the changes of the peak force in all columns of `step` (in units of `force_scale`).

    `evaluated`: equation along the orbit with the instants `rivals`, its direct changes, and its
    changes at the Gauss points."""
    points, direct, change = evaluated
    k, share = peak.element, peak.share - peak.shift
    count = elements.state.shape[1]
    first, last = count, count + equation.rates - 1
    value, bend = points.values[peak.place], points.slopes[peak.place]
    time, state = moved_at(elements, step, k, share)
    here = bend[:, :1] * time + bend[:, 1:] @ state + direct[peak.place]
    # The peak may lie slightly off the instant of the evaluation. The changes here and at the Gauss
    # points lie on one polynomial.
    rows = change[k].reshape(POINTS, -1)
    away = share - GAUSS.nodes
    bends = jnp.sum(away / (away**2 + _COINCIDE**2))
    beside = (here.ravel() - GAUSS.lagrange(share) @ rows) * bends
    beside += GAUSS.derivative(share) @ rows
    here += peak.shift * beside.reshape(here.shape)
    if not equation.pair.free:
        return here[first]
    force = value[first] / value[last]
    return (here[first] - force * here[last]) / value[last]


def origin(elements: Elements) -> Int[Array, ""]:
    """Return the index of the element that begins at φ1 = 0."""
    mesh = elements.mesh
    begin = mesh.ends[0]
    away = jnp.abs(begin - mesh.period * jnp.round(begin / mesh.period))
    return jnp.argmin(jnp.where(mesh.filled, away, jnp.inf))
