"""Terms of the objective: what of a design and its motion is to be small.

A term is an object found through one table, the package's own as any other. Its gradient follows
from its formula: what it takes of the profile is differentiated, what it takes of the forces is
chained with their gradients.
"""

import abc
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rootsopt.config.units import MM
from rootsopt.errors import InputError
from rootsopt.profiles import Geometry, Profile, geometry
from rootsopt.runtime.programs import Program
from rootsopt.scene import Scene


class Forces(NamedTuple):
    """Mean, peak and RMS of the contact force (N)."""

    mean: Float[Array, ""]
    peak: Float[Array, ""]
    rms: Float[Array, ""]


class Term(eqx.Module):
    """Something to be small: `objective.terms` names it with its weight.

    Write `value`; numbers are fields that hold arrays or are static. In the objective a term counts
    relative to its value for the baseline, so it must be greater than 0 there.
    """

    @abc.abstractmethod
    def value(
        self, scene: Scene, profile: Profile, shape: Geometry, forces: Forces
    ) -> Float[Array, ""]:
        """Return the term for one design, by operations that JAX can differentiate.

        `profile` and its `shape` (SI units), `forces` of its steady motion in the `scene`."""


class GeometryTerm(Term):
    """A field of `Geometry`, in units of `unit`."""

    field: str = eqx.field(static=True)
    unit: float = eqx.field(static=True)

    def value(self, scene, profile, shape, forces):
        del scene, profile, forces
        return getattr(shape, self.field) / self.unit


class InertiaTerm(Term):
    """Polar moment of inertia of one rotor (kg·m²)."""

    def value(self, scene, profile, shape, forces):
        del profile, forces
        return scene.inertia(shape)


class ForceTerm(Term):
    """One of the `Forces` (N)."""

    field: str = eqx.field(static=True)

    def value(self, scene, profile, shape, forces):
        del scene, profile, shape
        return getattr(forces, self.field)


_terms: dict[str, Term] = {}


def register_term(name: str, term: Term) -> None:
    """Let `objective.terms` name a `term`.

    Raises ValueError for a name that is no word or is taken."""
    if not name.isidentifier():
        raise ValueError(
            f"Argument `name` must be a word of letters, digits and _, but is {name!r}"
        )
    if name in _terms:
        raise ValueError(
            f"Argument `name` must be one that no term has, but {name!r} is that of "
            f"`{type(_terms[name]).__name__}`; choose another"
        )
    _terms[name] = term


def terms_of(names: Sequence[str]) -> tuple[Term, ...]:
    """Return the terms of these `names`; raises `InputError` for a name that none has."""
    for name in names:
        if name not in _terms:
            raise InputError(
                f"`objective.terms` must name registered terms ({', '.join(sorted(_terms))}), but "
                f"names {name}; correct it, or register it with rootsopt.register_term"
            )
    return tuple(_terms[name] for name in names)


@Program
def values_of(
    scene: Scene,
    terms: tuple[Term, ...],
    design: Float[Array, " d"],
    forces: Float[Array, "3"],
    slopes: Float[Array, "3 d"],
) -> tuple[Float[Array, " t"], Float[Array, "t d"]]:
    """Return the values of `terms` for a `design` in config units and their gradients, from the
    `forces` (mean, peak, RMS; N) and their `slopes`."""

    def every(design, forces):
        profile = scene.profile(design)
        shape = geometry(profile)
        found = [term.value(scene, profile, shape, Forces(*forces)) for term in terms]
        return jnp.stack([jnp.asarray(one, float) for one in found])

    by_design, by_forces = jax.jacfwd(every, (0, 1))(design, forces)
    return every(design, forces), by_design + by_forces @ slopes


def _own() -> dict[str, Any]:
    return {
        "mean_force_N": ForceTerm("mean"),
        "peak_force_N": ForceTerm("peak"),
        "rms_force_N": ForceTerm("rms"),
        "polar_inertia_kg_m2": InertiaTerm(),
        "outer_radius_mm": GeometryTerm("outer_radius", MM),
        "area_mm2": GeometryTerm("area", MM**2),
    }


for _name, _term in _own().items():
    register_term(_name, _term)
