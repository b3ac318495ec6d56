"""Where the search begins if the baseline is a rotor from a file, or of another family.

Such a rotor does not have the parameters that the search varies. It remains the baseline. The
search begins at the member of the family `optimizer.family` that is nearest to it."""

import dataclasses
from pathlib import Path
from typing import Any

import jax.numpy as jnp

from rootsopt.config import Config
from rootsopt.config.families import FREE_FORM, families, family_of
from rootsopt.config.study import NEAREST
from rootsopt.config.units import MM
from rootsopt.errors import InputError
from rootsopt.optimize.limits import settled
from rootsopt.profiles import Outline, Profile
from rootsopt.response.evaluation import Evaluation
from rootsopt.response.records import geometry_record
from rootsopt.scene import Scene
from rootsopt.scene.check import shape_of
from rootsopt.scene.families import classical, design_of, profile_from_file, profile_of
from rootsopt.scene.resemblance import COEFFICIENTS, Likeness, free_likeness, likeness
from rootsopt.scene.space import widened

# Distance (m) of the nearest named family above which the message recommends a free form.
_FAR = 20e-6

# Numbers of coefficients of a free form, tried in this order until it is as near as the distance
# (m): searches with few parameters compile and run faster.
_COUNTS, _EXACT = (3, COEFFICIENTS // 2, COEFFICIENTS), 1e-6


@dataclasses.dataclass(frozen=True)
class Beginning:
    """The design that begins the search in another family than the baseline's.

    `config`: config of the search, with the fitted profile and with bounds that hold it.
    `likeness`: the fitted profile, and its distances from the outline. `considered`: the nearest
    members of all families that were compared, nearest first. `widened`: keys of the parameters
    whose default bounds were widened. `file`: name of the outline's file, "" without one.
    `evaluation`: simulation of the fitted profile, `None` before it has been simulated. `oversize`:
    flank gap (mm) by which the members exceed that of an outline whose flanks overlap, otherwise 0.
    """

    config: Config
    likeness: Likeness
    considered: list[Likeness]
    widened: tuple[str, ...]
    file: str
    evaluation: Evaluation | None = None
    oversize: float = 0.0

    @property
    def message(self) -> str:
        """Sentences for the user: where the search begins, and how far from the outline."""
        one = self.likeness
        text = f"The baseline is the rotor of {self.file} as it is. " if self.file else ""
        text += (
            f"The search began at the nearest {one.family} profile, at most "
            f"{one.departure * 1e6:.3g} um (RMS {one.rms * 1e6:.3g} um) from it."
        )
        if one.inset:
            text += f" {self._inset}."
        if self.widened:
            pairs = self.config.optimizer.bounds
            named = [f"{k} to [{pairs[k][0]:.4g}, {pairs[k][1]:.4g}]" for k in self.widened]
            text += f" Its bounds were widened to hold it: {', '.join(named)}."
        if one.departure > _FAR and one.family != FREE_FORM:
            text += " `--set optimizer.family=free_form` begins closer to the outline."
        return text

    @property
    def _inset(self) -> str:
        """Say how the members get the gap that the outline has by its inset."""
        size, gap = self.likeness.inset * 1e3, self.config.contact.clearance_mm
        text = f"The outline is cut, inset {size:.3g} mm: the members of the family have the same "
        text += f"flank gap with `--set contact.clearance_mm={gap:.6g}`"
        if self.oversize:
            text = f"The outline is oversize, inset {size:.3g} mm: its flanks overlap by "
            text += f"{self.oversize:.3g} mm more than those of the members, whose clearance is 0"
        return text

    def record(self) -> dict[str, Any]:
        """Return the entry `beginning` of the result file."""
        return self.likeness.record() | {
            "widened_bounds": [*self.widened],
            "considered": [one.record() for one in self.considered],
            "message": self.message,
        }


def beginning(config: Config) -> Beginning | None:
    """Return where the search of a `config` begins; `None` if it varies the baseline's own family.

    Raises `InputError` if the file holds no usable outline, or if no profile of the family
    `optimizer.family` could be fitted to it."""
    wanted, own = config.optimizer.family, config.profile
    given = profile_from_file(own)
    if given is None:
        if wanted in (NEAREST, own.family):
            return None
        radius = jnp.asarray(own.pitch_radius_mm * MM)
        given = profile_of(own.family, own.lobes, radius, design_of(own))
    found = _fits(given, wanted)
    for one in found:
        try:
            profile = one.config(config.profile)
        except (InputError, ValueError):
            continue
        other, oversize = _cut(config.model_copy(update={"profile": profile}), one.inset)
        other, keys = widened(other)
        file = Path(config.profile.outline_file or "").name
        return Beginning(other, one, found, keys, file, oversize=oversize)
    valid = ", ".join([NEAREST, *(name for name, one in families().items() if one.fitted)])
    raise InputError(
        f"`optimizer.family` must be a family with a sound profile near the baseline, but is "
        f"{wanted}, for which none was found; choose another one of {valid}"
    )


def _cut(config: Config, inset: float) -> tuple[Config, float]:
    """Return (config of a member with the flank gap of an outline, gap in mm that is too much).

    An `inset` (m) of both rotors widens the gap by twice as much. The outline's area efficiency
    and its outer radius include the inset, which no member has: limits of the geometry that are
    `baseline` are those of the member."""
    if not inset:
        return config, 0.0
    gap = round(config.contact.clearance_mm + 2 * inset / MM, 6)
    contact = config.contact.model_copy(update={"clearance_mm": max(0.0, gap)})
    config = config.model_copy(update={"contact": contact})
    shape = geometry_record(Scene.from_config(config), shape_of(config))
    return settled(config, shape), max(0.0, -gap)


def _fits(given: Profile, family: str) -> list[Likeness]:
    """Return the members nearest to the profile `given`, nearest first.

    `family`: name of a family, or `NEAREST` for all classical ones with parameters."""
    named = [name for name in classical() if family_of(name).fitted]
    if family == NEAREST:
        found = [likeness(given, name) for name in named]
    elif family in named:
        found = [likeness(given, family)]
    else:
        # Projections of smooth members are better starts than those of measured points.
        smooth = ("five_arcs", "cic") if isinstance(given, Outline) else ()
        near = [one for name in smooth if (one := likeness(given, name)) is not None]
        for count in _COUNTS:
            found = [free_likeness(given, *near, count=count)]
            if found[0] is not None and found[0].departure <= _EXACT:
                break
    return sorted((one for one in found if one is not None), key=lambda one: one.departure)
