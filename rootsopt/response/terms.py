"""Terms of the objective: quantities of a design and its motion to be minimised.

All terms, built-in or your own, are registered in one table. The gradient of a term follows from
its formula. JAX differentiates the dependence on the profile, and the chain rule adds the gradients
of the forces.
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
    """Mean, peak and RMS of the contact force (N), in the fields `mean`, `peak`, `rms`."""

    mean: Float[Array, ""]
    peak: Float[Array, ""]
    rms: Float[Array, ""]


class Term(eqx.Module):
    """A quantity to be minimised, with a name and a weight in `objective.terms`.

    To add a term, subclass and write `value`. Store numbers in fields that hold arrays or are
    static. The objective divides a term by its value for the baseline, which must be positive.
    """

    @abc.abstractmethod
    def value(
        self, scene: Scene, profile: Profile, shape: Geometry, forces: Forces
    ) -> Float[Array, ""]:
        """Return the value of the term for one design, using operations that JAX can differentiate.

        `profile` and `shape`: profile and geometry of the design (SI units); `forces` (N): mean,
        peak and RMS of the steady contact force in the `scene`."""


class GeometryTerm(Term):
    """A term whose value is the field of `Geometry` (SI units) named `field`, divided by `unit`."""

    field: str = eqx.field(static=True)
    unit: float = eqx.field(static=True)

    def value(self, scene, profile, shape, forces):
        del scene, profile, forces
        return getattr(shape, self.field) / self.unit


class InertiaTerm(Term):
    """A term whose value is the polar moment of inertia of one rotor (kg·m²)."""

    def value(self, scene, profile, shape, forces):
        del profile, forces
        return scene.inertia(shape)


class ForceTerm(Term):
    """A term whose value is the field of `Forces` (N) named `field`."""

    field: str = eqx.field(static=True)

    def value(self, scene, profile, shape, forces):
        del scene, profile, shape
        return getattr(forces, self.field)


_terms: dict[str, Term] = {}


def register_term(name: str, term: Term) -> None:
    """Register a `term` under a `name` for use in `objective.terms`.

    Raises ValueError if the name is not an identifier or is already taken."""
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
    """Return the terms registered under `names`. Raises `InputError` for an unknown name."""
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
    """Return the values (t,) of `terms` for a `design` in config units, and their gradients (t, d).

    `forces` (3,): mean, peak and RMS force (N); `slopes` (3, d): their gradients."""

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
