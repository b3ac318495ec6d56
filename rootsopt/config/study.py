"""Config sections that define the solver, objective, reports, sweep, constraints and optimiser."""

import math
import re
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from rootsopt.config.families import RESERVED, Parameter, families, parameters
from rootsopt.config.section import (
    Among,
    Listed,
    Section,
    Speed,
    between,
    number,
    require,
    such,
)
from rootsopt.config.units import hint, named, shown

NEAREST = "nearest"
"""Word in `optimizer.family` for the named family that is nearest to an outline."""

# Sum of all weights below which an objective is rejected as empty.
_LEAST_WEIGHT = 1e-6

# Number of spectral lines above which an objective is rejected.
_MOST_LINES = 32


# Weight of a term in a sum; a weight of 0 leaves the term out.
_Weight = Annotated[float, between(0, 1e6)]

# Order of a spectral line: its frequency as a multiple of the mesh frequency.
_Order = Annotated[float, between(1e-2, 1e3)]

# Seed of random numbers.
_Seed = Annotated[int, Field(ge=0, le=2**31 - 1)]


class SolverConfig(Section):
    """Settings of the simulation: accuracy, integration method, tolerance and limits."""

    accuracy: Annotated[float, Field(ge=1e-9, le=0.1)] = Field(
        1e-5,
        description="relative error of forces and of their gradient that is accepted: the greater, "
        "the faster",
    )
    slices: Annotated[int, Field(ge=1, le=64)] | None = Field(
        None,
        description="slices (Gauss points) along twisted rotors; absent: as many as the contact "
        "torque needs for a mean error of 1 %",
    )
    method: Literal["tsit5", "dopri8"] = Field(
        "tsit5", description="Runge-Kutta method, of order 5 or 8 (cheaper below an rtol of 1e-10)"
    )
    rtol: Annotated[float, Field(ge=1e-12, le=1e-2)] | None = Field(
        None,
        description="tolerance on the orbit and its statistics, refined where the orbit does not "
        "close; absent: accuracy / 1000",
    )
    max_steps_per_period: Annotated[int, Field(ge=64, le=10**6)] = Field(
        4096, description="solver steps allowed per mesh period"
    )
    max_mesh_periods: Annotated[int, Field(ge=16, le=10**6)] = Field(
        640, description="longest transient, in mesh periods"
    )
    max_orbit_periods: Annotated[int, Field(ge=1, le=8)] = Field(
        8,
        description="longest periodic orbit to find, in mesh periods; with errors of the timing "
        "gear, the next whole revolution",
    )

    @property
    def orbit_tolerance(self) -> float:
        """Relative tolerance on the orbit and its statistics."""
        return self.rtol or self.accuracy / 1000

    @property
    def transient_tolerance(self) -> float:
        """Relative tolerance during the transient."""
        return self.accuracy / 100


_Share = Annotated[float, between(1e-6, 1e6)]


def _few(what: str) -> Any:
    """Return a mark of lists and dictionaries of at most `_MOST_LINES` different numbers.

    `what`: what the numbers are, in a message."""
    return such(
        f"at most {_MOST_LINES} {what}",
        lambda numbers: len(set(numbers)) == len(numbers) <= _MOST_LINES,
    )


