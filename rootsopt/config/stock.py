"""Tables of materials, media and usual gears, for a rotor that is known only from a sheet.

All values are usual ones at 20 °C, unless they say otherwise. A certificate or a data sheet
replaces them."""

import math

MATERIALS = {
    # density (kg/m³), Young's modulus (GPa), Poisson's ratio, usual densities and moduli, source
    "cast-iron": (7200, 110, 0.26, "7100 to 7300", "103 to 118", "EN-GJL-250, EN 1561"),
    "ductile-iron": (7100, 169, 0.275, "7000 to 7200", "165 to 176", "EN-GJS-400, EN 1563"),
    "steel": (7850, 210, 0.30, "7800 to 7870", "200 to 212", "EN 1993-1-1"),
    "stainless-steel": (7900, 200, 0.30, "7700 to 8000", "193 to 200", "EN 10088-1"),
    "aluminium": (2700, 70, 0.30, "2650 to 2800", "68 to 73", "EN 1999-1-1"),
    "pom": (1410, 2.8, 0.35, "1390 to 1430", "2.6 to 3.1", "unfilled, data sheets of makers"),
    "peek": (1310, 3.7, 0.38, "1290 to 1320", "3.5 to 4.1", "unfilled, data sheets of makers"),
}
_GASES = "-10 to 150 °C: 0.9 to 1.4 times this"
MEDIA = {
    # viscosity (mPa·s), gas constant (J/(kg·K)), ratio of specific heats, range of the viscosity.
    # Gases: NIST Chemistry WebBook at 1 bar, R / M; water: IAPWS; oil: ISO 3448, with 870 kg/m³.
    "air": (0.0182, 287.05, 1.40, _GASES),
    "nitrogen": (0.0176, 296.80, 1.40, _GASES),
    "oxygen": (0.0203, 259.84, 1.40, _GASES),
    "argon": (0.0223, 208.13, 1.667, _GASES),
    "helium": (0.0196, 2077.3, 1.667, _GASES),
    "hydrogen": (0.0088, 4124.5, 1.41, _GASES),
    "carbon-dioxide": (0.0147, 188.92, 1.29, _GASES),
    "methane": (0.0110, 518.28, 1.31, _GASES),
    "water": (1.00, None, None, "5 to 80 °C: 1.52 to 0.35"),
    "oil": (40.0, None, None, "ISO VG 46 at 40 °C; VG 22 to VG 220: 19 to 190"),
}
TEETH, FACE, TOOTH_ANGLE, MESH = 50, 0.3, 20.0, 20.0
"""A usual timing gear: teeth per gear, face width (pitch diameters), pressure angle (°), stiffness
(N/(mm·µm)) of the mesh of steel spur gears by ISO 6336-1, where usual gears have 14 to 25."""
LINE = 10 / 9
"""Exponent of the force between two cylinders that touch along a line."""


def gear_stiffness(center_distance: float) -> float:
    """Return the torsional stiffness (N·m/rad) of the mesh of a usual timing gear.

    `center_distance` in mm, equal to the pitch diameter of both gears. With the face width b and
    the base radius r_b, a torque turns one gear against the other by torque / (c b r_b²)."""
    base = center_distance / 2 * math.cos(math.radians(TOOTH_ANGLE))
    return MESH * FACE * center_distance * base**2


def gear_backlash(center_distance: float) -> float:
    """Return the least backlash (mm) along the pitch circle that is recommended for usual gears.

    ISO/TR 10064-2: 2/3 (0.06 + 0.0005 a + 0.03 m) along the normal, in mm, with the centre distance
    a, here `center_distance`, and the module m."""
    normal = 2 / 3 * (0.06 + (0.0005 + 0.03 / TEETH) * center_distance)
    return normal / math.cos(math.radians(TOOTH_ANGLE))


def line_stiffness(modulus: float, poisson: float, length: float) -> float:
    """Return K (N/mm^e) of the force K δ^e of two flanks of a `length` (mm), e = `LINE`.

    `modulus` (GPa), `poisson`: Young's modulus E and Poisson's ratio ν. Lundberg (1939), as in
    Palmgren's bearing formulas: δ = 1.36 (η F)^0.9 / L^0.8, with η = 2 (1 - ν²) / E. For steel it
    is δ = 3.84e-5 F^0.9 / L^0.8."""
    return (length**0.8 / 1.36) ** LINE * modulus * 1e3 / (2 * (1 - poisson**2))
