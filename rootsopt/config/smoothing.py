"""Chooses the smoothing length of a scene if the config gives none."""

import math

_LONGEST = 1e-4
"""Maximum default smoothing length (mm). A limit from `_SHARES` can be smaller."""
_SHARES = {"twist": 0.05, "depth": 0.02, "damping": 0.1}
"""Maximum default smoothing length, as a fraction of each of three lengths.

`twist`: deflection of the timing gear under the full load, at the pitch radius. With a longer
smoothing length, the gear would work in the rounded edge of its backlash, where its stiffness
differs. `depth`: penetration of the flanks under the full load. `damping`: penetration at which the
damping is full."""
_LEAST = 1e-6
"""Minimum default smoothing length (mm).

A shorter length would need more solver steps and make the gradient less accurate."""
_LEAST_LOAD = 1e-3
"""Load torque (N·m) below which the smoothing length does not depend on the load."""


def following_mm(
    load_torque: float,
    pitch_radius_mm: float,
    gear_stiffness: float | None,
    contact: tuple[float, float, float],
) -> float:
    """Return the default smoothing length (mm) of a scene, with two significant digits.

    `load_torque`: torque on rotor 2 (N·m). `pitch_radius_mm`: pitch radius (mm). `gear_stiffness`:
    stiffness of the timing gear (N·m/rad), `None` without a gear. `contact`: stiffness (N/mm^e),
    exponent e and depth of full damping (mm) of the flanks.

    This smoothing changes the forces by less than 1e-4 of their values. The command `python -m
    experiments smoothing` measures this."""
    torque = max(load_torque, _LEAST_LOAD)
    stiffness, exponent, full = contact
    force = torque / (pitch_radius_mm * 1e-3)
    lengths = [
        _LONGEST,
        _SHARES["depth"] * (force / stiffness) ** (1 / exponent),
        _SHARES["damping"] * full,
    ]
    if gear_stiffness is not None:
        lengths.append(_SHARES["twist"] * torque / gear_stiffness * pitch_radius_mm)
    shortest = max(min(lengths), _LEAST)
    # Two digits keep the written config readable.
    return float(f"{shortest:.1e}") if math.isfinite(shortest) else _LONGEST
