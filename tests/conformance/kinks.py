"""Find kinks and jumps along lines, which switches must mark."""

import jax
import jax.numpy as jnp
import numpy as np

COUNT = 801
"""Number of points along a line. It is odd, so that steps are not a simple fraction of the line."""
_AGAINST = 8.0
"""Change of a slope (multiples of the greatest change beside it) above which there is a kink."""
_ROUNDINGS = 1e-6
"""Change of a slope (fraction of the greatest slope along the line) below which it may be
rounding."""


def along(function, lines):
    """Yield values, slopes and flags of `function` at `COUNT` points on each of several lines.

    `function(point)` → (values (r,), flags (s,)); `lines`: pairs (start, stop) of points, which are
    trees of arrays. One program serves all of them."""

    @jax.jit
    def look(start, way):
        def at(t):
            return function(jax.tree.map(lambda a, d: a + t * d, start, way))

        slope = lambda t: jax.jvp(at, (t,), (jnp.ones_like(t),), has_aux=True)  # noqa: E731
        return jax.lax.map(slope, jnp.linspace(0.0, 1.0, COUNT))

    for start, stop in lines:
        start, stop = (jax.tree.map(jnp.asarray, end) for end in (start, stop))
        way = jax.tree.map(lambda a, b: b - a, start, stop)
        yield [np.asarray(x) for x in look(start, way)]


def kinks(values, slopes):
    """Return a mask of the intervals between points (COUNT - 1,) with a jump of a value or of a
    slope."""
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
    return found


def unmarked(values, slopes, flags):
    """Return the indices of kinks without a change of flags."""
    marked = np.any(flags[1:] != flags[:-1], axis=1)
    # A kink exactly on a point appears in the neighbouring interval.
    near = marked | np.roll(marked, 1) | np.roll(marked, -1)
    return np.flatnonzero(kinks(values, slopes) & ~near)
