"""Solver steps that end where the equation of motion is not smooth.

Inside a step, a kink of the equation reduces a high-order method to low order. A jump of the
equation's derivatives (where contact moves to the next flank segment) harms the linearised motion
far more than the motion itself.

A *switch* in this file is an instant at which a flag of `RotorPair.switches` changes.
"""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from rootsopt.dynamics.flow import Flow
from rootsopt.dynamics.pair import RotorPair
from rootsopt.dynamics.peak import Steps, blended

_LOOKS, _LONGEST = 252, 8
"""Number of times per mesh period, in addition to the ends of steps, at which flags are compared to
find switches; and the maximum length of the motion (mesh periods)."""
_CHANGES = 1024
"""Maximum number of switches found in one motion. A mesh period has about 20 to 100."""
_FEW, _FEW_CHANGES = 2048, 128
"""Numbers of steps and of switches above which whole arrays are sorted, unused entries included."""
_LANES = 16
"""Number of times at which flags are evaluated together, as arrays."""
_HALVINGS = 26
"""Number of bisections that locate a switch."""
_BRIEF, _PARTS = 0.05, 8
"""Distance (mesh periods) between two switches below which the interval between them is divided,
and the number of steps into which it is divided."""
_ASIDE, _CLOSE = (1e-10, 1e-6), 1e-9
"""Lower and upper limits (mesh periods) of half the length of the short step around a switch, and
the lower limit next to another switch, unless the length is smaller anyway. The error of the
gradients is proportional to this length."""
_LOOSE = 1e3
"""Ratio of half the length (mesh periods) of the short step around a switch to the tolerance. The
limits `_ASIDE` have precedence."""
_ROUNDINGS = 16.0
"""Minimum half length (rounding errors of the time) of the short step around a switch."""
_SHARE = 1e-4
"""Maximum half length of the short step around a switch, as a fraction of the time to the nearest
other switch. Where flags change at the ends of a rounded corner, the error of the gradients is
proportional to the square of this fraction."""
_GRADES = 8.0, 64.0
"""Distances of further step ends from a switch, as multiples of half the length of the short step
around it. They keep the neighbouring steps short, in case the switch occurs slightly outside its
short step."""
_HOLDS = 2.5
"""Length of a step below which the step is never halved, in multiples of the greatest half length
of a short step around a switch. The step may be such a short step."""
_APART = 1e-11
"""Distance (mesh periods) below which two step ends are merged."""


