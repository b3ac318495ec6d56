"""Limits of any quantity (`constraints.terms`), and the report's rows on all constraints.

A term that does not depend on forces becomes a `Constraint` of the design space. It costs no
simulation, and designs are moved onto it. A force, or a term that depends on forces, becomes a
`ForceLimit`, which an evaluation satisfies or not. `constraint_rows` are the rows of the report."""

import math
import re
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from rootsopt.config.reading import Config
from rootsopt.config.study import BASELINE
from rootsopt.config.units import unit_of, words
from rootsopt.errors import InputError
from rootsopt.optimize.local import NEAR, Certificate, Group
from rootsopt.response.result import Evaluation
from rootsopt.response.terms import (
    Forces,
    Term,
    depends_on_forces,
    is_force,
    objective_weights,
    reporting,
    sense_of,
    terms_of,
)
from rootsopt.runtime.programs import CachedFunction
from rootsopt.scene.build import Scene
from rootsopt.scene.space import Constraint, RangeConstraint, Space

if TYPE_CHECKING:
    from rootsopt.optimize.problem import Problem

LIMITS = "constraints.terms"
"""Config key that names the limited quantities."""
PEAK = "peak_force_N"
"""Key of the peak force in a response: the greatest of several local maxima of the force."""

# Slack and slope (both scaled) below which every design counts as meeting a limit with equality.
_SAME = 1e-6

# Multiplier of a bound, or share of a branch, below which the bound or branch counts as inactive.
HELD = 1e-6

# Change of a limit, by the unit of the limit, for which the report states the effect on the
# objective. In other units, it is the power of ten nearest to 1 % of the limit.
_STEPS = {"mm": 0.1, "deg": 1.0, "°": 1.0, "": 0.01}

SCENE_KINDS = 64
"""Number of branch kinds reserved for each scene: one per speed, of which there are at most 33."""


class TermConstraint(Constraint):
    """A constraint on a `term` that does not read forces; its unit is that of the term."""

    term: Term = eqx.field(kw_only=True)

    def slack_of(self, space, design, profile, shape, soundness):
        nothing = Forces(*[jnp.asarray(jnp.nan)] * 3)
        return self.scaled(self.term.value(space.scene.at(design), profile, shape, nothing))


class ForceLimit(NamedTuple):
    """A limit that depends on forces: value ≤ `limit` for a `ceiling`, else value ≥ `limit`.

    `key`: name of the quantity in a response; `name`: in words; `unit`: empty if the key does not
    tell it."""

    key: str
    ceiling: bool
    limit: float
    name: str
    unit: str

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
        return abs(self.limit) or 1.0

    @property
    def cornered(self) -> bool:
        """Whether all local maxima of the force must stay below the limit."""
        return self.ceiling and self.key == PEAK

    def excess(self, value):
        """Return how far values exceed the limit, divided by `scale`; ≤ 0 if they satisfy it."""
        return self.sign * (value - self.limit) / self.scale


def limited(config: Config) -> Config:
    """Return a copy of a `config` whose evaluations report all quantities of `constraints.terms`.

    Raises `InputError` if a name is not that of a quantity."""
    names = [*config.constraints.terms]
    terms_of([name for name in names if not is_force(config, name, LIMITS)], LIMITS)
    return reporting(config, names, LIMITS) if names else config


