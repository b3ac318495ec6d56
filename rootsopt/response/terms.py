"""Terms of objective and trade-offs: quantities of a design and its motion.

All terms, built-in or your own, are registered in one table. The gradient of a term follows from
its formula. JAX differentiates the dependence on the profile, and the chain rule adds the gradients
of the forces.
"""

import abc
import dataclasses
import re
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, ClassVar, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rootsopt.config.reading import Config
from rootsopt.config.units import MM, UM
from rootsopt.dynamics.orbit import PEAK_NORM, line_name
from rootsopt.dynamics.reserve import GEAR, RESERVES
from rootsopt.dynamics.steady import CLOSED
from rootsopt.errors import InputError
from rootsopt.profiles import Geometry, Profile, geometry
from rootsopt.pump import flow
from rootsopt.pump.flow import CM3, L_MIN, MRAD, play_of, ripple_of
from rootsopt.pump.loads import BEARING, still_loads
from rootsopt.pump.rattle import SILENT, silent_eccentricity
from rootsopt.response.result import RESPONSES, Evaluation
from rootsopt.runtime.programs import CachedFunction
from rootsopt.scene.build import Scene
from rootsopt.status import Status


class Forces(NamedTuple):
    """Mean, peak and RMS of the contact force (N), in the fields `mean`, `peak`, `rms`.

    `of_motion`: NaN, in place of quantities that an evaluation takes from the motion itself.
    Examples are bearing loads and the torque of the timing gear."""

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


class _At(NamedTuple):
    """Arguments of `Term.value`."""

    scene: Scene
    profile: Profile
    shape: Geometry
    forces: Forces


class Formula(Term):
    """A term of the package; `name`: that of its formula."""

    name: str = eqx.field(static=True)

    def value(self, scene, profile, shape, forces):
        return (_LESS | _MORE)[self.name](_At(scene, profile, shape, forces))


class LargeFormula(Formula):
    """A `Formula` of a term that is to be maximised."""

    sense: ClassVar[Literal["min", "max"]] = "max"


def _flow(at: _At) -> Float[Array, ""]:
    return flow.theoretical_flow(at.shape, at.scene.length, at.scene.speed) / L_MIN


def _leakage(at: _At, name: str) -> flow.Leakage:
    if at.scene.medium is None:
        raise InputError(
            f"the term `{name}` needs the section `pump`; add it with `pump.viscosity_mPa_s` and "
            "`pump.pressure_difference_Pa`"
        )
    return flow.leakage(at.scene, at.scene.medium, at.profile, at.shape)


def _silent(at: _At) -> Float[Array, ""]:
    if at.scene.gear is None or at.scene.gear.errors is None:
        raise InputError(
            f"the term `{SILENT}` needs a timing gear with errors; set "
            "`scene.timing_gear.eccentricity_um`, which may be 0"
        )
    return silent_eccentricity(at.scene, at.profile, at.shape)[0] / UM


def _still_loads(at: _At, name: str) -> tuple[Array, Array]:
    _need_bearings(at.scene, name)
    return still_loads(at.scene, at.profile, at.shape)


def _of_bearings(at: _At, name: str) -> Any:
    _need_bearings(at.scene, name)
    if name in BEARING[2:] and at.scene.helix is None:
        raise InputError(
            f"the term `{name}` needs twisted rotors, because it is 0 for straight ones; "
            "set `rotor.helix_deg`, or make the twist a design parameter with "
            "`optimizer.bounds.helix_deg`"
        )
    return at.forces.of_motion


def _need_bearings(scene: Scene, name: str) -> None:
    if scene.bearings is None:
        raise InputError(
            f"the term `{name}` needs the section `scene.bearings`; add it, as in "
            "`scene.bearings={}`"
        )


def _of_gear(at: _At, name: str) -> Any:
    if at.scene.gear is None:
        raise InputError(
            f"the term `{name}` needs the section `scene.timing_gear`; add it with "
            "`scene.timing_gear.stiffness_N_m_per_rad` and `scene.timing_gear.backlash_mm`"
        )
    return at.forces.of_motion


