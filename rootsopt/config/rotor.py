"""Config sections of the rotor: profile, body, drawing."""

import functools
import shlex
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, create_model, model_validator
from pydantic.fields import FieldInfo

from rootsopt.config import catalogue as _catalogue  # noqa: F401  (fills the table)
from rootsopt.config.families import (
    EXAMPLE_RADIUS,
    RESERVED,
    Family,
    families,
    family_of,
    parameters,
    users_of,
)
from rootsopt.config.section import (
    Among,
    Listed,
    Section,
    bare,
    between,
    is_number,
    such,
)
from rootsopt.config.units import hint

# Usual range (pitch radii) of a profile's lengths.
#
# If a length is outside its limits but would lie in this range in another unit, the message
# suggests this unit.
_USUAL = 0.01, 2.0


# Absolute value (mm) above which a coordinate of a rotor's axis is rejected.
_FARTHEST = 1e5
_Coordinate = Annotated[float, between(-_FARTHEST, _FARTHEST)]


def _is_center(value: Any) -> bool:
    """Return whether a value is the word `fit`, or two coordinates (mm)."""
    if not isinstance(value, list | tuple):
        return value == "fit"
    return len(value) == 2 and all(is_number(x) and abs(x) <= _FARTHEST for x in value)


_Center = Annotated[
    Literal["fit"] | Annotated[tuple[_Coordinate, _Coordinate], Listed],
    such(
        f"fit, or x and y of the axis in mm, as in [0.1, 0.2], each at most {_FARTHEST:g}",
        _is_center,
        before=True,
    ),
]
FilePath = Annotated[str, such("a path of characters that can be printed", str.isprintable)]


class ProfileConfig(Section):
    """The rotor profile.

    An instance belongs to the subclass that `model_of` makes for its `family`, whose further keys
    are the family's parameters."""

    family: Annotated[str, Among(families)] = Field(
        description="profile family; outline: read from a file"
    )
    lobes: Annotated[int, Field(ge=2, le=6)] = Field(description="number of lobes")
    pitch_radius_mm: Annotated[float, between(1, 5000)] = Field(
        description="pitch radius, half the centre distance"
    )
    outline_file: FilePath | None = Field(
        None, description="outline: CSV or DXF file, relative to the config's folder"
    )
    outline_smoothing_mm: Annotated[float, between(0, 10)] | None = Field(
        None,
        description="outline: scatter (RMS) of measured points; absent: 0, the curve passes "
        "through them",
    )

    outline_center: _Center | None = Field(
        None,
        description="outline: x and y (mm) of the rotor's axis in the file, or fit: the centre of "
        "the lobes' rotational symmetry; absent: the origin",
    )
    outline_unit: Literal["mm", "cm", "m", "um", "inch"] | None = Field(
        None,
        description="outline: unit of the numbers in the file; absent: mm, or the unit that a "
        "drawing or a header states",
    )
    outline_join_mm: Annotated[float, between(1e-6, 1)] | None = Field(
        None,
        description="outline: distance (mm) between ends of a drawing's entities up to which they "
        "are joined; absent: 0.001",
    )

    def __reduce__(self) -> tuple[Any, ...]:
        # A class that is made at run time cannot be found by its name in another process.
        return _restored, (self.family, self.__getstate__())

    @property
    def parameters(self) -> dict[str, float | tuple[float, ...]]:
        """Design parameters of the config's family by key, in the units of the keys."""
        return {key: getattr(self, key) for key in family_of(self.family).keys}

    @property
    def design(self) -> NDArray[np.float64]:
        """Design parameters as an array (d,), in the units of `design_keys`."""
        return np.hstack([*self.parameters.values(), ()]).astype(float)

    @property
    def design_keys(self) -> tuple[str, ...]:
        """Names of the entries of `design`; the entries of a list are numbered from 1."""
        names: list[str] = []
        for key, value in self.parameters.items():
            numbers = range(1, 1 + len(value)) if isinstance(value, tuple) else ()
            names += [f"{key}_{number}" for number in numbers] or [key]
        return tuple(names)

    def with_design(self, design: Sequence[float]) -> "ProfileConfig":
        """Return a copy with other design parameters (d,), in the units of `design_keys`."""
        family = family_of(self.family)
        values = zip(family.parameters, family.split([*design]), strict=True)
        return self.model_copy(
            update={one.key: tuple(v) if one.count is not None else v for one, v in values}
        )

    def alone(self, key: str, value: Any) -> dict[str, Any]:
        """Return the plain section of a rotor of this size that has a parameter `key`.

        If this family does not have the key, the rotor belongs to another family."""
        data = self.model_dump(mode="json", exclude_none=True) | {key: value}
        names = users_of(key) or ["outline"] * (key in _OUTLINE)
        if not names or self.family in names or value is None:
            return data
        size = {name: data[name] for name in ("lobes", "pitch_radius_mm")}
        example = family_of(names[0]).example or {_OUTLINE[0]: "rotor.csv"}
        return {"family": names[0], **size, **example, key: value}

    @property
    def from_file(self) -> bool:
        """Whether the profile is read from a file rather than made from parameters."""
        return family_of(self.family).maker is None

    @classmethod
    def fields(cls) -> Mapping[str, FieldInfo]:
        """Return all keys, with the parameters of all registered families before `outline_file`."""
        model = model_of(*families().values())
        names = [*cls.model_fields]
        place = names.index(_OUTLINE[0])
        order = *names[:place], *parameters(), *names[place:]
        return {name: model.model_fields[name] for name in order}

    @model_validator(mode="wrap")
    @classmethod
    def _of_family(cls, data, handler):
        """Choose the model by the family, and report keys that are missing or not its own."""
        if cls is not ProfileConfig or not isinstance(data, dict):
            return handler(data)
        known = {*parameters(), *_OUTLINE}
        data = {key: v for key, v in data.items() if v is not None or key not in known}
        name = bare(str(data.get("family")))
        family = next((one for key, one in families().items() if bare(key) == name), None)
        if family is None:
            return handler({key: value for key, value in data.items() if key not in known})
        if known | cls.model_fields.keys() >= data.keys():
            _require_own(family, data, known & data.keys())
        return model_of(family).model_validate(data)

    @model_validator(mode="after")
    def _sized(self):
        for parameter in family_of(self.family).parameters:
            key, limits = parameter.key, parameter.limits(self.pitch_radius_mm)
            value = getattr(self, key)
            if limits is None or limits[0] <= value <= limits[1]:
                continue
            low, high = limits
            word = f"at least {low:.4g}" if value < low else f"at most {high:.4g}"
            share = (low if value < low else high) / self.pitch_radius_mm
            raise ValueError(
                f"`profile.{key}` must be {word} ({share:g} pitch radii), but is {value:g}"
                + hint(key, value, *(share * self.pitch_radius_mm for share in _USUAL))
            )
        return self


