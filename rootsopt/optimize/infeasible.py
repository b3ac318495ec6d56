"""Explains why no design satisfies all constraints, and which limits could be met instead.

A search minimises the greatest scaled violation of all constraints (elastic mode). See Nocedal and
Wright, Numerical Optimization (2006), section 18.5. The constraints that keep this minimum above
zero are in conflict. If the geometry alone rules out all designs, none is simulated.

`beginning` finds the start of a search if the baseline is a rotor from a file, or of another
family. Such a rotor lacks the parameters that the search varies. It remains the baseline. The
search begins at the nearest member of the family `optimizer.family`."""

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rootsopt.config.families import FREE_FORM, families, family_of
from rootsopt.config.reading import Config
from rootsopt.config.study import NEAREST
from rootsopt.config.units import MM
from rootsopt.errors import InputError
from rootsopt.optimize.limits import ForceLimit, settled
from rootsopt.optimize.local import FEASIBLE, Group, Linearization, Look
from rootsopt.optimize.sqp import Descent, Stops, descend
from rootsopt.profiles import Outline, Profile
from rootsopt.response.records import geometry_record
from rootsopt.response.result import Evaluation
from rootsopt.scene.build import Scene
from rootsopt.scene.check import shape_of
from rootsopt.scene.families import arguments_of, classical, profile_from_file, profile_of
from rootsopt.scene.resemblance import COEFFICIENTS, Likeness, free_likeness, likeness
from rootsopt.scene.space import Constraint, widened

if TYPE_CHECKING:
    from rootsopt.optimize.problem import Problem


# Maximum number of points at which the search for the least violation of the constraints starts.
_EXPLAINED = 8

_STOPS = Stops(feasibility=1e-9, evaluations=300)

# Criteria for the end of each local search if every point must be simulated.
_SIMULATED = Stops(feasibility=FEASIBLE, evaluations=60)

# Difference between the phases that `_groups` gives the branches at successive speeds.
_GOLDEN = 0.6180339887

# Share of a constraint in the least violation above which the constraint counts as in conflict.
# The shares of all constraints add up to 1.
_PART = 1e-3


class Conflict(NamedTuple):
    """A constraint that is in conflict with others.

    `name`: name in reports; `sense`: "<=" or ">="; `limit`: required limit; `unit`: unit of all
    values. `together`: value in the design of least violation. `alone`: nearest limit that can be
    met while all other constraints hold, or `None` if no such design was found."""

    name: str
    sense: str
    limit: float
    unit: str
    together: float
    alone: float | None


class Infeasible(NamedTuple):
    """Why no design satisfies all constraints.

    `violation`: least possible value of the greatest scaled violation; `conflicts`: the constraints
    in conflict; `design`: design of least violation, in config units by key. If no design could be
    evaluated, `violation` is NaN and the others are empty. `simulated`: whether limits of forces
    count, so that few designs could be tried."""

    violation: float
    conflicts: tuple[Conflict, ...]
    design: dict[str, float]
    simulated: bool = False

    @property
    def message(self) -> str:
        """Message for the user: constraints in conflict, and limits that can be met."""
        lines = []
        for one in self.conflicts:
            unit = f" {one.unit}" if one.unit else ""
            line = f"{one.name} {one.sense} {one.limit:.5g}{unit}"
            if one.alone is not None:
                line += f" (possible with the others: {one.alone:.5g}{unit})"
            lines.append(line)
        if any(one.alone is not None for one in self.conflicts):
            advice = "Relax one of these to the value in brackets, or widen optimizer.bounds."
        else:
            advice = (
                "Relaxing one of them is not enough. Relax all of them to their values in the "
                "design of least violation, or widen optimizer.bounds."
            )
        if self.simulated:
            advice += (
                " Limits of forces are searched for locally: optimizer.starts and "
                "optimizer.screening look further."
            )
        phrase = "was found that" if self.simulated else "within optimizer.bounds"
        return (
            f"No design {phrase} satisfies all constraints. In conflict: "
            f"{'; '.join(lines)}. {advice}"
        )

    def feasible(self, problem: "Problem") -> NDArray[np.float64] | None:
        """Return the point (d,) of the design if it satisfies all constraints after all."""
        if not self.violation <= FEASIBLE:
            return None
        return problem.point([*self.design.values()])

    def record(self) -> dict[str, Any]:
        """Return the entries `violation`, `conflicts` and `design` of the result file."""
        conflicts = [one._asdict() for one in self.conflicts]
        return {"violation": self.violation, "conflicts": conflicts, "design": self.design}


def feasible_points(
    problem: "Problem", sample: Sequence[NDArray[np.float64]]
) -> tuple[list[NDArray[np.float64]], Infeasible | None]:
    """Return the feasible points (d,) of a `sample`; if no design is feasible, the reason.

    The steps onto the feasible set may fail for every point of a small sample. The search for the
    least violation may then still find a feasible design, which is the only point."""
    points = [point for point in sample if problem.feasible(point)]
    if points:
        return points, None
    reason = explain(problem, sample)
    point = reason.feasible(problem)
    return ([], reason) if point is None else ([point], None)


