"""Forces of a closed orbit, its monodromy matrix, and the derivatives of the forces.

The derivatives with respect to parameters solve the same linear equations as Newton's step. The
right-hand sides are the derivatives of the equation and of the margins. Events move with the
parameters, and elements move with the events. Therefore no kink or jump crosses a Gauss point.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from rootsopt.dynamics.collocation.elements import GAUSS, Elements, summed
from rootsopt.dynamics.collocation.equation import CollocatedEquation, Points
from rootsopt.dynamics.collocation.peak import Peak
from rootsopt.dynamics.collocation.system import Step, moved_at, moved_places, unchanged

# Distance (fraction of an element's length) between two instants below which they count as one.
_COINCIDE = 1e-6


class OrbitForces(NamedTuple):
    """Results of a closed orbit, with derivatives along d directions of the parameters.

    `elements`: the orbit after a last correction; `response` (r,): mean (N), mean square (N²), peak
    (N) and the further measures; `sensitivity` (r, d): derivatives of `response`; `state` (n,):
    scaled state at φ1 = 0; `moved` (n, d): derivatives of `state`; `monodromy` (n, n): monodromy
    matrix at the start of the mesh; `depth`: greatest penetration (m) at Gauss points and element
    ends; `peak`: the greatest force before the last correction; `correction`: greatest entry of the
    last correction of the states (scaled); `variation`: changes of the whole motion along the
    directions, `None` unless the equation asks for it.
    """

    elements: Elements
    response: Float[Array, " r"]
    sensitivity: Float[Array, "r d"]
    state: Float[Array, " n"]
    moved: Float[Array, "n d"]
    monodromy: Float[Array, "n n"]
    depth: Float[Array, ""]
    peak: Peak
    correction: Float[Array, ""]
    variation: Step | None = None


def forces_of(
    equation: CollocatedEquation,
    elements: Elements,
    peak: Peak,
    evaluated: tuple[Points, Float[Array, "e p r k"]],
    step: Step,
    corrected: Elements,
) -> OrbitForces:
    """Return the forces of the closed orbit `elements` and their derivatives.

    `peak`: result of `peak_of`; `evaluated`: equation along the orbit (`newton.evaluated`), and
    direct changes of its values in the columns of `step`; `step`: a last correction of the motion,
    followed by its changes along directions of the parameters; `corrected`: the orbit after the
    correction."""
    points, direct = evaluated
    change = _changes(elements, points, direct, step)
    raw, changes = _averages(equation, elements, points, change, step)
    unit = lax.stop_gradient(equation.pair.force_scale)
    top = lax.stop_gradient(equation.top) / unit
    averages, factors = equation.measures.values(raw, unit, top)
    by_averages = changes * factors[:, None]
    by_height = unit * _by_height(equation, elements, peak, (points, direct, change), step)
    peak = peak._replace(force=unit * peak.force)
    values = jnp.concatenate([averages[:2], peak.force[None], averages[2:]])
    slopes = jnp.concatenate([by_averages[:2], by_height[None], by_averages[2:]])
    variation = None
    if equation.variation:
        columns = (x[..., 1:] for x in (step.state, step.slopes, step.times))
        variation = Step(*columns, monodromy=step.monodromy)
    first = origin(elements)
    used = (jnp.arange(elements.state.shape[0]) < elements.mesh.used)[:, None]
    return OrbitForces(
        elements=corrected,
        response=values + slopes[:, 0],
        sensitivity=slopes[:, 1:],
        state=corrected.state[first],
        moved=step.state[first, :, 1:],
        monodromy=step.monodromy,
        depth=jnp.max(jnp.where(used, points.depth, -jnp.inf)),
        peak=peak,
        correction=jnp.max(jnp.abs(step.state[..., 0])),
        variation=variation,
    )


def no_forces(equation: CollocatedEquation, elements: Elements, directions: int) -> OrbitForces:
    """Return zeros in place of the forces of a motion like `elements`."""
    rows, count = equation.measures.count + 1, elements.state.shape[1]
    zeros, zero, index = jnp.zeros, jnp.zeros(()), jnp.zeros((), int)
    return OrbitForces(
        elements=elements,
        response=zeros(rows),
        sensitivity=zeros((rows, directions)),
        state=zeros(count),
        moved=zeros((count, directions)),
        monodromy=zeros((count, count)),
        depth=zero,
        peak=Peak(index, zero, (index, index), zero, zero),
        correction=zero,
        variation=unchanged(elements, directions) if equation.variation else None,
    )


def _changes(elements: Elements, points: Points, direct, step: Step) -> Float[Array, "e s r k"]:
    """Return the changes of the equation's values at the Gauss points, which move with the orbit,
    in all columns of `step`; `direct`: changes at constant motion."""
    inside = len(GAUSS.nodes)
    times, states = moved_places(elements, step)
    moves = [times, *jnp.moveaxis(states, 2, 0)]
    bend = points.slopes[:, :inside]
    change = summed(bend[..., k, None] * move[:, :, None] for k, move in enumerate(moves))
    return change + direct[:, :inside]


def _averages(equation: CollocatedEquation, elements: Elements, points: Points, change, step: Step):
    """Return the averages of the integrands over the orbit, and their changes (averages, columns).

    `points`: equation along the orbit; `change`: its changes at the Gauss points (`_changes`), in
    the columns of `step`."""
    mesh = elements.mesh
    left, right = step.times[mesh.interval], step.times[mesh.interval + 1]
    longer = (mesh.right - mesh.left)[:, None] * (right - left)
    count, inside = elements.state.shape[1], len(GAUSS.nodes)
    rates = slice(count, count + equation.rates)
    part, by_part = GAUSS.whole(points.values[:, :inside, rates]), GAUSS.whole(change[:, :, rates])
    used = (jnp.arange(part.shape[0]) < mesh.used)[:, None]
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
    # The peak may be a little beside the instant of the evaluation. The changes here and at the
    # Gauss points lie on one polynomial.
    rows = change[k].reshape(len(GAUSS.nodes), -1)
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
    return jnp.argmin(jnp.where(jnp.arange(begin.shape[0]) < mesh.used, away, jnp.inf))
