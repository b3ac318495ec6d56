"""Base class of the config's sections, and types for their numbers."""

import re
import types
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel, ConfigDict, Field, model_validator


def between(low: float, high: float) -> Any:
    """Return a pydantic field for a finite number from `low` to `high`, both ends included."""
    return Field(ge=low, le=high, allow_inf_nan=False)


Speed = Annotated[float, between(1e-2, 1e6)]
"""Speed of rotation (rpm)."""
Radius = Annotated[float, between(1, 5000)]
"""Radius of a rotor (mm)."""
Weight = Annotated[float, between(0, 1e6)]
"""Weight of a term in a sum; a weight of 0 leaves the term out."""
Order = Annotated[float, between(1e-2, 1e3)]
"""Order of a spectral line: its frequency as a multiple of the mesh frequency."""
Torque = Annotated[float, between(0, 1e7)]
"""Magnitude of a load or motor torque (N·m)."""


class Section(BaseModel):
    """An immutable section of the config that rejects unknown keys and values of the wrong type.

    A word from a list of choices may be in upper or lower case, with spaces, `-` or `_` between its
    parts. The section stores the word as listed."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)

    @model_validator(mode="before")
    @classmethod
    def _canonical(cls, data):
        if not isinstance(data, dict):
            return data
        found = dict(data)
        for name, field in cls.model_fields.items():
            words = {bare(word): word for word in choices(field.annotation)}
            value = found.get(name)
            if isinstance(value, str):
                found[name] = words.get(bare(value), value)
            elif isinstance(value, dict) and words:
                named = {words.get(bare(str(key)), key): inner for key, inner in value.items()}
                found[name] = named if len(named) == len(value) else value
        return found


def choices(annotation: Any) -> tuple[str, ...]:
    """Return the words that a type allows for a value, or for the keys of a dictionary.

    Return () for a type without a list of choices."""
    if get_origin(annotation) is Literal:
        return get_args(annotation)
    if get_origin(annotation) in (Union, types.UnionType, Annotated, dict):
        return tuple(word for part in get_args(annotation) for word in choices(part))
    return ()


def bare(word: str) -> str:
    """Return a word in lower case, without spaces, `-` and `_`, for comparison with other words."""
    return re.sub(r"[-_\s]", "", word.casefold())


def tuples(data: Any) -> Any:
    """Return a section's `data` with tuples in place of lists, because YAML has no tuples.

    Return anything but a dictionary unchanged."""
    if isinstance(data, dict):
        return {k: tuple(v) if isinstance(v, list) else v for k, v in data.items()}
    return data


def number(key: Any) -> Any:
    """Convert a numeric string to float; return anything else unchanged."""
    try:
        return float(key) if isinstance(key, str) else key
    except ValueError:
        return key
