"""Forces of a closed orbit, its monodromy matrix, and the derivatives of the forces.

The derivatives with respect to parameters solve the same linear equations as Newton's step. The
right-hand sides are the derivatives of the equation and of the margins. Events move with the
parameters, and elements move with the events. Therefore no kink or jump crosses a Gauss point.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from rootsopt.dynamics.collocation.blocks import in_blocks
from rootsopt.dynamics.collocation.elements import Elements
from rootsopt.dynamics.collocation.equation import CollocatedEquation, Points
from rootsopt.dynamics.collocation.gauss import GAUSS, summed
from rootsopt.dynamics.collocation.newton import lines
from rootsopt.dynamics.collocation.system import (
    Columns,
    Condensed,
    Lines,
    Step,
    chained,
    condensed,
    moved_places,
    own_column,
)

_RIVALS, _PLACES = 4, 9
"""Number of elements in which the peak is searched for, and number of instants per element at which
the force is evaluated in each round."""
_ROUNDS, _CLOSER = 4, 0.25
"""Number of rounds of the search for the peak, and factor by which the searched range shrinks from
one round to the next. The vertex of a parabola through the best three instants follows."""
_MENDED, _SETTLED = 8, 1e-11
"""Maximum number of evaluations at each instant, and change of a force (relative to the greatest)
below which they end. Each improves the `NearContact.roots` from which the next one starts. After a
single one, errors of the roots would decide between two instants near the peak, where the force
hardly changes. Where the contact passes a cusp, more are needed than elsewhere."""


class Peak(NamedTuple):
    """The greatest contact force of an orbit.

    `element`: index of the element that contains the peak; `share`: position in the element, from 0
    (start) to 1 (end); `roots` (sides, 2): `NearContact.roots` at the peak; `force`: contact force
    (N).
    """

    element: Int[Array, ""]
    share: Float[Array, ""]
    roots: Float[Array, "sides 2"]
    force: Float[Array, ""]


class OrbitForces(NamedTuple):
    """Results of a closed orbit, with derivatives along d directions of the parameters.

    `elements`: the orbit after a last correction; `response` (r,): mean (N), mean square (N²), peak
    (N) and the further measures; `sensitivity` (r, d): derivatives of `response`; `state` (n,):
    scaled state at φ1 = 0; `moved` (n, d): derivatives of `state`; `monodromy` (n, n): monodromy
    matrix at the start of the mesh; `depth`: greatest penetration (m) at Gauss points and element
    ends; `peak`: the greatest force before the last correction; `correction`: greatest entry of the
    last correction of the states (scaled).
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


def _inside(elements: Elements, k: Any, share: Any) -> tuple[Array, Array, Array]:
    """Return time (mesh periods), scaled state and `NearContact.roots` inside element `k`.

    `share`: position in the element, from 0 (start) to 1 (end). The roots come from the polynomial
    through those at the Gauss points."""
    begin, length = elements.mesh.ends[0][k], elements.mesh.lengths[k]
    rise = jnp.sum(GAUSS.integrated(share)[:, None] * elements.slopes[k], axis=0)
    weights = GAUSS.lagrange(share)
    roots = jnp.sum(weights[:, None, None] * elements.roots[k, : len(GAUSS.nodes)], axis=0)
    return begin + length * share, elements.state[k] + length * rise, roots