def explain(
    problem: "Problem", starts: Sequence[NDArray[np.float64]], look: Look | None = None
) -> Infeasible:
    """Return why no design satisfies all constraints of a `problem`.

    `starts`: points (d,) of the unit box at which searches for the least violation start; only the
    first `_EXPLAINED` count. `look`: function that returns constraints and caps at a point, from a
    simulation. By default, only the constraints of the geometry count."""
    starts = starts[:_EXPLAINED]
    limits, stops = ((), _STOPS) if look is None else (problem.limits, _SIMULATED)

    def parts(point: NDArray[np.float64]) -> tuple[Group, ...] | None:
        local = _geometry(problem, point) if look is None else look(point)
        return None if local is None else _groups(local)

    def greatest(point: NDArray[np.float64]) -> Linearization | None:
        groups = parts(point)
        if groups is None:
            return None
        every = [np.concatenate(arrays) for arrays in zip(*groups, strict=True)]
        nothing = np.zeros(0), np.zeros((0, len(point)))
        return Linearization(0.0, np.zeros(len(point)), (Group(*every),), *nothing)

    best = _best([descend(greatest, start, stops) for start in starts])
    if best is None or best.certificate is None or best.local is None:
        return Infeasible(float("nan"), (), {}, look is not None)
    kinds = best.local.groups[0].tags[:, 0].astype(int)
    shares = np.bincount(kinds, best.certificate.shares[0])
    conflicts = []
    # A design that satisfies all constraints after all has none in conflict.
    for k in np.flatnonzero((shares > _PART) & (best.local.objective > FEASIBLE)):
        excess = float(np.max(best.local.groups[0].values[kinds == k]))
        alone = _alone(parts, int(k), [best.point, *starts], stops)
        conflicts.append(_conflict((*problem.space.constraints, *limits)[k], excess, alone))
    design = problem.named(best.point)
    return Infeasible(best.local.objective, tuple(conflicts), design, look is not None)


def _geometry(problem: "Problem", point: NDArray[np.float64]) -> Linearization | None:
    """Return the constraints of the geometry at a `point` (d,), without an objective."""
    slack, normals = problem.look(point)[2:]
    if not np.all(np.isfinite(slack)) or not np.all(np.isfinite(normals)):
        return None
    return Linearization(0.0, np.zeros(len(point)), (), slack, normals)


def _groups(local: Linearization) -> tuple[Group, ...]:
    """Return all constraints and caps as groups of branches that must be at most 0.

    The index of a constraint or cap is the kind of its branches."""
    groups = [
        Group(np.array([[float(k), 0.0]]), np.array([-value]), -row[None, :])
        for k, (value, row) in enumerate(zip(local.slack, local.normals, strict=True))
    ]
    for cap in local.caps:
        # Shift the phases, so that equal instants at different speeds or scenes stay distinct.
        phases = (cap.tags[:, 1] + cap.tags[:, 0] * _GOLDEN) % 1.0
        kinds = np.full(len(phases), float(len(groups)))
        groups.append(cap._replace(tags=np.stack([kinds, phases], axis=1)))
    return tuple(groups)


def _alone(
    parts: Callable[[NDArray[np.float64]], tuple[Group, ...] | None],
    k: int,
    starts: Sequence[NDArray[np.float64]],
    stops: Stops,
) -> float | None:
    """Return the least scaled excess over constraint `k` in designs that satisfy all others.

    `parts`: function that returns all constraints at a point; `starts`: points (d,) of the unit box
    from which to search. Return `None` if the searches find no point that satisfies the other
    constraints."""

    def look(point: NDArray[np.float64]) -> Linearization | None:
        groups = parts(point)
        if groups is None:
            return None
        others = groups[:k] + groups[k + 1 :]
        nothing = np.zeros(0), np.zeros((0, len(point)))
        return Linearization(0.0, np.zeros(len(point)), (groups[k],), *nothing, others)

    minima = [descend(look, start, stops) for start in starts]
    minima = [one for one in minima if one.local is not None and one.local.violation <= FEASIBLE]
    best = _best(minima)
    return None if best is None or best.local is None else best.local.objective


def _conflict(one: Constraint | ForceLimit, excess: float, alone: float | None) -> Conflict:
    """Return a conflict in reported units.

    `excess`: scaled excess over the limit in the design of least violation; `alone`: the same if
    all other constraints hold."""
    forced = isinstance(one, ForceLimit)
    limit, size = (one.limit, one.scale) if forced else (one.bound, one.scale / one.factor)
    size = size if one.ceiling else -size
    nearest = None if alone is None else limit + size * alone
    return Conflict(one.name, one.sense, limit, one.unit, limit + size * excess, nearest)


