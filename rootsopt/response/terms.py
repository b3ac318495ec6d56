"""Terms of objective and trade-offs: quantities of a design and its motion.

All terms, built-in or your own, are registered in one table. The gradient of a term follows from
its formula. JAX differentiates the dependence on the profile, and the chain rule adds the gradients
of the forces.
"""

import abc
from collections.abc import Sequence
from typing import Any, ClassVar, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rootsopt.config.units import MM, UM
from rootsopt.errors import InputError
from rootsopt.profiles import Geometry, Profile, geometry
from rootsopt.pump import flow
from rootsopt.pump.loads import still_loads
from rootsopt.pump.rattle import SILENT, silent_eccentricity
from rootsopt.pump.sheet import CM3, L_MIN, MRAD, play_of, ripple_of
from rootsopt.runtime.programs import CachedFunction
from rootsopt.scene import Scene
from rootsopt.scene.reading import Medium


class Forces(NamedTuple):
    """Mean, peak and RMS of the contact force (N), in the fields `mean`, `peak`, `rms`.

    `of_motion`: what an evaluation takes from the motion itself, such as loads of the bearings and
    the torque of the timing gear, so that it is NaN here."""

    mean: Float[Array, ""]
    peak: Float[Array, ""]
    rms: Float[Array, ""]
    of_motion: Float[Array, ""] | float = float("nan")


class Term(eqx.Module):
    """A quantity with a name, for `objective.terms` and `pareto.terms`.

    To add a term, subclass and write `value`. Store numbers in fields that hold arrays or are
    static. The objective divides a term by its value for the baseline, which must be positive.

    `sense`: whether less of the quantity is better (`min`) or more (`max`). Only terms to be
    minimised may have a weight in the objective.

    >>> import jax
    >>> import rootsopt
    >>> jax.config.update("jax_enable_x64", True)
    >>> class Mass(rootsopt.Term):
    ...     def value(self, scene, profile, shape, forces):
    ...         return scene.density * scene.length * shape.area  # kg
    >>> Mass().sense
    'min'
    """

    sense: ClassVar[Literal["min", "max"]] = "min"

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


class LargeTerm(GeometryTerm):
    """A `GeometryTerm` that is to be maximised."""

    sense: ClassVar[Literal["min", "max"]] = "max"


class DisplacementTerm(Term):
    """A term whose value is the volume (cm³) that a pair displaces per revolution."""

    sense: ClassVar[Literal["min", "max"]] = "max"

    def value(self, scene, profile, shape, forces):
        del profile, forces
        return flow.displaced_volume(shape, scene.length) / CM3


class FlowTerm(Term):
    """A term whose value is the flow (l/min) at the scene's speed: without leakage, or `delivered`.

    The flow delivered needs the section `pump`."""

    sense: ClassVar[Literal["min", "max"]] = "max"
    delivered: bool = eqx.field(static=True)

    def value(self, scene, profile, shape, forces):
        del forces
        found = flow.theoretical_flow(shape, scene.length, scene.speed) / L_MIN
        if not self.delivered:
            return found
        medium = _medium(scene, "delivered_flow_l_min")
        return found * flow.leakage(scene, medium, profile, shape).efficiency


class RippleTerm(Term):
    """A term whose value is the peak-to-peak ripple of the flow, as a fraction of the mean flow."""

    def value(self, scene, profile, shape, forces):
        del forces
        return ripple_of(scene, profile, shape)


class BacklashTerm(Term):
    """A term whose value is the backlash (mm) up to which a timing gear keeps the flanks apart.

    It is 0 without clearance, and negative where the rotors overlap."""

    sense: ClassVar[Literal["min", "max"]] = "max"

    def value(self, scene, profile, shape, forces):
        del shape, forces
        return play_of(scene, profile).gear_backlash / MM


class PlayTerm(Term):
    """A term whose value is the least angular play (mrad) of rotor 2 over the rotation."""

    def value(self, scene, profile, shape, forces):
        del shape, forces
        return jnp.min(play_of(scene, profile).total) / MRAD


class GapTerm(Term):
    """A term whose value is the least gap (um) of the flanks over the mesh, or its `mean`.

    The scene must have a section `pump`. A negative least gap is an overlap."""

    sense: ClassVar[Literal["min", "max"]] = "max"
    mean: bool = eqx.field(static=True)

    def value(self, scene, profile, shape, forces):
        del forces
        name = "mean" if self.mean else "min"
        medium = _medium(scene, f"flank_gap_{name}_um")
        gaps = flow.leakage(scene, medium, profile, shape).gap.least
        return (jnp.mean(gaps) if self.mean else jnp.min(gaps)) / UM


