"""The design problem: unit box, constraints, objective.

The search runs in a unit box. Pressure angle and tip arc angle map linearly onto their
bounds; the involute length is a share of the longest involute the other two allow, so
that u ≤ u_max holds by construction. Constraints depend on geometry alone and are cheap.
"""

import dataclasses
import functools
import importlib
import itertools
import threading
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import NDArray
from scipy.optimize import nnls

from rootsopt.config import Config
from rootsopt.dynamics.measures import line_name
from rootsopt.errors import InputError
from rootsopt.evaluate import Evaluation, objective_weights
from rootsopt.families import DEG
from rootsopt.model import MM, Model
from rootsopt.profiles import Geometry, geometry
from rootsopt.programs import Program
from rootsopt.speeds import counted, parts_of

_SHORTEST = 0.1
"""Least involute, as a share of the longest, where the config sets no bound."""
_NO_LINE = 1e-9
"""Amplitude of a spectral line, relative to the mean force, that counts as none."""
_ACTIVE = 1e-6
"""Scaled distance from its limit at which a constraint counts as active."""


class Constraint(eqx.Module):
    """value(geometry) ≥ limit, scaled by `scale` to order one.

    `quantity`: a field of `Geometry`; `factor` turns SI into the reported `unit`.
    """

    name: str = eqx.field(static=True)
    quantity: str = eqx.field(static=True)
    unit: str = eqx.field(static=True)
    limit: Float[Array, ""]
    scale: float = eqx.field(static=True)
    factor: float = eqx.field(static=True)

    def slack(self, shape: Geometry) -> Float[Array, ""]:
        """Scaled distance to the limit, ≥ 0 where satisfied."""
        return (getattr(shape, self.quantity) - self.limit) / self.scale


class Space(eqx.Module):
    """The unit box and the constraints in it."""

    model: Model
    lower: Float[Array, "3"]
    upper: Float[Array, "3"]
    constraints: tuple[Constraint, ...]

    @classmethod
    def of(cls, config: Config, model: Model, area_efficiency: float) -> "Space":
        """Bounds and floors of a config whose baseline has this `area_efficiency`; raises
        `InputError` where they leave no design."""
        bounds, limits = config.optimizer.bounds, config.constraints
        lengths = bounds.involute_length_mm or (0.0, np.inf)
        rows = [bounds.pressure_angle_deg, lengths, bounds.tip_arc_angle_deg]
        half = 90.0 / config.profile.lobes
        if rows[2][1] >= half:
            raise InputError(
                f"`optimizer.bounds.tip_arc_angle_deg` must stay below {half:g} (a quarter of "
                f"the lobe pitch), but is {list(rows[2])}"
            )
        floor = limits.area_efficiency_min
        if floor == "baseline":
            floor = area_efficiency
        margin = limits.undercut_margin_min_mm * MM
        constraints = (
            _constraint("area efficiency", "area_efficiency", "", floor, 0.01, 1.0),
            _constraint("undercut margin", "undercut_margin", "mm", margin, MM, MM),
            _constraint("seal width", "seal_width", "mm", limits.seal_width_min_mm * MM, MM, MM),
        )
        if model.bore_radius is not None:
            room = model.bore_radius
            constraints += (_constraint("root radius", "root_radius", "mm", room, MM, MM),)
        lower, upper = np.array(rows, dtype=float).T
        return cls(model, jnp.asarray(lower), jnp.asarray(upper), constraints)

    def design(self, point: Float[Array, "3"]) -> Float[Array, "3"]:
        """Design in config units (α deg, u mm, θ1 deg) at `point` of the unit box."""
        low, high = self.lower, self.upper
        alpha = low[0] + (high[0] - low[0]) * point[0]
        tip = low[2] + (high[2] - low[2]) * point[2]
        least, most = self._lengths(alpha, tip)
        return jnp.stack([alpha, least + (most - least) * point[1], tip])

    def point(self, design: Float[Array, "3"]) -> Float[Array, "3"]:
        """The nearest point of the unit box to a design."""
        alpha, length, tip = jnp.clip(design, self.lower, self.upper)
        least, most = self._lengths(alpha, tip)
        low, high = self.lower, self.upper
        raw = jnp.stack(
            [
                (alpha - low[0]) / (high[0] - low[0]),
                (length - least) / (most - least),
                (tip - low[2]) / (high[2] - low[2]),
            ]
        )
        return jnp.clip(raw, 0.0, 1.0)

    def _lengths(self, alpha, tip):
        """Shortest and longest involute (mm) at α, θ1 (deg)."""
        half = jnp.pi / (2 * self.model.lobes)
        radius = self.model.pitch_radius / MM
        longest = radius * jnp.sin(alpha * DEG) * (half - tip * DEG)
        most = jnp.minimum(longest, self.upper[1])
        return jnp.minimum(jnp.maximum(self.lower[1], _SHORTEST * longest), 0.999 * most), most

    def slacks(self, point: Float[Array, "3"]) -> Float[Array, " m"]:
        """Scaled slack of every constraint."""
        shape = geometry(self.model.profile(self.design(point)))
        return jnp.stack([c.slack(shape) for c in self.constraints])

    def prepare(self) -> None:
        """Compile in the background what a search in this space takes."""
        # Half a second to import, and only needed here.
        threading.Thread(target=importlib.import_module, args=("scipy.stats.qmc",)).start()
        _look.prepare(self, jax.ShapeDtypeStruct((3,), self.lower.dtype))


