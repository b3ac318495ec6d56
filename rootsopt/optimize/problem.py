"""The design problem of a config: objective and constraints, relative to its baseline."""

import dataclasses
import functools
import itertools
import math
from collections.abc import Iterator, Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import NDArray

from rootsopt.config import Config
from rootsopt.config.units import unit_of, words
from rootsopt.dynamics.orbit import PEAK_NORM, line_name
from rootsopt.errors import InputError
from rootsopt.optimize.limits import (
    PEAK,
    ForceLimit,
    TermConstraint,
    force_limits,
    settled,
    term_constraints,
)
from rootsopt.optimize.local import FEASIBLE, NEAR, Certificate, Group, Linearization
from rootsopt.optimize.optimality import Holder
from rootsopt.response.evaluation import RESPONSES, Evaluation, objective_weights
from rootsopt.response.reducers import counted
from rootsopt.response.terms import sense_of
from rootsopt.runtime.programs import CachedFunction
from rootsopt.scene import Scene
from rootsopt.scene.space import RangeConstraint, Space, slacks_and_slopes
from rootsopt.status import Status

# Amplitude of the baseline's line (relative to its mean force) below which it can be no objective.
_NO_LINE = 1e-9

# Share of a measure's nominal value below which the baseline's value in another scene is no unit.
_LEAST = 0.1

# Slack and slope (both scaled) below which every design counts as meeting a limit with equality.
_SAME = 1e-6

# Multiplier of a bound, or share of a branch, below which the bound or branch counts as inactive.
_HELD = 1e-6

# Change of a limit, by the unit of the limit, for which the report states the effect on the
# objective. In other units, it is the power of ten nearest to 1 % of the limit.
_STEPS = {"mm": 0.1, "deg": 1.0, "°": 1.0, "": 0.01}
SCENE_KINDS = 64
"""Number of branch kinds reserved for each scene: one per speed, of which there are at most 33."""

# Maximum number of times that an infeasible point is moved halfway towards a feasible point.
_DRAWN = 5


@CachedFunction
def _nearest(space: Space, design):
    """Return the point (d,) of the unit box nearest to a `design` (d,) in config units."""
    return space.point(design)


@CachedFunction
def _ranges(space: Space, design):
    """Return {key: (high, least, most)} for the parameters whose range depends on others.

    `high`: upper end of the range, whatever the bounds; `least`, `most`: ends within the bounds."""
    within = {space.family.keys[place]: ends for place, *ends in space.within(design)}
    return {key: (high, *within[key]) for key, (_, high) in space.ranges(design).items()}


_slacks_of = CachedFunction(Space.slacks_of)


def needs_maxima(config: Config, limits: Sequence[ForceLimit]) -> bool:
    """Return whether evaluations need all local maxima of the force.

    They do if the objective of `config` contains the peak force of single motions, or if one of its
    `limits` is a ceiling of this force."""
    cornered = PEAK in objective_weights(config) or any(one.cornered for one in limits)
    return cornered and _of_motions(config)


def _of_motions(config: Config) -> bool:
    """Return whether the objective contains forces of single motions, not averages over many."""
    return config.objective.motion in ("reached", "worst")


