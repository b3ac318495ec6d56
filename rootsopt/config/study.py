"""Config sections that define the solver, objective, reports, sweep, constraints and optimiser."""

import math
import re
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from rootsopt.config.families import families, on_change, parameters, replace_fields
from rootsopt.config.section import Order, Section, Speed, Weight, bare, between, number, tuples
from rootsopt.config.units import hint
from rootsopt.config.words import named, shown

_Seed = Annotated[int, Field(ge=0, le=2**31 - 1)]
NEAREST = "nearest"
"""Word in `optimizer.family` for the named family that is nearest to an outline."""
_LEAST_WEIGHT = 1e-6
"""Sum of all weights below which an objective is rejected as empty."""
_MOST_LINES = 32
"""Number of spectral lines above which an objective is rejected."""


_SEARCHED = "contact is always found by the search, the most accurate of the former models"
_REMOVED: dict[str, tuple[Any, str]] = {
    "fidelity": ("search", _SEARCHED),
    "nodes": (400, _SEARCHED),
    "map_error": (1e-4, _SEARCHED),
    "map_rolls": (None, _SEARCHED),
    "map_relatives": (None, _SEARCHED),
    "gradient": ("forward", "both modes of differentiation gave the same gradient"),
    "orbit": ("auto", "orbits are closed by collocation, and confirmed by an integration"),
    "precision": ("float64", "motions are integrated in double precision"),
}
"""Keys of former versions: (former default, which a resolved config holds; why it was removed)."""
_REMOVED_METHODS = ("dopri5", "kvaerno3", "kvaerno5")
"""Values of `solver.method` of former versions."""


class SolverConfig(Section):
    """Settings of the simulation: accuracy, integration method, tolerances and limits."""

    accuracy: Annotated[float, Field(ge=1e-9, le=0.1)] = Field(
        1e-5,
        description="relative error of forces and of their gradient that is accepted: the greater, "
        "the faster",
    )
    slices: Annotated[int, Field(ge=1, le=64)] | None = Field(
        None,
        description="slices (Gauss points) along twisted rotors; absent: as many as slice_error "
        "needs",
    )
    slice_error: Annotated[float, Field(ge=1e-6, le=0.1)] = Field(
        1e-2,
        description="mean error of the contact torque of twisted rotors, relative to its maximum",
    )
    method: Literal["tsit5", "dopri8"] = Field(
        "tsit5", description="Runge-Kutta method, of order 5 or 8 (cheaper below an rtol of 1e-10)"
    )
    rtol: Annotated[float, Field(ge=1e-12, le=1e-2)] | None = Field(
        None,
        description="tolerance on the orbit and its statistics, refined where the orbit does not "
        "close; absent: accuracy / 1000",
    )
    transient_rtol: Annotated[float, Field(ge=1e-12, le=1e-2)] | None = Field(
        None, description="tolerance during the transient; absent: accuracy / 100"
    )
    max_steps_per_period: Annotated[int, Field(ge=64, le=10**6)] = Field(
        4096, description="solver steps allowed per mesh period"
    )
    max_mesh_periods: Annotated[int, Field(ge=16, le=10**6)] = Field(
        640, description="longest transient, in mesh periods"
    )
    max_orbit_periods: Annotated[int, Field(ge=1, le=8)] = Field(
        8, description="longest periodic orbit to find, in mesh periods"
    )

    @model_validator(mode="before")
    @classmethod
    def _former(cls, data):
        """Drop keys of former versions. Reject values that would now have no effect."""
        if not isinstance(data, dict):
            return data
        for key, (accepted, reason) in _REMOVED.items():
            value = data.get(key, accepted)
            if value != accepted and bare(str(value)) != accepted:
                raise ValueError(
                    f"`solver.{key}` must be left out, but is {shown(value)}: {reason}; remove it, "
                    "and set `solver.accuracy` to trade accuracy for time"
                )
        method = data.get("method")
        if isinstance(method, str) and bare(method) in _REMOVED_METHODS:
            raise ValueError(
                f"`solver.method` must be tsit5 or dopri8, but is {shown(method)}, which was "
                "removed: it was rarely faster; leave the key out"
            )
        return {key: value for key, value in data.items() if key not in _REMOVED}

    @property
    def orbit_tolerance(self) -> float:
        """Relative tolerance on the orbit and its statistics."""
        return self.rtol or self.accuracy / 1000

    @property
    def transient_tolerance(self) -> float:
        """Relative tolerance during the transient."""
        return self.transient_rtol or self.accuracy / 100


