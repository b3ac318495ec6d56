"""Where the search begins if the baseline is a rotor from a file.

Such a rotor has no design parameters. It remains the baseline. The search varies the parameters of
a family, and begins at the member of this family that is nearest to the outline."""

import dataclasses
from pathlib import Path
from typing import Any

from rootsopt.config import Config
from rootsopt.config.families import FREE_FORM, families, family_of
from rootsopt.config.study import NEAREST
from rootsopt.design.bounds import widened
from rootsopt.design.resemblance import Likeness, free_likeness, likeness
from rootsopt.errors import InputError
from rootsopt.profiles import Outline
from rootsopt.response.evaluation import Evaluation
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
    of the fitted profile, `None` before it has been simulated."""

    config: Config
    likeness: Likeness
    considered: list[Likeness]
    widened: tuple[str, ...]
    file: str
    evaluation: Evaluation | None = None

    @property
    def message(self) -> str:
        """Sentences for the user: where the search begins, and how far from the outline."""
        one = self.likeness
        text = (
            f"The baseline is the rotor of {self.file} as it is. The search began at the nearest "
            f"{one.family} profile, at most {one.departure * 1e6:.3g} um (RMS "
            f"{one.rms * 1e6:.3g} um) from it."
        )
        if self.widened:
            bounds = family_of(one.family).parameters
            pairs = {p.key: getattr(self.config.optimizer.bounds, p.key) for p in bounds}
            named = [f"{k} to [{pairs[k][0]:.4g}, {pairs[k][1]:.4g}]" for k in self.widened]
            text += f" Its bounds were widened to hold it: {', '.join(named)}."
        if one.departure > _FAR and one.family != FREE_FORM:
            text += " `--set optimizer.family=free_form` begins closer to the outline."
        return text

    def record(self) -> dict[str, Any]:
        """Return the entry `beginning` of the result file."""
        found = self.likeness.record() | {"widened_bounds": [*self.widened]}
        if self.evaluation is not None:
            found |= {
                "response": self.evaluation.response,
                "geometry": self.evaluation.geometry,
                "status": self.evaluation.status.label,
            }
        return found | {
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
    found = _fits(given, wanted)
    for one in found:
        try:
            profile = one.config(config.profile)
        except (InputError, ValueError):
            continue
        other = config.model_copy(update={"profile": profile})
        other, keys = widened(other)
        file = Path(config.profile.outline_file or "").name
        return Beginning(other, one, found, keys, file)
    valid = ", ".join([NEAREST, *(name for name, one in families().items() if one.fitted)])
    raise InputError(
        f"`optimizer.family` must be a family with a sound profile near the outline, but is "
        f"{wanted}, for which none was found; choose another one of {valid}"
    )


def _fits(given: Outline, family: str) -> list[Likeness]:
    """Return the members nearest to the outline `given`, nearest first.

    `family`: name of a family, or `NEAREST` for all classical ones with parameters."""
    named = [name for name in classical() if family_of(name).fitted]
    if family == NEAREST:
        found = [likeness(given, name) for name in named]
    elif family in named:
        found = [likeness(given, family)]
    else:
        near = [likeness(given, name) for name in ("five_arcs", "cic")]
        found = [free_likeness(given, *(one for one in near if one is not None))]
    return sorted((one for one in found if one is not None), key=lambda one: one.departure)


__all__ = ["Beginning", "beginning"]