def with_switches(  # 81 lines: its inner functions share the steps.
    pair: RotorPair,
    out: Flow,
    periods: Float[Array, ""],
    tolerance: Float[Array, ""],
    base: Float[Array, " steps"] | None = None,
) -> Float[Array, " steps"]:
    """Return the grid `base` with step ends added around the switches along the motion `out`.

    `out` was integrated over `periods` mesh periods. Its switches are known to about the relative
    `tolerance`, which sets the lengths of the short steps around them. `base`: ends of steps (mesh
    periods), by default the grid of `out`."""
    width = periods / out.states.shape[0]
    before = jnp.concatenate([out.states[:1], out.corners[:-1]])
    begins = jnp.concatenate([jnp.zeros_like(out.grid[:1]), out.grid[:-1]])
    taken = jnp.sum(out.grid < jnp.inf)
    steps = Steps(begins, out.grid, before, out.corners, taken)
    even = jnp.arange(_LONGEST * _LOOKS, dtype=width.dtype) / _LOOKS
    even = jnp.where(even < periods, even, jnp.inf)
    most = out.grid.shape[0] + even.shape[0]
    places = _if_few(
        taken <= _FEW,
        lambda room: jnp.sort(jnp.concatenate([even, out.grid[:room]])),
        (_FEW, out.grid.shape[0]),
        most,
    )
    known = jnp.sum(places < jnp.inf)
    blocks = -(-known // _LANES)
    lanes = jnp.arange(_LANES)

    def flags(tau):
        return pair.switches(tau, blended(pair, out.states, steps, tau, width))

    width_of = jax.eval_shape(flags, width)[0].shape[0]

    # Scan and bisect in one loop, so that the flags are compiled once.
    def go_on(carry):
        turn, number, *_ = carry
        return (turn < blocks) | (turn < blocks + _HALVINGS * -(-number // _LANES))

    def look(carry):
        turn, number, listed, (low, high), last = carry
        looking = turn < blocks
        place = jnp.where(looking, turn, (turn - blocks) // _HALVINGS) * _LANES + lanes
        at = jnp.minimum(place, jnp.where(looking, known, _CHANGES) - 1)
        middle = (low[at % _CHANGES] + high[at % _CHANGES]) / 2
        found, counted = jax.vmap(flags)(jnp.where(looking, places[at], middle))
        # Scan: list the flags that differ from those at the previous instant, if they matter at
        # one of both.
        differ, before = _changed((found, counted), last)
        differ &= (looking & (place > 0) & (place < known))[:, None]
        codes = 2 * (at[:, None] * width_of + jnp.arange(width_of)) + before
        slot = jnp.where(differ, number + _rank(differ), _CHANGES)
        listed = listed.at[slot.ravel()].set(codes.ravel(), mode="drop")
        number = jnp.minimum(number + jnp.sum(differ), _CHANGES)
        # Bisect between the two instants at which a flag differs.
        which, was = listed[at % _CHANGES] // 2 % width_of, listed[at % _CHANGES] % 2 == 1
        same = found[lanes, which] == was
        lower, upper = (jnp.where(looking | ~side, _CHANGES, at) for side in (same, ~same))
        low, high = low.at[lower].set(middle, mode="drop"), high.at[upper].set(middle, mode="drop")
        after = listed // (2 * width_of)
        ready = turn + 1 == blocks
        low = jnp.where(ready, places[jnp.maximum(after - 1, 0)], low)
        high = jnp.where(ready, places[after], high)
        return turn + 1, number, listed, (low, high), (found[-1], counted[-1])

    nothing, unseen = jnp.zeros((), int), jnp.zeros(width_of, bool)
    listed = jnp.zeros(_CHANGES, int)
    ends = jnp.zeros(_CHANGES, width.dtype), jnp.zeros(_CHANGES, width.dtype)
    start = nothing, nothing, listed, ends, (unseen, unseen)
    _, number, _, (_, high), _ = lax.while_loop(go_on, look, start)
    grid = out.grid if base is None else base
    switches = jnp.where(jnp.arange(_CHANGES) < number, high, jnp.inf)
    few = (jnp.sum(grid < jnp.inf) <= _FEW) & (number <= _FEW_CHANGES)
    rooms = (_FEW, _FEW_CHANGES), (grid.shape[0], _CHANGES)
    return _if_few(
        few,
        lambda room: _surrounded(grid[: room[0]], switches[: room[1]], periods, tolerance),
        rooms,
        grid.shape[0],
    )


def _if_few(few: Bool[Array, ""], build, rooms: tuple, size: int) -> Float[Array, " size"]:
    """Return `build` of the first of the `rooms` if `few`, else of the second, with inf appended up
    to the length `size`.

    Sorting takes a tenth of the time of an orbit if all unused entries are sorted as well."""

    def built(room):
        found = build(room)[:size]
        return jnp.concatenate([found, jnp.full(size - found.shape[0], jnp.inf, found.dtype)])

    small, large = rooms
    if small == large:
        return built(large)
    return lax.cond(few, lambda: built(small), lambda: built(large))


def _surrounded(
    grid: Float[Array, " steps"],
    switches: Float[Array, " changes"],
    periods: Float[Array, ""],
    tolerance: Float[Array, ""],
) -> Float[Array, " more"]:
    """Return `grid` with step ends added around the `switches`, padded with inf."""
    found = jnp.sort(switches)
    # Between two close switches the contact crosses a whole flank segment: make short steps there.
    brief = jnp.diff(found, append=jnp.inf)
    share = jnp.arange(1, _PARTS, dtype=found.dtype) / _PARTS
    # Each switch lies inside a step too short to matter. No stage is evaluated right at the switch,
    # where rounding would decide the side.
    apart = jnp.minimum(brief, jnp.diff(found, prepend=-jnp.inf))
    usual = jnp.clip(_LOOSE * tolerance, *_ASIDE)
    # A minimum length: two switches at almost the same instant would give steps of zero length.
    rounding = _ROUNDINGS * float(jnp.finfo(found.dtype).eps) * periods
    least = jnp.maximum(jnp.minimum(usual, _CLOSE), rounding)
    aside = jnp.maximum(jnp.minimum(usual, _SHARE * apart), least)
    # Two switches may be at the same instant, as where seal and contact pass the same joint. A step
    # end between them would be right at the switch, where derivatives may be wrong by 10⁴.
    divided = (brief < _BRIEF) & (brief > 2 * _PARTS * least)
    inside = found[:, None] + jnp.where(divided, brief, jnp.inf)[:, None] * share
    beside = [sign * grade * aside for grade in (1.0, *_GRADES) for sign in (-1, 1)]
    added = [*(found + apart for apart in beside), inside.ravel()]
    merged = jnp.sort(jnp.concatenate([grid, *added]))
    # Nearly equal ends would give steps of zero length.
    close = jnp.diff(merged, prepend=-jnp.inf) < _APART
    close |= ~((merged > 0) & (merged <= periods))
    return jnp.sort(jnp.where(close, jnp.inf, merged))


def _changed(
    now: tuple[Bool[Array, "lanes s"], Bool[Array, "lanes s"]],
    last: tuple[Bool[Array, " s"], Bool[Array, " s"]],
) -> tuple[Bool[Array, "lanes s"], Bool[Array, "lanes s"]]:
    """Return which flags differ from those at the previous instant, and these previous flags.

    `now`: flags at successive instants, and which of them matter; `last`: the same at the instant
    before the first. A flag counts if it matters at one of the two instants."""
    before, counted_before = (
        jnp.concatenate([old[None], new[:-1]]) for old, new in zip(last, now, strict=True)
    )
    found, counted = now
    return (found != before) & (counted | counted_before), before


def _rank(chosen: Bool[Array, "lanes s"]) -> Int[Array, "lanes s"]:
    """Return for each entry the number of chosen entries before it, row by row.

    The sums are masked, because XLA takes seconds to compile a cumulative sum inside a loop."""

    def before(counts):
        places = jnp.arange(counts.shape[-1])
        return jnp.sum(jnp.where(places[:, None] > places, counts[..., None, :], 0), axis=-1)

    inside = chosen.astype(int)
    return before(jnp.sum(inside, axis=1))[:, None] + before(inside)


def halved(grid: Float[Array, " steps"]) -> Float[Array, " steps"]:
    """Return `grid` with its steps halved, or only the longest of them if there is no room for all.

    The short steps around switches are not halved. A switch lies in the middle of such a step, and
    rounding would decide on which side of the switch the derivatives are taken."""
    lengths, whole = _lengths(grid)
    taken = grid < jnp.inf
    begins = jnp.concatenate([jnp.zeros_like(grid[:1]), grid[:-1]])
    longer = lengths > whole

    def longest():
        rank = jnp.argsort(jnp.argsort(-lengths))
        return (rank < grid.shape[0] - jnp.sum(taken)) & longer

    chosen = lax.cond(has_room(grid), lambda: longer, longest)
    middles = jnp.where(chosen, begins + lengths / 2, jnp.inf)
    return _if_few(
        jnp.sum(taken) <= _FEW,
        lambda room: jnp.sort(jnp.concatenate([grid[:room], middles[:room]])),
        (_FEW, grid.shape[0]),
        grid.shape[0],
    )


def has_room(grid: Float[Array, " steps"]) -> Bool[Array, ""]:
    """Return whether `grid` has room to halve all steps, except the short ones around switches."""
    lengths, whole = _lengths(grid)
    return jnp.sum(grid < jnp.inf) + jnp.sum(lengths > whole) <= grid.shape[0]


def _lengths(grid):
    """Return (lengths of all steps, length below which a step may be a short one around a switch).

    Lengths are in mesh periods, and 0 for unused entries of `grid`."""
    taken = grid < jnp.inf
    begins = jnp.concatenate([jnp.zeros_like(grid[:1]), grid[:-1]])
    lengths = jnp.where(taken, grid - jnp.where(taken, begins, 0.0), 0.0)
    rounding = float(jnp.finfo(grid.dtype).eps) * jnp.max(jnp.where(taken, grid, 0.0))
    return lengths, _HOLDS * jnp.maximum(_ASIDE[1], _ROUNDINGS * rounding)
