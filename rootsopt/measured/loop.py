"""The points of a closed outline."""

import dataclasses

import numpy as np
from jaxtyping import Bool, Complex128


@dataclasses.dataclass(frozen=True)
class Loop:
    """The points of a closed outline in order; the first point is not repeated at the end.

    `points` (n,): points (mm) as x + iy; `joints` (n,): mask of the points at the ends of arcs and
    splines, where curvature may jump; `unit`: length (mm) of the file's unit. The readers also use
    this class for open chains of points.
    """

    points: Complex128[np.ndarray, " n"]
    joints: Bool[np.ndarray, " n"]
    unit: float = 1.0


def signed_area(points: Complex128[np.ndarray, " n"]) -> float:
    """Return the area (mm²) of the closed polygon with the corners `points` (mm, as x + iy).

    The area is positive if the polygon runs counter-clockwise."""
    return float(np.sum(np.imag(np.conj(points) * np.roll(points, -1)))) / 2


def place(z: complex) -> str:
    """Format a point `z` = x + iy (mm) as text for a message."""
    return f"({z.real:.5g}, {z.imag:.5g}) mm"