class LossTerm(Term):
    """A term whose value is the leakage as a fraction of the theoretical flow.

    It is 1 minus the volumetric efficiency. The scene must have a section `pump`."""

    def value(self, scene, profile, shape, forces):
        del forces
        medium = _medium(scene, "leakage_fraction")
        return 1 - flow.leakage(scene, medium, profile, shape).efficiency


def _medium(scene: Scene, name: str) -> Medium:
    if scene.medium is None:
        raise InputError(
            f"the term `{name}` needs the section `pump`; add it with `pump.viscosity_mPa_s` and "
            "`pump.pressure_difference_Pa`"
        )
    return scene.medium


class SilentTerm(Term):
    """A term whose value is the eccentricity (µm) up to which the timing gear does not rattle.

    The scene must have a timing gear with errors."""

    sense: ClassVar[Literal["min", "max"]] = "max"

    def value(self, scene, profile, shape, forces):
        del forces
        if scene.gear is None or scene.gear.errors is None:
            raise InputError(
                f"the term `{SILENT}` needs a timing gear with errors; set "
                "`scene.timing_gear.eccentricity_um`, which may be 0"
            )
        return silent_eccentricity(scene, profile, shape)[0] / UM


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


class BearingTerm(Term):
    """A term from the loads on the bearings along the motion, under the `name` of a response.

    The scene must have a section `scene.bearings`; for a `twisted` one, also a helix."""

    name: str = eqx.field(static=True)
    twisted: bool = eqx.field(static=True, default=False)

    def value(self, scene, profile, shape, forces):
        del profile, shape
        _need_bearings(scene, self.name)
        if self.twisted and scene.straight:
            raise InputError(
                f"the term `{self.name}` needs twisted rotors, because it is 0 for straight ones; "
                "set `rotor.helix_deg`, or make the twist a design parameter with "
                "`optimizer.bounds.helix_deg`"
            )
        return forces.of_motion


class GearTerm(Term):
    """A term from the torque of the timing gear along the motion, under the `name` of a response.

    The scene must have a section `scene.timing_gear`."""

    name: str = eqx.field(static=True)

    def value(self, scene, profile, shape, forces):
        del profile, shape
        if scene.gear is None:
            raise InputError(
                f"the term `{self.name}` needs the section `scene.timing_gear`; add it with "
                "`scene.timing_gear.stiffness_N_m_per_rad` and `scene.timing_gear.backlash_mm`"
            )
        return forces.of_motion


class ReserveTerm(GearTerm):
    """A `GearTerm` for the distance of the flanks from touching, which is to be maximised."""

    sense: ClassVar[Literal["min", "max"]] = "max"


class StaticBearingTerm(Term):
    """A term whose value is a load (N) of the bearings while the timing gear carries the load.

    It is the greatest one of the four bearings, or the greatest `equivalent` load. Nothing is
    simulated. The scene must have a section `scene.bearings`."""

    equivalent: bool = eqx.field(static=True)

    def value(self, scene, profile, shape, forces):
        del forces
        name = "equivalent" if self.equivalent else "max"
        _need_bearings(scene, f"static_bearing_load_{name}_N")
        equivalent, greatest = still_loads(scene, profile, shape)
        return jnp.max(equivalent if self.equivalent else greatest)


def _need_bearings(scene: Scene, name: str) -> None:
    if scene.bearings is None:
        raise InputError(
            f"the term `{name}` needs the section `scene.bearings`; add it, as in "
            "`scene.bearings={}`"
        )


EQUIVALENT = "bearing_load_equivalent_N"
"""Name of the greatest equivalent dynamic load of the bearings."""
BEARING = (*(EQUIVALENT, "bearing_load_max_N", "axial_force_max_N", "tilting_moment_max_N_m"),)
"""Names of the terms that an evaluation takes from the bearing loads along the motion."""
RESERVES = "contact_reserve_um", "backlash_reserve_mm"
"""Names of the least gap of the flanks along the motion, and of the backlash that would use it up.
"""
GEAR = tuple(
    f"{which}gear_{what}" for what in ("torque_N_m", "force_N") for which in ("mean_", "", "rms_")
)
"""Names of mean, greatest and RMS torque of the timing gear, and of its force at the pitch circle.
"""
OF_MOTION = (*BEARING, *RESERVES, *GEAR)
"""Names of all terms that an evaluation takes from the motion itself."""
_terms: dict[str, Term] = {}


