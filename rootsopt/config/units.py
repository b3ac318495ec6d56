"""Units in the names of keys, and values and messages as short text.

Hints name a value that seems to be given in another unit. `NAMES` are the quantities of a scene on
which the contact forces depend."""

import difflib
import math
import reprlib
from collections.abc import Iterable, Iterator
from typing import Any

MM = 1e-3
"""One millimetre (m)."""
UM = 1e-6
"""One micrometre (m)."""
DEG = math.pi / 180
"""One degree (rad)."""
RPM = 2 * math.pi / 60
"""One revolution per minute (rad/s)."""

# Ending of a key: (unit, {unit often written by mistake: factor to the right unit}). The first
# ending that fits counts, so the longest endings come first.
_UNITS: dict[str, tuple[str, dict[str, float]]] = {
    "_N_s_per_mm": ("N·s/mm", {"N·s/m": 1e-3, "kN·s/mm": 1e3}),
    "_N_per_mm_e": ("N/mm^e", {}),
    "_N_per_mm": ("N/mm", {"N/m": 1e-3, "kN/mm": 1e3}),
    "_N_m_s_per_rad": ("N·m·s/rad", {"N·mm·s/rad": 1e-3}),
    "_N_m_per_rad": ("N·m/rad", {"N·mm/rad": 1e-3, "kN·m/rad": 1e3}),
    "_mPa_s": ("mPa·s", {"Pa·s": 1e3, "µPa·s": 1e-3}),
    "_J_per_kg_K": ("J/(kg·K)", {"kJ/(kg·K)": 1e3}),
    "_kg_m3": ("kg/m³", {"g/cm³": 1e3, "kg/mm³": 1e9, "t/mm³": 1e12}),
    "_kg_m2": ("kg·m²", {"kg·mm²": 1e-6}),
    "_mm_s": ("mm/s", {"m/s": 1e3, "µm/s": 1e-3}),
    "_rad_s": ("rad/s", {}),
    "_mrad": ("mrad", {"rad": 1e3, "µrad": 1e-3}),
    "_N_m": ("N·m", {"N·mm": 1e-3, "kN·m": 1e3}),
    "_rpm": ("rpm", {"Hz": 60.0, "thousands of rpm": 1e3}),
    "_mm": ("mm", {"metres": 1e3, "micrometres": 1e-3, "centimetres": 10.0}),
    "_deg": ("°", {"radians": 180 / math.pi}),
    "_Pa": ("Pa", {"bar": 1e5, "kPa": 1e3, "MPa": 1e6, "mbar": 100.0}),
    "_per_K": ("1/K", {"1e-6/K": 1e-6}),
    "_K": ("K", {}),
    "_N": ("N", {"kN": 1e3}),
    "_kW": ("kW", {"W": 1e-3, "MW": 1e3}),
    "_bar": ("bar", {}),
    "_cm3": ("cm³", {"litres": 1e3, "mm³": 1e-3}),
    "_mm2": ("mm²", {"m²": 1e6, "cm²": 100.0}),
    "_l_min": ("l/min", {}),
    "_um": ("µm", {"millimetres": 1e3}),
}

_SPELT = str.maketrans({"·": "_", "/": "_per_", "³": "3", "²": "2", "µ": "u", "(": "", ")": ""})

# Units as they are spelt in names of keys.
_SHORT = {"metres": "m", "centimetres": "cm", "micrometres": "um", "radians": "rad"}

MICROMETRE = 1e-3
"""One micrometre (mm): change of clearance, backlash and centre distance error for which the table
states the effect."""

# Quantities of a scene on which the contact forces depend: key, name in words, and unit. Clearance,
# backlash and centre distance error are lengths, in mm.
LENGTHS = (
    ("contact.clearance_mm", "clearance of the flanks"),
    ("scene.timing_gear.backlash_mm", "backlash of the timing gear"),
    ("scene.center_distance_error_mm", "centre distance error"),
)
OTHERS = (
    ("scene.speed_rpm", "speed", "rpm"),
    ("scene.load.torque_N_m", "load", "N m"),
    ("scene.load.pressure_difference_Pa", "pressure difference", "Pa"),
    ("scene.timing_gear.stiffness_N_m_per_rad", "stiffness of the timing gear", "N m/rad"),
    ("scene.timing_gear.damping_ratio", "damping ratio of the timing gear", ""),
    ("contact.stiffness_N_per_mm_e", "contact stiffness", "N/mm^e"),
    ("contact.max_damping_N_s_per_mm", "contact damping", "N s/mm"),
    ("rotor.density_kg_m3", "density", "kg/m^3"),
    ("rotor.length_mm", "rotor length", "mm"),
)
NAMES = {key: name for key, name, *_ in (*LENGTHS, *OTHERS)}
"""Names in words of these quantities, by config key."""


def unit_of(key: str) -> str:
    """Return the unit in the name of a key, or "" if the name has none."""
    return next((unit for end, (unit, _) in _UNITS.items() if key.endswith(end)), "")


