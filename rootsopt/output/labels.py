"""Names, units and numbers of the result file in words, for tables and reports."""

import math
from collections.abc import Mapping
from typing import Any

DASH = "-"
"""Text in place of an unknown number."""
_UNITS = {
    "_kg_m2": "kg m^2",
    "_l_min": "l/min",
    "_N_m": "N m",
    "_cm3": "cm^3",
    "_mm2": "mm^2",
    "_mrad": "mrad",
    "_um": "um",
    "_mm": "mm",
    "_deg": "deg",
    "_rpm": "rpm",
    "_N": "N",
}
_NAMES = {
    "seconds": ("time", "s"),
    "kind": ("steady state", ""),
    "period": ("period", "mesh periods"),
    "window_mesh_periods": ("window", "mesh periods"),
    "lyapunov_exponent_per_mesh_period": ("Lyapunov exponent", "1/mesh period"),
    "lyapunov_standard_error": ("  its standard error", ""),
    "floquet_multiplier": ("largest Floquet multiplier", ""),
    "residual": ("orbit residual", ""),
    "rms_force_N": ("RMS force", "N"),
    "peak_norm_force_N": ("p-norm of the force", "N"),
}


def name_and_unit(key: str) -> tuple[str, str]:
    """Return (name in words, unit) for a key of the result file."""
    if key in _NAMES:
        return _NAMES[key]
    for suffix, unit in _UNITS.items():
        if key.startswith("line_") and key.endswith(suffix):
            order = key.removeprefix("line_").removesuffix("_force" + suffix)
            return f"line at {order} x mesh frequency", unit
        if key.endswith(suffix):
            return in_words(key.removesuffix(suffix)), unit
    return in_words(key), ""


def label_of(key: str) -> str:
    """Return the name in words and the unit of a `key` of the result file, as one label."""
    if ", " in key:  # already a label
        return key
    name, unit = name_and_unit(key)
    return f"{name}, {unit}" if unit else name


def in_words(name: str) -> str:
    """Return a `name` with blanks in place of underscores."""
    return name.replace("_", " ")


def change(first: Any, second: Any) -> str:
    """Return the change from `first` to `second` in % of `first`, or a dash if it has none."""
    numbers = [x for x in (first, second) if isinstance(x, int | float) and math.isfinite(x)]
    if len(numbers) < 2 or first == 0:
        return DASH
    percent = 100 * (second - first) / abs(first)
    return f"{percent:+.2f} %" if abs(percent) < 1000 else f"{percent:+.3g} %"


def fitting(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the entries of `values` that fit into a cell: all except lists and mappings."""
    tables = Mapping, list, tuple
    return {key: value for key, value in values.items() if not isinstance(value, tables)}


def number(value: Any) -> str:
    """Format a number with five significant digits, or as a dash if it is `None` or not finite.

    Whole numbers, truth values and text are not changed."""
    if value is None:
        return DASH
    if isinstance(value, bool | str):
        return str(value)
    if isinstance(value, int):
        return str(value)
    value = float(value)
    if not math.isfinite(value):
        return DASH
    if value == 0:
        return "0"
    size = math.floor(math.log10(abs(value)))
    if not -4 <= size < 7:
        return f"{value:.3e}"
    return f"{value:.{max(0, 4 - size)}f}"
