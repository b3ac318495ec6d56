"""The terms of a trade-off: which they are, in which sense, and what a design needs for them."""

import re
from typing import NamedTuple

import jax.numpy as jnp

from rootsopt.config import Config
from rootsopt.dynamics.measures import PEAK_NORM, line_name
from rootsopt.errors import InputError
from rootsopt.optimize.search import check_gradient
from rootsopt.response.evaluation import RESPONSES
from rootsopt.response.terms import needs_forces, terms_of
from rootsopt.scene import Scene

_LINE = re.compile(r"line_(\d+(?:\.\d+)?)_force_N")
_UNITS = {
    "_kg_m2": "kg m²",
    "_cm3": "cm³",
    "_mm2": "mm²",
    "_mm": "mm",
    "_deg": "°",
    "_N": "N",
}


class Aim(NamedTuple):
    """A term of a trade-off.

    `name`: key in the result file; `sense`: `min` if less is better, `max` if more is."""

    name: str
    sense: str

    @property
    def sign(self) -> float:
        """Factor that turns the term into a quantity of which less is better."""
        return -1.0 if self.sense == "max" else 1.0

    @property
    def unit(self) -> str:
        """Unit of the term; empty if it has none or if its name does not tell it."""
        return next((unit for end, unit in _UNITS.items() if self.name.endswith(end)), "")

    @property
    def words(self) -> str:
        """Name in words, without the unit."""
        end = next((end for end in _UNITS if self.name.endswith(end)), "")
        return self.name.removesuffix(end).replace("_", " ")

    @property
    def label(self) -> str:
        """Name in words with the unit in brackets, for an axis."""
        return f"{self.words} ({self.unit})" if self.unit else self.words


def aims_of(config: Config) -> tuple[Aim, ...]:
    """Return the terms of `config.pareto`.

    Raises `InputError` for a name that is neither a force nor a registered term."""
    found = []
    for name in config.pareto.terms:
        sense = "min" if _force(config, name) else terms_of([name], "pareto.terms")[0].sense
        found.append(Aim(name, config.pareto.senses.get(name, sense)))
    return tuple(found)


def simulated(config: Config, scene: Scene) -> bool:
    """Return whether a term of `config.pareto` depends on forces.

    Raises `InputError` if so and the forces have no gradient, or are not those of one motion at one
    speed in one scene."""
    names = config.pareto.terms
    design = jnp.asarray(config.design)
    forced = [
        name
        for name in names
        if _force(config, name) or needs_forces(scene, terms_of([name])[0], design)
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
    check_gradient(config)
    return True


def reporting(config: Config) -> Config:
    """Return a copy of a `config` whose evaluations report all terms of `config.pareto`."""
    lines = [*config.response.lines]
    terms = dict(config.objective.terms)
    for name in config.pareto.terms:
        if found := _LINE.fullmatch(name):
            order = float(found[1])
            lines += [order] * (order not in lines)
        elif not _force(config, name):
            terms.setdefault(name, 0.0)
    response = config.response.model_copy(update={"lines": tuple(lines)})
    objective = config.objective.model_copy(update={"terms": terms})
    return config.model_copy(update={"response": response, "objective": objective})


def freed(config: Config) -> Config:
    """Return a copy of a `config` whose area efficiency may fall below the baseline's.

    This applies only if area efficiency is a term of `config.pareto` and its floor is `baseline`,
    the default: that floor would cut off one side of the front. A floor that is a number stays."""
    limits = config.constraints
    if "area_efficiency" not in config.pareto.terms or limits.area_efficiency_min != "baseline":
        return config
    limits = limits.model_copy(update={"area_efficiency_min": 0.0})
    return config.model_copy(update={"constraints": limits})


def _force(config: Config, name: str) -> bool:
    """Return whether `name` is a measure of the force; raise `InputError` for a wrong one."""
    if name == PEAK_NORM and config.objective.peak_norm is None:
        raise InputError(
            f"`pareto.terms` names {PEAK_NORM}, which needs `objective.peak_norm`; set it, or name "
            "peak_force_N"
        )
    found = _LINE.fullmatch(name)
    if found is None:
        return name in RESPONSES or name == PEAK_NORM
    order = float(found[1])
    if not 1e-2 <= order <= 1e3 or line_name(order) != name:
        raise InputError(
            f"`pareto.terms` must name a line as line_ORDER_force_N with an order from 0.01 to "
            f"1000, as in line_2_force_N, but names {name}"
        )
    return True


__all__ = ["Aim", "aims_of", "freed", "reporting", "simulated"]