def _best(minima: Sequence[Descent]) -> Descent | None:
    usable = [(one.local.objective, one) for one in minima if one.local is not None]
    return min(usable, key=lambda pair: pair[0], default=(0.0, None))[1]


# Distance (m) of the nearest named family above which the message recommends a free form.
_FAR = 20e-6

# Numbers of coefficients of a free form, tried in this order until it is as near as the distance
# (m): searches with few parameters compile and run faster.
_COUNTS, _EXACT = (3, COEFFICIENTS // 2, COEFFICIENTS), 1e-6


@dataclasses.dataclass(frozen=True)
class Beginning:
    """The design that begins the search in another family than the baseline's.

    `config`: config of the search, with the fitted profile and with bounds that hold it.
    `likeness`: the fitted profile, and its distances from the outline. `considered`: the nearest
    members of all families that were compared, nearest first. `widened`: keys of the parameters
    whose default bounds were widened. `file`: name of the outline's file, "" without one.
    `evaluation`: simulation of the fitted profile, `None` before it has been simulated. `oversize`:
    flank gap (mm) by which the members exceed that of an outline whose flanks overlap, otherwise 0.
    """

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
        text = f"The baseline is the rotor of {self.file} as it is. " if self.file else ""
        text += (
            f"The search began at the nearest {one.family} profile, at most "
            f"{one.departure * 1e6:.3g} um (RMS {one.rms * 1e6:.3g} um) from it."
        )
        if one.inset:
            text += f" {self._inset}."
        if self.widened:
            pairs = self.config.optimizer.bounds
            named = [f"{k} to [{pairs[k][0]:.4g}, {pairs[k][1]:.4g}]" for k in self.widened]
            text += f" Its bounds were widened to hold it: {', '.join(named)}."
        if one.departure > _FAR and one.family != FREE_FORM:
            text += " `--set optimizer.family=free_form` begins closer to the outline."
        return text

    @property
    def _inset(self) -> str:
        """Sentence on the clearance that gives the members the gap of the inset outline."""
        size, gap = self.likeness.inset * 1e3, self.config.contact.clearance_mm
        if self.oversize:
            return (
                f"The outline is oversize, inset {size:.3g} mm: its flanks overlap by "
                f"{self.oversize:.3g} mm more than those of the members, whose clearance is 0"
            )
        return (
            f"The outline is cut, inset {size:.3g} mm: the members of the family have the same "
            f"flank gap with `--set contact.clearance_mm={gap:.6g}`"
        )

    def record(self) -> dict[str, Any]:
        """Return the entry `beginning` of the result file."""
        return self.likeness.record() | {
            "widened_bounds": [*self.widened],
            "considered": [one.record() for one in self.considered],
            "message": self.message,
        }


def beginning(config: Config) -> Beginning | None:
    """Return where the search of a `config` begins; `None` if it varies the baseline's own family.

    Raises `InputError` if the file holds no usable outline, or if no profile of the family
    `optimizer.family` could be fitted to it."""
    wanted, own = config.optimizer.family, config.profile
    given = profile_from_file(own)
    if given is None:
        if wanted in (NEAREST, own.family):
            return None
        given = profile_of(*arguments_of(own))
    members = _fits(given, wanted)
    for one in members:
        try:
            profile = one.config(config.profile)
        except (InputError, ValueError):
            continue
        other, oversize = _cut(config.model_copy(update={"profile": profile}), one.inset)
        other, keys = widened(other)
        file = Path(config.profile.outline_file or "").name
        return Beginning(other, one, members, keys, file, oversize=oversize)
    valid = ", ".join([NEAREST, *(name for name, one in families().items() if one.fitted)])
    raise InputError(
        f"`optimizer.family` must be a family with a sound profile near the baseline, but is "
        f"{wanted}, for which none was found; choose another one of {valid}"
    )


def _cut(config: Config, inset: float) -> tuple[Config, float]:
    """Return (config of a member with the flank gap of an outline, excess of its gap in mm).

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


def _fits(given: Profile, family: str) -> list[Likeness]:
    """Return the members nearest to the profile `given`, nearest first.

    `family`: name of a family, or `NEAREST` for all classical ones with parameters."""
    named = [name for name in classical() if family_of(name).fitted]
    if family == NEAREST:
        members = [likeness(given, name) for name in named]
    elif family in named:
        members = [likeness(given, family)]
    else:
        # Projections of smooth members are better starts than those of measured points.
        smooth = ("five_arcs", "cic") if isinstance(given, Outline) else ()
        near = [one for name in smooth if (one := likeness(given, name)) is not None]
        for count in _COUNTS:
            members = [free_likeness(given, *near, count=count)]
            if members[0] is not None and members[0].departure <= _EXACT:
                break
    return sorted((one for one in members if one is not None), key=lambda one: one.departure)
