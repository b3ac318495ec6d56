"""The smoothing length that follows the scene, where the config leaves it open."""

import math

_LONGEST = 1e-4
"""Smoothing length (mm) of a scene with nothing small in it."""
_SHARES = {"twist": 0.05, "depth": 0.02, "damping": 0.1}
"""Greatest smoothing length in units of: the gear's deflection at the pitch radius under the whole
load, the flanks' penetration under it, and the depth of full damping. A gear that rests inside its
rounded edge is another gear."""
_LEAST = {"float64": 1e-6, "float32": 1e-5}
"""Least smoothing length (mm), by precision. A shorter one costs solver steps and accuracy of the
gradient; in single precision the gap itself is known to some 4e-6 mm only."""
_LEAST_LOAD = 1e-3
"""Load (N·m) below which the smoothing length no longer follows it."""


def following_mm(
    load_torque: float,
    pitch_radius_mm: float,
    gear_stiffness: float | None,
    contact: tuple[float, float, float],
    precision: str,
) -> float:
    """Smoothing length (mm) of a scene with a `load_torque` (N·m) on rotor 2, and a timing gear of
    `gear_stiffness` (N·m/rad) if there is one.

    `contact`: stiffness (N/mm^e), exponent and depth of full damping (mm) of the flanks. Chosen so
    that rounding changes no force by 1e-4 of itself (`python -m experiments.smoothing`).
    """
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
    shortest = max(min(lengths), _LEAST[precision])
    # Two digits: a config is read by people.
    return float(f"{shortest:.1e}") if math.isfinite(shortest) else _LONGEST
