"""Rotor profiles: the roll-angle core and one file per family."""

from rootsopt.profiles.arc_families import arc, five_arcs, four_arcs
from rootsopt.profiles.arcs import Arcs
from rootsopt.profiles.base import Profile, RollPoint, Segment
from rootsopt.profiles.cic import CIC
from rootsopt.profiles.curve import Curve, Piece
from rootsopt.profiles.ee import EE
from rootsopt.profiles.ellipse import ellipse
from rootsopt.profiles.freeform import FreeForm, project
from rootsopt.profiles.geometry import Geometry, flank, flank_nodes, geometry, outline

__all__ = [
    "CIC",
    "EE",
    "Arcs",
    "Curve",
    "FreeForm",
    "Geometry",
    "Piece",
    "Profile",
    "RollPoint",
    "Segment",
    "arc",
    "ellipse",
    "five_arcs",
    "flank",
    "flank_nodes",
    "four_arcs",
    "geometry",
    "outline",
    "project",
]