@Program
def _look(space: Space, point):
    """Design, its Jacobian, slacks of the constraints, and theirs."""

    def both(point):
        values = space.design(point), space.slacks(point)
        return values, values

    (design_slope, slack_slope), (design, slack) = jax.jacfwd(both, has_aux=True)(point)
    return design, design_slope, slack, slack_slope


@Program
def _nearest(space: Space, design):
    """Point of the unit box nearest to a design."""
    return space.point(design)


@Program
def _longest(space: Space, point):
    """Longest involute (mm) at a point of the unit box, bounds aside."""
    profile = space.model.profile(space.design(point))
    return profile.longest_involute / MM  # type: ignore[attr-defined]


@dataclasses.dataclass(frozen=True)
class Problem:
    """A config's design problem against its evaluated baseline."""

    config: Config
    baseline: Evaluation
    space: Space

    @classmethod
    def of(cls, config: Config, model: Model, baseline: Evaluation) -> "Problem":
        """The problem whose floors are those of the config or of the `baseline`.

        Raises `InputError` where a spectral line is to fall that the baseline has not got."""
        weighted = [order for order, w in config.objective.line_weights.items() if w]
        for order, part in itertools.product(weighted, parts_of(baseline)):
            one = part.evaluation
            if not one.response[line_name(order)] > _NO_LINE * one.response["mean_force_N"]:
                period = one.steady_state.get("period")
                raise InputError(
                    f"`objective.line_weights` has the order {order:g}, but the baseline's force "
                    f"has no such line (its motion repeats every {period} mesh periods); remove it"
                )
        return cls(config, baseline, Space.of(config, model, baseline.geometry["area_efficiency"]))

    def objective(self, evaluation: Evaluation) -> float:
        """Weighted measures of the force relative to the baseline's (1 at the baseline), over the
        speeds that count; NaN for a design without a usable steady state."""
        if not evaluation.usable:
            return float("nan")
        return sum(share * self._value(*pair) for share, *pair in self._counted(evaluation))

    def by_speed(self, evaluation: Evaluation) -> list[dict[str, float]]:
        """The objective at each speed by itself, if there are several."""
        parts = zip(parts_of(evaluation), parts_of(self.baseline), strict=True)
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
        """Design at a point of the unit box, its Jacobian, slacks, and their Jacobian."""
        return self._look_at(tuple(np.asarray(point, dtype=np.float64)))

    @functools.cached_property
    def _look_at(self):
        def look(point):
            return tuple(map(np.asarray, _look(self.space, np.asarray(point))))

        # The same point is asked about several times over.
        return functools.lru_cache(maxsize=1024)(look)

    def slope(self, evaluation: Evaluation, point) -> NDArray[np.float64]:
        """Gradient of the objective in the unit box."""
        _, jacobian, _, _ = self.look(point)
        by_design = np.zeros(3)
        for share, one, baseline in self._counted(evaluation):
            for key, weight in self._weights(baseline).items():
                by_design += share * weight * np.array(list(one.gradient[key].values()))
        return np.asarray(by_design @ np.asarray(jacobian))

    def _counted(self, evaluation: Evaluation):
        return counted(self.config, evaluation, self.baseline, self._value)

    def _value(self, evaluation: Evaluation, baseline: Evaluation) -> float:
        """Weighted measures of the force at one speed relative to the baseline's there."""
        return sum(w * evaluation.response[k] for k, w in self._weights(baseline).items())

    def _weights(self, baseline: Evaluation) -> dict[str, float]:
        weights = objective_weights(self.config)
        return {k: w / max(baseline.response[k], 1e-12) for k, w in weights.items()}

    def point(self, design) -> NDArray[np.float64]:
        """The nearest point of the unit box to a design in config units."""
        return np.asarray(_nearest(self.space, np.asarray(design, dtype=np.float64)))

    def design(self, point) -> Float[Array, "3"]:
        """Design in config units at a point of the unit box."""
        return jnp.asarray(self.look(point)[0])

    def feasible(self, point) -> bool:
        """Whether a point of the unit box satisfies every constraint."""
        return bool(np.min(self.look(point)[2]) >= -_ACTIVE)

    def project(self, point) -> NDArray[np.float64]:
        """A feasible point near `point`: Gauss-Newton steps on the violated constraints.

        The result may still be infeasible where the constraints contradict the bounds.
        """
        point = np.clip(np.asarray(point, dtype=np.float64), 0.0, 1.0)
        for _ in range(30):
            _, _, slack, jacobian = self.look(point)
            violated = slack < 0
            if not violated.any():
                break
            # Aim a hair inside, so that rounding leaves the constraint satisfied. A
            # coordinate already held by its bound takes no part.
            rows, want = jacobian[violated], 1e-7 - slack[violated]
            push = rows.T @ want
            held = ((point <= 0) & (push < 0)) | ((point >= 1) & (push > 0))
            move = np.linalg.lstsq(np.where(held, 0.0, rows), want, rcond=1e-8)[0]
            point = np.clip(point + np.clip(move, -0.3, 0.3), 0.0, 1.0)
        return np.asarray(point, dtype=np.float64)

    def descent(self, point, slope: NDArray[np.float64]) -> NDArray[np.float64]:
        """The slope less what active constraints and box faces forbid.

        -slope is projected onto the cone of feasible directions: the closest direction
        that leaves no active constraint (a non-negative least-squares problem). It
        vanishes exactly at a Karush-Kuhn-Tucker point.
        """
        _, _, slack, jacobian = self.look(point)
        point = np.asarray(point)
        walls = [row for row, s in zip(jacobian, slack, strict=True) if s < 1e-4]
        walls += [np.eye(3)[i] for i in range(3) if point[i] <= _ACTIVE]
        walls += [-np.eye(3)[i] for i in range(3) if point[i] >= 1 - _ACTIVE]
        if not walls:
            return np.asarray(slope, dtype=np.float64)
        normals = np.stack(walls)
        multipliers, _ = nnls(normals.T, slope)
        return np.asarray(slope - multipliers @ normals, dtype=np.float64)

    def constraint_rows(self, optimized: Evaluation) -> list[dict]:
        """Every constraint with its values, for report and result file."""
        rows = []
        keys = {
            "area_efficiency": "area_efficiency",
            "undercut_margin": "undercut_margin_mm",
            "seal_width": "seal_width_mm",
            "root_radius": "root_radius_mm",
        }
        for c in self.space.constraints:
            before = self.baseline.geometry[keys[c.quantity]]
            after = optimized.geometry[keys[c.quantity]]
            limit = float(c.limit) / c.factor
            slack = (after - limit) * c.factor / c.scale
            rows.append(_row(c.name, before, after, limit, c.unit, slack))
        rows.append(self._length_row(optimized))
        return rows

    def _length_row(self, optimized: Evaluation) -> dict:
        point = self.point(list(optimized.design.values()))
        limit = float(_longest(self.space, point))
        after = optimized.design["involute_length_mm"]
        row = _row(
            "involute length",
            self.baseline.design["involute_length_mm"],
            after,
            limit,
            "mm",
            limit - after,
        )
        return row | {"sense": "<="}


def _constraint(name, quantity, unit, limit, scale, factor) -> Constraint:
    return Constraint(name, quantity, unit, jnp.asarray(float(limit)), scale, factor)


def _row(name, before, after, limit, unit, slack) -> dict:
    return {
        "name": name,
        "baseline": before,
        "optimized": after,
        "limit": limit,
        "unit": unit,
        "sense": ">=",
        "satisfied": bool(slack >= -1e-6),
        "active": bool(abs(slack) < 1e-4),
    }


def sobol(count: int, seed: int) -> NDArray[np.float64]:
    """`count` points (n, 3) of a scrambled Sobol sequence in the unit box."""
    from scipy.stats import qmc

    sampler = qmc.Sobol(3, rng=np.random.default_rng(seed))
    power = max(0, int(np.ceil(np.log2(max(count, 1)))))
    return sampler.random_base2(power)[:count]


__all__: Sequence[str] = ["Constraint", "Problem", "Space", "sobol"]
