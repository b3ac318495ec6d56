"""The greatest distance between the flanks of two profiles."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from rootsopt.profiles.base import Profile
from rootsopt.runtime.programs import Program

_NODES = 400
"""Least number of nodes on each side of the pitch circle. Chords then deviate from the flank by
about 1e-7 pitch radii."""


def departure(profile: Profile, other: Profile, nodes: int = _NODES) -> float:
    """Return the greatest distance (m) between the flanks of two profiles, from tip to root.

    Distances are measured from each flank to the other, and the greatest of all is returned.
    `nodes`: least number of points on each side of the pitch circle."""
    first, second = (flank_points(one, nodes) for one in (profile, other))
    return float(max(distances(first, second).max(), distances(second, first).max()))


def flank_points(profile: Profile, nodes: int = _NODES) -> NDArray[np.float64]:
    """Return points (n, 2) in m on a flank of `profile` from tip to root.

    The points are evenly spaced in normal angle; the ends of segments are further points. `nodes`:
    least number of points on each side of the pitch circle."""
    stop = float(profile.pitch_normal)
    ends = [float(s.stop) for s in profile.segments()]
    return np.asarray(_points(profile, np.union1d(np.linspace(0, stop, nodes), ends)))


@Program
def _points(profile: Profile, nu):
    addendum, dedendum = (profile.position(f(nu)) for f in (profile.addendum, profile.dedendum))
    return jnp.concatenate([addendum, dedendum[::-1]])


def distances(
    points: Float[np.ndarray, "n 2"], line: Float[np.ndarray, "m 2"]
) -> NDArray[np.float64]:
    """Return the distance (n,) of each of the `points` from a polygonal `line`.

    Points, line and distances have the same unit of length."""
    start, step = line[:-1], np.diff(line, axis=0)
    squares = np.maximum(np.sum(step**2, axis=1), np.finfo(float).tiny)
    away = points[:, None] - start
    share = np.clip(np.einsum("nmk,mk->nm", away, step) / squares, 0.0, 1.0)
    away -= share[..., None] * step
    return np.sqrt(np.min(np.einsum("nmk,nmk->nm", away, away), axis=1))
