"""A closed outline as points."""

import dataclasses

import numpy as np
from jaxtyping import Bool, Complex128


@dataclasses.dataclass(frozen=True)
class Loop:
    """Points (mm, as x + iy) of a closed outline in order, the first not repeated.

    `joints` marks the ends of a drawing's arcs and splines, where curvature may jump. The readers
    also use it for open chains of points.
    """

    points: Complex128[np.ndarray, " n"]
    joints: Bool[np.ndarray, " n"]


def signed_area(points: Complex128[np.ndarray, " n"]) -> float:
    """Area inside a closed polygon (mm²), positive if it runs counter-clockwise."""
    return float(np.sum(np.imag(np.conj(points) * np.roll(points, -1)))) / 2


def place(z: complex) -> str:
    """A point for a message."""
    return f"({z.real:.5g}, {z.imag:.5g}) mm"
