"""Does `fidelity: auto` keep its word? Random designs and scenes against the reference.

    python experiments/auto_accuracy.py [-o DIR] [--count 50] [--seed 0]

Draws profiles (CIC of random pressure angle, involute and tip land, EE; two to four lobes)
and scenes (speed, load, backlash, damping), lets `auto` choose for a relative error of 1 %,
0.1 % or 0.01 %, and measures the true error of mean and peak force against contact by
search with Dopri8 at 1e-10. Scenes that settle on no periodic orbit are listed, and others
drawn until there are `--count`. Writes auto.csv, auto.json and auto.png; the exit status is
3 if a request was missed.
"""

import argparse
import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

os.environ.setdefault("EQX_ON_ERROR", "off")

from rootsopt.cli import use_float64

use_float64()

import numpy as np  # noqa: E402
from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: E402
from matplotlib.figure import Figure  # noqa: E402

from rootsopt import auto, files  # noqa: E402
from rootsopt.config import Config, load  # noqa: E402
from rootsopt.errors import InputError  # noqa: E402
from rootsopt.evaluate import Evaluator  # noqa: E402
from rootsopt.status import Status  # noqa: E402

REQUESTS = (1e-2, 1e-3, 1e-4)
SHARP = ("solver.fidelity=search", "solver.method=dopri8", "solver.rtol=1e-10")
MARKS = {"linear": ("o", "#0072B2"), "search": ("s", "#D55E00"), "map": ("^", "#009E73")}


def scenes(seed: int) -> Iterator[tuple[str, list[str]]]:
    """Endless shipped configs with random overrides."""
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
            radius = load("configs/cic.yaml").profile.pitch_radius_mm
            angle, tip = draw.uniform(25, 42), draw.uniform(0.5, 5.0)
            longest = radius * np.sin(np.radians(angle)) * (np.pi / 2 / lobes - np.radians(tip))
            values |= {
                "profile.pressure_angle_deg": round(angle, 2),
                "profile.tip_arc_angle_deg": round(tip, 2),
                "profile.involute_length_mm": round(draw.uniform(0.1, 0.9) * longest, 2),
            }
        yield family, [f"{key}={value}" for key, value in values.items()]


def measure(config: Config, overrides: list[str], family: str, wanted: float) -> dict[str, Any]:
    """One row: what was asked, chosen, estimated and true."""
    truth = Evaluator(load(f"configs/{family}.yaml", [*overrides, *SHARP]))(series=False)
    row: dict[str, Any] = {"family": family, "scene": " ".join(overrides), "requested": wanted}
    row |= {"fidelity": "", "rtol": np.nan, "estimated": np.nan, "error": np.nan}
    row |= {"seconds_to_choose": np.nan, "status": truth.status.label}
    if truth.status is not Status.PERIODIC:
        return row
    began = time.perf_counter()
    choice = auto.choose(config)
    row["seconds_to_choose"] = time.perf_counter() - began
    found = Evaluator(choice.config)(series=False)
    error = auto.difference(found, truth)
    return row | {
        "fidelity": choice.config.solver.fidelity,
        "rtol": choice.config.solver.rtol,
        "estimated": np.nan if choice.error is None else choice.error,
        "error": np.nan if error is None else error,
        "status": found.status.label,
    }


def draw_errors(rows: list[dict[str, Any]], path: Path) -> None:
    """True error against the error asked for; all points belong below the line."""
    figure = Figure(figsize=(6.4, 4.8), layout="constrained", dpi=150)
    FigureCanvasAgg(figure)
    ax = figure.subplots()
    spread = np.random.default_rng(0)
    for fidelity, (mark, colour) in MARKS.items():
        chosen = [row for row in rows if row["fidelity"] == fidelity]
        if chosen:
            asked = np.array([row["requested"] for row in chosen])
            ax.loglog(
                asked * 10 ** spread.uniform(-0.15, 0.15, len(asked)),
                np.maximum([row["error"] for row in chosen], 1e-10),
                mark, color=colour, mfc="none", label=f"{fidelity} chosen ({len(chosen)})",
            )  # fmt: skip
    line = np.array([3e-5, 3e-2])
    ax.loglog(line, line, "k-", lw=1, label="error asked for")
    ax.set_xlabel("relative error asked for (points spread for legibility)")
    ax.set_ylabel("true error of mean and peak force, the larger")
    ax.set_title(f"{len(rows)} random designs and scenes", fontsize=11)
    ax.legend(fontsize=8)
    ax.grid(alpha=0.3)
    figure.savefig(path)


def main() -> int:
    arguments = argparse.ArgumentParser(description="True error of what auto chooses.")
    arguments.add_argument("-o", "--output", type=Path, default=Path("results/auto"))
    arguments.add_argument("--count", type=int, default=50)
    arguments.add_argument("--seed", type=int, default=0)
    options = arguments.parse_args()
    folder = files.ResultFolder(options.output)
    rows: list[dict[str, Any]] = []
    periodic = 0
    for family, overrides in scenes(options.seed):
        wanted = REQUESTS[periodic % len(REQUESTS)]
        asked = [*overrides, "solver.fidelity=auto", f"solver.accuracy={wanted}"]
        try:
            config = load(f"configs/{family}.yaml", asked)
        except InputError:
            continue  # an impossible geometry
        rows.append(measure(config, overrides, family, wanted))
        row = rows[-1]
        judged = row["fidelity"] != ""
        periodic += judged
        print(
            f"{periodic}/{options.count} {family} {row['status']} {row['fidelity']}"
            f" asked {wanted:g} estimated {row['estimated']:.1e} true {row['error']:.1e}",
            flush=True,
        )
        if periodic >= options.count:
            break
    folder.write_csv("auto.csv", {key: [row[key] for row in rows] for key in rows[0]})
    judged_rows = [row for row in rows if row["fidelity"]]
    kept = [bool(row["error"] <= row["requested"]) for row in judged_rows]
    summary = {
        "judged": len(kept),
        "within_request": sum(kept),
        "without_periodic_orbit": len(rows) - len(kept),
        "largest_share_of_request": max(r["error"] / r["requested"] for r in judged_rows),
        "chosen": {f: sum(r["fidelity"] == f for r in judged_rows) for f in MARKS},
    }
    folder.write_json("auto.json", summary)
    draw_errors(judged_rows, options.output / "auto.png")
    for key, value in summary.items():
        print(f"{key}: {value}")
    return 0 if all(kept) else 3


if __name__ == "__main__":
    sys.exit(main())
