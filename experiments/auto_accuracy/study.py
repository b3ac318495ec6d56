"""Measures the true error of the settings that `auto` chooses, on random designs and scenes.

Profiles are EE, and CIC with random pressure angle, involute and tip land, with two to four lobes.
Scenes vary speed, load, backlash and damping. The requested relative error is 1 %, 0.1 % or 0.01 %
in turn. The true error of mean and peak force is measured against contact by search with dopri8 at
1e-10. Scenes without a periodic orbit are listed, and replaced by other random scenes.
"""

import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from experiments._common.scenes import CIC, shipped
from experiments._common.simulation import evaluate
from rootsopt.config import Config, load
from rootsopt.errors import InputError
from rootsopt.response.choice import choose, difference
from rootsopt.status import Status

Row = dict[str, Any]
REQUESTS = (1e-2, 1e-3, 1e-4)
SHARP = ("solver.fidelity=search", "solver.method=dopri8", "solver.rtol=1e-10")
FIDELITIES = ("linear", "search", "map")
QUICK_COUNT = 1
"""Number of scenes of a reduced run."""


def scenes(seed: int) -> Iterator[tuple[str, list[str]]]:
    """Yield (name of a shipped config, random overrides) without end."""
    draw = np.random.default_rng(seed)
    while True:
        family = "ee" if draw.uniform() < 0.25 else "cic"
        lobes = int(draw.integers(2, 5))
        values: dict[str, Any] = {
            "profile.lobes": lobes,
            "scene.speed_rpm": round(10 ** draw.uniform(2.5, 3.7), 1),
            "scene.load.torque_N_m": round(10 ** draw.uniform(0.3, 1.5), 3),
            "scene.timing_gear.backlash_mm": round(draw.uniform(0.02, 0.3), 3),
            "scene.timing_gear.damping_ratio": round(draw.uniform(0.1, 0.8), 3),
        }
        if family == "cic":
            radius = load(CIC).profile.pitch_radius_mm
            angle, tip = draw.uniform(25, 42), draw.uniform(0.5, 5.0)
            longest = radius * np.sin(np.radians(angle)) * (np.pi / 2 / lobes - np.radians(tip))
            values |= {
                "profile.pressure_angle_deg": round(angle, 2),
                "profile.tip_arc_angle_deg": round(tip, 2),
                "profile.involute_length_mm": round(draw.uniform(0.1, 0.9) * longest, 2),
            }
        yield family, [f"{key}={value}" for key, value in values.items()]


def measure(config: Config, overrides: list[str], family: str, wanted: float) -> Row:
    """Measure one scene. Return a row with requested error, chosen settings, estimated and true
    error.

    `wanted`: requested relative error."""
    truth = evaluate(shipped(family, *overrides, *SHARP))
    row: Row = {"family": family, "scene": " ".join(overrides), "requested": wanted}
    row |= {"fidelity": "", "rtol": np.nan, "estimated": np.nan, "error": np.nan}
    row |= {"seconds_to_choose": np.nan, "status": truth.status.label}
    if truth.status is not Status.PERIODIC:
        return row
    began = time.perf_counter()
    choice = choose(config)
    row["seconds_to_choose"] = time.perf_counter() - began
    found = evaluate(choice.config)
    error = difference(found, truth)
    return row | {
        "fidelity": choice.config.solver.fidelity,
        "rtol": choice.config.solver.orbit_tolerance,
        "estimated": np.nan if choice.error is None else choice.error,
        "error": np.nan if error is None else error,
        "status": found.status.label,
    }


def run(
    quick: bool, count: int = 50, seed: int = 0, say: Callable[[str], None] = lambda text: None
) -> list[Row]:
    """Measure random scenes until `count` of them are periodic; return a row per scene tried."""
    count = QUICK_COUNT if quick else count
    rows: list[Row] = []
    periodic = 0
    for family, overrides in scenes(seed):
        wanted = REQUESTS[periodic % len(REQUESTS)]
        asked = [*overrides, "solver.fidelity=auto", f"solver.accuracy={wanted}"]
        try:
            config = shipped(family, *asked)
        except InputError:
            continue  # an impossible geometry
        row = measure(config, overrides, family, wanted)
        rows.append(row)
        periodic += row["fidelity"] != ""
        say(
            f"{periodic}/{count} {family} {row['status']} {row['fidelity']}"
            f" requested {wanted:g} estimated {row['estimated']:.1e} true {row['error']:.1e}"
        )
        if periodic >= count:
            break
    return rows


def judged(rows: list[Row]) -> list[Row]:
    """Return the rows of periodic scenes, whose true error is known."""
    return [row for row in rows if row["fidelity"]]


def summary(rows: list[Row]) -> dict[str, Any]:
    """Return counts of the fulfilled requests and of the chosen settings."""
    known = judged(rows)
    return {
        "judged": len(known),
        "within_request": sum(bool(row["error"] <= row["requested"]) for row in known),
        "without_periodic_orbit": len(rows) - len(known),
        "largest_share_of_request": max(r["error"] / r["requested"] for r in known),
        "chosen": {name: sum(r["fidelity"] == name for r in known) for name in FIDELITIES},
    }
