"""The pump sheet: what a designer weighs beside the contact force, at one glance."""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from rootsopt.profiles import geometry
from rootsopt.pump import flow
from rootsopt.runtime.programs import Program
from rootsopt.scene import Scene

CM3 = 1e-6
"""One cubic centimetre (m³)."""
L_MIN = 1e-3 / 60
"""One litre per minute (m³/s)."""
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
    lines are left out for twisted rotors."""
    found = {key: value.tolist() for key, value in _flow(scene, design).items()}
    hidden = () if scene.straight else _STRAIGHT
    return {key: found[key] for key in KEYS if key in found and key not in hidden}


KEYS = (
    "displaced_volume_cm3",
    "theoretical_flow_l_min",
    "flow_ripple",
    "flow_lines",
    "tip_height_of_limit",
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
