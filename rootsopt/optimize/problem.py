"""The design problem of a config: objective and constraints, relative to its baseline."""

import dataclasses
import functools
import itertools
import math
from collections.abc import Callable, Iterator, Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import NDArray

from rootsopt.config.reading import Config
from rootsopt.dynamics.orbit import PEAK_NORM, line_name
from rootsopt.errors import InputError
from rootsopt.optimize.limits import (
    HELD,
    PEAK,
    ForceLimit,
    branches_of,
    check_senses,
    counting,
    force_limits,
    needs_maxima,
    scaled_slack,
    settled_by,
    term_constraints,
)
from rootsopt.optimize.local import FEASIBLE, Certificate, Group, Linearization, Look
from rootsopt.optimize.optimality import Holder
from rootsopt.response.reducers import counted
from rootsopt.response.result import RESPONSES, Evaluation, Seeds
from rootsopt.response.terms import objective_weights
from rootsopt.runtime.programs import CachedFunction
from rootsopt.scene.build import Scene
from rootsopt.scene.space import Space, onto, slacks_and_slopes
from rootsopt.status import Status

# Amplitude of the baseline's line (relative to its mean force) below which it is rejected as an
# objective.
_NO_LINE = 1e-9

# Share of a measure's nominal value below which the baseline's value in another scene is too small
# as a unit.
_LEAST = 0.1

# Maximum number of times that an infeasible point is moved halfway towards a feasible point.
_DRAWN = 5

_nearest = CachedFunction(Space.point)


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
        w. F_0 is the baseline's value there, F_n that of `self.baseline`. If F_0 is small or 0, a
        ratio to F_0 alone would mean nothing. Designs and constraints of the geometry are the
        same."""
        alone = Problem(self.config, _in_units(baseline, self.baseline), self.space, self.limits)
        problem = dataclasses.replace(alone, added=1 - alone.objective(baseline))
        problem.__dict__["_look_at"] = self._look_at  # Expensive, independent of `baseline`.
        return problem

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
        by_design = np.zeros(len(self.space.lower))
        for share, one, baseline in self._counted(evaluation):
            for key, weight in self._weights(baseline).items():
                by_design += share * weight * np.array(list(one.gradient[key].values()))
        return by_design @ self.look(point)[1]

    def looks(self, evaluate: Callable[..., Evaluation]) -> Look:
        """Return a function for a search that evaluates the problem at a point.

        `evaluate`: an `Evaluator`; each motion begins on the last usable one."""
        starts: list[Seeds] = [None]

        def look(point: NDArray[np.float64]) -> Linearization | None:
            evaluation = evaluate(self.design(point), starts[-1], series=False)
            if evaluation.usable:
                starts.append(evaluation.start)
            return self.local(evaluation, point)

        return look

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
        cornered = needs_maxima(self.config, ()) or self.config.objective.motion == "worst"
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
        caps = self.caps(evaluation, jacobian)
        return Linearization(smooth, slope @ jacobian, scaled, slack, normals, caps)

    def caps(self, evaluation: Evaluation, jacobian: NDArray[np.float64]) -> tuple[Group, ...]:
        """Return one cap for each of `limits`, with the amount by which an evaluated design
        exceeds it.

        `evaluation`: usable, with gradients; `jacobian` (d, d): that of the design with respect to
        the point. Each speed that counts, each coexisting motion and each scene of a sample is a
        branch. If the peak force has a ceiling, each local maximum of the force is a branch, too.
        """
        caps = []
        for limit in self.limits:
            parts = [
                branches_of(one, limit.key, limit.cornered, kind)
                for kind, one in counting(evaluation)
            ]
            tags, values, slopes = map(np.concatenate, zip(*parts, strict=True))
            rows = limit.sign * slopes / limit.scale
            caps.append(Group(tags, limit.excess(values), rows @ jacobian))
        return tuple(caps)

    def worst(self, evaluation: Evaluation, limit: ForceLimit) -> float:
        """Return the worst value of a limited quantity: the one nearest to its `limit`, or farthest
        beyond it.

        `evaluation`: usable. Speeds, motions and scenes are those of `caps`."""
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
        names = [
            one.name
            for k, one in enumerate(self.space.constraints)
            if scaled_slack(self, evaluation, k) < -FEASIBLE
        ]
        limits = self.limits if evaluation.usable else ()
        beyond = [one for one in limits if one.excess(self.worst(evaluation, one)) > FEASIBLE]
        return names + [one.name for one in beyond]

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

    def named(self, point) -> dict[str, float]:
        """Return the design at a `point` (d,), in config units by key."""
        return dict(zip(self.config.design_keys, self.look(point)[0].tolist(), strict=True))

    def feasible(self, point) -> bool:
        """Return whether a `point` (d,) satisfies every constraint within `FEASIBLE`."""
        return bool(np.min(self.look(point)[2]) >= -FEASIBLE)

    def project(self, point) -> NDArray[np.float64]:
        """Return `point` (d,) moved onto the feasible set if possible; see `onto`."""
        *_, point = onto(self.limits_at, point)
        return point

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
        projected = self.project(point)
        if self.space.family.by_limits:
            return projected
        for share in (*0.5 ** np.arange(1, _DRAWN + 1), 0.0):
            if self.feasible(projected):
                break
            projected = self.project(inside + share * (np.asarray(point) - inside))
        return projected

    def held_by(self, evaluation: Evaluation, certificate: Certificate) -> list[Holder]:
        """Return the branches of the objective that are active at an evaluated optimum.

        `evaluation`, `certificate`: those of the optimum."""
        labels: list[list[Holder]] = []
        worst = self.config.objective.over_speeds == "worst"
        parts = zip(evaluation.by_speed, self.baseline.by_speed, strict=True)
        for part, base in parts:
            if part.share <= 0:
                continue
            holders: list[Holder] = []
            for one in (part.evaluation, *part.evaluation.rivals):
                value = self._value(one, base.evaluation)
                if one.maxima is None or not one.maxima.times.size:
                    holders.append(Holder(part.speed_rpm, math.nan, math.nan, value, 0.0))
                    continue
                weight = self._weights(base.evaluation).get(PEAK, 0.0)
                turn = 360.0 / self.config.profile.lobes
                for time, force, _ in zip(*one.maxima, strict=True):
                    height = value + weight * (force - one.response[PEAK])
                    holders.append(Holder(part.speed_rpm, turn * time, float(force), height, 0.0))
            if worst and labels:
                labels[0] += holders
            else:
                labels.append(holders)
        return [
            label._replace(share=float(share))
            for shares, group in zip(certificate.shares, labels, strict=False)
            for share, label in zip(shares, group, strict=True)
            if share > HELD
        ]


def _in_units(evaluation: Evaluation, other: Evaluation) -> Evaluation:
    """Return an `evaluation` with each measure raised to at least `_LEAST` of that in the `other`.

    Measures are divided by these values, and a ratio to a value near 0 would mean nothing."""
    least = {key: _LEAST * value for key, value in other.response.items()}
    response = {k: max(value, least.get(k, value)) for k, value in evaluation.response.items()}
    speeds = tuple(
        one._replace(evaluation=_in_units(one.evaluation, two.evaluation))
        for one, two in zip(evaluation.speeds, other.speeds, strict=True)
    )
    return dataclasses.replace(evaluation, response=response, speeds=speeds)