_OUTLINE = tuple(key for key in ProfileConfig.model_fields if key.startswith("outline_"))
RESERVED.update(ProfileConfig.model_fields)


@functools.cache
def model_of(*owners: Family) -> type[ProfileConfig]:
    """Return the section's model for a registered family, or for several at once."""
    fields: Any = {
        one.key: one.field(family.name for family in owners if one.key in family.keys)
        for owner in owners
        for one in owner.parameters
    }
    return create_model("ProfileConfig", __base__=ProfileConfig, **fields)


def _restored(family: str, state: dict[str, Any]) -> ProfileConfig:
    """Return a pickled section."""
    model = model_of(family_of(family))
    section = model.__new__(model)
    section.__setstate__(state)
    return section


def _require_own(family: Family, data: Mapping[str, Any], given: set[str]) -> None:
    """Raise `ValueError` if `given` keys do not belong to a family, or if keys of it are missing.

    The message lists the overrides that complete the section `data`. They set missing keys to the
    values of the family's example at this pitch radius. Keys shared with another family are set as
    well, because that family's values may not fit."""
    from_file = family.maker is None
    own, required = (_OUTLINE, _OUTLINE[:1]) if from_file else (family.keys, family.keys)
    foreign = [key for key in (*parameters(), *_OUTLINE) if key in given and key not in own]
    missing = [key for key in required if key not in given]
    if not foreign and not missing:
        return
    radius = data.get("pitch_radius_mm")
    values: dict[str, Any] = {key: "null" for key in foreign}
    scale = radius / EXAMPLE_RADIUS if isinstance(radius, int | float) else 1.0
    for key in family.keys if foreign and missing and family.keys else missing:
        value = family.example.get(key, "FILE")
        value = f"{value * scale:.4g}" if key.endswith("_mm") else value
        values[key] = [*value] if isinstance(value, tuple) else value
    first = f"`profile.{[*foreign, *missing][0]}` " + (
        f"does not belong to family {family.name}; for this family, add"
        if foreign
        else f"is required for family {family.name}; add, for example,"
    )
    sets = [shlex.quote(f"profile.{key}={value}") for key, value in values.items()]
    raise ValueError(" --set ".join((first, *sets)))


class RotorConfig(Section):
    """The rotor as a rigid body: length, density, bore, helix."""

    length_mm: Annotated[float, between(1, 2e4)] = Field(description="axial length")
    density_kg_m3: Annotated[float, between(50, 3e4)] = Field(description="density")
    bore_mm: Annotated[float, between(0.1, 1e4)] | None = Field(
        None, description="diameter of the bore; absent: none"
    )
    helix_deg: Annotated[float, Field(ge=-360, le=360)] = Field(
        0.0,
        description="twist over the length, positive in the rotor's own sense of rotation",
    )


# Length (characters) above which a text of the title block is rejected.
_LONGEST = 60
_Text = Annotated[
    str,
    such(
        f"one line of at most {_LONGEST} characters that can be printed, in quotes if it is a "
        "number (\"'1.4301'\")",
        lambda text: isinstance(text, str) and 0 < len(text) <= _LONGEST and text.isprintable(),
        before=True,
    ),
]


class DrawingConfig(Section):
    """What the title block of a drawing states, and its inset.

    Nothing here is simulated."""

    tolerance_mm: Annotated[float, between(1e-4, 10)] | None = Field(
        None, description="width of the tolerance zone of the flank (profile of a line, ISO 1101)"
    )
    title_block: dict[_Text, _Text] = Field(
        default_factory=dict,
        description="fields of the title block by heading, as {Title: Blower rotor, Material: "
        "EN-GJS-500-7, Drawing number: '4711'}; numbers in quotes",
    )
    inset_mm: Annotated[float, Field(ge=0, le=5)] = Field(
        0.0,
        description="distance along the normal by which the drawn rotor is smaller than its "
        "profile: half of contact.clearance_mm for rotors that are cut with their clearance",
    )
