"""How large a contact map must be for a stated error.

The gap is computed by search along a few lines through the map, finely, and the map's
spline is fitted to it at every size of a ladder (SciPy, one dimension at a time). The
error is that of the penetration where the flanks overlap. A ladder rather than any size,
because every size is a program of its own to compile.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from rootsopt.contact.closest import FlankPair
from rootsopt.contact.map import MARGIN, continued_gap, first_roll
from rootsopt.profiles.base import Profile
from rootsopt.runtime.programs import Program

ROLLS = (96, 128, 192, 256, 384, 512, 768, 1024, 1536)
RELATIVES = (16, 24, 32, 48)
_FINE = 3073, 193
_LINES = 5, 33
"""Lines along the roll, at geometrically spaced ε; lines along ε, at uniform rolls."""


class MapSize(NamedTuple):
    """Points over roll and over ε, the `error` of the penetration (m) they leave, and
    whether that is within what was asked."""

    rolls: int
    relatives: int
    error: float
    enough: bool


def size_map(profile: Profile, deepest: float, error: float) -> MapSize:
    """Smallest map down to ε = `deepest` (rad) with an error of penetration ≤ `error` (m).

    Where even the largest falls short, the smallest that is nearly as good.
    """
    along_roll, along_relative = _probe(profile, jnp.asarray(deepest))
    half = float(profile.half_pitch)
    first = float(first_roll(deepest, half))
    rolls, by_roll = _smallest(ROLLS, first, half, along_roll, 0.8 * error)
    relatives, by_relative = _smallest(RELATIVES, deepest, 0.0, along_relative, 0.2 * error)
    total = by_roll + by_relative
    return MapSize(rolls, relatives, total, total <= error)


@Program
def _probe(profile, deepest):
    """Gap (lines, points) on fine lines along the roll and along ε, with the points."""
    pair = FlankPair.of(profile)
    half = profile.half_pitch
    first = first_roll(deepest, half)
    gap = jax.vmap(jax.vmap(lambda x, e: continued_gap(pair, x, e), (0, None)), (None, 0))
    fine_roll = jnp.linspace(first, half, _FINE[0])
    depths = deepest * 0.5 ** jnp.arange(_LINES[0])
    fine_relative = jnp.linspace(deepest, 0.0, _FINE[1])
    rolls = jnp.linspace(first, half, _LINES[1])
    return (fine_roll, gap(fine_roll, depths)), (fine_relative, gap(rolls, fine_relative).T)


def _smallest(
    ladder: tuple[int, ...],
    start: float,
    stop: float,
    probed: tuple[Array, Array],
    error: float,
) -> tuple[int, float]:
    """Smallest number of points of the ladder that keeps within `error`, and its error."""
    from scipy.interpolate import CubicSpline  # Half a second, for maps alone.

    points, lines = map(np.asarray, probed)
    inside = lines < 0
    # Not the cells next to where contact begins: beyond lies what is only continued.
    for shift in (-1, 1):
        inside &= np.roll(lines, shift, axis=1) < 0
    errors: list[float] = []
    for count in ladder:
        step = (stop - start) / (count - 1 - MARGIN)
        knots = np.minimum(start + step * np.arange(count - MARGIN), points[-1])
        fitted = CubicSpline(knots, CubicSpline(points, lines, axis=1)(knots), axis=1)(points)
        errors.append(float(np.max(np.abs(fitted - lines), where=inside, initial=0.0)))
        if errors[-1] <= error:
            return count, errors[-1]
    best = next(i for i, found in enumerate(errors) if found <= 1.5 * min(errors))
    return ladder[best], errors[best]