def settled(
    config: Config, geometry: Mapping[str, float], responses: Sequence[Mapping[str, float]] = ()
) -> Config:
    """Return a copy of a `config` in which limits that are `baseline` are the baseline's values.

    `geometry`: geometry of the baseline, with the keys of the result file; `responses`: its
    responses, one for each scene and speed; the worst one becomes the limit. Without responses,
    limits of `constraints.terms` stay as they are."""
    own = [key for key, limit in config.constraints if limit == BASELINE]
    values: dict[str, Any] = {key: geometry[quantity_of(key)] for key in own}
    terms: dict[str, dict[str, Any]] = {}
    for name, sides in config.constraints.terms.items():
        terms[name] = sides = {**sides}
        for side, worst in (("max", max), ("min", min)):
            if sides.get(side) == BASELINE and responses:
                sides[side] = worst(one[name] for one in responses)
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
    return tuple(
        TermConstraint(
            words(name), name, unit_of(name), jnp.asarray(limit), abs(limit) or 1.0, 1.0,
            ceiling=ceiling, term=terms_of([name], LIMITS)[0],
        )
        for name, ceiling, limit in _sides(config)
        if not depends_on_forces(config, scene, name, LIMITS)
    )  # fmt: skip


def force_limits(config: Config, scene: Scene) -> tuple[ForceLimit, ...]:
    """Return the limits on those quantities of `constraints.terms` that depend on forces.

    Raises `InputError` if such limits do not suit the objective or the method of the search."""
    limits = tuple(
        ForceLimit(name, ceiling, limit, words(name), unit_of(name))
        for name, ceiling, limit in _sides(config)
        if depends_on_forces(config, scene, name, LIMITS)
    )
    if limits and config.objective.motion == "ensemble":
        raise InputError(
            f"`{LIMITS}` must not limit forces for `objective.motion` ensemble, but limits "
            f"{limits[0].key}: averages have noise; give it a weight in `objective`, or choose "
            "another motion"
        )
    return limits


def _sides(config: Config) -> list[tuple[str, bool, float]]:
    """Return (name, whether it is a ceiling, limit) for each floor and ceiling.

    The baseline's value is filled in before a search; until then it is 0, without effect."""
    return [
        (name, side == "max", 0.0 if one[side] == BASELINE else float(one[side]))
        for name, one in config.constraints.terms.items()
        for side in ("max", "min")
        if side in one
    ]


@CachedFunction
def _ranges(space: Space, design):
    """Return {key: (high, least, most)} for the parameters whose range depends on others.

    `high`: upper end of the range, whatever the bounds; `least`, `most`: ends within the bounds."""
    within = {space.family.keys[place]: ends for place, *ends in space.within(design)}
    return {key: (high, *within[key]) for key, (_, high) in space.ranges(design).items()}


_slacks_of = CachedFunction(Space.slacks_of)


def needs_maxima(config: Config, limits: Sequence[ForceLimit]) -> bool:
    """Return whether evaluations need all local maxima of the force.

    They do if the objective of `config` contains the peak force of single motions, not an average
    over many. They also do if one of its `limits` is a ceiling of this force."""
    cornered = PEAK in objective_weights(config) or any(one.cornered for one in limits)
    return cornered and config.objective.motion in ("reached", "worst")


def counting(evaluation: Evaluation) -> list[tuple[int, Evaluation]]:
    """Return (kind, evaluation) of each scene, speed and motion in which limits must hold."""
    scenes = [part.evaluation for part in evaluation.scenes] or [evaluation]
    return [
        (SCENE_KINDS * scene + number, one)
        for scene, whole in enumerate(scenes)
        for number, part in enumerate(whole.by_speed)
        if part.share > 0
        for one in (part.evaluation, *part.evaluation.rivals)
    ]


def branches_of(evaluation: Evaluation, key: str, cornered: bool, kind: int) -> Group:
    """Return the k branches of a quantity of a usable `evaluation`, with gradients in config units.

    `key`: name of the quantity; `cornered`: whether it is the peak force, of which each known local
    maximum is a branch; `kind` of the branches."""
    maxima = evaluation.maxima if cornered else None
    if maxima is None or not maxima.times.size:
        slope = np.array([*evaluation.gradient[key].values()])
        tags = np.array([[float(kind), 0.0]])
        return Group(tags, np.array([evaluation.response[key]]), slope[None, :])
    phases = maxima.times / evaluation.steady_state["period"]
    tags = np.stack([np.full(len(phases), float(kind)), phases], axis=1)
    return Group(tags, maxima.forces, maxima.slopes)


