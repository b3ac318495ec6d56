"""The linear equations of one Newton step, solved element by element.

On an element with Runge-Kutta matrix A and weights b, slopes k and length h, collocation requires

    k_i = f(τ_i, z + h Σ A_ij k_j),      z⁺ = z + h Σ b_i k_i,

where z⁺ is the state at the start of the next element. At an event, the margin m(τ, z⁺) must be
zero as well.

The slopes of an element depend only on the state at its start and on the times of both ends of its
interval. They are therefore eliminated first (condensation; Ascher, Mattheij and Russell, Numerical
Solution of Boundary Value Problems, section 7.2). The remaining equations are solved from one
element to the next. Each event determines the change of its own time. The state at the end of the
last element must equal that at the start of the first.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from rootsopt.dynamics.collocation.elements import (
    GAUSS,
    Elements,
    Mesh,
    greatest,
    in_blocks,
    summed,
)
from rootsopt.dynamics.linear import solved


class Lines(NamedTuple):
    """The equation linearised on e elements with s Gauss points each, for n states.

    `miss` (e, s, n): slope from the equation minus the element's slope, at the Gauss points;
    `slopes` (e, s, n, 1 + n): derivatives of the equation at the Gauss points with respect to time
    and state; `margin` (e,): margin at the element's end; `bend` (e, 1 + n): derivatives of the
    margin with respect to time and state.
    """

    miss: Float[Array, "e s n"]
    slopes: Float[Array, "e s n c"]
    margin: Float[Array, " e"]
    bend: Float[Array, "e c"]


class Columns(NamedTuple):
    """Right-hand sides of the linear equations in k columns (e, s and n as in `Lines`).

    `slope` (e, s, n, k): change of the equation at the Gauss points; `gap` (e, n, k): state at the
    end of each element minus that at the start of the next; `margin` (e, k): change of the margin
    at the element's end.
    """

    slope: Float[Array, "e s n k"]
    gap: Float[Array, "e n k"]
    margin: Float[Array, "e k"]


class Step(NamedTuple):
    """Solution of the linear equations: changes of a motion, one in each of k columns.

    `state` (e, n, k): scaled states at the starts of e elements; `slopes` (e, s, n, k): slopes at
    their s Gauss points; `times` (m, k): times of the mesh (mesh periods); `monodromy` (n, n):
    monodromy matrix at the start of the mesh.
    """

    state: Float[Array, "e n k"]
    slopes: Float[Array, "e s n k"]
    times: Float[Array, "m k"]
    monodromy: Float[Array, "n n"]


class Condensed(NamedTuple):
    """The linear equations after elimination of the slopes (e, s and n as in `Lines`).

    `slopes` (e, s, n, n + 2 + k): coefficients of the slopes' changes; `rise` (e, n, n + 2 + k):
    likewise, of the change of the state at the element's end. They multiply the change of the state
    at the element's start (n), and the shifts of both ends of its interval (2). The last k are
    constants, one for each right-hand side.
    """

    slopes: Float[Array, "e s n c"]
    rise: Float[Array, "e n c"]


def condensed(elements: Elements, lines: Lines, columns: Columns) -> Condensed:
    """Return the linear equations of all `elements` after elimination of the slopes.

    `lines`: equation linearised along the motion `elements`; `columns`: right-hand sides. In unused
    blocks of elements, the result has no meaning."""
    mesh = elements.mesh
    shares = jnp.stack([mesh.left, mesh.right, mesh.lengths], axis=1)
    return in_blocks(_condensed, mesh.used, shares, elements.slopes, lines, columns)


def _condensed(
    shares: Float[Array, "e 3"], own: Float[Array, "e s n"], lines: Lines, columns: Columns
) -> Condensed:
    """Return the linear equations of a block of e elements after elimination of the slopes.

    `shares`: start and end of each element as fractions of its interval, and its length (mesh
    periods); `own`: its slopes; `lines`, `columns`: linearised equation and right-hand sides of the
    block."""
    count, points, states = own.shape
    left, right_end, lengths = shares.T
    length = lengths[:, None, None, None]
    share = right_end - left
    rise = GAUSS.inside(own)
    by_time, by_state = lines.slopes[..., :1], lines.slopes[..., 1:]
    matrix = jnp.eye(points * states).reshape(points, states, points, states) - (
        length[..., None] * by_state[:, :, :, None] * GAUSS.integral[:, None, :, None]
    )
    # If the interval becomes longer, so does the element, and the states at its Gauss points move.
    stretch = share[:, None, None, None] * jnp.sum(
        by_state * rise[:, :, None], axis=-1, keepdims=True
    )
    place = (left[:, None] + share[:, None] * GAUSS.nodes)[..., None, None]
    right = [by_state, by_time * (1 - place) - stretch, by_time * place + stretch, columns.slope]
    right = jnp.concatenate(right, axis=-1)
    system = jnp.concatenate(
        [
            matrix.reshape(count, points * states, points * states),
            right.reshape(count, points * states, -1),
        ],
        axis=-1,
    )
    slopes = _eliminated(system).reshape(count, points, states, -1)
    end = GAUSS.whole(slopes) * length[:, 0]
    longer = share[:, None] * GAUSS.whole(own)
    still = jnp.broadcast_to(jnp.eye(states), (count, states, states))
    added = [still, -longer[..., None], longer[..., None], columns.gap]
    return Condensed(slopes, end + jnp.concatenate(added, axis=-1))


def _eliminated(system: Float[Array, "e m c"]) -> Float[Array, "e m k"]:
    """Return the solutions of e small linear systems.

    `system` (e, m, c): each matrix, followed by its right-hand sides as further columns. The method
    is Gauss-Jordan elimination without pivoting. On short elements the matrices are close to the
    identity."""
    size = system.shape[1]
    place = jnp.arange(size)

    def eliminate(k, system):
        row = lax.dynamic_index_in_dim(system, k, 1, keepdims=False)
        row = row / lax.dynamic_index_in_dim(row, k, 1)
        factor = lax.dynamic_index_in_dim(system, k, 2)
        changed = system - factor * row[:, None]
        return jnp.where((place == k)[:, None], row[:, None], changed)

    return lax.fori_loop(0, size, eliminate, system)[..., size:]


class Chain(NamedTuple):
    """The condensed equations, solved from element to element for an open motion (n states).

    All rows are linear in the change of the first state (n) and in the k right-hand sides: `end`
    (n, n + k): state at the end of the last element; `state` (e, n, n + k): state at the start of
    each element, if the end of its interval stays; `by_end` (e, n): its derivative with respect to
    the shift of that end; `shift` (m - 1, n + k): shift of the end of each interval.
    """

    end: Float[Array, "n c"]
    state: Float[Array, "e n c"]
    by_end: Float[Array, "e n"]
    shift: Float[Array, "i c"]

    @property
    def monodromy(self) -> Float[Array, "n n"]:
        """Monodromy matrix at the start of the mesh."""
        return self.end[:, : self.end.shape[0]]


def chained(elements: Elements, lines: Lines, columns: Columns, parts: Condensed) -> Step:
    """Return the changes of states, slopes and event times that solve the linear equations.

    `elements`: motion along which the equation is linearised; `lines`, `columns`: linearised
    equation and right-hand sides; `parts`: result of `condensed` for them."""
    chain = opened(elements, lines, columns, parts)
    states = elements.state.shape[1]
    unit = jnp.eye(states, dtype=elements.state.dtype)
    return spread(elements, parts, chain, solved(unit - chain.monodromy, chain.end[:, states:]))


def opened(elements: Elements, lines: Lines, columns: Columns, parts: Condensed) -> Chain:
    """Return the solution of the linear equations for any change of the first state.

    For the arguments, see `chained`. The maps from element to element are multiplied within each
    interval. The event at the end of an interval then determines the shift of this end, and the
    maps from interval to interval are multiplied."""
    mesh = elements.mesh
    states, used, ends = elements.state.shape[1], mesh.filled, mesh.finals
    first = jnp.append(True, mesh.last[:-1])
    # From the start of the interval to the end of each element. The columns are the change of the
    # state, the shifts of the interval's start and end, and the right-hand sides.
    after = _composed(parts.rise, first, mesh.used)
    begin, end = slice(0, states + 1), states + 1
    reached, bend, fixed = after[ends], lines.bend[ends], mesh.which[1:] < 0
    pull = summed(bend[:, 1 + k, None] * reached[:, k] for k in range(states))
    pull = pull.at[:, end + 1 :].add(columns.margin[ends])
    slope = bend[:, 0] + pull[:, end]
    free = jnp.where(fixed, 0.0, -1 / jnp.where(fixed, 1.0, slope))
    row = free[:, None] * jnp.concatenate([pull[:, begin], pull[:, end + 1 :]], axis=1)
    # From the start of the period to the end of each interval, for the state and the shift.
    over = jnp.concatenate([reached[:, :, begin], reached[:, :, end + 1 :]], axis=-1)
    over += reached[:, :, end, None] * row[:, None]
    over = jnp.concatenate([over, row[:, None]], axis=1)
    intervals = mesh.interval[mesh.used - 1] + 1
    over = _composed(over, jnp.arange(over.shape[0]) == 0, intervals)
    # The start of the period stays where it is.
    over = jnp.concatenate([over[..., :states], over[..., states + 1 :]], axis=-1)
    still = jnp.eye(states + 1, over.shape[-1], dtype=over.dtype).at[states].set(0.0)
    begun = jnp.concatenate([still[None], over[:-1]])[mesh.interval]
    same = jnp.eye(states, after.shape[-1], dtype=after.dtype)
    inside = jnp.concatenate([same[None], after[:-1]])
    inside = jnp.where(first[:, None, None], same, inside)
    state = summed(inside[:, :, k, None] * begun[:, k, None] for k in range(states + 1))
    state = state.at[..., states:].add(inside[..., states + 2 :])
    return Chain(
        end=over[intervals - 1, :states],
        state=jnp.where(used[:, None, None], state, 0.0),
        by_end=jnp.where(used[:, None], inside[..., states + 1], 0.0),
        shift=over[:, states],
    )


def _composed(
    maps: Float[Array, "m n c"], starts: Bool[Array, " m"], count: Int[Array, ""]
) -> Float[Array, "m n c"]:
    """Return the products of affine `maps`, from the last of the `starts` up to each of them.

    The first n columns of a map multiply a vector, the others are constants. Only the first `count`
    products are valid. The first map must be a start."""
    size = maps.shape[1]

    def step(k, carry):
        before, products = carry
        own = maps[k]
        after = summed(own[:, j, None] * before[j] for j in range(size))
        after = jnp.where(starts[k], own, after.at[:, size:].add(own[:, size:]))
        return after, products.at[k].set(after)

    begin = jnp.zeros_like(maps[0]), jnp.zeros_like(maps)
    return lax.fori_loop(0, greatest(count), step, begin)[1]


def spread(
    elements: Elements,
    parts: Condensed,
    chain: Chain,
    first: Float[Array, "n c"],
    mix: Float[Array, "k c"] | None = None,
) -> Step:
    """Return the changes of the whole motion for c changes `first` of its first state.

    `mix`: factors of the right-hand sides in each of the c columns; by default, there is one column
    for each right-hand side. For the other arguments, see `chained`."""
    mesh = elements.mesh
    states, width = first.shape
    dtype = elements.state.dtype

    def mixed(constants):
        if mix is None:
            return constants
        return jnp.sum(constants[..., None] * mix, axis=-2)

    def closed(rows):
        moved = summed(rows[..., k, None] * first[k] for k in range(states))
        return moved + mixed(rows[..., states:])

    # All times after the last interval in use are the end of the period.
    real = jnp.arange(1, mesh.times.shape[0]) <= mesh.interval[mesh.used - 1]
    shift = jnp.where(real[:, None], closed(chain.shift), 0.0)
    times = jnp.concatenate([jnp.zeros((1, width), dtype), shift])
    left, right = times[mesh.interval], times[mesh.interval + 1]
    state = closed(chain.state) + chain.by_end[..., None] * right[:, None]
    moves = [*jnp.moveaxis(state, 1, 0), left, right]
    answer = mixed(parts.slopes[..., states + 2 :]) + summed(
        parts.slopes[..., k, None] * move[:, None, None] for k, move in enumerate(moves)
    )
    return Step(state, answer, times, chain.monodromy)


def unchanged(elements: Elements, columns: int) -> Step:
    """Return a step with zeros in all of its `columns`, for a motion like `elements`."""
    count = elements.state.shape[1]
    parts = elements.state, elements.slopes, elements.mesh.times
    nothing = (jnp.zeros((*x.shape, columns)) for x in parts)
    return Step(*nothing, monodromy=jnp.zeros((count, count)))


def moved_at(
    elements: Elements, step: Step, k: Int[Array, "*m"], share: Float[Array, "*m"]
) -> tuple[Float[Array, "*m k"], Float[Array, "*m n k"]]:
    """Return the changes of times and scaled states at fractions `share` of the elements `k`."""
    mesh: Mesh = elements.mesh
    left, right = step.times[mesh.interval[k]], step.times[mesh.interval[k] + 1]
    width = (mesh.right - mesh.left)[k][..., None]
    place = mesh.left[k][..., None] + width * share[..., None]
    weights = GAUSS.integrated(share)[..., None]
    rise = jnp.sum(weights * elements.slopes[k], axis=-2)
    inside = jnp.sum(weights[..., None] * step.slopes[k], axis=-3)
    longer = width * (right - left)
    states = step.state[k] + mesh.lengths[k][..., None, None] * inside
    states += rise[..., None] * longer[..., None, :]
    return left * (1 - place) + right * place, states


def moved_places(elements: Elements, step: Step) -> tuple[Array, Array]:
    """Return the changes of times (e, s, k) and scaled states (e, s, n, k) at the Gauss points."""
    mesh: Mesh = elements.mesh
    left, right = step.times[mesh.interval], step.times[mesh.interval + 1]
    share = mesh.right - mesh.left
    place = (mesh.left[:, None] + share[:, None] * GAUSS.nodes)[..., None]
    times = left[:, None] * (1 - place) + right[:, None] * place
    rise = GAUSS.inside(elements.slopes)
    longer = share[:, None] * (right - left)
    within = GAUSS.inside(step.slopes)
    states = step.state[:, None] + mesh.lengths[:, None, None, None] * within
    return times, states + rise[..., None] * longer[:, None, None]
