"""Find kinks and jumps along lines, which switches must mark."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

COUNT = 801
"""Number of points along a line. It is odd, so that steps are not a simple fraction of the line."""
# Change of a slope (multiples of the greatest change beside it) above which there is a kink.
_AGAINST = 8.0
# Change of a slope (fraction of the greatest slope along the line) that may be rounding.
_ROUNDINGS = 1e-6


def along(function, lines, *given):
    """Yield values, slopes and flags of `function` at `COUNT` points on each of several lines.

    `function(point, *given)` → (values (r,), flags (s,)); `lines`: pairs (start, stop) of points,
    which are trees of arrays. One program serves all of them, and other arrays in `given`."""
    for line in lines:
        start, stop = (jax.tree.map(lambda x: jnp.asarray(x, float), end) for end in line)
        yield [np.asarray(x) for x in _look(function, start, stop, *given)]


@functools.partial(jax.jit, static_argnums=0)
def _look(function, start, stop, *given):
    def at(t):
        return function(jax.tree.map(lambda a, b: a + t * (b - a), start, stop), *given)

    def slope(t):
        return jax.jvp(at, (t,), (jnp.ones_like(t),), has_aux=True)

    return jax.lax.map(slope, jnp.linspace(0.0, 1.0, COUNT))


def unmarked(values, slopes, flags):
    """Return the indices of intervals between points in which a value or a slope jumps without a
    change of flags."""
    found = np.zeros(len(values) - 1, bool)
    step = 1 / (len(values) - 1)
    for value, slope in zip(values.T, slopes.T, strict=True):
        scale = np.max(np.abs(slope)) + np.finfo(float).tiny
        # At a jump, a value changes by more than its slopes at both ends explain.
        rise = np.abs(np.diff(value) - step * (slope[1:] + slope[:-1]) / 2)
        for change, size in ((np.abs(np.diff(slope)), scale), (rise / step, scale)):
            padded = np.pad(change, 2, mode="edge")
            beside = np.maximum.reduce([padded[:-4], padded[1:-3], padded[3:-1], padded[4:]])
            found |= (change > _AGAINST * beside) & (change > _ROUNDINGS * size)
    marked = np.any(flags[1:] != flags[:-1], axis=1)
    # A kink exactly on a point appears in the neighbouring interval.
    near = marked | np.roll(marked, 1) | np.roll(marked, -1)
    return np.flatnonzero(found & ~near)