def without_unit(key: str) -> str:
    """Return a key without the unit at the end of its name."""
    return key.removesuffix(next((end for end in _UNITS if key.endswith(end)), ""))


def readings(name: str) -> Iterator[tuple[str, str, float]]:
    """Yield what a key's `name` may mean: (name without unit, ending of the unit, factor).

    The ending is one of the config's units, or "" without a unit; the factor converts to it."""
    yield name, "", 1.0
    for end, (_, others) in _UNITS.items():
        endings = {end: 1.0}
        for other, by in others.items():
            spelt = "_" + _SHORT.get(other, other).translate(_SPELT)
            endings |= {spelt: by, spelt.replace("_per_", "_"): by}
        for ending, factor in endings.items():
            if name.endswith(ending):
                yield name.removesuffix(ending), end, factor


def si_unit(key: str) -> float:
    """Return the SI value of one unit of a design parameter's key (mm, ° or no unit)."""
    if key.endswith("_deg"):
        return math.pi / 180
    return 1e-3 if key.endswith("_mm") else 1.0


def words(key: str) -> str:
    """Return the name of a quantity without its unit: `edge_radius_mm` gives "edge radius"."""
    return without_unit(key).replace("_", " ").replace("rms ", "RMS ")


def hint(key: object, value: float, low: float, high: float) -> str:
    """Return the end of a message that asks whether an out-of-range `value` is in another unit.

    `low`, `high`: range of the key. A unit is suggested if the converted value lies in this range.
    For a key without a unit, a percentage may be suggested. Return "" if nothing fits."""
    name = str(key)
    for end, (_, others) in _UNITS.items():
        if name.endswith(end):
            meant = {other: value * factor for other, factor in others.items()}
            fits = [other for other, number in meant.items() if low <= number <= high]
            return f"; is that {fits[0]}? write {meant[fits[0]]:.4g}" if fits else ""
    if high <= 1 < value <= 100 and low <= value / 100:
        return f"; is that a percentage? write {value / 100:g}"
    return ""


# Length (characters) above which a message about a config is shortened.
_LONGEST = 500

# Lengths (characters) of a string value, a key and a path above which a message shortens them.
_VALUE, _NAME, _PATH = 80, 60, 160


class _Bounded(reprlib.Repr):
    """A `repr` that shortens long values and does not process the omitted part."""

    def __init__(self):
        super().__init__()
        self.maxstring = self.maxother = _VALUE
        self.maxlevel, self.maxdict, self.maxlist, self.maxtuple = 3, 4, 8, 8

    def repr_int(self, x, level):
        digits = int(abs(x).bit_length() * 0.30103)
        if digits < 30:
            return repr(x)
        return f"a whole number of {digits} digits"


_repr = _Bounded().repr


def shown(value: Any) -> str:
    """Return a value as text for a message: its `repr`, shortened if it is long."""
    return clipped(_repr(value), 2 * _VALUE)


def named(part: Any, longest: int = _NAME) -> str:
    """Return a config key or another text as printable text for a message.

    It is shortened if it has more than `longest` characters."""
    text = clipped(part if isinstance(part, str) else shown(part), longest)
    return text if text.isprintable() else ascii(text)[1:-1]


def placed(path: Any) -> str:
    """Return a path as printable text for a message. Only the end of a long path is shown."""
    text = str(path)
    text = text if len(text) <= _PATH else "..." + text[3 - _PATH :]
    return text if text.isprintable() else ascii(text)[1:-1]


def clipped(text: str, longest: int = _LONGEST) -> str:
    """Shorten a text to at most `longest` characters by omitting its middle."""
    if len(text) <= longest:
        return text
    tail = longest // 3
    return f"{text[: longest - tail - 5]} ... {text[-tail:]}"


def sentence(text: str) -> str:
    """Return a message as one line of at most `_LONGEST` characters."""
    return clipped(" ".join(text[: 100 * _LONGEST].split()))


def near(word: str, known: Iterable[str], cutoff: float = 0.6) -> str:
    """Return the one of the `known` words that is most similar to `word`, or "" without one.

    `cutoff`: least similarity, 1 for the same word."""
    return next(iter(difflib.get_close_matches(word[:_NAME], [*known], n=1, cutoff=cutoff)), "")


COLUMNS = {
    "rotation": ("rotation_deg", "deg", "rotation of rotor 1", 57.29577951308232),
    "relative": ("relative_rotation_rad", "rad", "relative rotation of rotor 2", 1.0),
    "rate": ("relative_speed_rad_s", "rad/s", "relative angular speed of rotor 2", 1.0),
    "drive_force": ("drive_flank_force_N", "N", "normal force on the drive flank", 1.0),
    "coast_force": ("coast_flank_force_N", "N", "normal force on the coast flank", 1.0),
    "force": ("contact_force_N", "N", "contact force: sum of the normal forces", 1.0),
    "depth": ("penetration_m", "m", "greatest penetration; negative: least gap", 1.0),
}
"""Columns of a simulated motion, keyed by the field of a `Series`: name, unit, long name, and
factor from SI units to this unit. CSV files have all but the penetration."""
