"""Config section of the drawing: what its title block states."""

from typing import Annotated, Any

from pydantic import Field, model_validator

from rootsopt.config.section import Section, between
from rootsopt.config.words import shown

_LONGEST = 60
"""Length (characters) above which a text of the title block is rejected."""


class DrawingConfig(Section):
    """What the title block of a drawing states, and how many points its table has.

    Nothing here is simulated."""

    title: str = Field("Roots rotor", description="title of the drawing")
    number: str | None = Field(None, description="drawing number")
    revision: str | None = Field(None, description="revision of the drawing")
    drawn_by: str | None = Field(None, description="author of the drawing")
    date: str | None = Field(None, description="date of the drawing, as text")
    material: str | None = Field(None, description="material, in quotes if it is a number")
    tolerance_mm: Annotated[float, between(1e-4, 10)] | None = Field(
        None, description="width of the tolerance zone of the flank (profile of a line, ISO 1101)"
    )
    general_tolerance: str | None = Field(
        None, description="tolerances of all other dimensions, as ISO 2768-mK"
    )
    points: Annotated[int, Field(ge=9, le=20_001)] = Field(
        361, description="number of points over one lobe in rotor_points.csv"
    )

    @model_validator(mode="before")
    @classmethod
    def _texts(cls, data: Any) -> Any:
        for key in _TEXTS if isinstance(data, dict) else ():
            value = data.get(key)
            if isinstance(value, int | float) and not isinstance(value, bool):
                raise ValueError(
                    f"`drawing.{key}` must be text, but is the number {shown(value)}; put it in "
                    "quotes, as in \"'1.4301'\""
                )
            if isinstance(value, str) and not (0 < len(value) <= _LONGEST and value.isprintable()):
                raise ValueError(
                    f"`drawing.{key}` must be one line of at most {_LONGEST} characters that can "
                    f"be printed, but is {shown(value)}"
                )
        return data


_TEXTS = tuple(
    name for name in DrawingConfig.model_fields if name not in ("tolerance_mm", "points")
)
