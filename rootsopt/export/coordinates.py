"""Coordinates of one lobe for the grinder, and the width of a lobe (mm)."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rootsopt.export.pieces import Arc, DrawnPiece

_SAME = 1e-9
"""Distance along the outline (fraction of the outline's length) below which two points count as
one."""


class Coordinates(NamedTuple):
    """Points on one lobe, from the root before it to the root behind it, counter-clockwise.

    `point` (n,): x + iy (mm), with the lobe's tip on +x; `normal` (n,): outward unit normals, at a
    corner that of the part behind it; `along` (n,): distance along the outline from the tip (mm).
    """

    point: NDArray[np.complex128]
    normal: NDArray[np.complex128]
    along: NDArray[np.float64]

    def columns(self) -> dict[str, NDArray[np.float64]]:
        """Return the columns of `rotor_points.csv`, each (n,)."""
        return {
            "x_mm": self.point.real,
            "y_mm": self.point.imag,
            "radius_mm": np.abs(self.point),
            "angle_deg": np.degrees(np.angle(self.point)),
            "normal_deg": np.degrees(np.angle(self.normal)),
            "along_mm": self.along,
        }


def coordinates(pieces: Sequence[DrawnPiece], lobes: int, count: int) -> Coordinates:
    """Return points on the lobe on +x: `count` of them, evenly spaced, and all ends of pieces.

    `pieces`: closed outline, as from `outline_pieces`; `lobes`: number of lobes."""
    ends = np.concatenate([[0.0], np.cumsum([piece.length for piece in pieces])])
    total, tip = ends[-1], _tip(pieces, ends)
    half = total / (2 * lobes)
    along = np.linspace(-half, half, count)
    corners = (ends[:-1] - tip + total / 2) % total - total / 2
    corners = corners[np.abs(corners) < half * (1 - _SAME)]
    along = np.sort(np.concatenate([along, corners]))
    along = along[np.concatenate([[True], np.diff(along) > _SAME * total])]
    place = (along + tip) % total
    # A point at the end of a piece belongs to the piece behind it.
    number = np.searchsorted(ends[1:] - _SAME * total, place, side="right") % len(pieces)
    place = np.where(place >= total * (1 - _SAME), 0.0, place)
    point, normal = np.empty(len(along), complex), np.empty(len(along), complex)
    for k, piece in enumerate(pieces):
        mine = number == k
        share = np.clip((place[mine] - ends[k]) / piece.length, 0.0, 1.0)
        point[mine], normal[mine] = piece.at(share), -1j * piece.heading(share)
    return Coordinates(point, normal, along)


def _tip(pieces: Sequence[DrawnPiece], ends: NDArray[np.float64]) -> float:
    """Return the distance along the outline at which it crosses the x axis at the tip on +x."""
    for piece, start in zip(pieces, ends, strict=False):
        y = [float(np.imag(piece.at(share))) for share in (0.0, 1.0)]
        if y[0] > 0 or y[1] <= 0 or np.real(piece.at(0.5)) < 0:
            continue
        low, high = 0.0, 1.0
        for _ in range(60):
            middle = (low + high) / 2
            low, high = (middle, high) if np.imag(piece.at(middle)) <= 0 else (low, middle)
        return float(start + high * piece.length)
    raise ValueError("Argument `pieces` must be an outline with a lobe tip on +x, but is not")


def widest(pieces: Sequence[DrawnPiece], lobes: int) -> complex:
    """Return the point (mm) on the upper flank of the lobe on +x at which the lobe is widest.

    Its width is twice the point's y coordinate. If the lobe widens all the way down to the root,
    the point is that on the pitch circle, at the angle π / (2 `lobes`)."""
    found = [point for piece in pieces for point in _tops(piece)]
    reach = max(abs(piece.start) for piece in pieces)
    inside = [
        point for point in found
        if 0 < np.angle(point) < np.pi / lobes - _SAME and point.imag > _SAME * reach
    ]  # fmt: skip
    if inside:
        return max(inside, key=lambda point: point.real)
    return _at_angle(pieces, np.pi / (2 * lobes))


def _tops(piece: DrawnPiece) -> list[complex]:
    """Return the points of a piece at which y is greatest among their neighbours."""
    if isinstance(piece, Arc):
        if piece.sweep < 0:
            return []
        turn = (np.pi / 2 - piece.begin) % (2 * np.pi)
        return [complex(piece.center + 1j * piece.radius)] if turn <= piece.sweep else []
    points = []
    for curve in piece.beziers():
        y = curve.imag
        slope = np.diff(y)
        # Slope of a cubic Bézier curve as a polynomial: 3 ((1-t)² d0 + 2 t (1-t) d1 + t² d2).
        a, b, c = slope[0] - 2 * slope[1] + slope[2], 2 * (slope[1] - slope[0]), slope[0]
        for root in np.roots([a, b, c]):
            t = float(np.real(root))
            if abs(np.imag(root)) < _SAME and 0 <= t <= 1 and 2 * a * t + b < 0:
                weights = np.array([(1 - t) ** 3, 3 * t * (1 - t) ** 2, 3 * t**2 * (1 - t), t**3])
                points.append(complex(weights @ curve))
    return points


def _at_angle(pieces: Sequence[DrawnPiece], angle: float) -> complex:
    """Return the point of the outline at a polar angle (rad) between 0 and that of the root."""
    turn = np.exp(-1j * angle)
    for piece in pieces:
        share = np.linspace(0.0, 1.0, 65)
        y = np.imag(piece.at(share) * turn)
        crossed = np.flatnonzero((y[:-1] <= 0) & (y[1:] > 0))
        for k in crossed:
            low, high = share[k], share[k + 1]
            for _ in range(60):
                middle = (low + high) / 2
                above = np.imag(piece.at(middle) * turn) > 0
                low, high = (low, middle) if above else (middle, high)
            point = complex(piece.at(high))
            if np.real(point * turn) > 0:
                return point
    raise ValueError("Argument `pieces` must be a closed outline around the origin, but is not")


__all__ = ["Coordinates", "coordinates", "widest"]
