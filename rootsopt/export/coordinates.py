"""Coordinates of one lobe for the grinder, and the width of a lobe (mm)."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import root_scalar

from rootsopt.export.pieces import DrawnPiece

_SAME = 1e-9
"""Distance along the outline (fraction of the outline's length) below which two points count as
one."""
_SAMPLES = 65
"""Number of points of a piece between which crossings are sought."""


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
    number, share = _at_angle(pieces, 0.0)
    total, tip = ends[-1], ends[number] + share * pieces[number].length
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


def widest(pieces: Sequence[DrawnPiece], lobes: int) -> complex:
    """Return the point (mm) on the upper flank of the lobe on +x at which the lobe is widest.

    Its width is twice the point's y coordinate. If the lobe widens all the way down to the root,
    the point is that on the pitch circle, at the angle π / (2 `lobes`)."""
    found = []
    for piece in pieces:
        for share in _falls(lambda x, piece=piece: np.imag(piece.heading(x))):
            found.append(complex(piece.at(share)))
    inside = [point for point in found if 0 < np.angle(point) < np.pi / lobes - _SAME]
    if inside:
        return max(inside, key=lambda point: point.real)
    number, share = _at_angle(pieces, np.pi / (2 * lobes))
    return complex(pieces[number].at(share))


def _at_angle(pieces: Sequence[DrawnPiece], angle: float) -> tuple[int, float]:
    """Return number and share of the piece at which the outline crosses a polar angle (rad)."""
    turn = np.exp(-1j * angle)
    for number, piece in enumerate(pieces):
        for share in _falls(lambda x, piece=piece: -np.imag(piece.at(x) * turn)):
            if np.real(piece.at(share) * turn) > 0:
                return number, share
    raise ValueError("Argument `pieces` must be a closed outline around the origin, but is not")


def _falls(function: Callable[[Any], Any]) -> Iterator[float]:
    """Yield the shares (0 to 1) at which a `function` of them falls below 0."""
    share = np.linspace(0.0, 1.0, _SAMPLES)
    value = function(share)
    for k in np.flatnonzero((value[:-1] >= 0) & (value[1:] < 0)):
        bracket = share[k], share[k + 1]
        yield root_scalar(lambda x: float(function(x)), bracket=bracket, xtol=1e-15).root


__all__ = ["Coordinates", "coordinates", "widest"]