def settled_by(config: Config, baseline: Evaluation) -> Config:
    """Return a copy of a `config` in which limits that are `baseline` are its evaluated values."""
    responses = [one.response for _, one in counting(baseline)] if baseline.usable else []
    return settled(config, baseline.geometry, responses)


def check_senses(config: Config) -> None:
    """Raise `InputError` if the objective of a `config` has a term that is to be maximised."""
    for name, weight in config.objective.terms.items():
        if weight > 0 and sense_of(name) == "max":
            raise InputError(
                f"`objective.terms` must name terms of which less is better, but names {name}; "
                "limit it under `constraints`, or trade it against others with `rootsopt pareto`"
            )


def _step(unit: str, limit: float) -> float:
    """Return the change of a `limit` for which the report states the effect on the objective."""
    if unit in _STEPS or limit == 0:
        return _STEPS.get(unit, 1.0)
    return 10.0 ** (round(math.log10(abs(limit))) - 2)


def _row(name, before, after, limit, unit, slacks, sense) -> dict:
    """Return a row of the report; `slacks`: those of baseline (NaN: not known) and optimum."""
    first, slack = slacks
    return {
        "name": name,
        "baseline": before,
        "optimized": after,
        "limit": limit,
        "unit": unit,
        "sense": sense,
        "satisfied": bool(slack >= -1e-6),
        "baseline_satisfied": None if math.isnan(first) else bool(first >= -1e-6),
        "active": bool(abs(slack) < NEAR),
    }


def constraint_rows(
    problem: "Problem", optimized: Evaluation, certificate: Certificate | None = None
) -> list[dict]:
    """Return one row per constraint for the report and the result file.

    `optimized`: evaluation of the optimum. Upper limits of parameters whose range depends on
    the others have rows too. With a `certificate`, each row has a `multiplier`: the change of
    the objective per unit of the limit. Active bounds of the search then have rows as well."""
    rows, both = [], (problem.baseline, optimized)
    always = _always(problem, optimized)
    for k, c in enumerate(problem.space.constraints):
        before, after = (_limited_value(problem, one, k) for one in both)
        slacks = [scaled_slack(problem, one, k) for one in both]
        row = _row(c.name, before, after, c.bound, c.unit, slacks, c.sense)
        if always[k]:
            row |= {"active": False, "always": True}
        if certificate is not None:
            per_unit = certificate.multipliers[k] * c.factor / c.scale
            row |= _multiplier(problem, row, per_unit, optimized)
        rows.append(row)
    for k, one in enumerate(problem.limits):
        before, after = (problem.worst(every, one) for every in both)
        slacks = [-float(one.excess(value)) for value in (before, after)]
        row = _row(one.name, before, after, one.limit, one.unit, slacks, one.sense)
        if certificate is not None:
            per_unit = float(np.sum(certificate.caps[k])) / one.scale
            row |= _multiplier(problem, row, per_unit, optimized)
        rows.append(row)
    return rows + _range_rows(problem, optimized, certificate)


def _always(problem: "Problem", optimized: Evaluation) -> NDArray[np.bool_]:
    """Return a mask (m,) of the constraints that every design meets with equality.

    Their slack is 0 at the config's own design and at the optimum, and does not depend on the
    design."""
    always = np.ones(len(problem.space.constraints), bool)
    for design in (problem.config.design, list(optimized.design.values())):
        _, _, slack, normals = problem.look(problem.point(design))
        always &= (np.abs(slack) < _SAME) & (np.linalg.norm(normals, axis=1) < _SAME)
    return always


def _multiplier(problem: "Problem", row: dict, per_unit: float, optimized: Evaluation) -> dict:
    """Return entries for a `row` that state how its limit affects the objective.

    `per_unit`: decrease of the objective per unit by which the limit is relaxed."""
    step = _step(row["unit"], row["limit"])
    relax = step if row["sense"] == "<=" else -step
    toward = -1.0 if row["sense"] == "<=" else 1.0
    gain = -100 * per_unit * step / problem.objective(optimized)
    return {
        "multiplier": toward * float(per_unit),
        "relaxed_by": relax,
        "relaxed_objective_percent": float(gain),
    }


