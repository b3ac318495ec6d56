"""Colours and line styles of all figures, and a function that makes figures without a display."""

from typing import Any

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

# Okabe and Ito's palette: distinguishable with any colour vision, and in grey.
BLUE, VERMILION, GREEN = "#0072B2", "#D55E00", "#009E73"
ORANGE, SKY, PURPLE, GREY = "#E69F00", "#56B4E9", "#CC79A7", "#808080"
COLORS = (BLUE, VERMILION, GREEN, PURPLE, ORANGE, SKY)
"""Colours of the curves in a figure, used in this order."""
DASHES = ("-", (0, (5, 1.5)), (0, (1, 1)), "-.")
"""Line styles of the curves in a figure, used in this order."""


def figure(
    width: float, height: float, rows: int = 1, columns: int = 1, **options: Any
) -> tuple[Figure, NDArray]:
    """Return a figure that needs no display, and its array of axes of shape (rows, columns).

    `width`, `height`: size in inches; `options`: keyword arguments of `Figure.subplots`."""
    made = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(made)
    return made, made.subplots(rows, columns, squeeze=False, **options)
