"""Names, units and values of the result file as a report prints them."""

import re
from typing import Any

from rootsopt.config import Config
from rootsopt.output.labels import DASH, change, in_words, name_and_unit, number

_UNITS = {
    "kg m^2": "kg·m²",
    "mm^2": "mm²",
    "cm^3": "cm³",
    "um": "µm",
    "deg": "°",
    "N m": "N·m",
}
_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def unit(text: str) -> str:
    """Return a `unit` of the tables as it is printed: µm instead of um, ° instead of deg."""
    return _UNITS.get(text, text)


def label(key: str) -> str:
    """Return the name in words of a `key` of the result file, with its unit in parentheses.

    Of a dotted key of the config, the last part is shown."""
    name, text = name_and_unit(last_part(key))
    name = name.strip().replace(" x ", " × ")
    return f"{name} ({unit(text)})" if text else name


def last_part(key: str) -> str:
    """Return the last part of a dotted `key` of the config, and any other key unchanged."""
    section, _, _ = key.partition(".")
    return key.rpartition(".")[2] if section in Config.model_fields else key


def value(given: Any) -> str:
    """Return a value as it is printed: numbers with five digits, truth values as `yes` or `no`."""
    if isinstance(given, bool):
        return "yes" if given else "no"
    if isinstance(given, list | tuple):
        return ", ".join(map(value, given))
    shown = number(given)
    if shown == DASH:
        return "–"
    if isinstance(given, str):
        return in_words(given)
    return _powered(shown)


def brief(given: float, digits: int = 5) -> str:
    """Return a number for a sentence: at most `digits` significant digits, no final zeros."""
    shown = f"{given:.{digits}g}"
    power = int(shown.partition("e")[2] or 0)
    return _powered(f"{float(shown):.0f}" if 0 < power < 7 else shown)


def quantity(given: float | None, text: str) -> str:
    """Return a number for a sentence, with the unit `text`, written as in the tables."""
    text = unit(text)
    shown = "–" if given is None else brief(given)
    return f"{shown}{'' if text == '°' else ' '}{text}".strip()


def signed(given: float, text: str) -> str:
    """Return a number of three digits with its sign, followed by the unit `text`."""
    shown = f"{given:+.3g}".replace("-", "−")
    return f"{'0' if given == 0 else shown} {text}".strip()


def percent(first: Any, second: Any) -> str:
    """Return the change from `first` to `second` in % of `first`, or "" if this is not defined."""
    shown = change(first, second)
    if shown == DASH:
        return ""
    return re.sub(r"^[+-](0(\.0+)? %)$", r"\1", shown).replace("-", "−")


def _powered(shown: str) -> str:
    """Return a formatted number with minus signs and with its power of ten as an exponent."""
    mantissa, _, power = shown.partition("e")
    if power:
        return f"{mantissa} × 10{str(int(power)).translate(_RAISED)}".replace("-", "−")
    return shown.replace("-", "−")


__all__ = ["brief", "label", "last_part", "percent", "quantity", "signed", "unit", "value"]
