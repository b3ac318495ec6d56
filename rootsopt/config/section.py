"""Base class of the config's sections, and types for their values."""

import dataclasses
import functools
import re
import types
from collections.abc import Callable, Iterable, Mapping
from typing import Annotated, Any, Literal, TypeGuard, Union, get_args, get_origin

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, model_validator
from pydantic.fields import FieldInfo
from pydantic_core import PydanticCustomError, core_schema

from rootsopt.config.units import named
from rootsopt.errors import InputError


def between(low: float, high: float) -> Any:
    """Return a pydantic field for a finite number from `low` to `high`, both ends included."""
    return Field(ge=low, le=high, allow_inf_nan=False)


def such(wanted: str, holds: Callable[[Any], bool], before: bool = False) -> Any:
    """Return a pydantic validator that accepts values for which `holds` is true.

    `wanted`: what a value must be, for the message; `before`: whether it sees values before their
    type is checked."""

    def check(value: Any) -> Any:
        if not holds(value):
            raise PydanticCustomError(UNMET, "{wanted}", {"wanted": wanted})
        return value

    return BeforeValidator(check) if before else AfterValidator(check)


UNMET = "unmet"
"""Type of the errors of `such`."""


def require(holds: bool, message: str) -> None:
    """Raise `ValueError` with this message if `holds` is false: the keys do not fit each other."""
    if not holds:
        raise ValueError(message)


@dataclasses.dataclass(frozen=True)
class Among:
    """Type annotation of a word that must be among `words`, which may grow at run time."""

    words: Callable[[], Iterable[str]]

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        return core_schema.no_info_before_validator_function(self._check, handler(source))

    def _check(self, word: Any) -> Any:
        words = [repr(one) for one in self.words()]
        if repr(word) not in words:
            expected = f"{', '.join(words[:-1])} or {words[-1]}"
            raise PydanticCustomError("literal_error", "{expected}", {"expected": expected})
        return word


Speed = Annotated[float, between(1e-2, 1e6)]
"""Speed of rotation (rpm)."""
Listed = Field(strict=False)
"""Marks a tuple that is given as a list, because YAML has no tuples."""


class Section(BaseModel):
    """An immutable section of the config that rejects unknown keys and values of the wrong type.

    A word from a list of choices may be in upper or lower case, with spaces, `-` or `_` between its
    parts. The section stores the word as listed."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)

    @classmethod
    def fields(cls) -> Mapping[str, FieldInfo]:
        """Return all keys that this section may have, with their pydantic fields."""
        return cls.model_fields

    @model_validator(mode="before")
    @classmethod
    def _canonical(cls, data):
        if not isinstance(data, dict):
            return data
        canonical = dict(data)
        for name, value in data.items():
            field = cls.model_fields.get(name)
            if field is not None and isinstance(value, str):
                words = {bare(word): word for word in choices(field)}
                canonical[name] = words.get(bare(value), value)
        return canonical


def choices(kind: Any) -> tuple[str, ...]:
    """Return the words that a field or type allows for a value, or for the keys of a dictionary.

    Return () for a type without a list of choices."""
    if isinstance(kind, Among):
        return tuple(kind.words())
    if get_origin(kind) is Literal:
        return get_args(kind)
    parts = get_args(kind)
    if isinstance(kind, FieldInfo):
        parts = kind.annotation, *kind.metadata
    elif get_origin(kind) not in (Union, types.UnionType, Annotated, dict):
        return ()
    return tuple(word for part in parts for word in choices(part))


def bare(word: str) -> str:
    """Return a word in lower case, without spaces, `-` and `_`, for comparison with other words."""
    return re.sub(r"[-_\s]", "", word.casefold())


def is_number(value: Any) -> TypeGuard[float]:
    """Return whether a plain value is a number; true and false are not."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def number(key: Any) -> Any:
    """Convert a numeric string to float; return anything else unchanged."""
    try:
        return float(key) if isinstance(key, str) else key
    except ValueError:
        return key


def taken(data: Any, key: str) -> Any:
    """Return the value at a dotted `key` in plain `data`, `None` if it or a section is absent."""
    return functools.reduce(
        lambda at, part: at.get(part) if isinstance(at, dict) else None, key.split("."), data
    )


def put(data: dict, key: str, value: Any) -> None:
    """Set the `value` at a dotted `key` in plain `data`, and create the sections around it.

    Raises `InputError` if a section is a plain value."""
    *parts, last = key.split(".")
    target = data
    for count, part in enumerate(parts, 1):
        if target.get(part) is None:
            target[part] = {}
        target = target[part]
        if not isinstance(target, dict):
            place = ".".join(map(named, parts[:count]))
            raise InputError(f"`{named(key)}` is not a known key: `{place}` holds no keys")
    target[last] = value