def register_term(name: str, term: Term) -> None:
    """Register a `term` under a `name` for use in `objective.terms`.

    Raises ValueError if the name is not an identifier or is already taken.

    >>> import jax
    >>> import rootsopt
    >>> jax.config.update("jax_enable_x64", True)
    >>> class Mass(rootsopt.Term):
    ...     def value(self, scene, profile, shape, forces):
    ...         return scene.density * scene.length * shape.area  # kg
    >>> rootsopt.register_term("rotor_mass_kg", Mass())
    >>> config = rootsopt.load_config("cic", ["objective.terms.rotor_mass_kg=0.5"])
    """
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


def terms_of(names: Sequence[str], key: str = "objective.terms") -> tuple[Term, ...]:
    """Return the terms registered under `names`. Raises `InputError` for an unknown name.

    `key`: config key that lists the names, for the message."""
    for name in names:
        if name not in _terms:
            raise InputError(
                f"`{key}` must name registered terms ({', '.join(sorted(_terms))}), but "
                f"names {name}; correct it, or register it with rootsopt.register_term"
            )
    return tuple(_terms[name] for name in names)


@CachedFunction
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
        here, profile = scene.at(design), scene.profile(design)
        shape = geometry(profile)
        found = [term.value(here, profile, shape, Forces(*forces)) for term in terms]
        return jnp.stack([jnp.asarray(one, float) for one in found])

    def twice(*at):
        return (every(*at),) * 2

    (by_design, by_forces), values = jax.jacfwd(twice, (0, 1), has_aux=True)(design, forces)
    return values, by_design + by_forces @ slopes


class _UsedError(Exception):
    """Raised where a term reads a force."""


class _NoForces:
    """Substitute for `Forces` that raises an error when a term reads a force."""

    def __getattr__(self, name: str) -> Any:
        raise _UsedError(name)

    def __iter__(self) -> Any:
        raise _UsedError("all")

    def __getitem__(self, place: Any) -> Any:
        raise _UsedError(str(place))


def needs_forces(scene: Scene, term: Term, design: Float[Array, " d"]) -> bool:
    """Return whether the value of a `term` depends on forces, so that it needs a simulation.

    The term is traced once for a `design` (d,) in config units, and nothing is computed."""

    def value(design):
        here, profile = scene.at(design), scene.profile(design)
        return jnp.asarray(term.value(here, profile, geometry(profile), _NoForces()), float)  # pyright: ignore[reportArgumentType]

    try:
        jax.eval_shape(value, design)
    except _UsedError:
        return True
    return False


def sense_of(name: str) -> Literal["min", "max"]:
    """Return the sense (`min` or `max`, see `Term`) of the term registered under `name`.

    Raises `InputError` if there is no such term."""
    return terms_of([name])[0].sense


def _own() -> dict[str, Any]:
    return {
        "mean_force_N": ForceTerm("mean"),
        "peak_force_N": ForceTerm("peak"),
        "rms_force_N": ForceTerm("rms"),
        "polar_inertia_kg_m2": InertiaTerm(),
        "outer_radius_mm": GeometryTerm("outer_radius", MM),
        "area_mm2": GeometryTerm("area", MM**2),
        "area_efficiency": LargeTerm("area_efficiency", 1.0),
        "root_radius_mm": LargeTerm("root_radius", MM),
        "undercut_margin_mm": LargeTerm("undercut_margin", MM),
        "seal_width_mm": LargeTerm("seal_width", MM),
        "displaced_volume_cm3": DisplacementTerm(),
        "theoretical_flow_l_min": FlowTerm(delivered=False),
        "flow_ripple": RippleTerm(),
        "gear_backlash_max_mm": BacklashTerm(),
        "leakage_fraction": LossTerm(),
        "delivered_flow_l_min": FlowTerm(delivered=True),
        "angular_play_min_mrad": PlayTerm(),
        SILENT: SilentTerm(),
        "flank_gap_min_um": GapTerm(mean=False),
        "flank_gap_mean_um": GapTerm(mean=True),
        "static_bearing_load_max_N": StaticBearingTerm(equivalent=False),
        "static_bearing_load_equivalent_N": StaticBearingTerm(equivalent=True),
        **{name: BearingTerm(name, name in BEARING[2:]) for name in BEARING},
        **{name: ReserveTerm(name) for name in RESERVES},
        **{name: GearTerm(name) for name in GEAR},
    }


for _name, _term in _own().items():
    register_term(_name, _term)