@dataclasses.dataclass(frozen=True)
class Problem:
    """The design problem of a config, relative to its evaluated baseline.

    `config`: the config; `baseline`: evaluation of the config's own design, or of the outline that
    the search is to improve; `space`: unit box of the d design parameters, with m constraints;
    `limits`: limits that depend on forces; `added`: number added to the objective. In all methods,
    a *point* (d,) is a point of this box.
    """

    config: Config
    baseline: Evaluation
    space: Space
    limits: tuple[ForceLimit, ...] = ()
    added: float = 0.0

    @classmethod
    def of(cls, config: Config, scene: Scene, baseline: Evaluation) -> "Problem":
        """Return the problem of a `config`, with its `scene` and the evaluated `baseline`.

        Limits that are `baseline` are those of the `baseline`. Raises `InputError` if a
        measure in the objective is 0 for the baseline, because the objective divides by this value.
        """
        check_senses(config)
        orders = {line_name(order): order for order in config.objective.line_weights}
        counting = [part for part in baseline.by_speed if part.share > 0]
        for name, part in itertools.product(objective_weights(config), counting):
            one = part.evaluation
            least = _NO_LINE * one.response["mean_force_N"] if name in orders else 0.0
            if one.response[name] > least:
                continue
            at = "" if math.isnan(part.speed_rpm) else f" at {part.speed_rpm:g} rpm"
            if name in orders:
                period = one.steady_state.get("period")
                raise InputError(
                    f"`objective.line_weights` has the order {orders[name]:g}, but the baseline's "
                    f"force has no such line{at} (its motion repeats every {period} mesh periods); "
                    "remove it"
                )
            said = f"its {name} is {one.response[name]:g}{at}"
            if one.status is Status.IDLE and name in (*RESPONSES, PEAK_NORM):
                raise InputError(
                    "the weights of `objective` must be on quantities that the baseline has, but "
                    f"{said}, because its flanks never touch; minimise what counts then, as in "
                    "`objective={mean_weight: 0, peak_weight: 0, terms: {leakage_fraction: 1}}` or "
                    "with flow_ripple, gear_force_N or static_bearing_load_max_N, and keep "
                    "contact_reserve_um above a limit under `constraints.terms`"
                )
            raise InputError(
                f"the weights of `objective` must be on quantities of the baseline, but {said}; "
                "set the weight to 0"
            )
        config = settled_by(config, baseline)
        space = Space.of(config, scene, term_constraints(config, scene))
        return cls(config, baseline, space, force_limits(config, scene))

    def beside(self, baseline: Evaluation) -> "Problem":
        """Return the problem relative to another usable evaluation of the `baseline`.

        Its objective is 1 + Σ w (F - F_0) / max(F_0, F_n / 10) over the measures F with the weights
        w, where F_0 is the baseline's value there and F_n that of `self.baseline`. Where the
        baseline hardly strikes or not at all, a ratio to F_0 alone would say nothing. Designs and
        constraints of the geometry are the same."""
        found = Problem(self.config, _in_units(baseline, self.baseline), self.space, self.limits)
        found.__dict__["_look_at"] = self._look_at  # Its results are costly, and the same.
        return dataclasses.replace(found, added=1 - found.objective(baseline))

    def objective(self, evaluation: Evaluation) -> float:
        """Return the objective of an `evaluation`, which is 1 for the baseline.

        The objective is a weighted sum of measures, each divided by its value for the baseline. All
        speeds are combined. The result is NaN without a usable steady state."""
        if not evaluation.usable:
            return float("nan")
        counted = self._counted(evaluation)
        return self.added + sum(share * self._value(*pair) for share, *pair in counted)

    def by_speed(self, evaluation: Evaluation) -> list[dict[str, float]]:
        """Return one row per speed of `objective.speeds_rpm`, with the objective at this speed.

        The keys of a row are `speed_rpm`, `share` (weight of the speed) and `objective`. The
        objective is NaN if a measure of the baseline is 0, which is possible only if the share is
        0. Without `objective.speeds_rpm`, the list is empty."""
        parts = zip(evaluation.by_speed, self.baseline.by_speed, strict=True)
        return [
            {
                "speed_rpm": part.speed_rpm,
                "share": part.share,
                "objective": self._value(part.evaluation, base.evaluation),
            }
            for part, base in parts
            if self.config.objective.speeds_rpm
        ]

    def look(self, point) -> tuple[NDArray[np.float64], ...]:
        """Return (design (d,), its Jacobian (d, d), slacks (m,), their Jacobian (m, d)).

        They are taken at a `point` (d,), and the Jacobians are with respect to this point. The
        slacks belong to the m constraints. A slack is negative if its constraint is violated."""
        return self._look_at(tuple(np.asarray(point, dtype=np.float64)))

    def limits_at(self, point) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return (slacks (m,), their Jacobian (m, d)) at a `point` (d,), as in `look`."""
        return self.look(point)[2:]  # type: ignore[return-value]

    @functools.cached_property
    def _look_at(self):
        def look(point):
            return tuple(map(np.asarray, slacks_and_slopes(self.space, np.asarray(point))))

        # The same point is requested several times.
        return functools.lru_cache(maxsize=1024)(look)

    def slope(self, evaluation: Evaluation, point) -> NDArray[np.float64]:
        """Return the gradient (d,) of the objective with respect to the `point` (d,).

        `evaluation`: evaluation of the design at this point, with gradients."""
        _, jacobian, _, _ = self.look(point)
        by_design = np.zeros(len(self.space.lower))
        for share, one, baseline in self._counted(evaluation):
            for key, weight in self._weights(baseline).items():
                by_design += share * weight * np.array(list(one.gradient[key].values()))
        return np.asarray(by_design @ np.asarray(jacobian))

    def local(self, evaluation: Evaluation, point) -> Linearization | None:
        """Return the objective and the constraints at a `point`, with gradients.

        `evaluation`: evaluation of the design at this point. Return `None` if it has no usable
        steady state. If it lists local maxima of the force, each maximum is a branch of the
        objective. Each coexisting motion is a branch too, and each speed if only the worst speed
        counts."""
        if not evaluation.usable:
            return None
        _, jacobian, slack, normals = self.look(point)
        worst = self.config.objective.over_speeds == "worst"
        # The same groups at every point, even if one of them has a single branch.
        cornered = self.cornered or self.config.objective.motion == "worst"
        parts = zip(evaluation.by_speed, self.baseline.by_speed, strict=True)
        smooth, slope = self.added, np.zeros(len(self.space.lower))
        groups: list[Group] = []
        for number, (part, base) in enumerate(parts):
            if part.share <= 0:
                continue
            one = self._branches(part.evaluation, base.evaluation, number)
            if not (cornered or worst):
                smooth += part.share * float(one.values[0])
                slope += part.share * one.slopes[0]
            else:
                share = 1.0 if worst else part.share
                groups.append(Group(one.tags, share * one.values, share * one.slopes))
        if worst:
            together = [np.concatenate(arrays) for arrays in zip(*groups, strict=True)]
            groups = [Group(*together)]
        scaled = tuple(g._replace(slopes=g.slopes @ jacobian) for g in groups)
        walls = self.walls(evaluation, jacobian)
        return Linearization(smooth, slope @ jacobian, scaled, slack, normals, walls)

    def walls(self, evaluation: Evaluation, jacobian: NDArray[np.float64]) -> tuple[Group, ...]:
        """Return one wall for each of `limits`, with the amount by which an evaluated design
        exceeds it.

        `evaluation`: usable, with gradients; `jacobian` (d, d): that of the design with respect to
        the point. Each speed that counts, each coexisting motion and each scene of a sample is a
        branch. If the peak force has a ceiling, each local maximum of the force is a branch, too.
        """
        found = []
        for limit in self.limits:
            tags, values, slopes = [], [], []
            for kind, one in counting(evaluation):
                maxima = one.maxima if limit.cornered else None
                if maxima is None or not maxima.times.size:
                    tags.append((kind, 0.0))
                    values.append(one.response[limit.key])
                    slopes.append(np.array(list(one.gradient[limit.key].values())))
                    continue
                period = one.steady_state["period"]
                tags += [(kind, time / period) for time in maxima.times]
                values += [*maxima.forces]
                slopes += [*maxima.slopes]
            rows = limit.sign * np.array(slopes) / limit.scale
            found.append(
                Group(np.array(tags, float), limit.excess(np.array(values)), rows @ jacobian)
            )
        return tuple(found)

    def worst(self, evaluation: Evaluation, limit: ForceLimit) -> float:
        """Return the worst value of a limited quantity: the one nearest to its `limit`, or farthest
        beyond it.

        `evaluation`: usable. Speeds, motions and scenes are those of `walls`."""
        values = [one.response[limit.key] for _, one in counting(evaluation)]
        return float(max(values, key=limit.excess))

    def excess(self, evaluation: Evaluation) -> float:
        """Return by how much an evaluated design exceeds the worst of `limits`; ≤ 0 if all hold.

        The excess is scaled. It is 0 if there are no limits, NaN without a usable steady state."""
        if not self.limits:
            return 0.0
        if not evaluation.usable:
            return math.nan
        return max(float(one.excess(self.worst(evaluation, one))) for one in self.limits)

    @property
    def with_maxima(self) -> bool:
        """Whether an evaluation needs all local maxima of the force."""
        return needs_maxima(self.config, self.limits)

    def broken(self, evaluation: Evaluation) -> list[str]:
        """Return the names of all limits that an evaluated design violates.

        They are those of the geometry, of its soundness, and of `constraints.terms`. For a rotor
        from a file, limits that need design parameters are left out."""
        found = [
            one.name
            for k, one in enumerate(self.space.constraints)
            if self._slack(evaluation, k) < -FEASIBLE
        ]
        for one in self.limits:
            if evaluation.usable and one.excess(self.worst(evaluation, one)) > FEASIBLE:
                found.append(one.name)
        return found

    def along_scene(self, moved: Evaluation, certificate: Certificate) -> dict[str, float]:
        """Return the derivatives of the optimal objective with respect to scene quantities, by key.

        `moved`: evaluation of the optimum at a single speed, with gradients with respect to scene
        quantities (`by_scene`); `certificate`: that of the optimum. The design is held fixed,
        because its own change has no effect to first order (envelope theorem). Return {} if a
        measure in the objective has no such gradient."""
        weights = self._weights(self.baseline)
        if not weights.keys() <= moved.gradient.keys():
            return {}
        group = self._branches(moved, self.baseline, 0)
        shares = certificate.shares[0] if certificate.shares else np.ones(1)
        keys = next(iter(moved.gradient.values()))
        return dict(zip(keys, map(float, shares @ group.slopes), strict=True))

    @property
    def cornered(self) -> bool:
        """Whether the objective contains the peak force of single motions, which has corners."""
        return PEAK in objective_weights(self.config) and _of_motions(self.config)

    def _branches(self, evaluation: Evaluation, baseline: Evaluation, number: int) -> Group:
        """Return the objective at one speed as branches, with gradients in config units.

        `number`: number of the speed, used as the kind of the branches."""
        weights = self._weights(baseline)
        tags, values, slopes = [], [], []
        for one in (evaluation, *evaluation.rivals):
            maxima = one.maxima if PEAK in weights else None
            smooth = {k: w for k, w in weights.items() if maxima is None or k != PEAK}
            value = sum(w * one.response[k] for k, w in smooth.items())
            slope = sum(
                (w * np.array(list(one.gradient[k].values())) for k, w in smooth.items()),
                start=0.0,
            )
            if maxima is None or not maxima.times.size:
                tags.append((number, 0.0))
                values.append(self._value(one, baseline))
                slopes.append(slope)
                continue
            period = one.steady_state["period"]
            for time, force, row in zip(*maxima, strict=True):
                tags.append((number, time / period))
                values.append(value + weights[PEAK] * force)
                slopes.append(slope + weights[PEAK] * row)
        return Group(np.array(tags), np.array(values), np.array(slopes))

    def _counted(self, evaluation: Evaluation):
        return counted(self.config, evaluation, self.baseline, self._value)

    def _value(self, evaluation: Evaluation, baseline: Evaluation) -> float:
        """Return the weighted sum of the measures at one speed.

        Each measure is divided by its value for the `baseline` at the same speed."""
        return sum(w * evaluation.response[k] for k, w in self._weights(baseline).items())

    def _weights(self, baseline: Evaluation) -> dict[str, float]:
        """Return the weight of each measure at one speed, divided by the baseline's value (1/N).

        A weight is NaN if the baseline's value is 0."""
        weights = objective_weights(self.config)
        forces = {key: baseline.response[key] or math.nan for key in weights}
        return {key: weight / forces[key] for key, weight in weights.items()}

    def point(self, design) -> NDArray[np.float64]:
        """Return the point (d,) of the unit box nearest to a `design` (d,) in config units."""
        return np.asarray(_nearest(self.space, np.asarray(design, dtype=np.float64)))

    def design(self, point) -> Float[Array, " d"]:
        """Return the design (d,) in config units at a `point` (d,)."""
        return jnp.asarray(self.look(point)[0])

    def feasible(self, point) -> bool:
        """Return whether a `point` (d,) satisfies every constraint within `FEASIBLE`."""
        return bool(np.min(self.look(point)[2]) >= -FEASIBLE)

    def project(self, point) -> NDArray[np.float64]:
        """Return `point` (d,) moved onto the feasible set by Gauss-Newton steps.

        Each step is computed from the violated constraints. The result can still be infeasible, for
        example if the constraints contradict the bounds."""
        point = np.clip(np.asarray(point, dtype=np.float64), 0.0, 1.0)
        for _ in range(30):
            _, _, slack, jacobian = self.look(point)
            violated = slack < 0
            if not violated.any():
                break
            # Aim slightly inside, so that the constraint holds despite rounding. Coordinates held
            # by their bound do not move.
            # Where no profile exists, a margin may have no derivative, and does not move the point.
            rows, want = np.nan_to_num(jacobian[violated]), 1e-7 - slack[violated]
            push = rows.T @ want
            held = ((point <= 0) & (push < 0)) | ((point >= 1) & (push > 0))
            move = np.linalg.lstsq(np.where(held, 0.0, rows), want, rcond=1e-8)[0]
            point = np.clip(point + np.clip(move, -0.3, 0.3), 0.0, 1.0)
        return np.asarray(point, dtype=np.float64)

    def nearby(self, point, sizes: Sequence[float]) -> Iterator[NDArray[np.float64]]:
        """Yield points beside a feasible `point` (d,), towards the middle of the unit box.

        `sizes`: distances along each coordinate. An orbit can fail a check of accuracy at a design
        although its neighbours pass."""
        for size in sizes:
            yield self.toward(point + size * np.sign(0.5 - point), point)

    def toward(self, point, inside) -> NDArray[np.float64]:
        """Return a point near `point` (d,) that is feasible if possible.

        `inside`: a feasible point. The result is that of `project` if this is feasible. Otherwise,
        `point` is moved halfway towards `inside` and projected again, up to `_DRAWN` times. If this
        fails too, the result is the projection of `inside`. This helps where no profile exists at
        `point`. Families whose closed-form limits ensure a sound profile need only the first
        projection."""
        found = self.project(point)
        if self.space.family.by_limits:
            return found
        for share in (*0.5 ** np.arange(1, _DRAWN + 1), 0.0):
            if self.feasible(found):
                break
            found = self.project(inside + share * (np.asarray(point) - inside))
        return found

    def descent(self, point, slope: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the gradient `slope` (d,) projected so that its negative is a feasible direction.

        The negative of the result is the direction closest to -`slope` that violates no constraint
        or bound active at `point` (d,). It solves a non-negative least-squares problem. The result
        is zero exactly at a Karush-Kuhn-Tucker point."""
        _, _, slack, jacobian = self.look(point)
        point = np.asarray(point)
        walls = [row for row, s in zip(jacobian, slack, strict=True) if s < 1e-4]
        sides = np.eye(len(point))
        walls += [side for side, x in zip(sides, point, strict=True) if x <= FEASIBLE]
        walls += [-side for side, x in zip(sides, point, strict=True) if x >= 1 - FEASIBLE]
        if not walls:
            return np.asarray(slope, dtype=np.float64)
        from scipy.optimize import nnls  # Slow import (0.3 s).

        normals = np.stack(walls)
        multipliers, _ = nnls(normals.T, slope)
        return np.asarray(slope - multipliers @ normals, dtype=np.float64)

    def constraint_rows(
        self, optimized: Evaluation, certificate: Certificate | None = None
    ) -> list[dict]:
        """Return one row per constraint for the report and the result file.

        `optimized`: evaluation of the optimum. Upper limits of parameters whose range depends on
        the others have rows too. With a `certificate`, each row has a `multiplier`: the change of
        the objective per unit of the limit. Active bounds of the search then have rows as well."""
        rows, both = [], (self.baseline, optimized)
        always = self._always(optimized)
        for k, c in enumerate(self.space.constraints):
            before, after = (self._limited_value(one, k) for one in both)
            slacks = [self._slack(one, k) for one in both]
            row = _row(c.name, before, after, c.bound, c.unit, slacks, c.sense)
            if always[k]:
                row |= {"active": False, "always": True}
            if certificate is not None:
                per_unit = certificate.multipliers[k] * c.factor / c.scale
                row |= self._multiplier(row, per_unit, optimized)
            rows.append(row)
        for k, one in enumerate(self.limits):
            before, after = (self.worst(every, one) for every in both)
            slacks = [-float(one.excess(value)) for value in (before, after)]
            row = _row(one.name, before, after, one.limit, one.unit, slacks, one.sense)
            if certificate is not None:
                per_unit = float(np.sum(certificate.walls[k])) / one.scale
                row |= self._multiplier(row, per_unit, optimized)
            rows.append(row)
        return rows + self._range_rows(optimized, certificate)

    def _slack(self, evaluation: Evaluation, k: int) -> float:
        """Return the scaled slack of constraint `k` for an evaluated design, NaN if not known."""
        one = self.space.constraints[k]
        beyond = self._limited_value(evaluation, k) - one.bound
        return one.sign * beyond * one.factor / one.scale

    def _limited_value(self, evaluation: Evaluation, k: int) -> float:
        """Return the value that constraint `k` limits, in its unit, for an evaluated design.

        Return NaN for a rotor without the parameters of the search if the value needs these."""
        one = self.space.constraints[k]
        if isinstance(one, TermConstraint):
            return evaluation.response[one.quantity]
        if not (one.margin or isinstance(one, RangeConstraint)):
            key = f"{one.quantity}_{one.unit}" if one.unit else one.quantity
            return evaluation.geometry.get(key, math.nan)
        if tuple(evaluation.design) != tuple(self.config.design_keys):
            return math.nan
        slack = float(self._slacks(evaluation)[k])
        return (float(one.limit) + one.sign * slack * one.scale) / one.factor

    def _always(self, optimized: Evaluation) -> NDArray[np.bool_]:
        """Return a mask (m,) of the constraints that every design meets with equality.

        Their slack is 0 at the config's own design and at the optimum, and does not depend on the
        design."""
        found = np.ones(len(self.space.constraints), bool)
        for design in (self.config.design, list(optimized.design.values())):
            _, _, slack, normals = self.look(self.point(design))
            found &= (np.abs(slack) < _SAME) & (np.linalg.norm(normals, axis=1) < _SAME)
        return found

    def _multiplier(self, row: dict, per_unit: float, optimized: Evaluation) -> dict:
        """Return entries for a `row` that state how its limit affects the objective.

        `per_unit`: decrease of the objective per unit by which the limit is relaxed."""
        step = _step(row["unit"], row["limit"])
        relax = step if row["sense"] == "<=" else -step
        toward = -1.0 if row["sense"] == "<=" else 1.0
        gain = -100 * per_unit * step / self.objective(optimized)
        return {
            "multiplier": toward * float(per_unit),
            "relaxed_by": relax,
            "relaxed_objective_percent": float(gain),
        }

    def _slacks(self, evaluation: Evaluation) -> NDArray[np.float64]:
        """Return the scaled slacks (m,) of all constraints for an evaluated design."""
        design = np.asarray(list(evaluation.design.values()), dtype=np.float64)
        return np.asarray(_slacks_of(self.space, design))

    def _range_rows(
        self, optimized: Evaluation, certificate: Certificate | None = None
    ) -> list[dict]:
        """Return rows for limits that are not constraints of the config.

        They are the upper limits of parameters whose range depends on the others. With a
        `certificate`, active bounds of the search are included."""
        design = np.asarray(list(optimized.design.values()), dtype=np.float64)
        ranges, names = _ranges(self.space, design), list(optimized.design)
        low, high = (np.array(x) for x in (self.space.lower, self.space.upper))
        limited = dict.fromkeys(names, False)
        rows = []
        for key, (end, least, most) in ranges.items():
            place = names.index(key)
            before, after, limit = self.baseline.design.get(key), optimized.design[key], float(end)
            own = self._upper_end(key)
            slacks = [own - (math.nan if before is None else before), limit - after]
            row = _row(words(key), before, after, limit, unit_of(key), slacks, "<=")
            row["baseline_limit"] = None if math.isnan(own) else own
            limited[key] = limit <= high[place]
            low[place], high[place] = float(least), float(most)
            if certificate is not None:
                width = max(high[place] - low[place], 1e-300)
                per_unit = certificate.upper[place] / width if limited[key] else 0.0
                row |= self._multiplier(row, per_unit, optimized)
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
                if multiplier <= _HELD or (side == "upper" and limited[key]):
                    continue
                before, after = self.baseline.design.get(key), float(design[place])
                known = before is not None and key not in ranges
                pair = np.array([before if known else math.nan, after])
                slacks = (pair - limit) / width * (1 if sense == ">=" else -1)
                name, unit = f"{side} bound of {words(key)}", unit_of(key)
                if side == "lower" and self.space.floors[place]:
                    name += f" ({100 * self.space.floors[place]:g} %)"
                row = _row(name, before, after, float(limit), unit, slacks, sense)
                rows.append(row | self._multiplier(row, multiplier / width, optimized))
        return rows

    def _upper_end(self, key: str) -> float:
        """Return the upper end of a parameter's range for the baseline, NaN for one from a file."""
        if key not in self.baseline.design:
            return math.nan
        design = np.asarray([*self.baseline.design.values()], dtype=np.float64)
        return float(_ranges(self.space, design)[key][0])

    def held_by(self, evaluation: Evaluation, certificate: Certificate) -> list[Holder]:
        """Return the branches of the objective that are active at an evaluated optimum.

        `evaluation`, `certificate`: those of the optimum."""
        labels: list[list[Holder]] = []
        worst = self.config.objective.over_speeds == "worst"
        parts = zip(evaluation.by_speed, self.baseline.by_speed, strict=True)
        for part, base in parts:
            if part.share <= 0:
                continue
            found: list[Holder] = []
            for one in (part.evaluation, *part.evaluation.rivals):
                value = self._value(one, base.evaluation)
                if one.maxima is None or not one.maxima.times.size:
                    found.append(Holder(part.speed_rpm, math.nan, math.nan, value, 0.0))
                    continue
                weight = self._weights(base.evaluation).get(PEAK, 0.0)
                turn = 360.0 / self.config.profile.lobes
                for time, force, _ in zip(*one.maxima, strict=True):
                    height = value + weight * (force - one.response[PEAK])
                    found.append(Holder(part.speed_rpm, turn * time, float(force), height, 0.0))
            if worst and labels:
                labels[0] += found
            else:
                labels.append(found)
        return [
            label._replace(share=float(share))
            for shares, group in zip(certificate.shares, labels, strict=False)
            for share, label in zip(shares, group, strict=True)
            if share > _HELD
        ]


def counting(evaluation: Evaluation) -> list[tuple[int, Evaluation]]:
    """Return (kind, evaluation) of each scene, speed and motion in which limits must hold."""
    scenes = [part.evaluation for part in evaluation.scenes] or [evaluation]
    found = []
    for scene, whole in enumerate(scenes):
        for number, part in enumerate(whole.by_speed):
            if part.share <= 0:
                continue
            kind = SCENE_KINDS * scene + number
            found += [(kind, one) for one in (part.evaluation, *part.evaluation.rivals)]
    return found


def _in_units(evaluation: Evaluation, other: Evaluation) -> Evaluation:
    """Return an `evaluation` in which no measure is below `_LEAST` of its value in the `other`."""
    least = {key: _LEAST * value for key, value in other.response.items()}
    response = {k: max(value, least.get(k, value)) for k, value in evaluation.response.items()}
    speeds = tuple(
        one._replace(evaluation=_in_units(one.evaluation, two.evaluation))
        for one, two in zip(evaluation.speeds, other.speeds, strict=True)
    )
    return dataclasses.replace(evaluation, response=response, speeds=speeds)


def settled_by(config: Config, baseline: Evaluation) -> Config:
    """Return a copy of a `config` in which limits that are `baseline` are its evaluated values."""
    found = [one.response for _, one in counting(baseline)] if baseline.usable else []
    return settled(config, baseline.geometry, found)


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
