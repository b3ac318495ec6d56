"""Optimises the shipped CIC pair with tolerances and compares the designs in fresh scenes.

Each case is a config with `tolerances`. `rootsopt.optimize_design` finds the nominal and the robust
optimum. Baseline and both optima are then simulated in the same fresh scenes. The standard
deviations of the forces of the nominal optimum are also estimated to first order, from the table of
sensitivities and the standard deviation of each key.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from experiments._common.scenes import shipped
from rootsopt.config import Config
from rootsopt.config.tolerances import Scatter
from rootsopt.optimize.design import optimize_design
from rootsopt.optimize.outcome import Optimization
from rootsopt.optimize.robust import Robustness

Say = Callable[[str], None]
FORCES = ("mean_force_N", "peak_force_N")
"""Forces whose distributions are reported."""
STATISTICS = ("mean", "sigma", "quantile_95", "worst")
"""Statistics that are reported, as `rootsopt.optimize.robust.Scattered` names them."""


class Case(NamedTuple):
    """A scene with scattered values: name in tables and figures, and overrides of
    configs/cic.yaml."""

    title: str
    overrides: tuple[str, ...]


_PLAY = "contact.clearance_mm=0.01"
_MACHINE = (
    "contact.clearance_mm: {normal: 0.002}, "
    "scene.timing_gear.backlash_mm: {uniform: 0.02}, "
    "scene.load.torque_N_m: {relative_normal: 0.05}"
)
CASES = {
    "shipped": Case("shipped scene, mean + 2 sigma", (_PLAY, f"tolerances.over={{{_MACHINE}}}")),
    "center_distance": Case(
        "shipped scene with centre distance, mean + 2 sigma",
        (
            _PLAY,
            "scene.center_distance_error_mm=0",
            f"tolerances.over={{{_MACHINE}, scene.center_distance_error_mm: {{uniform: 0.02}}}}",
        ),
    ),
    "light": Case(
        "damping 0.1, speed +-300 rpm, worst scene",
        (
            _PLAY,
            "scene.timing_gear.damping_ratio=0.1",
            f"tolerances.over={{{_MACHINE}, scene.speed_rpm: {{uniform: 300}}}}",
            "tolerances.combine=worst",
        ),
    ),
}
"""Cases by name."""
USUAL = ("shipped",)
"""Cases that run by default."""
QUICK = (
    "tolerances.over={contact.clearance_mm: {normal: 0.002}}",
    "tolerances.samples=2",
    "tolerances.check_samples=8",
    "optimizer.screening=0",
    "optimizer.starts=1",
    "optimizer.iterations=3",
)
"""Further overrides of a reduced run."""


class Found(NamedTuple):
    """Result of a case: its name, its config and what the search found."""

    name: str
    config: Config
    result: Optimization

    @property
    def robustness(self) -> Robustness:
        """Nominal optimum, and all designs in fresh scenes."""
        assert self.result.robustness is not None
        return self.result.robustness


def run(quick: bool, name: str, say: Say = lambda text: None) -> Found:
    """Find both optima of the case `name` and compare them in fresh scenes."""
    config = shipped("cic", *((_PLAY, *QUICK) if quick else CASES[name].overrides))
    told = [0]

    def progress(done: int, expected: int, best: float) -> None:
        if done >= told[0] + 10:
            told[0] = done
            say(f"{name}: {done} of at most {expected} designs, best objective {best:.4f}")

    found = Found(name, config, optimize_design(config, progress))
    say(f"{name}: {found.result.status.label}")
    return found


def rows_of(found: Found) -> list[dict[str, Any]]:
    """Return a row for each design: its parameters, and statistics over the fresh scenes."""
    known = {
        "baseline": found.result.baseline,
        "nominal": found.robustness.nominal.optimized,
        "robust": found.result.optimized,
    }
    rows = []
    for name, one in found.robustness.fresh.items():
        evaluation = known[name]
        assert evaluation is not None
        row: dict[str, Any] = {"case": found.name, "design": name, **evaluation.design}
        row["robust_objective"] = one.combined
        for force in ("objective", *FORCES):
            statistics = one.statistics(force)
            row |= {f"{force}_{key}": statistics[key] for key in STATISTICS}
        rows.append(row | {"failed_share": float(np.mean(~one.usable))})
    return rows


def scenes_of(found: Found) -> list[dict[str, Any]]:
    """Return a row for each fresh scene: its values, and the forces of each design."""
    columns = dict(found.robustness.scenes)
    for name, one in found.robustness.fresh.items():
        columns |= {f"{name}_{force}": one.values[force] for force in FORCES}
    count = len(next(iter(columns.values())))
    return [
        {"case": found.name} | {key: float(values[k]) for key, values in columns.items()}
        for k in range(count)
    ]


def deviation(scatter: Scatter) -> float:
    """Return the standard deviation of a key; for a normal distribution, before it is cut off."""
    return (
        scatter.width
        / {"normal": 1.0, "uniform": math.sqrt(3), "triangular": math.sqrt(6)}[scatter.kind]
    )


def linear_of(found: Found) -> list[dict[str, Any]]:
    """Return the standard deviation of each force of the nominal optimum, by key and in total.

    To first order, it is |derivative| times the standard deviation of the key. The total is the
    root of the sum of squares. `sampled`: standard deviation over the fresh scenes. The list is
    empty without sensitivities."""
    optimality = found.robustness.nominal.optimality
    if optimality is None or not found.robustness.fresh:
        return []
    by_key = {row["key"]: row for row in optimality.sensitivities}
    rows, squares = [], dict.fromkeys(FORCES, 0.0)
    for scatter in found.config.scatters:
        if scatter.key not in by_key:
            return []
        row = by_key[scatter.key]
        parts = {force: abs(row[force] / row["step"]) * deviation(scatter) for force in FORCES}
        squares = {force: squares[force] + parts[force] ** 2 for force in FORCES}
        rows.append({"key": scatter.key, "sigma_of_key": deviation(scatter)} | parts)
    total = {force: math.sqrt(square) for force, square in squares.items()}
    name = "nominal" if "nominal" in found.robustness.fresh else "baseline"
    one = found.robustness.fresh[name]
    sampled = {force: one.statistics(force)["sigma"] for force in FORCES}
    return [*rows, {"key": "all, first order"} | total, {"key": "all, sampled"} | sampled]


def record_of(found: Found) -> dict[str, Any]:
    """Return the record of a case for the result file."""
    result = found.result
    return {
        "title": CASES[found.name].title,
        "config": found.config.model_dump(mode="json", exclude_none=True),
        "status": result.status.label,
        "optimality": None if result.optimality is None else result.optimality.record(),
        "improvement": result.improvement,
        "robustness": found.robustness.record(),
        "first_order": linear_of(found),
    }


def kept(found: Found) -> bool:
    """Return whether the robust optimum is at least as good as the nominal one, over the sample."""
    problem, best = found.result.problem, found.result.optimized
    if problem is None or best is None:
        return False
    return problem.objective(best) <= found.robustness.begun + 1e-6
