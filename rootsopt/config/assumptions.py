"""Config section `assumptions`: the spread of what is only assumed about where a pump runs."""

import math
from collections.abc import Mapping
from typing import Annotated, Any, Literal, NamedTuple

from pydantic import Field, model_validator

from rootsopt.config.section import Increasing, Listed, Section, Seed, between, such
from rootsopt.config.tolerances import entries

_Pair = Annotated[tuple[Annotated[float, between(-1e9, 1e9)], ...], Listed, Increasing]
_Spread = Annotated[
    dict[Literal["factor", "range"], _Pair],
    such("one range, as in {factor: [0.8, 1.2]}", lambda given: len(given) == 1),
]
_CLEARANCE = "contact.clearance_mm"
_FACTORS = {
    "scene.speed_rpm": (0.8, 1.2),
    "scene.load.torque_N_m": (0.6, 1.6),
    "scene.load.pressure_difference_Pa": (0.6, 1.6),
    "scene.timing_gear.stiffness_N_m_per_rad": (0.5, 2.0),
    "scene.timing_gear.backlash_mm": (0.5, 1.5),
    "scene.timing_gear.damping_ratio": (0.6, 1.4),
    "contact.stiffness_N_per_mm_e": (0.7, 1.4),
}
"""Usual ranges, as multiples of the config's value, of what a designer seldom knows."""
_CLEARANCES = 0.015, 0.5
"""Half of the usual range of the clearance: the first number (mm), or the second one as a fraction
of the config's value, whichever is more."""


class Span(NamedTuple):
    """Range of one assumed quantity: `key` and the ends `low` and `high`, in the key's unit."""

    key: str
    low: float
    high: float

    @property
    def ends(self) -> tuple[float, float]:
        """Both ends."""
        return self.low, self.high


class AssumptionsConfig(Section):
    """Scenes around that of the config, in which an optimum is compared with the baseline."""

    over: dict[str, _Spread | None] = Field(
        default_factory=dict,
        description="ranges by key, as {scene.speed_rpm: {factor: [0.8, 1.2]}, "
        "contact.clearance_mm: {range: [0, 0.04]}}; factor: of the key's value; null: not varied; "
        "other keys keep their usual range",
    )
    scenes: Annotated[int, Field(ge=0, le=1024)] = Field(
        32, description="random scenes, beside the ends of each range; 0: no comparison"
    )
    combine: Literal["mean", "worst", "regret"] = Field(
        "mean",
        description="with objective.over assumptions: mean or worst objective over these scenes, "
        "or the greatest distance from the best design known in a scene",
    )
    seed: Seed = Field(0, description="seed of these scenes")

    @model_validator(mode="before")
    @classmethod
    def _flat(cls, data):
        over = data.get("over") if isinstance(data, dict) else None
        kinds = "factor", "range"
        return data | {"over": entries(over, kinds)} if isinstance(over, dict) else data

    def spans(self, values: Mapping[str, float], every: bool = True) -> tuple[Span, ...]:
        """Return the ranges of the keys that the config has, those that it gives last.

        `values`: the config's own value of each key that can vary; `every`: whether to include the
        usual ranges. A range without an extent is left out, such as a factor of 0."""
        here = values.get(_CLEARANCE, 0.0)
        half = max(_CLEARANCES[0], _CLEARANCES[1] * here)
        usual: dict[str, Any] = {key: {"factor": pair} for key, pair in _FACTORS.items()}
        usual |= {_CLEARANCE: {"range": (max(0.0, here - half), here + half)}}
        found = []
        for key, given in ((usual if every else {}) | self.over).items():
            if key not in values or given is None:
                continue
            ((kind, ends),) = given.items()
            size = values[key] if kind == "factor" else 1.0
            low, high = sorted(size * end for end in ends)
            if not math.isclose(low, high, abs_tol=1e-300):
                found.append(Span(key, low, high))
        return tuple(found)


__all__ = ["AssumptionsConfig", "Span"]
