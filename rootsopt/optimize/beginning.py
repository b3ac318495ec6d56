"""Where the search begins if the baseline is a rotor from a file.

Such a rotor has no design parameters. It remains the baseline. The search varies the parameters of
a family, and begins at the member of this family that is nearest to the outline."""

import dataclasses
from pathlib import Path
from typing import Any

from rootsopt.config import Config
from rootsopt.config.families import FREE_FORM, families, family_of
from rootsopt.config.study import NEAREST
from rootsopt.config.units import MM
from rootsopt.design.bounds import widened
from rootsopt.design.resemblance import Likeness, free_likeness, likeness
from rootsopt.errors import InputError
from rootsopt.optimize.limits import settled
from rootsopt.profiles import Outline
from rootsopt.response.evaluation import Evaluation
from rootsopt.response.records import geometry_record
from rootsopt.scene import Scene
from rootsopt.scene.check import shape_of
from rootsopt.scene.families import classical, profile_from_file

_FAR = 20e-6
"""Distance (m) of the nearest named family above which the message recommends a free form."""


@dataclasses.dataclass(frozen=True)
class Beginning:
    """The design that begins the search for a better rotor than that of a file.

    `config`: config of the search, with the fitted profile and with bounds that hold it.
    `likeness`: the fitted profile, and its distances from the outline. `considered`: the nearest
    members of all families that were compared, nearest first. `widened`: keys of the parameters
    whose default bounds were widened. `file`: name of the outline's file. `evaluation`: simulation
    of the fitted profile, `None` before it has been simulated. `oversize`: flank gap (mm) by which
    the members exceed that of an outline whose flanks overlap, otherwise 0."""

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
        text = (
            f"The baseline is the rotor of {self.file} as it is. The search began at the nearest "
            f"{one.family} profile, at most {one.departure * 1e6:.3g} um (RMS "
            f"{one.rms * 1e6:.3g} um) from it."
        )
        if one.inset:
            text += f" {self._inset}."
        if self.widened:
            bounds = family_of(one.family).parameters
            pairs = {p.key: getattr(self.config.optimizer.bounds, p.key) for p in bounds}
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
    """Return where the search of a `config` begins; `None` unless its profile is from a file.

    Raises `InputError` if the file holds no usable outline, or if no profile of the family
    `optimizer.family` could be fitted to it."""
    given = profile_from_file(config.profile)
    if given is None:
        return None
    wanted = config.optimizer.family
    found = fits(given, wanted)
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
        f"`optimizer.family` must be a family with a sound profile near the outline, but is "
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


def fits(given: Outline, family: str = NEAREST, enough: float = 0.0) -> list[Likeness]:
    """Return the members nearest to the outline `given`, nearest first.

    `family`: name of a family, or `NEAREST` for all classical ones with parameters; `enough`:
    distance (m) of a member at which no further families are compared."""
    named = [name for name in classical() if family_of(name).fitted]
    if family == NEAREST:
        found = []
        for name in named:
            found.append(likeness(given, name))
            if found[-1] is not None and found[-1].departure <= enough:
                break
    elif family in named:
        found = [likeness(given, family)]
    else:
        near = [likeness(given, name) for name in ("five_arcs", "cic")]
        found = [free_likeness(given, *(one for one in near if one is not None))]
    return sorted((one for one in found if one is not None), key=lambda one: one.departure)


__all__ = ["Beginning", "beginning", "fits"]
