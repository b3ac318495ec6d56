"""Steps that end where the equation of motion is not smooth.

A method of high order sees a kink of the equation as an error of low order, and a jump of
its derivatives (where the contact moves on to the next piece of a flank) costs the
linearised motion far more than the motion itself.
"""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from rootsopt.dynamics.flow import Flow
from rootsopt.dynamics.pair import RotorPair
from rootsopt.dynamics.peak import Steps, blended

_LOOKS, _LONGEST = 252, 8
"""Places in a mesh period where changes are looked for, beside the ends of the steps, and mesh
periods that there are places for."""
_CHANGES = 1024
"""Changes found in one stretch of motion, at most; a mesh period has some 20 to 100."""
_LANES = 16
"""Places looked at together."""
_HALVINGS = 26
_BRIEF, _PARTS = 0.05, 8
"""Changes less than `_BRIEF` mesh periods apart have `_PARTS` steps between them."""
_ASIDE = 1e-9, 1e-6
"""Half a step (mesh periods) that holds a change: so many times the tolerance of the motion as
`_LOOSE`, but within these. What it does to the gradients is in proportion to it."""
_LOOSE = 1e3
_ROUNDINGS = 16.0
"""The same in roundings of the time, at least: in single precision that is the longest of these."""
_SHARE = 1e-4
"""The same as a share of the time to the next change, at most: beside a change of curvature in a
rounding layer the error of the gradients is in proportion to the square of this share."""
_GRADES = 8.0, 64.0
"""Further ends beside a change, in units of that half step: a change that lies a little outside its
step is still in a short one."""
_HOLDS = 2.5
"""Steps up to this length, in units of the longest half step that holds a change, stay whole."""
_APART = 1e-10
"""Ends of steps closer than this (mesh periods) are one."""