def located_peak(
    equation: CollocatedEquation, elements: Elements, force: Float[Array, "e s"]
) -> Peak:
    """Return the greatest contact force of the orbit `elements`.

    `force` (e, s): contact force (N) at the Gauss points. Inside an element the force is smooth.
    The polynomial through these forces therefore shows which elements may contain the peak. In
    these, ever closer scans search for it. A peak at a corner of the force lies at the end of an
    element, which is an event, and moves with this event."""
    shares = jnp.linspace(0.0, 1.0, _PLACES)
    used = jnp.arange(force.shape[0]) < elements.mesh.used
    smooth = force @ GAUSS.lagrange(shares).T
    highest = jnp.where(used, jnp.max(smooth, axis=1), -jnp.inf)
    rivals = lax.top_k(highest, _RIVALS)[1]
    spread = jnp.linspace(-1.0, 1.0, _PLACES)

    def at(k, share, roots):
        tau, state, _ = _inside(elements, k, share)
        found = equation.force(tau, state, roots)
        return found

    each = jax.vmap(jax.vmap(at, (None, 0, 0)))

    def mended(places, roots):
        """Return the forces (N) at `places` of the rivals, and the improved `roots`."""

        def go_on(carry):
            times, before, forces, _ = carry
            moved = jnp.max(jnp.abs(forces - before)) > _SETTLED * jnp.max(jnp.abs(forces))
            return (times < 2) | (moved & (times < _MENDED))

        def again(carry):
            times, _, forces, roots = carry
            return times + 1, forces, *each(rivals, places, roots)

        nothing = jnp.zeros_like(places)
        start = jnp.zeros((), int), nothing, nothing, roots
        return lax.while_loop(go_on, again, start)[2:]

    pick = jax.vmap(lambda x, i: x[i])

    def round_(number, carry):
        share, roots, *_ = carry
        reach = 0.5 * _CLOSER ** number.astype(force.dtype)
        tried = jnp.clip(share, reach, 1.0 - reach)[:, None] + reach * spread
        first = jax.vmap(lambda k, places: jax.vmap(lambda x: _inside(elements, k, x)[2])(places))
        # The polynomial through the roots is inaccurate near the element's ends.
        begun = jnp.where(number == 0, first(rivals, tried), roots[:, None])
        forces, new = mended(tried, begun)
        top = jnp.argmax(forces, axis=1)
        middle = jnp.clip(top, 1, _PLACES - 2)[:, None] + jnp.arange(-1, 2)
        around = jnp.take_along_axis(tried, middle, 1), jnp.take_along_axis(forces, middle, 1)
        return pick(tried, top), pick(new, top), pick(forces, top), around

    half = jnp.full(_RIVALS, 0.5, force.dtype)
    begun = jnp.zeros((_RIVALS, *elements.roots.shape[2:]), force.dtype)
    three = jnp.zeros((_RIVALS, 3), force.dtype)
    start = half, begun, half, (three, three)
    share, roots, best, around = lax.fori_loop(0, _ROUNDS, round_, start)
    vertex = jax.vmap(_vertex)(*around)
    last, moved = mended(vertex[:, None], roots[:, None])
    better = last[:, 0] > best
    best = jnp.where(better, last[:, 0], best)
    share = jnp.where(better, vertex, share)
    roots = jnp.where(better[:, None, None], moved[:, 0], roots)
    top = jnp.argmax(best)
    return Peak(rivals[top], share[top], roots[top], best[top])


def _vertex(places: Float[Array, " 3"], values: Float[Array, " 3"]) -> Float[Array, ""]:
    """Return the place of the vertex of the parabola through three points, in ascending order.

    It is limited to the span of `places`. If the parabola has no maximum, it is the middle one."""
    left, right = places[1] - places[0], places[2] - places[1]
    before, after = (values[1] - values[0]) / left, (values[2] - values[1]) / right
    bend = 2 * (after - before) / (left + right)
    slope = (before * right + after * left) / (left + right)
    bends = bend < 0
    step = jnp.where(bends, -slope / jnp.where(bends, bend, -1.0), 0.0)
    return jnp.clip(places[1] + step, places[0], places[2])


@eqx.filter_jit
def response(
    equation: CollocatedEquation,
    elements: Elements,
    force: Any,
    tangents: Any,
    solve: Callable[[Elements, Lines, Columns, Condensed], Step] = chained,
) -> OrbitForces:
    """Return the forces of the closed orbit `elements` and their derivatives.

    `force` (e, s): contact force (N) at the Gauss points; `tangents`: d directions of the pair's
    parameters, stacked along a leading axis; `solve`: solver of the condensed equations, by default
    for a last correction at constant parameters. The arrays of the mesh must have room for one more
    element."""
    mesh = elements.mesh
    count, inside = elements.state.shape[1], len(GAUSS.nodes)
    peak = located_peak(equation, elements, force)
    # Append the peak to the instants, to evaluate the equation at all of them in one call.
    tau, state = elements.places
    at_peak = _inside(elements, peak.element, peak.share)
    extra = mesh.used
    tau, state = tau.at[extra].set(at_peak[0]), state.at[extra].set(at_peak[1])
    roots = elements.roots.at[extra].set(peak.roots)
    which = jnp.maximum(mesh.which[mesh.interval + 1], 0)

    def both(tau, state, roots, which):
        return equation.along(tau, state, roots, which, tangents)

    points, along = in_blocks(both, extra + 1, tau, state, roots, which)
    found = lines(elements, points)
    own = own_column(elements, found)
    width = along.shape[-1]
    columns = Columns(
        slope=jnp.concatenate([own.slope, along[:, :inside, :count]], axis=-1),
        gap=jnp.pad(own.gap, ((0, 0), (0, 0), (0, width))),
        margin=jnp.concatenate([own.margin, along[:, inside, -1]], axis=-1),
    )
    step = solve(elements, found, columns, condensed(elements, found, columns))
    raw, changes = _averages(equation, elements, points, along, step)
    unit = lax.stop_gradient(equation.pair.force_scale)
    top = lax.stop_gradient(equation.top) / unit
    averages, factors = equation.measures.values(raw, unit, top)
    by_averages = changes * factors[:, None]
    height, by_height = _height(equation, elements, step, peak, (points, along))
    values = jnp.concatenate([averages[:2], height[None], averages[2:]])
    slopes = jnp.concatenate([by_averages[:2], by_height[None], by_averages[2:]])
    values = values + slopes[:, 0]
    first = origin(elements)
    corrected = Elements(
        mesh._replace(times=mesh.times + step.times[:, 0]),
        elements.state + step.state[..., 0],
        elements.slopes + step.slopes[..., 0],
        points.roots.at[extra].set(elements.roots[extra]),
    )
    used = (jnp.arange(tau.shape[0]) < mesh.used)[:, None]
    return OrbitForces(
        elements=corrected,
        response=values,
        sensitivity=slopes[:, 1:],
        state=corrected.state[first],
        moved=step.state[first, :, 1:],
        monodromy=step.monodromy,
        depth=jnp.max(jnp.where(used, points.depth, -jnp.inf)),
        peak=peak,
        correction=jnp.max(jnp.abs(step.state[..., 0])),
    )


