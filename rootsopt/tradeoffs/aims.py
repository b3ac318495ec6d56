"""The terms of a trade-off: names, senses (`min` or `max`), and whether they need a simulation."""

from typing import Any, NamedTuple

from rootsopt.config import Config
from rootsopt.config.study import BASELINE
from rootsopt.config.units import unit_of, words
from rootsopt.errors import InputError
from rootsopt.optimize.limits import LIMITS, depends_on_forces, limited, quantity_of
from rootsopt.response.reporting import is_force, reporting
from rootsopt.response.terms import terms_of
from rootsopt.scene import Scene

# Keys of `constraints` that may be absent; a floor of 0 has the same effect in the others.
_OPTIONAL = "outer_radius_min_mm", "outer_radius_max_mm"
# Config key that names the terms.
_KEY = "pareto.terms"


class Aim(NamedTuple):
    """A term of a trade-off.

    `name`: key in the result file; `sense`: `min` if less is better, `max` if more is."""

    name: str
    sense: str

    @property
    def sign(self) -> float:
        """Factor (1 or -1) that turns the term into a quantity to be minimised."""
        return -1.0 if self.sense == "max" else 1.0

    @property
    def unit(self) -> str:
        """Unit of the term; "" if its name does not contain a unit."""
        return unit_of(self.name)

    @property
    def words(self) -> str:
        """Name in words, without the unit."""
        return words(self.name)

    @property
    def label(self) -> str:
        """Name in words with the unit in brackets, for an axis."""
        return f"{self.words} ({self.unit})" if self.unit else self.words


def aims_of(config: Config) -> tuple[Aim, ...]:
    """Return the terms of `config.pareto`.

    Raises `InputError` for a name that is neither a force nor a registered term."""
    found = []
    for name in config.pareto.terms:
        sense = "min" if is_force(config, name, _KEY) else terms_of([name], "pareto.terms")[0].sense
        found.append(Aim(name, config.pareto.senses.get(name, sense)))
    return tuple(found)


def simulated(config: Config, scene: Scene) -> bool:
    """Return whether a term of `config.pareto` depends on forces.

    If one does, the forces must have a gradient and belong to one motion at one speed in one scene.
    Raises `InputError` if they do not."""
    forced = [
        name
        for names, key in ((config.pareto.terms, _KEY), (config.constraints.terms, LIMITS))
        for name in names
        if depends_on_forces(config, scene, name, key)
    ]
    if not forced:
        return False
    if config.objective.motion != "reached":
        raise InputError(
            f"`objective.motion` must be reached for `pareto.terms` with forces ({forced[0]}), but "
            f"is {config.objective.motion}; set it to reached"
        )
    if config.objective.speeds_rpm:
        raise InputError(
            f"`objective.speeds_rpm` must be empty for `pareto.terms` with forces ({forced[0]}), "
            f"but is {[*config.objective.speeds_rpm]}: a front is that of one speed; set it to [] "
            "and `scene.speed_rpm` to that speed"
        )
    if config.tolerances is not None:
        raise InputError(
            f"`tolerances` must be absent for `pareto.terms` with forces ({forced[0]}): a front is "
            "that of the nominal scene; remove them"
        )
    return True


def reported(config: Config) -> Config:
    """Return a copy of a `config` whose evaluations report all terms of `config.pareto`."""
    return reporting(limited(config), config.pareto.terms, _KEY)


def freed(config: Config) -> tuple[Config, tuple[str, ...]]:
    """Return a copy of a `config` without those limits that would cut off a side of the front.

    They are limits that are `baseline`, of terms of `config.pareto`. A limit that is a number is
    kept. Also return the names of the quantities that lost a limit."""
    limits = config.constraints
    keys = [key for key, limit in limits if limit == BASELINE]
    keys = [key for key in keys if quantity_of(key) in config.pareto.terms]
    values: dict[str, Any] = {key: None if key in _OPTIONAL else 0.0 for key in keys}
    kept = {}
    for name, sides in limits.terms.items():
        lost = BASELINE if name in config.pareto.terms else None
        if left := {side: limit for side, limit in sides.items() if limit != lost}:
            kept[name] = left
    names = {quantity_of(key) for key in keys}
    names |= {name for name, sides in limits.terms.items() if sides != kept.get(name)}
    if not names:
        return config, ()
    limits = limits.model_copy(update=values | {"terms": kept})
    return config.model_copy(update={"constraints": limits}), tuple(sorted(names))


__all__ = ["Aim", "aims_of", "freed", "reported", "simulated"]