OF_MOTION = (*BEARING, *RESERVES, *GEAR)
"""Names of all terms whose values come from the motion itself."""
# Formulas of the terms that are to be minimised, and to be maximised.
_LESS: dict[str, Callable[[_At], Any]] = {
    "mean_force_N": lambda at: at.forces.mean,
    "peak_force_N": lambda at: at.forces.peak,
    "rms_force_N": lambda at: at.forces.rms,
    "polar_inertia_kg_m2": lambda at: at.scene.inertia(at.shape),
    "outer_radius_mm": lambda at: at.shape.outer_radius / MM,
    "area_mm2": lambda at: at.shape.area / MM**2,
    "flow_ripple": lambda at: ripple_of(at.scene, at.profile, at.shape),
    "leakage_fraction": lambda at: 1 - _leakage(at, "leakage_fraction").efficiency,
    "angular_play_min_mrad": lambda at: jnp.min(play_of(at.scene, at.profile).total) / MRAD,
    "static_bearing_load_max_N": lambda at: jnp.max(
        _still_loads(at, "static_bearing_load_max_N")[1]
    ),
    "static_bearing_load_equivalent_N": lambda at: jnp.max(
        _still_loads(at, "static_bearing_load_equivalent_N")[0]
    ),
    **{name: partial(_of_bearings, name=name) for name in BEARING},
    **{name: partial(_of_gear, name=name) for name in GEAR},
}
_MORE: dict[str, Callable[[_At], Any]] = {
    "area_efficiency": lambda at: at.shape.area_efficiency,
    "root_radius_mm": lambda at: at.shape.root_radius / MM,
    "undercut_margin_mm": lambda at: at.shape.undercut_margin / MM,
    "seal_width_mm": lambda at: at.shape.seal_width / MM,
    "displaced_volume_cm3": lambda at: flow.displaced_volume(at.shape, at.scene.length) / CM3,
    "theoretical_flow_l_min": _flow,
    "delivered_flow_l_min": lambda at: _flow(at) * _leakage(at, "delivered_flow_l_min").efficiency,
    # Greatest backlash at which a timing gear keeps the flanks apart; negative where the rotors
    # overlap.
    "gear_backlash_max_mm": lambda at: play_of(at.scene, at.profile).gear_backlash / MM,
    "flank_gap_min_um": lambda at: jnp.min(_leakage(at, "flank_gap_min_um").gap.least) / UM,
    "flank_gap_mean_um": lambda at: jnp.mean(_leakage(at, "flank_gap_mean_um").gap.least) / UM,
    SILENT: _silent,
    **{name: partial(_of_gear, name=name) for name in RESERVES},
}
_terms: dict[str, Term] = {}
_LINE = re.compile(r"line_(\d+(?:\.\d+)?)_force_N")


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
        term_values = [term.value(here, profile, shape, Forces(*forces)) for term in terms]
        return jnp.stack([jnp.asarray(one, float) for one in term_values])

    def twice(*at):
        return (every(*at),) * 2

    (by_design, by_forces), values = jax.jacfwd(twice, (0, 1), has_aux=True)(design, forces)
    return values, by_design + by_forces @ slopes


class _UsedError(Exception):
    """Raised where a term reads a force."""


class _NoForces:
    """Substitute for `Forces` that raises an error when a term reads a force."""

    def __getattr__(self, *asked: Any) -> Any:
        raise _UsedError

    __iter__ = __getitem__ = __getattr__


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


