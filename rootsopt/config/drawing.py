"""Config section of the drawing: what its title block states."""

from typing import Annotated

from pydantic import Field

from rootsopt.config.section import Section, between, such

_LONGEST = 60
"""Length (characters) above which a text of the title block is rejected."""


def _is_line(value: object) -> bool:
    """Return whether a value is text that fits into one line of the title block."""
    return isinstance(value, str) and 0 < len(value) <= _LONGEST and value.isprintable()


_Text = Annotated[
    str,
    such(
        f"one line of at most {_LONGEST} characters that can be printed, in quotes if it is a "
        "number (\"'1.4301'\")",
        _is_line,
        before=True,
    ),
]


class DrawingConfig(Section):
    """What the title block of a drawing states, its inset, and how many points its table has.

    Nothing here is simulated."""

    title: _Text = Field("Roots rotor", description="title of the drawing")
    number: _Text | None = Field(None, description="drawing number")
    revision: _Text | None = Field(None, description="revision of the drawing")
    drawn_by: _Text | None = Field(None, description="author of the drawing")
    date: _Text | None = Field(None, description="date of the drawing, as text")
    material: _Text | None = Field(None, description="material, in quotes if it is a number")
    tolerance_mm: Annotated[float, between(1e-4, 10)] | None = Field(
        None, description="width of the tolerance zone of the flank (profile of a line, ISO 1101)"
    )
    general_tolerance: _Text | None = Field(
        None, description="tolerances of all other dimensions, as ISO 2768-mK"
    )
    inset_mm: Annotated[float, Field(ge=0, le=5)] = Field(
        0.0,
        description="distance along the normal by which the drawn rotor is smaller than its "
        "profile: half of contact.clearance_mm for rotors that are cut with their clearance",
    )
    points: Annotated[int, Field(ge=9, le=20_001)] = Field(
        361, description="number of points over one lobe in rotor_points.csv"
    )
