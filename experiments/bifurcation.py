"""Quiet and noisy orbits of both rotor pairs over speed, load, play and design.

    python experiments/bifurcation.py [-o DIR] [--quick]

Starts from rest and from five other states at a dozen values of a parameter, follows every
periodic orbit reached over the whole range, through folds and period doublings, stable or not
(`rootsopt.continuation`), and reports where a stable quiet orbit exists, where a stable noisy
one, and where both do. Writes bifurcation.csv, special_points.csv, bifurcation.json,
bifurcation_speed.png, bifurcation_scene.png and bifurcation_ranges.png.
"""

import argparse
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rootsopt.cli import use_cache, use_float64

use_float64()
use_cache()

from experiments.bifurcation_parts.diagram import QUIET, Diagram, explore, overlaps, ranges  # noqa: E402
from experiments.bifurcation_parts.figures import draw_grid, draw_ranges  # noqa: E402
from rootsopt import files  # noqa: E402
from rootsopt.config import load  # noqa: E402
from rootsopt.continuation import Branch  # noqa: E402

STARTS = ((0.0, 0.0), (-0.2, -1.8), (-1.0, 0.0), (-3.0, 0.0), (0.8, 5.0), (-0.5, -8.0))
"""Scaled initial states tried at every value of the parameter."""
LIVELY = ("scene.timing_gear.backlash_mm=0.2", "scene.timing_gear.damping_ratio=0.2")
SCENES = {
    "shipped": (),
    "livelier": LIVELY,
}
TITLES = {
    "shipped": "shipped scene: backlash 0.1 mm, gear damping 0.5",
    "livelier": "livelier scene: backlash 0.2 mm, gear damping 0.2",
}
SLOWEST = {"shipped": 300, "livelier": 3500}
"""Lowest speed (rpm). Slower, the livelier pair bounces so often within a mesh period that its
orbits can hardly be followed."""


# Files


def point_rows(diagrams: list[Diagram]) -> list[dict[str, Any]]:
    return [
        {**where, **orbit_row(point)}
        for where, branch in branches_of(diagrams)
        for point in branch.points
    ]


def special_rows(diagrams: list[Diagram]) -> list[dict[str, Any]]:
    return [
        {**where, "kind": special.kind.name.lower(), **orbit_row(special.point)}
        for where, branch in branches_of(diagrams)
        for special in branch.bifurcations
    ]


def branches_of(diagrams: list[Diagram]) -> Iterator[tuple[dict[str, Any], Branch]]:
    """Every branch, with the columns that say which it is."""
    for diagram in diagrams:
        keys = {name: getattr(diagram, name) for name in ("scene", "family", "parameter")}
        for number, branch in enumerate(diagram.branches):
            yield keys | {"branch": number}, branch


def orbit_row(point) -> dict[str, Any]:
    row = {
        "value": point.value,
        "period": point.period,
        "mean_force_N": point.mean,
        "peak_force_N": point.peak,
        "rms_force_N": point.rms,
        "stable": point.stable,
        "gap_time": point.gap_time,
        "residual": point.residual,
    }
    for number, multiplier in enumerate(point.multipliers, 1):
        row |= {f"multiplier_{number}_real": multiplier.real}
        row |= {f"multiplier_{number}_imag": multiplier.imag}
    return row


def summary(diagrams: list[Diagram], seconds: float) -> dict[str, Any]:
    return {
        "quiet_up_to_static_forces": QUIET,
        "diagrams": [
            {
                "scene": diagram.scene,
                "family": diagram.family,
                "parameter": diagram.parameter,
                "range": [diagram.low, diagram.high],
                "stable": ranges(diagram),
                "several_stable": overlaps(diagram),
                "branches": [
                    {
                        "period": branch.period,
                        "points": len(branch.points),
                        "ends": [end.name.lower() for end in branch.ends],
                    }
                    for branch in diagram.branches
                ],
                "without_periodic_orbit": sorted(
                    {seed for seed in diagram.seeds if seed[1] != "periodic"}
                ),
            }
            for diagram in diagrams
        ],
        "largest_residual": max((row["residual"] for row in point_rows(diagrams)), default=None),
        "seconds": seconds,
        "versions": files.versions(),
    }


# The run


def survey(quick: bool) -> Iterator[Diagram]:
    configs = {
        (scene, family): load(f"configs/{family}.yaml", list(overrides))
        for scene, overrides in SCENES.items()
        for family in ("cic", "ee")
    }
    if quick:
        yield explore(
            "livelier", configs["livelier", "cic"], "speed_rpm", 3500, 4500, 1, STARTS[1:2]
        )
        return
    shipped = configs["shipped", "cic"]
    speeds = [
        (scene, config, "speed_rpm", SLOWEST[scene], 6000, 6, STARTS[:3])
        for (scene, _), config in configs.items()
    ]
    for plan in (
        *speeds,
        ("shipped", shipped, "torque_N_m", 0.5, 10.0, 2, STARTS[:2]),
        ("shipped", shipped, "backlash_mm", 0.02, 0.4, 4, STARTS[:2]),
        ("shipped", shipped, "involute_length_mm", 1.0, 9.0, 2, STARTS[:2]),
    ):
        yield explore(*plan)


def write(folder: files.ResultFolder, diagrams: list[Diagram], found: dict[str, Any]) -> None:
    folder.write_csv("bifurcation.csv", files.row_columns(point_rows(diagrams)))
    folder.write_csv("special_points.csv", files.row_columns(special_rows(diagrams)))
    folder.write_json("bifurcation.json", found)
    over_speed = [d for d in diagrams if d.parameter == "speed_rpm"]
    scenes = list(dict.fromkeys(d.scene for d in over_speed))
    columns = [[d for d in over_speed if d.scene == scene] for scene in scenes]
    folder.write_figure("bifurcation_speed.png", draw_grid(columns, [TITLES[s] for s in scenes]))
    others = [[d] for d in diagrams if d.parameter != "speed_rpm"]
    if others:
        figure = draw_grid(others, ["CIC, shipped scene, 3000 rpm"] * len(others))
        folder.write_figure("bifurcation_scene.png", figure)
    folder.write_figure("bifurcation_ranges.png", draw_ranges(over_speed))


def main() -> int:
    arguments = argparse.ArgumentParser(description="Quiet and noisy orbits, followed.")
    arguments.add_argument("-o", "--output", type=Path, default=Path("results/bifurcation"))
    arguments.add_argument("--quick", action="store_true", help="a part, for a test")
    options = arguments.parse_args()
    folder = files.ResultFolder(options.output)
    began = time.perf_counter()
    diagrams, found = [], {}
    # Written after every diagram, so that a long run can be looked at.
    for diagram in survey(options.quick):
        diagrams.append(diagram)
        found = summary(diagrams, time.perf_counter() - began)
        write(folder, diagrams, found)
        print(f"{diagram.scene} {diagram.family} {diagram.parameter}: {ranges(diagram)}")
        print(f"  more than one stable orbit: {overlaps(diagram)}", flush=True)
    print(f"largest residual {found['largest_residual']}, {found['seconds']:.0f} s")
    return 0


if __name__ == "__main__":
    sys.exit(main())