def _range_rows(
    problem: "Problem", optimized: Evaluation, certificate: Certificate | None = None
) -> list[dict]:
    """Return rows for limits that are not constraints of the config.

    They are the upper limits of parameters whose range depends on the others. With a
    `certificate`, active bounds of the search are included."""
    design = np.asarray(list(optimized.design.values()), dtype=np.float64)
    ranges, names = _ranges(problem.space, design), list(optimized.design)
    low, high = (np.array(x) for x in (problem.space.lower, problem.space.upper))
    limited = dict.fromkeys(names, False)
    rows = []
    for key, (end, least, most) in ranges.items():
        place = names.index(key)
        before, after, limit = problem.baseline.design.get(key), optimized.design[key], float(end)
        own = math.nan
        if before is not None:
            given = np.asarray([*problem.baseline.design.values()], dtype=np.float64)
            own = float(_ranges(problem.space, given)[key][0])
        slacks = [own - (math.nan if before is None else before), limit - after]
        row = _row(words(key), before, after, limit, unit_of(key), slacks, "<=")
        row["baseline_limit"] = None if math.isnan(own) else own
        limited[key] = limit <= high[place]
        low[place], high[place] = float(least), float(most)
        if certificate is not None:
            width = max(high[place] - low[place], 1e-300)
            per_unit = certificate.upper[place] / width if limited[key] else 0.0
            row |= _multiplier(problem, row, per_unit, optimized)
        rows.append(row)
    if certificate is None:
        return rows
    for place, key in enumerate(names):
        width = max(high[place] - low[place], 1e-300)
        sides = (
            (">=", low[place], certificate.lower[place], "lower"),
            ("<=", high[place], certificate.upper[place], "upper"),
        )
        for sense, limit, multiplier, side in sides:
            if multiplier <= HELD or (side == "upper" and limited[key]):
                continue
            before, after = problem.baseline.design.get(key), float(design[place])
            known = before is not None and key not in ranges
            pair = np.array([before if known else math.nan, after])
            slacks = (pair - limit) / width * (1 if sense == ">=" else -1)
            name, unit = f"{side} bound of {words(key)}", unit_of(key)
            if side == "lower" and problem.space.floors[place]:
                name += f" ({100 * problem.space.floors[place]:g} %)"
            row = _row(name, before, after, float(limit), unit, slacks, sense)
            rows.append(row | _multiplier(problem, row, multiplier / width, optimized))
    return rows


def scaled_slack(problem: "Problem", evaluation: Evaluation, k: int) -> float:
    """Return the scaled slack of constraint `k` for an evaluated design, NaN if not known."""
    one = problem.space.constraints[k]
    beyond = _limited_value(problem, evaluation, k) - one.bound
    return one.sign * beyond * one.factor / one.scale


def _limited_value(problem: "Problem", evaluation: Evaluation, k: int) -> float:
    """Return the value that constraint `k` limits, in its unit, for an evaluated design.

    Return NaN for a rotor without the parameters of the search if the value needs these."""
    one = problem.space.constraints[k]
    if isinstance(one, TermConstraint):
        return evaluation.response[one.quantity]
    if not (one.margin or isinstance(one, RangeConstraint)):
        key = f"{one.quantity}_{one.unit}" if one.unit else one.quantity
        return evaluation.geometry.get(key, math.nan)
    if tuple(evaluation.design) != tuple(problem.config.design_keys):
        return math.nan
    design = np.asarray(list(evaluation.design.values()), dtype=np.float64)
    slack = float(np.asarray(_slacks_of(problem.space, design))[k])
    return (float(one.limit) + one.sign * slack * one.scale) / one.factor
