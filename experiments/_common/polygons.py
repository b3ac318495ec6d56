"""Gap between the nodes of one outline and the segments of another: Eq. 9 of the paper.

Tests and studies use this method as the reference for the fast search. The method is slow, but
assumes neither roll angles nor conjugacy: it needs only a closed outline and a pose. The module
uses only NumPy and SciPy.
"""

import numpy as np
from numpy.typing import NDArray

from rootsopt.profiles import place_pair

Points = NDArray[np.float64]


def signed_distance(nodes: Points, outline: Points, refine: bool = True) -> NDArray[np.float64]:
    """Return the signed distance (n,) from `nodes` to a closed counter-clockwise `outline`.

    The distance is positive outside, in the unit of `nodes` (n, 2) and `outline` (m, 2). Without
    `refine`, the distance is that from the nearest straight segment (Eq. 9). With `refine`, a cubic
    through the segment's two ends, with the outline's own tangents, replaces that segment. The
    error is then of fourth order in the node spacing, not second.
    """
    from scipy.spatial import KDTree  # Slow import (0.2 s), not needed by figures.

    corners = outline[:-1] if np.allclose(outline[0], outline[-1], atol=0) else outline
    count = len(corners)
    nearest = KDTree(corners).query(nodes)[1]
    tangents = _tangents(corners) if refine else None
    # Distances from the segments on both sides of the nearest corner, with their signs.
    distances = []
    for shift in (-1, 0):
        start = (nearest + shift) % count
        point, direction = _project(nodes, corners, start, (start + 1) % count, tangents)
        offset = nodes - point
        outside = direction[:, 0] * offset[:, 1] - direction[:, 1] * offset[:, 0] < 0
        distances.append(np.where(outside, 1.0, -1.0) * np.hypot(offset[:, 0], offset[:, 1]))
    before, after = distances
    return np.where(np.abs(after) < np.abs(before), after, before)


def _tangents(corners):
    """Return unit tangents (n, 2) at the nodes `corners` (n, 2) of a closed outline.

    The tangent at a node is that of the circle through it and its two neighbours."""
    before = corners - np.roll(corners, 1, axis=0)
    after = np.roll(corners, -1, axis=0) - corners
    weight = np.linalg.norm(before, axis=1)[:, None], np.linalg.norm(after, axis=1)[:, None]
    tangent = before / weight[0] ** 2 + after / weight[1] ** 2
    return tangent / np.linalg.norm(tangent, axis=1)[:, None]


def _project(nodes, corners, start, stop, tangents):
    """Return (foot points of `nodes` on segments of the outline, tangents of the curve there).

    `corners`: nodes of the outline; `start`, `stop`: indices of the ends of the segment for each
    node; `tangents`: see `_tangents`, `None` for straight segments.
    """
    a = corners[start]
    chord = corners[stop] - a
    length2 = np.einsum("ij,ij->i", chord, chord)
    t = np.clip(np.einsum("ij,ij->i", nodes - a, chord) / length2, 0.0, 1.0)
    if tangents is None:
        return a + t[:, None] * chord, chord
    length = np.sqrt(length2)[:, None]
    m0, m1 = tangents[start] * length, tangents[stop] * length
    c2, c3 = 3 * chord - 2 * m0 - m1, m0 + m1 - 2 * chord
    for _ in range(4):
        u = t[:, None]
        point = a + u * (m0 + u * (c2 + u * c3))
        slope = m0 + u * (2 * c2 + 3 * u * c3)
        bend = 2 * c2 + 6 * u * c3
        offset = nodes - point
        residual = np.einsum("ij,ij->i", offset, slope)
        descent = np.einsum("ij,ij->i", slope, slope) - np.einsum("ij,ij->i", offset, bend)
        t = np.clip(t + residual / np.where(descent > 0, descent, np.inf), 0.0, 1.0)
    u = t[:, None]
    return a + u * (m0 + u * (c2 + u * c3)), m0 + u * (2 * c2 + 3 * u * c3)


def pair_gap(
    outline: Points,
    lobes: int,
    center_distance: float,
    phi1: float,
    phi2: float,
    reach: float | None = None,
    refine: bool = True,
) -> float:
    """Return the least signed distance between the rotors at one pose, in the unit of `outline`.

    `outline`, `lobes`, `center_distance`, `phi1`, `phi2`: as in `place_pair`. `refine`: as in
    `signed_distance`. `reach`: distance beyond rotor 2's outer circle above which a node of rotor 1
    is ignored. By default, it is 0.05 outer radii, which includes all nodes that can touch.
    """
    first, second = place_pair(outline, lobes, center_distance, phi1, phi2)
    outer = np.max(np.hypot(outline[:, 0], outline[:, 1]))
    reach = 0.05 * outer if reach is None else reach

    away = np.linalg.norm(first[:-1] - [center_distance, 0.0], axis=1)
    return _least(first[:-1][away < outer + reach], second, refine)


def _least(nodes, outline, refine):
    distance = signed_distance(nodes, outline, refine)
    i = int(np.argmin(distance))
    if not refine or i in (0, len(nodes) - 1):
        return float(distance[i])
    # Vertex of the parabola through the three nodes around the least distance.
    before, after = np.linalg.norm(np.diff(nodes[i - 1 : i + 2], axis=0), axis=1)
    curvature, slope, _ = np.polyfit([-before, 0.0, after], distance[i - 1 : i + 2], 2)
    if curvature <= 0 or max(before, after) > 3 * min(before, after):
        return float(distance[i])
    return float(distance[i] - slope**2 / (4 * curvature))
