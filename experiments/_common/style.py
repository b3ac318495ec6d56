"""Colours, marks and axes of the studies' figures."""

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
    "sheet",
]  # fmt: skip

BLACK = "#000000"
COLORS = (BLUE, VERMILION, GREEN, PURPLE, ORANGE, SKY, BLACK)
MARKS = "osD^vPX"
