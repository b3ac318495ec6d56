"""What the sections of a config are made of."""

from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]


class Section(BaseModel):
    """A section: no keys but its own, no value of another type, none changed later."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


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
