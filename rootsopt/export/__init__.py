"""Drawings, solids and animations of a design, all from one outline of arcs and splines."""
