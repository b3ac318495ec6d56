"""Rotor profiles: a base class that describes a flank by its roll angle, and the families."""

from rootsopt.profiles.arcs import Arcs, arc, arcs_epicycloid, five_arcs, four_arcs
from rootsopt.profiles.base import Profile, RollPoint, Segment
from rootsopt.profiles.cic import CIC
from rootsopt.profiles.curve import Curve, Piece, RollPiece, ellipse, extended_cycloid
from rootsopt.profiles.epicycloid import EE, TippedEpicycloid, circle_epicycloid, hypo_epicycloid
from rootsopt.profiles.freeform import FreeForm, project
from rootsopt.profiles.geometry import (
    Geometry,
    flank,
    flank_nodes,
    geometry,
    outline,
    place_pair,
    quadrature_nodes,
)
from rootsopt.profiles.outline import Outline, Table

__all__ = [
    "CIC",
    "EE",
    "Arcs",
    "Curve",
    "FreeForm",
    "Geometry",
    "Outline",
    "Piece",
    "Profile",
    "RollPiece",
    "RollPoint",
    "Segment",
    "Table",
    "TippedEpicycloid",
    "arc",
    "arcs_epicycloid",
    "circle_epicycloid",
    "ellipse",
    "extended_cycloid",
    "five_arcs",
    "flank",
    "flank_nodes",
    "four_arcs",
    "geometry",
    "hypo_epicycloid",
    "outline",
    "place_pair",
    "project",
    "quadrature_nodes",
]
