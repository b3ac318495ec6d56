"""The points of a closed outline, and the small loops in which it crosses itself."""

import dataclasses
import itertools

import numpy as np
from jaxtyping import Bool, Complex128, Float64
from numpy.typing import NDArray

_CUSP = 2.0
"""Turn (rad) at a point above which the outline runs back there."""
_STRAIGHT = 0.8
"""Distance between the two cusps of a tail (length of the path between them) below which they do
not belong together."""
_BESIDE = 1000
"""Number of points on each side of a tail that are searched for its crossing."""


@dataclasses.dataclass(frozen=True)
class Loop:
    """The points of a closed outline in order; the first point is not repeated at the end.

    `points` (n,): points (mm) as x + iy; `joints` (n,): mask of the points at the ends of arcs and
    splines, where curvature may jump; `unit`: length (mm) of the file's unit; `gap`: width (mm) of
    the widest gap between entities that was closed, and its place; `notes`: sentences for the user
    on what the reader converted, chose or changed. The readers also use this class for open chains
    of points.
    """

    points: Complex128[np.ndarray, " n"]
    joints: Bool[np.ndarray, " n"]
    unit: float = 1.0
    gap: tuple[float, complex] = (0.0, 0j)
    notes: tuple[str, ...] = ()


def signed_area(points: Complex128[np.ndarray, " n"]) -> float:
    """Return the area (mm²) of the closed polygon with the corners `points` (mm, as x + iy).

    The area is positive if the polygon runs counter-clockwise."""
    return float(np.sum(np.imag(np.conj(points) * np.roll(points, -1)))) / 2


def moment(points: Complex128[np.ndarray, " n"], order: int) -> complex:
    """Return ∬ z^order dA of a polygon, exactly, with the corners `points` (z = x + iy).

    By Green's theorem, the moment is ∮ z̄ z^order dz / 2i."""
    step = np.roll(points, -1) - points
    nodes, weights = np.polynomial.legendre.leggauss(order // 2 + 2)
    z = points[:, None] + step[:, None] * (1 + nodes) / 2
    return np.sum(np.conj(z) * z**order * step[:, None] * weights / 2) / 2j


def lengths_along(points: Complex128[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
    """Return the length (mm) of the polygonal line from its first point to each of its `points`."""
    return np.append(0.0, np.cumsum(np.abs(np.diff(points))))


Tail = tuple[NDArray[np.intp], complex, float]
"""A swallow-tail, in which the outline runs forth, back and forth again between two cusps: indices
of the points that trimming removes, crossing of the two forward runs (mm, as x + iy), and distance
(mm) between the cusps."""


def tails(points: Complex128[np.ndarray, " n"], most: int) -> list[Tail]:
    """Return the swallow-tails of a closed outline.

    There are none if more than `most` points are cusps: these are scattered."""
    steps, count = np.roll(points, -1) - points, len(points)
    cusps = np.flatnonzero(np.abs(np.angle(steps / np.roll(steps, 1))) > _CUSP)
    if not 2 <= len(cusps) <= most:
        return []
    # Begin after the widest stretch without cusps, so that the two cusps of a tail are neighbours.
    gaps = np.diff(cusps, append=cusps[0] + count)
    begin = cusps[np.argmax(gaps)] + np.max(gaps) // 2
    reach = min(_BESIDE, count // 4)
    found: list[Tail] = []
    free = 0  # First index that belongs to no tail yet.
    for i, j in itertools.pairwise(np.sort((cusps - begin) % count).tolist()):
        if i < free or j - i >= reach:
            continue
        index = (begin + np.arange(i - reach, j + reach + 1)) % count
        run = np.diff(points[index][reach - 1 : reach + j - i + 1])
        # Between the cusps, the outline runs back along the step to the first, without turns.
        back = np.all(np.real(run[1:] * np.conj(run[0])) < 0)
        direct = abs(np.sum(run[1:])) > _STRAIGHT * np.sum(np.abs(run[1:]))
        if back and direct:
            found.append(_tail(points[index], index, reach, reach + j - i))
            free = j + 1
    return found


def _tail(z: NDArray[np.complex128], index: NDArray[np.intp], i: int, j: int) -> Tail:
    """Return the swallow-tail between the cusps `i` and `j` of the points `z`.

    `index`: indices of these points in the outline."""
    ahead = np.real((z - z[i]) * np.conj(z[i] - z[i - 1]))
    # The last point before the stretch that is passed three times, and the first point after it.
    p = i - 1 - int(np.argmax(np.append(ahead[i - 1 :: -1] < np.min(ahead[i : j + 1]), True)))
    q = j + int(np.argmax(np.append(ahead[j:-1] > np.max(ahead[i : j + 1]), True)))
    p, size = max(p, 0), float(np.max(np.abs(z[i : j + 1] - z[i])))
    one, other = np.arange(p, i)[:, None], np.arange(j, q)[None, :]
    along, across, apart = z[one + 1] - z[one], z[other + 1] - z[other], z[other] - z[one]
    with np.errstate(all="ignore"):
        area = np.imag(np.conj(along) * across)
        first = np.imag(np.conj(apart) * across) / area
        second = np.imag(np.conj(apart) * along) / area
    hits = np.argwhere((first >= 0) & (first < 1) & (second >= 0) & (second < 1))
    if len(hits) == 0:  # Too thin for a crossing: the runs lie on one another.
        return index[p + 1 : q], complex(z[i] + z[j]) / 2, size
    k, m = hits[0]
    at = complex(z[p + k] + first[k, m] * along[k, 0])
    return index[p + k + 1 : j + m + 1], at, size


def place(z: complex) -> str:
    """Format a point `z` = x + iy (mm) as text for a message."""
    return f"({z.real:.5g}, {z.imag:.5g}) mm"
