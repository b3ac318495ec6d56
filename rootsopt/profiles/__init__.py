"""Rotor profiles: the roll-angle core and one file per family."""

from rootsopt.profiles.base import Profile, RollPoint, Segment
from rootsopt.profiles.cic import CIC
from rootsopt.profiles.ee import EE
from rootsopt.profiles.geometry import Geometry, flank, flank_nodes, geometry, outline

__all__ = [
    "CIC",
    "EE",
    "Geometry",
    "Profile",
    "RollPoint",
    "Segment",
    "flank",
    "flank_nodes",
    "geometry",
    "outline",
]