class ObjectiveConfig(Section):
    """Weighted sum of measures of the contact force, each relative to the baseline."""

    mean_weight: _Weight = Field(0.5, description="weight of the mean contact force")
    peak_weight: _Weight = Field(0.5, description="weight of the peak contact force")
    rms_weight: _Weight = Field(0.0, description="weight of the RMS contact force")
    line_weights: Annotated[dict[_Order, _Weight], _few("orders")] = Field(
        default_factory=dict,
        description="weights of spectral lines, {order: weight}, order in mesh frequencies",
    )
    terms: dict[str, _Weight] = Field(
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
    speeds_rpm: Annotated[tuple[Speed, ...], Listed, _few("different speeds")] = Field(
        (), description="speeds of the objective, as [2000, 3000]; empty: scene.speed_rpm"
    )
    speed_weights: Annotated[tuple[_Share, ...], Listed] = Field(
        (), description="weights of these speeds in the objective; empty: equal weights"
    )
    over_speeds: Literal["weighted", "worst"] = Field(
        "weighted", description="how these speeds are combined: weighted mean, or worst speed"
    )
    over: Literal["nominal", "assumptions"] = Field(
        "nominal",
        description="scenes that count: that of the config, or those of `assumptions`, combined as "
        "`assumptions.combine` says",
    )

    @model_validator(mode="before")
    @classmethod
    def _orders(cls, data):
        # A key given by `--set` or in JSON is a string.
        if isinstance(data, dict) and isinstance(given := data.get("line_weights"), dict):
            lines = {number(k): v for k, v in given.items()}
            return data | {"line_weights": lines if len(lines) == len(given) else given}
        return data

    @model_validator(mode="after")
    def _some_weight(self):
        lines, terms = sum(self.line_weights.values()), sum(self.terms.values())
        whole = self.mean_weight + self.peak_weight + self.rms_weight + lines + terms
        require(
            whole >= _LEAST_WEIGHT,
            "`objective.mean_weight`, `objective.peak_weight`, `objective.rms_weight`, "
            "`objective.line_weights` and `objective.terms` must not all be 0 (together at least "
            f"{_LEAST_WEIGHT:g})",
        )
        periodic = {
            "`objective.terms` belong": terms > 0,
            "`objective.line_weights` and `objective.peak_norm` belong": lines > 0
            or self.peak_norm is not None,
        }
        for words, given in periodic.items():
            require(
                not given or self.motion != "ensemble",
                f"{words} to a periodic motion; remove them or set `objective.motion` to reached, "
                "worst or weighted",
            )
        return self

    @model_validator(mode="after")
    def _speeds(self):
        speeds, weights, worst = self.speeds_rpm, self.speed_weights, self.over_speeds == "worst"
        key = "speed_weights" if weights else "over_speeds"
        require(
            bool(speeds) or not (weights or worst),
            f"`objective.{key}` belongs to `objective.speeds_rpm`, which is empty; add speeds or "
            f"remove `objective.{key}`",
        )
        require(
            len(weights) in (0, len(speeds)),
            f"`objective.speed_weights` must be {len(speeds)} numbers, one for each of "
            f"`objective.speeds_rpm`, but is {shown([*weights])}",
        )
        require(
            not (weights and worst),
            "`objective.speed_weights` belongs to `objective.over_speeds` = weighted, but "
            "`over_speeds` is worst; remove one of them",
        )
        require(
            not speeds or self.motion != "ensemble",
            "`objective.speeds_rpm` must be empty for `objective.motion` ensemble, but is "
            f"{shown([*speeds])}: the noise of an average is estimated at one speed; optimise "
            "at one, and check the others with `rootsopt sweep`",
        )
        return self


class ResponseConfig(Section):
    """Quantities reported in addition to the mean, peak and RMS of the contact force."""

    lines: Annotated[tuple[_Order, ...], Listed, _few("different orders")] = Field(
        (), description="spectral lines of the force, orders in mesh frequencies, as [1, 2]"
    )
    reserve: bool = Field(
        False,
        description="whether `steady_response` returns the reserve, as reports do",
    )


class AttractorsConfig(Section):
    """Grid of initial states for `rootsopt attractors`, which finds coexisting motions."""

    relatives: Annotated[int, Field(ge=1, le=1000)] = Field(
        12, description="number of initial relative rotations"
    )
    rates: Annotated[int, Field(ge=1, le=1000)] = Field(
        9, description="number of initial relative speeds"
    )


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


BASELINE = "baseline"
"""Value of a limit that stands for the baseline's own value of the quantity."""
_Own = Literal["baseline"]
_Floor = _Own | Annotated[float, between(0, 5000)]
_Outer = _Own | Annotated[float, between(1, 1e4)]
_Finite = _Own | Annotated[float, between(-1e12, 1e12)]


_LINE = re.compile(r"line_.+_force_N")

# Rows of quantities in ascending order: none exceeds the next one.
_CHAINS = (
    ("mean_force_N", "rms_force_N", "peak_norm_force_N", "peak_force_N"),
    ("bearing_load_equivalent_N", "bearing_load_max_N"),
    ("static_bearing_load_equivalent_N", "static_bearing_load_max_N"),
    ("flank_gap_min_um", "flank_gap_mean_um"),
    ("root_radius_mm", "outer_radius_mm"),
)

# Greatest amplitude of a spectral line of a force ≥ 0, as multiples of mean, RMS and peak force.
# The first is that of short pulses, the last that of a square wave. The second follows from the
# first: mean² + amplitude² / 2 ≤ RMS².
_LINE_SHARES = {
    "mean_force_N": 2.0,
    "rms_force_N": 2 / math.sqrt(3),
    "peak_force_N": 2 / math.pi,
}

# Quantities that are magnitudes of forces, and never negative, like spectral lines.
_SIZES = {*_CHAINS[0], *_CHAINS[1], *_CHAINS[2], "axial_force_max_N", "tilting_moment_max_N_m"}


def _above(name: str) -> list[tuple[str, float]]:
    """Return (other quantity, factor) for each quantity that bounds this one from above."""
    if _LINE.fullmatch(name):
        return [*_LINE_SHARES.items()]
    row = next((row for row in _CHAINS if name in row), (name,))
    return [(other, 1.0) for other in row[row.index(name) + 1 :]]


def limits_of(low: float | str | None, high: float | str | None) -> tuple[float, float]:
    """Return a floor and a ceiling as numbers, so that two limits from the config can be compared.

    Absent limits, and limits that are the baseline's still unknown value, are infinite."""
    return (
        low if isinstance(low, float) else -math.inf,
        high if isinstance(high, float) else math.inf,
    )


class ConstraintsConfig(Section):
    """Constraints that an optimised design must satisfy.

    Each limit is a number, or `baseline`: the value of the design that the search is to improve."""

    area_efficiency_min: _Own | Annotated[float, Field(ge=0, lt=1)] = Field(
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
        "displaced_volume_cm3: {min: baseline}}: mean_force_N, peak_force_N, rms_force_N, "
        "line_ORDER_force_N, built-in or registered terms; forces at every speed of the objective",
    )

    @model_validator(mode="after")
    def _ordered(self):
        radii = self.outer_radius_min_mm, self.outer_radius_max_mm
        low, high = limits_of(*radii)
        require(
            low < high,
            "`constraints.outer_radius_max_mm` must be greater than "
            f"`constraints.outer_radius_min_mm` = {low:g}, but is {high:g}",
        )
        require(
            radii != (BASELINE, BASELINE),
            "`constraints.outer_radius_min_mm` and `constraints.outer_radius_max_mm` must not both "
            "be baseline: no design meets both exactly; give one of them some room",
        )
        return self

    @model_validator(mode="after")
    def _reachable(self):
        for name, sides in self.terms.items():
            key = f"`constraints.terms.{named(name)}"
            require(bool(sides), f"{key}` must have `min`, `max` or both, as in {{max: 200}}, but "
                    "is empty")  # fmt: skip
            low, high = limits_of(sides.get("min"), sides.get("max"))
            require(low < high, f"{key}.max` must be greater than its `min` = {low:g}, but is "
                    f"{high:g}")  # fmt: skip
            require(
                sides != {"min": BASELINE, "max": BASELINE},
                f"{key}` must not have `min` and `max` both baseline: no design meets both "
                "exactly; give one of them some room",
            )
            require(
                high >= 0 or not (name in _SIZES or _LINE.fullmatch(name)),
                f"`constraints.terms.{name}.max` must be at least 0, but is {high:g}: the "
                "quantity is never negative; raise or remove the limit",
            )
            for other, factor in _above(name):
                ceiling = limits_of(None, self.terms.get(other, {}).get("max"))[1]
                require(
                    low <= factor * ceiling,
                    f"`constraints.terms.{name}.min` must be at most {factor * ceiling:.4g}, but "
                    f"is {low:g}: `constraints.terms.{other}.max` is {ceiling:g}, and {name} is "
                    f"never above {factor:.3g} times {other}; change one of the two",
                )
        return self


TWIST = "helix_deg"
"""Key of the twist, in the section `rotor`, among the bounds and among the design parameters."""
RESERVED.add(TWIST)


def _searched() -> dict[str, Parameter]:
    """Return the parameters that have bounds: those of all registered families, and the twist."""
    return parameters() | {TWIST: Parameter(TWIST, "twist", -360, 360)}


def _fitted() -> list[str]:
    """Return the words of `optimizer.family`."""
    return [NEAREST, *(name for name, family in families().items() if family.fitted)]


_Bounds = Annotated[
    tuple[float, float],
    Listed,
    such(
        "two numbers, as in [1, 2]",
        lambda pair: not isinstance(pair, list | tuple) or len(pair) == 2,
        before=True,
    ),
]


class OptimizerConfig(Section):
    """Starts, family and bounds of the optimisation."""

    iterations: Annotated[int, Field(ge=1, le=10000)] = Field(
        40, description="designs simulated per start; for an ensemble, iterations"
    )
    starts: Annotated[int, Field(ge=1, le=64)] = Field(2, description="number of local searches")
    screening: Annotated[int, Field(ge=0, le=4096)] = Field(
        48, description="designs screened to place the starts; 0 starts at the baseline only"
    )
    seed: _Seed = Field(0, description="seed of all samples: designs and scenes")
    prove: Literal["auto"] | bool = Field(
        "auto",
        description="whether the objective of all designs is bounded from below, for up to 4 "
        "parameters: true, false, or auto: where this costs less than the search",
    )
    family: Annotated[str, Among(_fitted)] = Field(
        NEAREST,
        description="family whose parameters are varied, from the member nearest to the profile; "
        "nearest: the profile's own, for an outline the named family that comes nearest",
    )
    bounds: dict[Annotated[str, Among(_searched)], _Bounds] = Field(
        default_factory=dict,
        description="(low, high) of design parameters, as {pressure_angle_deg: [25, 45]}; defaults "
        "stand beside each parameter; helix_deg frees the twist, from -360 to 360",
    )

    @model_validator(mode="before")
    @classmethod
    def _written_out(cls, data):
        """Add the default bounds that every config states, and drop those that are null."""
        given = data.get("bounds", {}) if isinstance(data, dict) else None
        if not isinstance(given, dict):
            return data
        usual = {one.key: one.default_bounds for one in parameters().values() if one.default_bounds}
        return data | {"bounds": usual | {k: v for k, v in given.items() if v is not None}}

    @model_validator(mode="after")
    def _ordered(self):
        for key, pair in self.bounds.items():
            least, most = _searched()[key].bounds_range
            advice = hint(key, pair[0], least, most)
            if pair[0] == pair[1]:
                near = pair[0] + 1e-3 * (abs(pair[0]) or 1.0)
                advice = f"; to hold it, give a narrow range, such as [{pair[0]:g}, {near:g}]"
            require(
                least <= pair[0] < pair[1] <= most,
                f"`optimizer.bounds.{key}` must be two increasing numbers in [{least:g}, "
                f"{most:g}], but is {shown([*pair])}{advice}",
            )
        return self