def is_force(config: Config, name: str, key: str) -> bool:
    """Return whether `name` is a measure of the force; otherwise, it can only be a registered term.

    `key`: config key that holds the name, for the message. Raises `InputError` for a measure that
    cannot exist."""
    if name == PEAK_NORM and config.objective.peak_norm is None:
        raise InputError(
            f"`{key}` names {PEAK_NORM}, which needs `objective.peak_norm`; set it, or name "
            "peak_force_N"
        )
    match = _LINE.fullmatch(name)
    if match is None:
        return name in RESPONSES or name == PEAK_NORM
    order = float(match[1])
    if not 1e-2 <= order <= 1e3 or line_name(order) != name:
        raise InputError(
            f"`{key}` must name a line as line_ORDER_force_N with an order from 0.01 to "
            f"1000, as in line_2_force_N, but names {name}"
        )
    return True


def with_terms(evaluation: Evaluation, scene: Scene, design, names: Sequence[str]) -> Evaluation:
    """Return an evaluation of a `design` (d,) with the terms in `names` that it lacks.

    They have gradients if the forces have. Without an orbit, the evaluation stays as it is."""
    names = [name for name in names if name not in evaluation.response]
    if not names or not (evaluation.status in CLOSED or evaluation.status is Status.IDLE):
        return evaluation
    keys, known = [*evaluation.design], RESPONSES[0] in evaluation.gradient
    forces = np.array([evaluation.response[name] for name in RESPONSES])
    slopes = np.zeros((len(RESPONSES), len(keys)))
    if known:
        slopes[:] = [[*evaluation.gradient[name].values()] for name in RESPONSES]
    values, rows = map(np.asarray, values_of(scene, terms_of(names), design, forces, slopes))
    response = evaluation.response | dict(zip(names, map(float, values), strict=True))
    further = {
        name: dict(zip(keys, map(float, row), strict=True))
        for name, row in zip(names, rows, strict=True)
    }
    gradient = evaluation.gradient | (further if known else {})
    return dataclasses.replace(evaluation, response=response, gradient=gradient)


def depends_on_forces(config: Config, scene: Scene, name: str, key: str) -> bool:
    """Return whether the quantity `name` is a force, or a term that depends on forces.

    `key`: config key that holds the name. Raises `InputError` if no quantity has this name."""
    if is_force(config, name, key):
        return True
    (term,) = terms_of([name], key)
    return needs_forces(scene, term, jnp.asarray(np.asarray(config.design, np.float64)))


def reporting(config: Config, names: Sequence[str], key: str) -> Config:
    """Return a copy of a `config` whose evaluations report all quantities in `names`.

    `key`: config key that holds the names."""
    lines = [*config.response.lines]
    terms = dict(config.objective.terms)
    for name in names:
        forced = is_force(config, name, key)
        if match := _LINE.fullmatch(name):
            order = float(match[1])
            lines += [order] * (order not in lines)
        elif not forced:
            terms.setdefault(name, 0.0)
    response = config.response.model_copy(update={"lines": tuple(lines)})
    objective = config.objective.model_copy(update={"terms": terms})
    return config.model_copy(update={"response": response, "objective": objective})


def sense_of(name: str) -> Literal["min", "max"]:
    """Return the sense (`min` or `max`, see `Term`) of the term registered under `name`.

    Raises `InputError` if there is no such term."""
    return terms_of([name])[0].sense


for _kind, _formulas in ((Formula, _LESS), (LargeFormula, _MORE)):
    for _name in _formulas:
        register_term(_name, _kind(_name))


def objective_weights(config: Config) -> dict[str, float]:
    """Return the weights of the responses in the objective, keyed by name; their sum is 1."""
    wanted = config.objective
    peak = PEAK_NORM if wanted.peak_norm is not None else "peak_force_N"
    shares = {
        "mean_force_N": wanted.mean_weight,
        peak: wanted.peak_weight,
        "rms_force_N": wanted.rms_weight,
        **{line_name(order): weight for order, weight in wanted.line_weights.items()},
    }
    for name, weight in wanted.terms.items():
        shares[name] = shares.get(name, 0.0) + weight
    total = sum(shares.values())
    return {name: share / total for name, share in shares.items() if share}
