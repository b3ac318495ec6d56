"""Steps that end where the equation of motion is not smooth.

A method of high order sees a kink of the equation as an error of low order, and a jump of
its derivatives (where the contact moves on to the next piece of a flank) costs the
linearised motion far more than the motion itself.
"""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from rootsopt.dynamics.flow import Flow
from rootsopt.dynamics.pair import RotorPair
from rootsopt.dynamics.peak import motion

_LOOKS = 252
"""Intervals in which changes are looked for (every switch for itself)."""
_CHANGES = 48
"""Changes found in one stretch of motion, at most."""
_HALVINGS = 24
_BRIEF, _PARTS = 0.05, 8
"""Changes less than `_BRIEF` mesh periods apart have `_PARTS` steps between them."""
_ASIDE = 1e-9, 1e-6
"""Half a step (mesh periods) that holds a change: so many times the tolerance of the motion as
`_LOOSE`, but within these. What it does to the gradients is in proportion to it."""
_LOOSE = 1e3
_APART = 1e-10
"""Ends of steps closer than this (mesh periods) are one."""


def with_switches(
    pair: RotorPair, out: Flow, periods: Float[Array, ""], tolerance: Float[Array, ""]
) -> Float[Array, " steps"]:
    """The grid of `out`, integrated over `periods` mesh periods at a relative `tolerance`, with
    steps that end where the equation changes from one smooth piece to another."""
    samples = out.states.shape[0]
    width = periods / samples
    stride = (samples - 1) / _LOOKS
    blocks = -(-(_LOOKS + 1) // _CHANGES)
    lanes = jnp.arange(_CHANGES)

    def flags(place):
        return pair.switches(place * width, motion(out.states, place))

    def changes(seen):
        """Where switches change: interval, switch, and its value before."""
        interval, which = jnp.nonzero(
            seen[1 : _LOOKS + 1] != seen[:_LOOKS], size=_CHANGES, fill_value=-1
        )
        return interval, which, seen[interval, which]

    # Looking and halving in one loop, so that the switches are compiled once.
    def look(i, carry):
        seen, low, high = carry
        interval, which, before = changes(seen)
        looking = i < blocks
        first = i == blocks
        low = jnp.where(first, interval * stride, low)
        high = jnp.where(first, (interval + 1) * stride, high)
        middle = (low + high) / 2
        index = jnp.minimum(i * _CHANGES + lanes, _LOOKS)
        found = jax.vmap(flags)(jnp.where(looking, index * stride, middle))
        seen = jnp.where(looking, seen.at[index].set(found), seen)
        same = found[lanes, which] == before
        low, high = jnp.where(same, middle, low), jnp.where(same, high, middle)
        return seen, low, high

    shape = jax.eval_shape(flags, width).shape
    nothing = jnp.zeros(_CHANGES, width.dtype)
    start = jnp.zeros((_LOOKS + 1, *shape), bool), nothing, nothing
    seen, _, high = lax.fori_loop(0, blocks + _HALVINGS, look, start)
    interval, _, _ = changes(seen)
    found = jnp.sort(jnp.where(interval >= 0, high * width, jnp.inf))
    # Between two changes close together the contact crosses a whole piece of the flank.
    brief = jnp.diff(found, append=jnp.inf)
    share = jnp.arange(1, _PARTS, dtype=found.dtype) / _PARTS
    inside = found[:, None] + jnp.where(brief < _BRIEF, brief, jnp.inf)[:, None] * share
    # A change lies inside a step too short to matter: no stage is evaluated beside it, where
    # rounding would decide on which side.
    aside = jnp.clip(_LOOSE * tolerance, *_ASIDE)
    added = [found - aside, found + aside, inside.ravel()]
    merged = jnp.sort(jnp.concatenate([out.grid, *added]))
    # Nearly equal ends would make steps of no length.
    close = jnp.diff(merged, prepend=-jnp.inf) < _APART
    close |= ~((merged > 0) & (merged <= periods))
    return jnp.sort(jnp.where(close, jnp.inf, merged))[: out.grid.shape[0]]
