"""Checks that the edge between a tip land and an arc is not too sharp."""

from typing import TYPE_CHECKING, Any

from rootsopt.config.units import hint
from rootsopt.errors import InputError

if TYPE_CHECKING:
    from rootsopt.config.scene import ProfileConfig

SHARPEST = 0.002
"""Edge radius (pitch radii) below which a config is rejected. On a sharper edge, nodes of the
outline and of the contact would coincide."""


def check(profile: "ProfileConfig") -> None:
    """Raise `InputError` if the edge radius is below `SHARPEST` pitch radii."""
    edge: Any = profile.parameters["edge_radius_mm"]
    least = SHARPEST * profile.pitch_radius_mm
    if edge < least:
        raise InputError(
            f"`profile.edge_radius_mm` must be at least {least:g} ({SHARPEST:g} pitch radii), but "
            f"is {edge:g}: the contact law does not apply to a sharp edge; round it"
            + hint("edge_radius_mm", edge, 0.01 * profile.pitch_radius_mm, profile.pitch_radius_mm)
        )
