"""Limits of any quantity (`constraints.terms`): as constraints of the geometry, or of the motion.

A term that does not read forces becomes a `Constraint` of the design space. It costs no
simulation, and designs are moved onto it. A force, or a term that reads forces, becomes a
`ForceLimit`, which an evaluation satisfies or not."""

import re
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp

from rootsopt.config import Config
from rootsopt.config.study import BASELINE
from rootsopt.config.units import unit_of, words
from rootsopt.errors import InputError
from rootsopt.response.terms import Forces, Term, depends_on_forces, is_force, reporting, terms_of
from rootsopt.scene import Scene
from rootsopt.scene.space import Constraint

LIMITS = "constraints.terms"
"""Config key that names the limited quantities."""
PEAK = "peak_force_N"
"""Key of the peak force in a response: the greatest of several local maxima of the force."""


class TermConstraint(Constraint):
    """A constraint on a `term` that does not read forces; its unit is that of the term."""

    term: Term = eqx.field(kw_only=True)

    def slack_of(self, space, design, profile, shape, found):
        nothing = Forces(*[jnp.asarray(jnp.nan)] * 3)
        return self.scaled(self.term.value(space.scene.at(design), profile, shape, nothing))


class ForceLimit(NamedTuple):
    """A limit that depends on forces: value ≤ `limit` for a `ceiling`, else value ≥ `limit`.

    `key`: name of the quantity in a response."""

    key: str
    ceiling: bool
    limit: float

    @property
    def name(self) -> str:
        """Name of the quantity in words."""
        return words(self.key)

    @property
    def unit(self) -> str:
        """Unit of the quantity, empty if its name does not tell it."""
        return unit_of(self.key)

    @property
    def sense(self) -> str:
        """Relation between value and limit."""
        return "<=" if self.ceiling else ">="

    @property
    def sign(self) -> float:
        """+1 if `limit` is a greatest value, -1 if it is a least value."""
        return 1.0 if self.ceiling else -1.0

    @property
    def scale(self) -> float:
        """Divisor for the distance from the limit: the limit's magnitude, or 1 if this is 0."""
        return scale_of(self.limit)

    @property
    def cornered(self) -> bool:
        """Whether all local maxima of the force must stay below the limit."""
        return self.ceiling and self.key == PEAK

    def excess(self, value):
        """Return how far values exceed the limit, divided by `scale`; ≤ 0 if they satisfy it."""
        return self.sign * (value - self.limit) / self.scale


def scale_of(limit: float) -> float:
    """Return the magnitude of a `limit`, 1 if it is 0."""
    return abs(limit) or 1.0


def limited(config: Config) -> Config:
    """Return a copy of a `config` whose evaluations report all quantities of `constraints.terms`.

    Raises `InputError` if a name is not that of a quantity."""
    names = [*config.constraints.terms]
    terms_of([name for name in names if not is_force(config, name, LIMITS)], LIMITS)
    return reporting(config, names, LIMITS) if names else config


def settled(
    config: Config, geometry: Mapping[str, float], found: Sequence[Mapping[str, float]] = ()
) -> Config:
    """Return a copy of a `config` in which limits that are `baseline` are the baseline's values.

    `geometry`: geometry of the baseline, with the keys of the result file; `found`: its responses,
    one for each scene and speed; the worst one becomes the limit. Without responses, limits of
    `constraints.terms` stay as they are."""
    own = [key for key, limit in config.constraints if limit == BASELINE]
    values: dict[str, Any] = {key: geometry[quantity_of(key)] for key in own}
    terms: dict[str, dict[str, Any]] = {}
    for name, sides in config.constraints.terms.items():
        terms[name] = sides = {**sides}
        for side, worst in (("max", max), ("min", min)):
            if sides.get(side) == BASELINE and found:
                sides[side] = worst(one[name] for one in found)
    limits = config.constraints.model_copy(update=values | {"terms": terms})
    return config.model_copy(update={"constraints": limits})


def quantity_of(key: str) -> str:
    """Return the name, in the result file, of the quantity that a `key` of `constraints` limits.

    >>> quantity_of("seal_width_min_mm")
    'seal_width_mm'
    """
    return re.sub("_(min|max)", "", key)


def term_constraints(config: Config, scene: Scene) -> tuple[TermConstraint, ...]:
    """Return the constraints on those quantities of `constraints.terms` that read no forces."""
    found = []
    for name, ceiling, limit in _sides(config):
        if depends_on_forces(config, scene, name, LIMITS):
            continue
        (term,) = terms_of([name], LIMITS)
        row = words(name), name, unit_of(name), jnp.asarray(limit), scale_of(limit), 1.0
        found.append(TermConstraint(*row, ceiling=ceiling, term=term))
    return tuple(found)


def force_limits(config: Config, scene: Scene) -> tuple[ForceLimit, ...]:
    """Return the limits on those quantities of `constraints.terms` that depend on forces.

    Raises `InputError` if such limits do not suit the objective or the method of the search."""
    found = tuple(
        ForceLimit(name, ceiling, limit)
        for name, ceiling, limit in _sides(config)
        if depends_on_forces(config, scene, name, LIMITS)
    )
    if found and config.objective.motion == "ensemble":
        raise InputError(
            f"`{LIMITS}` must not limit forces for `objective.motion` ensemble, but limits "
            f"{found[0].key}: averages have noise; give it a weight in `objective`, or choose "
            "another motion"
        )
    return found


def _sides(config: Config):
    """Yield (name, whether it is a ceiling, limit) for each floor and ceiling."""
    for name, one in config.constraints.terms.items():
        for side in ("max", "min"):
            if side in one:
                # The baseline's value is filled in before a search; the number has no effect.
                limit = 0.0 if one[side] == BASELINE else float(one[side])
                yield name, side == "max", limit