def with_switches(
    pair: RotorPair,
    out: Flow,
    periods: Float[Array, ""],
    tolerance: Float[Array, ""],
    base: Float[Array, " steps"] | None = None,
) -> Float[Array, " steps"]:
    """The grid `base` (default: that of `out`) with steps that end where the equation changes from
    one smooth piece to another along `out`, integrated over `periods` mesh periods at a relative
    `tolerance`."""
    width = periods / out.states.shape[0]
    before = jnp.concatenate([out.states[:1], out.corners[:-1]])
    begins = jnp.concatenate([jnp.zeros_like(out.grid[:1]), out.grid[:-1]])
    taken = jnp.sum(out.grid < jnp.inf)
    steps = Steps(begins, out.grid, before, out.corners, taken)
    even = jnp.arange(_LONGEST * _LOOKS, dtype=width.dtype) / _LOOKS
    places = jnp.sort(jnp.concatenate([jnp.where(even < periods, even, jnp.inf), out.grid]))
    known = jnp.sum(places < jnp.inf)
    blocks = -(-known // _LANES)
    lanes = jnp.arange(_LANES)

    def flags(tau):
        return pair.switches(tau, blended(pair, out.states, steps, tau, width))

    def changes(seen, counts):
        """Where switches change that count on either side: how many, and of each the switch, its
        value before, and the ends of the interval."""
        differ = (seen[1:] != seen[:-1]) & (counts[1:] | counts[:-1])
        differ &= (jnp.arange(1, places.shape[0]) < known)[:, None]
        interval, which = jnp.nonzero(differ, size=_CHANGES, fill_value=0)
        number = jnp.minimum(jnp.sum(differ), _CHANGES)
        return number, which, seen[interval, which], places[interval], places[interval + 1]

    # Looking and halving in one loop, so that the switches are compiled once.
    def go_on(carry):
        turn, (number, *_), *_ = carry
        return (turn <= blocks) | (turn < blocks + _HALVINGS * -(-number // _LANES))

    def look(carry):
        turn, listed, seen, counts = carry
        looking = turn < blocks
        listed = lax.cond(turn == blocks, lambda: changes(seen, counts), lambda: listed)
        number, which, value, low, high = listed
        place = jnp.where(looking, turn, (turn - blocks) // _HALVINGS) * _LANES + lanes
        at = jnp.minimum(place, jnp.where(looking, known, _CHANGES) - 1)
        middle = (low[at % _CHANGES] + high[at % _CHANGES]) / 2
        found, counted = jax.vmap(flags)(jnp.where(looking, places[at], middle))
        kept = jnp.where(looking, at, places.shape[0])
        seen = seen.at[kept].set(found, mode="drop")
        counts = counts.at[kept].set(counted, mode="drop")
        same = found[lanes, which[at % _CHANGES]] == value[at % _CHANGES]
        lower, upper = (jnp.where(looking | ~side, _CHANGES, at) for side in (same, ~same))
        low = low.at[lower].set(middle, mode="drop")
        high = high.at[upper].set(middle, mode="drop")
        return turn + 1, (number, which, value, low, high), seen, counts

    shape = jax.eval_shape(flags, width)[0].shape
    unseen = jnp.zeros((places.shape[0], *shape), bool)
    nothing = jax.tree.map(jnp.zeros_like, jax.eval_shape(changes, unseen, unseen))
    listed = lax.while_loop(go_on, look, (jnp.zeros((), int), nothing, unseen, unseen))[1]
    number, *_, high = listed
    found = jnp.sort(jnp.where(jnp.arange(_CHANGES) < number, high, jnp.inf))
    # Between two changes close together the contact crosses a whole piece of the flank.
    brief = jnp.diff(found, append=jnp.inf)
    share = jnp.arange(1, _PARTS, dtype=found.dtype) / _PARTS
    inside = found[:, None] + jnp.where(brief < _BRIEF, brief, jnp.inf)[:, None] * share
    # A change lies inside a step too short to matter: no stage is evaluated beside it, where
    # rounding would decide on which side.
    apart = jnp.minimum(brief, jnp.diff(found, prepend=-jnp.inf))
    aside = jnp.minimum(jnp.clip(_LOOSE * tolerance, *_ASIDE), _SHARE * apart)
    # Of two changes at almost the same instant each would be at an end of a step of no length.
    least = jnp.maximum(_ASIDE[0], _ROUNDINGS * float(jnp.finfo(found.dtype).eps) * periods)
    aside = jnp.maximum(aside, least)
    beside = [sign * grade * aside for grade in (1.0, *_GRADES) for sign in (-1, 1)]
    added = [*(found + apart for apart in beside), inside.ravel()]
    merged = jnp.sort(jnp.concatenate([out.grid if base is None else base, *added]))
    # Nearly equal ends would make steps of no length.
    close = jnp.diff(merged, prepend=-jnp.inf) < _APART
    close |= ~((merged > 0) & (merged <= periods))
    return jnp.sort(jnp.where(close, jnp.inf, merged))[: out.grid.shape[0]]


def halved(grid: Float[Array, " steps"]) -> Float[Array, " steps"]:
    """The grid with its steps divided in two; where there is no room for all, the longest.

    Steps that hold a change stay as they are: their middle is the change itself, where rounding
    decides on which side of it the derivatives are taken.
    """
    lengths, whole = _lengths(grid)
    taken = grid < jnp.inf
    begins = jnp.concatenate([jnp.zeros_like(grid[:1]), grid[:-1]])
    rank = jnp.argsort(jnp.argsort(-lengths))
    chosen = (rank < grid.shape[0] - jnp.sum(taken)) & (lengths > whole)
    middles = jnp.where(chosen, begins + lengths / 2, jnp.inf)
    return jnp.sort(jnp.concatenate([grid, middles]))[: grid.shape[0]]


def has_room(grid: Float[Array, " steps"]) -> Bool[Array, ""]:
    """Whether `halved` divides all steps that it is to divide."""
    lengths, whole = _lengths(grid)
    return jnp.sum(grid < jnp.inf) + jnp.sum(lengths > whole) <= grid.shape[0]


def _lengths(grid):
    """Lengths of the steps, and that up to which a step may hold a change."""
    taken = grid < jnp.inf
    begins = jnp.concatenate([jnp.zeros_like(grid[:1]), grid[:-1]])
    lengths = jnp.where(taken, grid - jnp.where(taken, begins, 0.0), 0.0)
    rounding = float(jnp.finfo(grid.dtype).eps) * jnp.max(jnp.where(taken, grid, 0.0))
    return lengths, _HOLDS * jnp.maximum(_ASIDE[1], _ROUNDINGS * rounding)
