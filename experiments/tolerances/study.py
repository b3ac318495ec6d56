"""Optimises a free form for `configs/cic.yaml` with tolerances, and compares it in fresh scenes.

`rootsopt.optimize_design` finds the nominal and the robust optimum. Baseline and both optima are
then simulated in the same fresh scenes. The standard
deviations of the forces of the nominal optimum are also estimated to first order, from the table of
sensitivities and the standard deviation of each key.
"""

import math
from collections.abc import Iterator

import numpy as np

from experiments._common.driver import Run
from experiments._common.scenes import FAIR, FORCES
from experiments._common.tables import Row, show
from rootsopt.config import Config, load
from rootsopt.optimize.design import optimize_design
from rootsopt.optimize.outcome import Optimization
from rootsopt.optimize.robust import Robustness
from rootsopt.view.figures.comparisons import distributions

# Statistics that are reported, as `rootsopt.optimize.robust.Scattered` names them.
STATISTICS = ("mean", "sigma", "quantile_95", "worst")


# Standard deviation of a distribution of width 1; of a normal one before it is cut off.
DEVIATIONS = {"normal": 1.0, "uniform": 1 / math.sqrt(3), "triangular": 1 / math.sqrt(6)}

# Overrides of the config: the search varies a free form, because no CIC is much better than the
# paper's in this pump.
FREE = "optimizer.family=free_form", "optimizer.bounds={}"

# The values that scatter.
OVER = (
    "tolerances.over={contact.clearance_mm: {normal: 0.002}, "
    "scene.timing_gear.backlash_mm: {uniform: 0.02}, "
    "scene.load.torque_N_m: {relative_normal: 0.05}}",
)

# Overrides of a reduced run: the three parameters of the CIC, which gains by a narrower tip land.
QUICK = (
    "constraints.seal_width_min_mm=4.3",
    "tolerances.over={contact.clearance_mm: {normal: 0.002}}",
    "tolerances.samples=2",
    "tolerances.check_samples=8",
    "optimizer.screening=0",
    "optimizer.starts=1",
    "optimizer.iterations=3",
)


def rows_of(result: Optimization, robustness: Robustness) -> Iterator[Row]:
    """Yield a row for each design: its parameters, and statistics over the fresh scenes."""
    nominal = robustness.nominal.optimized
    known = {"baseline": result.baseline, "nominal": nominal, "robust": result.optimized}
    for name, one in robustness.fresh.items():
        evaluation = known[name]
        assert evaluation is not None
        row = {"design": name, **evaluation.design, "robust_objective": one.combined}
        for force in ("objective", *FORCES):
            statistics = one.statistics(force)
            row |= {f"{force}_{key}": statistics[key] for key in STATISTICS}
        yield row | {"failed_share": float(np.mean(~one.usable))}


def linear_of(config: Config, robustness: Robustness) -> list[Row]:
    """Return the standard deviation of each force of the nominal optimum, by key and in total.

    To first order, it is |derivative| times the standard deviation of the key. The total is the
    root of the sum of squares. `sampled`: standard deviation over the fresh scenes. The list is
    empty without sensitivities."""
    optimality = robustness.nominal.optimality
    by_key = {} if optimality is None else {row["key"]: row for row in optimality.sensitivities}
    if not all(scatter.key in by_key for scatter in config.scatters):
        return []
    rows: list[Row] = []
    for scatter in config.scatters:
        row, width = by_key[scatter.key], scatter.width * DEVIATIONS[scatter.kind]
        parts = {force: abs(row[force] / row["step"]) * width for force in FORCES}
        rows.append({"key": scatter.key, "sigma_of_key": width} | parts)
    total = {force: math.hypot(*(row[force] for row in rows)) for force in FORCES}
    one = robustness.fresh.get("nominal", robustness.fresh["baseline"])
    sampled = {force: one.statistics(force)["sigma"] for force in FORCES}
    return [*rows, {"key": "all, first order"} | total, {"key": "all, sampled"} | sampled]


def run(job: Run) -> bool:
    """Find both optima and compare them in fresh scenes.

    Returns whether the robust optimum is at least as good as the nominal one, over the sample of
    the search."""
    config = load(FAIR, QUICK if job.quick else [*FREE, *OVER])
    result = optimize_design(config)
    robustness = result.robustness
    assert robustness is not None
    job.say(result.status.label)
    rows, linear = [*rows_of(result, robustness)], linear_of(config, robustness)
    columns = dict(robustness.scenes)
    for name, one in robustness.fresh.items():
        columns |= {f"{name}_{force}": one.values[force] for force in FORCES}
    job.csv("tolerances.csv", rows)
    job.folder.write_csv("tolerances_scenes.csv", columns)
    record = {"improvement": result.improvement, "robustness": robustness.record()}
    job.json("tolerances.json", record | {"first_order": linear})
    forces = {name: one.values for name, one in robustness.fresh.items()}
    job.figure("tolerances.png", distributions(forces, "shipped scene, mean + 2 sigma"))
    show("Baseline and optima over the fresh scenes", rows)
    show("Standard deviation, first-order and sampled", linear)
    problem, best = result.problem, result.optimized
    if problem is None or best is None:
        return False
    return problem.objective(best) <= robustness.begun + 1e-6
