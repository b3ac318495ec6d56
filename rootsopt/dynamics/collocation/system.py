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

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from rootsopt.dynamics.collocation.blocks import in_blocks
from rootsopt.dynamics.collocation.elements import Elements, Mesh
from rootsopt.dynamics.collocation.gauss import GAUSS
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


def own_column(elements: Elements, lines: Lines) -> Columns:
    """Return the right-hand side of Newton's step for the motion `elements`, as a single column."""
    rise = jnp.sum(GAUSS.weights[:, None] * elements.slopes, axis=1)
    reached = elements.state + elements.mesh.lengths[:, None] * rise
    gap = reached - elements.following
    return Columns(lines.miss[..., None], gap[..., None], lines.margin[:, None])


def condensed(elements: Elements, lines: Lines, columns: Columns) -> Condensed:
    """Return the linear equations of all `elements` after elimination of the slopes.

    `lines`: equation linearised along the motion `elements`; `columns`: right-hand sides. In unused
    blocks of elements, the result is 0."""
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
    rise = jnp.sum(GAUSS.integral[:, :, None] * own[:, None], axis=2)
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
    end = jnp.sum(GAUSS.weights[:, None, None] * slopes, axis=1) * length[:, 0]
    longer = share[:, None] * jnp.sum(GAUSS.weights[:, None] * own, axis=1)
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
    the shift of that end; `shift` (e, n + k): shift of the end of the interval, 0 unless the
    element is the last one of its interval.
    """

    end: Float[Array, "n c"]
    state: Float[Array, "e n c"]
    by_end: Float[Array, "e n"]
    shift: Float[Array, "e c"]

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

    For the arguments, see `chained`."""
    mesh = elements.mesh
    states, width = elements.state.shape[1], columns.gap.shape[-1]
    last, fixed = mesh.last, mesh.which[mesh.interval + 1] < 0
    rise, bend = parts.rise, lines.bend
    wide = states + width
    pushed = jnp.pad(columns.margin, ((0, 0), (states, 0)))

    def along(carry, k):
        """Return `carry` for the next element, and three results for element k.

        These are the first two entries of `carry` and the shift of the interval's end, which is 0
        unless the element is the last of its interval.

        `carry`: change of the state at the start of element k if the interval's end stays;
        derivative of this change with respect to the shift of that end; shift of the interval's
        start. Changes and shifts are linear in the change of the first state and in the right-hand
        sides, with one column for each."""
        now, by_end, begun = carry
        part = rise[k]
        after = jnp.sum(part[:, :states, None] * now, axis=1)
        after += part[:, states, None] * begun
        after = after.at[:, states:].add(part[:, states + 2 :])
        moved = jnp.sum(part[:, :states] * by_end, axis=1) + part[:, states + 1]
        by_state, by_time = bend[k, 1:], bend[k, 0]
        shift = -(pushed[k] + by_state @ after) / (by_time + by_state @ moved)
        shift = jnp.where(fixed[k], 0.0, shift)
        over = jnp.where(last[k], after + moved[:, None] * shift, after)
        following = over, jnp.where(last[k], 0.0, moved), jnp.where(last[k], shift, begun)
        return following, (now, by_end, jnp.where(last[k], shift, 0.0))

    def step(k, loop):
        carry, kept = loop
        carry, new = along(carry, k)
        return carry, jax.tree.map(lambda all_, one: all_.at[k].set(one), kept, new)

    count, dtype = elements.state.shape[0], elements.state.dtype
    start = jnp.eye(states, wide, dtype=dtype), jnp.zeros(states, dtype), jnp.zeros(wide, dtype)
    kept = (
        jnp.zeros((count, states, wide), dtype),
        jnp.zeros((count, states), dtype),
        jnp.zeros((count, wide), dtype),
    )
    (end, *_), rows = lax.fori_loop(0, mesh.used, step, (start, kept))
    return Chain(end, *rows)


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
    (states, width), count = first.shape, elements.state.shape[0]
    dtype = elements.state.dtype

    def mixed(constants):
        if mix is None:
            return constants
        return jnp.sum(constants[..., None] * mix, axis=-2)

    def closed(rows):
        return jnp.sum(rows[..., :states, None] * first, axis=-2) + mixed(rows[..., states:])

    used = jnp.arange(count) < mesh.used
    place = jnp.where(mesh.last & used, mesh.interval + 1, mesh.times.shape[0])
    times = jnp.zeros((mesh.times.shape[0], width), dtype)
    times = times.at[place].set(closed(chain.shift), mode="drop")
    left, right = times[mesh.interval], times[mesh.interval + 1]
    state = closed(chain.state) + chain.by_end[..., None] * right[:, None]
    answer = mixed(parts.slopes[..., states + 2 :]) + (
        parts.slopes[..., states, None] * left[:, None, None]
        + parts.slopes[..., states + 1, None] * right[:, None, None]
        + jnp.sum(parts.slopes[..., :states, None] * state[:, None, None], axis=-2)
    )
    return Step(state, answer, times, chain.monodromy)


def moved_places(elements: Elements, step: Step) -> tuple[Array, Array]:
    """Return the changes of times (e, s, k) and scaled states (e, s, n, k) at the Gauss points."""
    mesh: Mesh = elements.mesh
    left, right = step.times[mesh.interval], step.times[mesh.interval + 1]
    share = mesh.right - mesh.left
    place = (mesh.left[:, None] + share[:, None] * GAUSS.nodes)[..., None]
    times = left[:, None] * (1 - place) + right[:, None] * place
    rise = jnp.sum(GAUSS.integral[:, :, None] * elements.slopes[:, None], axis=2)
    longer = share[:, None] * (right - left)
    within = jnp.sum(GAUSS.integral[:, :, None, None] * step.slopes[:, None], axis=2)
    states = step.state[:, None] + mesh.lengths[:, None, None, None] * within
    return times, states + rise[..., None] * longer[:, None, None]