def _averages(equation: CollocatedEquation, elements: Elements, points: Points, along, step: Step):
    """Return the averages of the integrands over the orbit, and their changes (averages, columns).

    `points`, `along`: results of `CollocatedEquation.along` at the Gauss points; `step`: solution
    of the linear equations, one column per direction."""
    mesh = elements.mesh
    count, inside = elements.state.shape[1], len(GAUSS.nodes)
    rates = slice(count, count + equation.rates)
    times, states = moved_places(elements, step)
    value, bend = points.values[:, :inside, rates], points.slopes[:, :inside, rates]
    moves = [times, *jnp.moveaxis(states, 2, 0)]
    change = summed(bend[..., k, None] * move[:, :, None] for k, move in enumerate(moves))
    change = change.at[..., 1:].add(along[:, :inside, rates])
    left, right = step.times[mesh.interval], step.times[mesh.interval + 1]
    longer = (mesh.right - mesh.left)[:, None] * (right - left)
    part, by_part = GAUSS.whole(value), GAUSS.whole(change)
    used = (jnp.arange(part.shape[0]) < mesh.used)[:, None]
    total = jnp.sum(jnp.where(used, mesh.lengths[:, None] * part, 0.0), axis=0)
    moved = mesh.lengths[:, None, None] * by_part + part[..., None] * longer[:, None]
    moved = jnp.sum(jnp.where(used[..., None], moved, 0.0), axis=0)
    if not equation.pair.free:
        return total / mesh.period, moved / mesh.period
    duration, kept = total[-1], total[:-1] / total[-1]
    return kept, (moved[:-1] - kept[:, None] * moved[-1]) / duration


def _height(
    equation: CollocatedEquation, elements: Elements, step: Step, peak: Peak, evaluated: Any
):
    """Return the peak force (N), and its changes for all columns of `step`.

    `evaluated`: results of `CollocatedEquation.along`; those at the peak follow the elements in
    use."""
    points, along = evaluated
    mesh, extra = elements.mesh, elements.mesh.used
    count, k = elements.state.shape[1], peak.element
    rates = slice(count, count + equation.rates)
    value, bend = points.values[extra, 0, rates], points.slopes[extra, 0, rates]
    begin, end = mesh.interval[k], mesh.interval[k] + 1
    share = mesh.right[k] - mesh.left[k]
    place = mesh.left[k] + share * peak.share
    time = step.times[begin] * (1 - place) + step.times[end] * place
    weights = GAUSS.integrated(peak.share)[:, None]
    longer = share * (step.times[end] - step.times[begin])
    state = step.state[k] + mesh.lengths[k] * jnp.sum(weights[..., None] * step.slopes[k], axis=0)
    state += jnp.sum(weights * elements.slopes[k], axis=0)[:, None] * longer
    change = bend[:, :1] * time + bend[:, 1:] @ state
    change = change.at[:, 1:].add(along[extra, 0, rates])
    unit = lax.stop_gradient(equation.pair.force_scale)
    if not equation.pair.free:
        return unit * value[0], unit * change[0]
    force = value[0] / value[-1]
    return unit * force, unit * (change[0] - force * change[-1]) / value[-1]


def origin(elements: Elements) -> Int[Array, ""]:
    """Return the index of the element that begins at φ1 = 0."""
    mesh = elements.mesh
    begin = mesh.ends[0]
    away = jnp.abs(begin - mesh.period * jnp.round(begin / mesh.period))
    return jnp.argmin(jnp.where(jnp.arange(begin.shape[0]) < mesh.used, away, jnp.inf))