class ObjectiveConfig(Section):
    """Weighted sum of measures of the contact force, each relative to the baseline."""

    mean_weight: Weight = Field(0.5, description="weight of the mean contact force")
    peak_weight: Weight = Field(0.5, description="weight of the peak contact force")
    rms_weight: Weight = Field(0.0, description="weight of the RMS contact force")
    line_weights: dict[Order, Weight] = Field(
        default_factory=dict,
        description="weights of spectral lines, {order: weight}, order in mesh frequencies",
    )
    terms: dict[str, Weight] = Field(
        default_factory=dict,
        description="weights of further terms by name, as {outer_radius_mm: 0.2}: built-in or "
        "registered terms",
    )
    motion: Literal["reached", "worst", "weighted", "ensemble"] = Field(
        "reached",
        description="motion that counts: the one reached from rest, the worst of those that "
        "coexist, all weighted by their share of initial states, or the average over an "
        "ensemble, for chaotic scenes",
    )
    peak_norm: Annotated[float, Field(ge=4, le=64)] | None = Field(
        None,
        description="p of the p-norm that replaces the peak in the search; absent: the peak itself",
    )
    speeds_rpm: tuple[Speed, ...] = Field(
        (), description="speeds of the objective, as [2000, 3000]; empty: scene.speed_rpm"
    )
    speed_weights: tuple[Annotated[float, between(1e-6, 1e6)], ...] = Field(
        (), description="weights of these speeds in the objective; empty: equal weights"
    )
    over_speeds: Literal["weighted", "worst"] = Field(
        "weighted", description="how these speeds are combined: weighted mean, or worst speed"
    )

    @model_validator(mode="before")
    @classmethod
    def _orders(cls, data):
        data = tuples(data)
        # A key given by `--set` or in JSON is a string.
        if isinstance(data, dict) and isinstance(given := data.get("line_weights"), dict):
            lines = {number(k): v for k, v in given.items()}
            return data | {"line_weights": lines if len(lines) == len(given) else given}
        return data

    @model_validator(mode="after")
    def _some_weight(self):
        if len(self.line_weights) > _MOST_LINES:
            raise ValueError(
                f"`objective.line_weights` must be at most {_MOST_LINES} orders, but is "
                f"{shown(self.line_weights)}"
            )
        lines = sum(self.line_weights.values())
        terms = sum(self.terms.values())
        if self.mean_weight + self.peak_weight + self.rms_weight + lines + terms < _LEAST_WEIGHT:
            raise ValueError(
                "`objective.mean_weight`, `objective.peak_weight`, `objective.rms_weight`, "
                "`objective.line_weights` and `objective.terms` must not all be 0 (together at "
                f"least {_LEAST_WEIGHT:g})"
            )
        if self.motion == "ensemble" and terms > 0:
            raise ValueError(
                "`objective.terms` belong to a periodic motion; remove them or set "
                "`objective.motion` to reached, worst or weighted"
            )
        if self.motion == "ensemble" and (lines > 0 or self.peak_norm is not None):
            raise ValueError(
                "`objective.line_weights` and `objective.peak_norm` belong to a periodic motion; "
                "remove them or set `objective.motion` to reached, worst or weighted"
            )
        return self

    @model_validator(mode="after")
    def _speeds(self):
        speeds, weights = self.speeds_rpm, self.speed_weights
        if len(set(speeds)) != len(speeds) or len(speeds) > 32:
            raise ValueError(
                "`objective.speeds_rpm` must be at most 32 different speeds, but is "
                f"{shown([*speeds])}"
            )
        worst = self.over_speeds == "worst"
        if not speeds and (weights or worst):
            key = "speed_weights" if weights else "over_speeds"
            raise ValueError(
                f"`objective.{key}` belongs to `objective.speeds_rpm`, which is empty; add speeds "
                f"or remove `objective.{key}`"
            )
        if weights and len(weights) != len(speeds):
            raise ValueError(
                f"`objective.speed_weights` must be {len(speeds)} numbers, one for each of "
                f"`objective.speeds_rpm`, but is {shown([*weights])}"
            )
        if weights and worst:
            raise ValueError(
                "`objective.speed_weights` belongs to `objective.over_speeds` = weighted, but "
                "`over_speeds` is worst; remove one of them"
            )
        if speeds and self.motion == "ensemble":
            raise ValueError(
                "`objective.speeds_rpm` must be empty for `objective.motion` ensemble, but is "
                f"{shown([*speeds])}: the noise of an average is estimated at one speed; optimise "
                "at one, and check the others with `rootsopt sweep`"
            )
        return self


