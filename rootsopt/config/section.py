"""What the sections of a config are made of."""

import re
import types
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel, ConfigDict, Field, model_validator


def between(low: float, high: float) -> Any:
    """What a number must lie within, both ends allowed."""
    return Field(ge=low, le=high, allow_inf_nan=False)


Speed = Annotated[float, between(1e-2, 1e6)]
"""Speed of rotation, rpm."""
Radius = Annotated[float, between(1, 5000)]
"""Radius of a rotor, mm."""
Weight = Annotated[float, between(0, 1e6)]
"""Weight in a sum; 0 leaves out what it belongs to."""
Order = Annotated[float, between(1e-2, 1e3)]
"""Order of a spectral line, in mesh frequencies."""
Torque = Annotated[float, between(0, 1e7)]
"""Torque that opposes or drives, N·m."""


class Section(BaseModel):
    """A section: no keys but its own, no value of another type, none changed later.

    Words to choose from are taken in any case and with any of space, `-`, `_` between their
    parts; what is kept is the word as it is listed."""

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
    """The words that a value, or a key of a value, may be chosen from; () for none."""
    if get_origin(annotation) is Literal:
        return get_args(annotation)
    if get_origin(annotation) in (Union, types.UnionType, Annotated, dict):
        return tuple(word for part in get_args(annotation) for word in choices(part))
    return ()


def bare(word: str) -> str:
    """A word without case, spaces, `-` and `_`, as choices are compared."""
    return re.sub(r"[-_\s]", "", word.casefold())


def tuples(data: Any) -> Any:
    """Keys of a section with tuples for lists: YAML has no tuples."""
    if isinstance(data, dict):
        return {k: tuple(v) if isinstance(v, list) else v for k, v in data.items()}
    return data


def number(key: Any) -> Any:
    """A number for a word that is one."""
    try:
        return float(key) if isinstance(key, str) else key
    except ValueError:
        return key
