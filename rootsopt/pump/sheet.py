"""The pump sheet: what a designer weighs beside the contact force, at one glance."""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from rootsopt.config.units import MM
from rootsopt.profiles import geometry
from rootsopt.pump import flow
from rootsopt.pump.play import play
from rootsopt.runtime.programs import Program
from rootsopt.scene import Scene

CM3 = 1e-6
"""One cubic centimetre (m³)."""
L_MIN = 1e-3 / 60
"""One litre per minute (m³/s)."""
MRAD = 1e-3
"""One milliradian (rad)."""
LINES = 4
"""Number of lines of the flow in the sheet."""
NOTE = (
    "The flow ripple is (r_a - r_p)^2 / (eta r_a^2): with the outer radius r_a and the area "
    "efficiency eta given, no other shape of the flank changes it."
)
"""What limits the ripple, for the user."""


def sheet(scene: Scene, design: Float[Array, " d"]) -> dict[str, Any]:
    """Return the pump sheet of a `design` (d,) in config units, as in the result file.

    Every key ends with its unit; quantities without a unit are fractions. `flow_lines`: amplitudes
    of the flow's lines as fractions of the mean flow; the k-th has 2Nk periods per revolution.
    `tip_height_of_limit`: tip height over the pitch circle as a fraction of its limit. Ripple and
    lines are left out for twisted rotors.

    With a clearance, a centre distance error or a measured outline, there is also the play.
    `angular_play_…_mrad`: least and greatest play of rotor 2 over the rotation.
    `gear_backlash_max_mm`: greatest backlash of a timing gear that keeps the flanks apart, negative
    where the rotors overlap."""
    found = {key: value.tolist() for key, value in _flow(scene, design).items()}
    if _has_play(scene):
        found |= {key: value.tolist() for key, value in _play(scene, design).items()}
    hidden = () if scene.straight else _STRAIGHT
    return {key: found[key] for key in KEYS if key in found and key not in hidden}


KEYS = (
    "displaced_volume_cm3",
    "theoretical_flow_l_min",
    "flow_ripple",
    "flow_lines",
    "tip_height_of_limit",
    "angular_play_min_mrad",
    "angular_play_max_mrad",
    "gear_backlash_max_mm",
)
"""Keys of the sheet, in the order of its rows."""
_STRAIGHT = "flow_ripple", "flow_lines"
"""Keys that hold for straight rotors only."""


@Program
def _flow(scene: Scene, design: Float[Array, " d"]) -> dict[str, Array]:
    profile = scene.profile(design)
    shape = geometry(profile)
    return {
        "displaced_volume_cm3": flow.displaced_volume(shape, scene.length) / CM3,
        "theoretical_flow_l_min": flow.theoretical_flow(shape, scene.length, scene.speed) / L_MIN,
        "flow_ripple": flow.ripple(profile, shape),
        "flow_lines": jnp.abs(flow.flow_lines(profile, shape, LINES)),
        "tip_height_of_limit": flow.tip_height_share(profile, shape),
    }


def _has_play(scene: Scene) -> bool:
    """Return whether rotor 2 has play between its flanks, or the rotors may overlap."""
    odd = scene.outline is not None or scene.center_distance_error is not None
    return odd or float(scene.clearance) > 0


@Program
def _play(scene: Scene, design: Float[Array, " d"]) -> dict[str, Array]:
    profile = scene.profile(design)
    found = play(profile, scene.clearance, center_distance(scene))
    return {
        "angular_play_min_mrad": jnp.min(found.total) / MRAD,
        "angular_play_max_mrad": jnp.max(found.total) / MRAD,
        "gear_backlash_max_mm": found.gear_backlash / MM,
    }


def center_distance(scene: Scene) -> Float[Array, ""]:
    """Return the distance between the rotors' axes (m)."""
    error = scene.center_distance_error
    return 2 * scene.pitch_radius + (0.0 if error is None else error)