class ResponseConfig(Section):
    """Quantities reported in addition to the mean, peak and RMS of the contact force."""

    lines: tuple[Order, ...] = Field(
        (), description="spectral lines of the force, orders in mesh frequencies, as [1, 2]"
    )

    @model_validator(mode="before")
    @classmethod
    def _lists(cls, data):
        return tuples(data)

    @model_validator(mode="after")
    def _few(self):
        if len(set(self.lines)) != len(self.lines) or len(self.lines) > 32:
            raise ValueError(
                "`response.lines` must be at most 32 different orders, but is "
                f"{shown([*self.lines])}"
            )
        return self


_Milliradians = tuple[Annotated[float, between(-1e3, 1e3)], Annotated[float, between(-1e3, 1e3)]]
_Rates = tuple[Annotated[float, between(-1e6, 1e6)], Annotated[float, between(-1e6, 1e6)]]


class AttractorsConfig(Section):
    """Grid of initial states for `rootsopt attractors`, which finds coexisting motions."""

    relatives: Annotated[int, Field(ge=1, le=1000)] = Field(
        12, description="number of initial relative rotations"
    )
    rates: Annotated[int, Field(ge=1, le=1000)] = Field(
        9, description="number of initial relative speeds"
    )
    relative_range_mrad: _Milliradians | None = Field(
        None, description="(low, high) of the relative rotation; absent: backlash and contact"
    )
    rate_range_rad_s: _Rates | None = Field(
        None,
        description="(low, high) of the relative speed; absent: up to twice the speed of impacts",
    )

    @model_validator(mode="before")
    @classmethod
    def _pairs(cls, data):
        return tuples(data)

    @model_validator(mode="after")
    def _ordered(self):
        for key in ("relative_range_mrad", "rate_range_rad_s"):
            pair = getattr(self, key)
            if pair is not None and not pair[0] < pair[1]:
                raise ValueError(
                    f"`attractors.{key}` must be two increasing numbers, but is {shown([*pair])}"
                )
        return self


class EnsembleConfig(Section):
    """Settings of an ensemble: many motions that are averaged if a single one is chaotic."""

    members: Annotated[int, Field(ge=4, le=100_000)] = Field(
        16, description="motions from different initial states, per design"
    )
    settle_periods: Annotated[int, Field(ge=0, le=10**6)] = Field(
        64, description="mesh periods of a motion before averaging starts"
    )
    periods: Annotated[int, Field(ge=1, le=10**6)] = Field(
        64, description="mesh periods of a motion that are averaged"
    )
    designs: Annotated[int, Field(ge=12, le=4096)] = Field(
        32, description="designs around the current one, in pairs, that estimate its gradient"
    )
    spread: Annotated[float, Field(gt=0, le=0.5)] = Field(
        0.1,
        description="standard deviation of these designs, as a fraction of the bounds; designs "
        "stay within the bounds",
    )
    seed: _Seed = Field(0, description="seed of states and designs")


class SweepConfig(Section):
    """The speeds of `rootsopt sweep`."""

    speed_rpm: (
        dict[Literal["from", "to", "points"], Annotated[float, between(1e-2, 1e6)]] | None
    ) = Field(
        None,
        description="{from: 300, to: 6000, points: 39}; absent: `objective.speeds_rpm`, or if "
        "empty 39 speeds from 0.1 to 2 times `scene.speed_rpm`",
    )

    @model_validator(mode="after")
    def _range(self):
        wanted = self.speed_rpm
        if wanted is None:
            return self
        whole = wanted.get("points", 0)
        ordered = wanted.get("from", 0) < wanted.get("to", 0)
        if len(wanted) < 3 or not (ordered and whole == int(whole) and 2 <= whole <= 10_000):
            raise ValueError(
                "`sweep.speed_rpm` must be {from: .., to: .., points: ..} with from below to and "
                f"2 to 10000 points, but is {shown(wanted)}"
            )
        return self


