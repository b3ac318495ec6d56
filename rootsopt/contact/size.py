"""Finds the size that a contact map needs for a given error.

The gap is computed by search along a few fine lines through the map. For each size in a fixed list,
SciPy fits the map's spline to this gap, one dimension at a time. The error is that of the
penetration where the flanks overlap. The list is fixed because every size needs its own compiled
program."""

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
"""Number of poses on each line over the roll, and on each line over ε, in `_probe`."""
_LINES = 5, 33
"""Two numbers: lines over the roll, each at half the ε of the line before; lines over ε, at evenly
spaced rolls."""


class MapSize(NamedTuple):
    """Size of a contact map.

    `rolls`, `relatives`: number of points over roll and over ε; `error`: estimated error (m) of the
    penetration; `enough`: whether the map meets the requested error."""

    rolls: int
    relatives: int
    error: float
    enough: bool


def size_map(profile: Profile, deepest: float, error: float) -> MapSize:
    """Return the smallest map down to ε = `deepest` (rad) with a penetration error ≤ `error` (m).

    `profile`: profile of both rotors.

    If no size in the list meets the error, return the smallest whose error is at most 1.5 times the
    least in the list.
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
    """Return (rolls, gap (lines, rolls)) on lines of poses over the roll, and the same over ε.

    Rolls and ε are in rad; the gap is in m."""
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
    """Return (least number of points in `ladder` whose error is at most `error` (m), this error).

    If no number meets the error, return the least whose error is at most 1.5 times the least error.

    `start`, `stop`: range of the map (rad); `probed`: points and gap on fine lines."""
    from scipy.interpolate import CubicSpline  # Imported for maps only: it takes 0.5 s.

    points, lines = map(np.asarray, probed)
    inside = lines < 0
    # Exclude the cells next to the start of contact, beyond which the gap is only a continuation.
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
