"""Colours, marks and axes of the studies' figures."""

from typing import Any

from matplotlib.axes import Axes

from rootsopt.view.figures.style import BLUE, GREEN, ORANGE, PURPLE, SKY, VERMILION
from rootsopt.view.figures.style import GREY as GREY
from rootsopt.view.figures.style import figure as sheet

__all__ = [
    "BLACK",
    "BLUE",
    "COLORS",
    "GREEN",
    "GREY",
    "MARKS",
    "ORANGE",
    "PURPLE",
    "SKY",
    "VERMILION",
    "grid_below",
    "sheet",
]  # fmt: skip

BLACK = "#000000"
COLORS = (BLUE, VERMILION, GREEN, PURPLE, ORANGE, SKY, BLACK)
MARKS = "osD^vPX"


def grid_below(ax: Axes, **options: Any) -> None:
    """Draw a light grid behind everything else."""
    ax.grid(**({"color": "0.92", "linewidth": 0.6} | options))
    ax.set_axisbelow(True)