_Floor = Annotated[float, between(0, 5000)]
_Outer = Annotated[float, between(1, 1e4)]
_Finite = Annotated[float, between(-1e12, 1e12)]


_LINE = re.compile(r"line_.+_force_N")
_CHAINS = (
    ("mean_force_N", "rms_force_N", "peak_norm_force_N", "peak_force_N"),
    ("bearing_load_equivalent_N", "bearing_load_max_N"),
    ("static_bearing_load_equivalent_N", "static_bearing_load_max_N"),
    ("flank_gap_min_um", "flank_gap_mean_um"),
    ("root_radius_mm", "outer_radius_mm"),
)
"""Quantities that are never above the next one of their row."""
_LINE_SHARES = {
    "mean_force_N": 2.0,
    "rms_force_N": 2 / math.sqrt(3),
    "peak_force_N": 2 / math.pi,
}
"""Amplitude of a spectral line above which no force without a negative value comes, as multiples of
these. The first is that of short pulses, the last that of a square wave. The second follows from
the first: mean² + amplitude² / 2 ≤ RMS²."""
_SIZES = {*_CHAINS[0], *_CHAINS[1], *_CHAINS[2], "axial_force_max_N", "tilting_moment_max_N_m"}
"""Quantities that are magnitudes of forces, and never negative, like spectral lines."""


def _above(name: str) -> list[tuple[str, float]]:
    """Return (other quantity, factor) for all upper bounds of a quantity by another one."""
    if _LINE.fullmatch(name):
        return [*_LINE_SHARES.items()]
    row = next((row for row in _CHAINS if name in row), (name,))
    return [(other, 1.0) for other in row[row.index(name) + 1 :]]


class ConstraintsConfig(Section):
    """Constraints that an optimised design must satisfy."""

    area_efficiency_min: Literal["baseline"] | Annotated[float, Field(ge=0, lt=1)] = Field(
        "baseline", description="floor of the area efficiency"
    )
    undercut_margin_min_mm: _Floor = Field(0.0, description="floor of the undercut margin")
    seal_width_min_mm: _Floor = Field(0.0, description="floor of the tip land's full arc length")
    outer_radius_min_mm: _Outer | None = Field(None, description="floor of the outer radius")
    outer_radius_max_mm: _Outer | None = Field(
        None, description="ceiling of the outer radius: radius of the housing's bore"
    )
    terms: dict[str, dict[Literal["min", "max"], _Finite]] = Field(
        default_factory=dict,
        description="limits of further quantities by name, as {peak_force_N: {max: 200}, "
        "displaced_volume_cm3: {min: 900}}: mean_force_N, peak_force_N, rms_force_N, "
        "line_ORDER_force_N, built-in or registered terms; forces at every speed of the objective",
    )

    @model_validator(mode="after")
    def _ordered(self):
        low, high = self.outer_radius_min_mm, self.outer_radius_max_mm
        if low is not None and high is not None and not low < high:
            raise ValueError(
                "`constraints.outer_radius_max_mm` must be greater than "
                f"`constraints.outer_radius_min_mm` = {low:g}, but is {high:g}"
            )
        for name, sides in self.terms.items():
            if not sides:
                raise ValueError(
                    f"`constraints.terms.{named(name)}` must have `min`, `max` or both, as in "
                    "{max: 200}, but is empty"
                )
            if len(sides) == 2 and not sides["min"] < sides["max"]:
                raise ValueError(
                    f"`constraints.terms.{named(name)}.max` must be greater than its `min` = "
                    f"{sides['min']:g}, but is {sides['max']:g}"
                )
        return self

    @model_validator(mode="after")
    def _reachable(self):
        for name, sides in self.terms.items():
            if sides.get("max", 0) < 0 and (name in _SIZES or _LINE.fullmatch(name)):
                raise ValueError(
                    f"`constraints.terms.{name}.max` must be at least 0, but is {sides['max']:g}: "
                    "the quantity is never negative; raise or remove the limit"
                )
            for other, factor in _above(name):
                floor, ceiling = sides.get("min"), self.terms.get(other, {}).get("max")
                if floor is not None and ceiling is not None and floor > factor * ceiling:
                    raise ValueError(
                        f"`constraints.terms.{name}.min` must be at most {factor * ceiling:.4g}, "
                        f"but is {floor:g}: `constraints.terms.{other}.max` is {ceiling:g}, and "
                        f"{name} is never above {factor:.3g} times {other}; change one of the two"
                    )
        return self


