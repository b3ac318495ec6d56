"""Solver steps that end where the equation of motion is not smooth.

Inside a step, a kink of the equation reduces a high-order method to low order. A jump of the
equation's derivatives (where contact moves to the next flank segment) harms the linearised motion
far more than the motion itself.

A *switch* in this file is an instant at which a flag of `RotorPair.switches` changes.
"""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from rootsopt.dynamics.flow import Flow
from rootsopt.dynamics.pair import RotorPair
from rootsopt.dynamics.peak import Steps, blended

_LOOKS, _LONGEST = 252, 8
"""Number of times per mesh period, in addition to the ends of steps, at which flags are compared to
find switches; and the maximum length of the motion (mesh periods)."""
_CHANGES = 1024
"""Maximum number of switches found in one motion. A mesh period has about 20 to 100."""
_LANES = 16
"""Number of times at which flags are evaluated together, as arrays."""
_HALVINGS = 26
"""Number of bisections that locate a switch."""
_BRIEF, _PARTS = 0.05, 8
"""Distance (mesh periods) between two switches below which the interval between them is divided,
and the number of steps into which it is divided."""
_ASIDE = 1e-9, 1e-6
"""Lower and upper limits (mesh periods) of half the length of the short step around a switch. The
error of the gradients is proportional to this length."""
_LOOSE = 1e3
"""Half the length of the short step around a switch: this number of tolerances (mesh periods),
within the limits `_ASIDE`."""
_ROUNDINGS = 16.0
"""Minimum half length (rounding errors of the time) of the short step around a switch. It exceeds
the limits `_ASIDE` only in single precision."""
_SHARE = 1e-4
"""Maximum half length of the short step around a switch, as a fraction of the time to the nearest
other switch. Where flags change at the ends of a rounded corner, the error of the gradients is
proportional to the square of this fraction."""
_GRADES = 8.0, 64.0
"""Distances of further step ends from a switch, as multiples of half the length of the short step
around it. They keep the neighbouring steps short, in case the switch occurs slightly outside its
short step."""
_HOLDS = 2.5
"""Length of a step (multiples of the greatest half length of a short step around a switch) up to
which the step is never halved: it may be such a short step."""
_APART = 1e-10
"""Distance (mesh periods) below which two step ends are merged."""


def with_switches(
    pair: RotorPair,
    out: Flow,
    periods: Float[Array, ""],
    tolerance: Float[Array, ""],
    base: Float[Array, " steps"] | None = None,
) -> Float[Array, " steps"]:
    """Return the grid `base` with step ends added around the switches along the motion `out`.

    `out` was integrated over `periods` mesh periods at the relative `tolerance`. `base`: ends of
    steps (mesh periods), by default the grid of `out`."""
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
        """Return the number of switches, then for each switch the index of its flag, the flag's
        value before, and both ends of the interval. Flags count if they matter at either end."""
        differ = (seen[1:] != seen[:-1]) & (counts[1:] | counts[:-1])
        differ &= (jnp.arange(1, places.shape[0]) < known)[:, None]
        interval, which = jnp.nonzero(differ, size=_CHANGES, fill_value=0)
        number = jnp.minimum(jnp.sum(differ), _CHANGES)
        return number, which, seen[interval, which], places[interval], places[interval + 1]

    # Scan and bisect in one loop, so that the flags are compiled once.
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
    # Between two close switches the contact crosses a whole flank segment: make short steps there.
    brief = jnp.diff(found, append=jnp.inf)
    share = jnp.arange(1, _PARTS, dtype=found.dtype) / _PARTS
    inside = found[:, None] + jnp.where(brief < _BRIEF, brief, jnp.inf)[:, None] * share
    # Each switch lies inside a step too short to matter. No stage is evaluated right at the switch,
    # where rounding would decide the side.
    apart = jnp.minimum(brief, jnp.diff(found, prepend=-jnp.inf))
    aside = jnp.minimum(jnp.clip(_LOOSE * tolerance, *_ASIDE), _SHARE * apart)
    # A minimum length: two switches at almost the same instant would give steps of zero length.
    least = jnp.maximum(_ASIDE[0], _ROUNDINGS * float(jnp.finfo(found.dtype).eps) * periods)
    aside = jnp.maximum(aside, least)
    beside = [sign * grade * aside for grade in (1.0, *_GRADES) for sign in (-1, 1)]
    added = [*(found + apart for apart in beside), inside.ravel()]
    merged = jnp.sort(jnp.concatenate([out.grid if base is None else base, *added]))
    # Nearly equal ends would give steps of zero length.
    close = jnp.diff(merged, prepend=-jnp.inf) < _APART
    close |= ~((merged > 0) & (merged <= periods))
    return jnp.sort(jnp.where(close, jnp.inf, merged))[: out.grid.shape[0]]


def halved(grid: Float[Array, " steps"]) -> Float[Array, " steps"]:
    """Return `grid` with its steps halved, or only the longest steps if there is no room for all.

    The short steps around switches are not halved. A switch lies in the middle of such a step, and
    rounding would decide on which side of the switch the derivatives are taken.
    """
    lengths, whole = _lengths(grid)
    taken = grid < jnp.inf
    begins = jnp.concatenate([jnp.zeros_like(grid[:1]), grid[:-1]])
    rank = jnp.argsort(jnp.argsort(-lengths))
    chosen = (rank < grid.shape[0] - jnp.sum(taken)) & (lengths > whole)
    middles = jnp.where(chosen, begins + lengths / 2, jnp.inf)
    return jnp.sort(jnp.concatenate([grid, middles]))[: grid.shape[0]]


def has_room(grid: Float[Array, " steps"]) -> Bool[Array, ""]:
    """Return whether `grid` has room for `halved` to halve all steps but the short ones around
    switches."""
    lengths, whole = _lengths(grid)
    return jnp.sum(grid < jnp.inf) + jnp.sum(lengths > whole) <= grid.shape[0]


def _lengths(grid):
    """Return (lengths of all steps, length up to which a step counts as a short one around a
    switch).

    Lengths are in mesh periods, and 0 for unused entries of `grid`. The second result exceeds the
    length of every short step."""
    taken = grid < jnp.inf
    begins = jnp.concatenate([jnp.zeros_like(grid[:1]), grid[:-1]])
    lengths = jnp.where(taken, grid - jnp.where(taken, begins, 0.0), 0.0)
    rounding = float(jnp.finfo(grid.dtype).eps) * jnp.max(jnp.where(taken, grid, 0.0))
    return lengths, _HOLDS * jnp.maximum(_ASIDE[1], _ROUNDINGS * rounding)
