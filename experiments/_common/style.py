"""Colours, marks and axes of the studies' figures."""

from typing import Any

from matplotlib.axes import Axes
from matplotlib.ticker import LogLocator, NullFormatter

from rootsopt.figures.style import BLUE, GREEN, ORANGE, PURPLE, SKY, VERMILION
from rootsopt.figures.style import GREY as GREY
from rootsopt.figures.style import figure as sheet

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
    "plain_ticks",
    "sheet",
]  # fmt: skip

BLACK = "#000000"
COLORS = (BLUE, VERMILION, GREEN, PURPLE, ORANGE, SKY, BLACK)
MARKS = "osD^vPX"


def grid_below(ax: Axes, **options: Any) -> None:
    """Draw a light grid behind everything else."""
    ax.grid(**({"color": "0.92", "linewidth": 0.6} | options))
    ax.set_axisbelow(True)


def plain_ticks(axis: Any) -> None:
    """Put ticks of a logarithmic axis at 1, 2 and 5, without powers of ten."""
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter("{x:g}")
    axis.set_tick_params(labelsize=8)
    axis.set_minor_formatter(NullFormatter())
