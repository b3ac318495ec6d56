"""Fits records of simulated scenes whose values are known.

Each scene has random values of `RANGES` and a random speed. Its record is a turn of two sampled
columns with normal noise, whose standard deviation is a share of the column's RMS. The record holds
no standard deviations, so `identify` estimates the noise. The true values should lie in the joint
95 % region of 95 % of the fits, and each of them in 95 % of its intervals."""

from collections.abc import Iterator, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from scipy.stats import chi2

from experiments._common.driver import Run
from experiments._common.scenes import shipped
from experiments._common.tables import Row, show
from rootsopt.config import Config
from rootsopt.identification.answer import Identification
from rootsopt.identification.fit import identify
from rootsopt.response.evaluation import Evaluator
from rootsopt.status import Status
from rootsopt.view.figures.force import drawn

# Ranges of the values by key, which are the bounds of the fits, too.
RANGES = {
    "scene.timing_gear.backlash_mm": (0.05, 0.3),
    "scene.load.torque_N_m": (2.0, 10.0),
    "scene.timing_gear.stiffness_N_m_per_rad": (5e3, 5e4),
}
SPEEDS = 1500.0, 3500.0
COLUMNS = "relative_rotation_rad", "contact_force_N"

# Standard deviation of the noise, as a share of the RMS of the column.
NOISES = 0.01, 0.03, 0.1
SAMPLES = 180
SCENES, STARTS = 20, 2

# Share of regions that must hold the true values.
PROMISED = 0.9


def scene(rng: np.random.Generator) -> tuple[Config, np.ndarray, Any]:
    """Return (config with another speed, true values, series) of a random scene that repeats."""
    while True:
        config = shipped("cic").replaced({"scene.speed_rpm": float(rng.uniform(*SPEEDS))})
        true = np.array([rng.uniform(*ends) for ends in RANGES.values()])
        moved = config.replaced(dict(zip(RANGES, true.tolist(), strict=True)))
        found = Evaluator.of(moved)(jnp.asarray(moved.design))
        if found.status is Status.PERIODIC and found.series is not None:
            return config, true, found.to_dataset()


def fitted(
    config: Config, true: np.ndarray, data: Any, noise: float, rng: np.random.Generator
) -> tuple[Row, Identification]:
    """Fit a noisy record of a scene; return whether the true values are found, and the fit."""
    chosen = np.linspace(0, data.sizes["time_s"], SAMPLES, endpoint=False).astype(int)
    record = {"rotation_deg": data.rotation_deg.values[chosen]}
    for name in COLUMNS:
        values = data[name].values[chosen]
        size = np.sqrt(np.mean(values**2))
        record[name] = values + noise * size * rng.standard_normal(SAMPLES)
    found = identify(config, record, RANGES, starts=STARTS)
    row: Row = {"noise": noise, "status": found.status.label}
    if not found.parameters:
        return row | {"inside": False, "determined": 0}, found
    increase = found.increase(dict(zip(RANGES, true.tolist(), strict=True)))
    sure = sum(one["determined"] for one in found.combinations)
    row["inside"] = sure == 0 or increase < chi2.ppf(0.95, sure)
    row |= {"increase": increase, "determined": sure, "optima": len(found.optima)}
    for key, value, one in zip(RANGES, true, found.parameters.values(), strict=True):
        low, high = one["interval_95"]
        row |= {key: value, f"{key} found": one["value"], f"{key} inside": low <= value <= high}
    return row, found


def coverage(rows: Sequence[Row]) -> Iterator[Row]:
    """Yield the share of regions and intervals that hold the true values, by noise."""
    for noise in sorted({row["noise"] for row in rows}):
        mine = [row for row in rows if row["noise"] == noise]
        shares = {key.split(".")[-1]: np.mean([row.get(f"{key} inside", False) for row in mine])
                  for key in RANGES}  # fmt: skip
        inside = np.mean([row["inside"] for row in mine])
        yield {"noise": noise, "fits": len(mine), "region": inside} | shares


def run(job: Run) -> bool:
    """Fit all records; return whether enough regions hold the true values.

    The files are written after each scene, so that a run that is stopped leaves those it did."""
    rng = np.random.default_rng(0)
    scenes = 2 if job.quick else job.options.scenes or SCENES
    noises = NOISES[1:2] if job.quick else NOISES
    rows, table = [], []
    for number in range(1, scenes + 1):
        one = scene(rng)
        for noise in noises:
            row, found = fitted(*one, noise, rng)
            rows.append({"scene": number} | row)
            if number == 1 and noise == NOISES[1]:
                job.figure("identify.png", drawn(found))
        table = [*coverage(rows)]
        job.csv("identify.csv", rows)
        job.json("identify.json", {"coverage": table})
        if number % 10 == 0:
            job.say(f"{number} scenes, {np.mean([row['inside'] for row in rows]):.0%} inside")
    show("Share of 95 % regions and intervals that hold the true values", table)
    return job.quick or all(row["region"] >= PROMISED for row in table)
