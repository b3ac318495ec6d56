"""Drawings, solids and animations of a design, all made from one outline of arcs and splines."""

from rootsopt.export.command import FORMATS, add_option, chosen

__all__ = ["FORMATS", "add_option", "chosen"]
