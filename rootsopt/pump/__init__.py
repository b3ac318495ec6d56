"""Properties of a pump other than the contact force: flow, play, leakage, bearing loads.

All functions are pure, take SI units and can be differentiated by JAX with respect to profile and
scene. Nothing here enters the simulation."""

from rootsopt.pump.flow import (
    Leakage,
    displaced_volume,
    flow_lines,
    greatest_radius_ratio,
    leakage,
    relative_flow,
    ripple,
    theoretical_flow,
    tip_height_share,
    twisted_lines,
    twisted_ripple,
)
from rootsopt.pump.gap import Allowances, MeshGap, Play, mesh_gap, play, relative_curvature

__all__ = [
    "Allowances",
    "Leakage",
    "MeshGap",
    "Play",
    "displaced_volume",
    "flow_lines",
    "greatest_radius_ratio",
    "leakage",
    "mesh_gap",
    "play",
    "relative_curvature",
    "relative_flow",
    "ripple",
    "theoretical_flow",
    "tip_height_share",
    "twisted_lines",
    "twisted_ripple",
]