class BoundsConfig(Section):
    """Bounds (low, high) of each design parameter in an optimisation.

    Further keys are the parameters of all registered families."""

    helix_deg: tuple[float, float] | None = Field(
        None,
        description="bounds of `rotor.helix_deg`, from -360 to 360, which make the twist a design "
        "parameter; absent: the twist is fixed",
    )

    @model_validator(mode="before")
    @classmethod
    def _pairs(cls, data):
        return tuples(data)

    @model_validator(mode="after")
    def _ordered(self):
        for key, parameter in parameters().items():
            pair = getattr(self, key)
            least, most = parameter.bounds_limits or (parameter.lowest, parameter.highest)
            if pair is not None and not least <= pair[0] < pair[1] <= most:
                advice = hint(key, pair[0], least, most)
                if pair[0] == pair[1]:
                    near = pair[0] + 1e-3 * (abs(pair[0]) or 1.0)
                    advice = f"; to hold it, give a narrow range, such as [{pair[0]:g}, {near:g}]"
                raise ValueError(
                    f"`optimizer.bounds.{key}` must be two increasing numbers in "
                    f"[{least:g}, {most:g}], but is {shown([*pair])}{advice}"
                )
        twist = self.helix_deg
        if twist is not None and not -360 <= twist[0] < twist[1] <= 360:
            raise ValueError(
                "`optimizer.bounds.helix_deg` must be two increasing numbers in [-360, 360], but "
                f"is {shown([*twist])}"
            )
        return self


_BOUNDS = dict(BoundsConfig.model_fields)


def _derive() -> None:
    """Set the fields of `BoundsConfig` from the table of families."""
    made = {key: parameter.bounds_field() for key, parameter in parameters().items()}
    replace_fields(BoundsConfig, made | _BOUNDS)


_derive()
on_change(_derive)


class OptimizerConfig(Section):
    """Method, starts and bounds of the optimisation."""

    method: Literal["auto", "slsqp", "adam", "rmsprop", "sgd"] = Field(
        "auto",
        description="slsqp: sequential quadratic programming, converges to a certified optimum; "
        "adam, rmsprop, sgd: optax update rules; auto: slsqp, or adam for an ensemble",
    )
    learning_rate: Annotated[float, between(1e-6, 10)] = Field(
        0.05, description="step of an optax update rule, in bounds scaled to the unit box"
    )
    iterations: Annotated[int, Field(ge=1, le=10000)] = Field(
        40, description="iterations per start; for slsqp, designs simulated per start"
    )
    starts: Annotated[int, Field(ge=1, le=64)] = Field(2, description="number of local searches")
    screening: Annotated[int, Field(ge=0, le=4096)] = Field(
        48, description="designs screened to place the starts; 0 starts at the baseline only"
    )
    seed: _Seed = Field(0, description="seed of the screening sample")
    family: str = Field(
        NEAREST,
        description="profile family outline: family whose parameters are varied, from the member "
        "nearest to the outline; nearest: the named family that comes nearest",
    )
    bounds: BoundsConfig = Field(default_factory=lambda: BoundsConfig.model_validate({}))


def _derive_optimizer() -> None:
    """Set the fields of `OptimizerConfig` from the table of families."""
    fields = dict(OptimizerConfig.model_fields)
    words = NEAREST, *(name for name, family in families().items() if family.fitted)
    described = Field(NEAREST, description=fields["family"].description)
    replace_fields(OptimizerConfig, fields | {"family": (Literal[words], described)})  # type: ignore


_derive_optimizer()
on_change(_derive_optimizer)
