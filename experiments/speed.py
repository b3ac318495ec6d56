"""How do speed and optimised forces go together?

    python experiments/speed.py [-o DIR] [--quick]

Mean and peak contact force over speed, every speed from rest, of the shipped CIC and EE pairs and
of CIC designs optimised at 3000 rpm, over the range (weighted mean) and for its worst speed; in
the shipped scene and in one with less damping in the gear. Beside them the natural frequencies of
the linearised pair, and the speeds at which a harmonic of the mesh frequency meets one. Writes
speed.csv, speed_resonances.csv, speed_maxima.csv, speed.json, speed.png, speed_objective.png and
speed_resonances.png.
"""

import argparse
import math
import sys
import time
from pathlib import Path
from typing import Any

from rootsopt.cli import use_cache, use_float64

use_float64()
use_cache()

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from matplotlib.lines import Line2D  # noqa: E402
from scipy.signal import find_peaks  # noqa: E402

from rootsopt import files, plot  # noqa: E402
from rootsopt.config import Config, load  # noqa: E402
from rootsopt.dynamics.pair import RotorPair  # noqa: E402
from rootsopt.evaluate import Evaluation, Evaluator, objective_weights  # noqa: E402
from rootsopt.model import design_vector  # noqa: E402
from rootsopt.optimize.search import Search  # noqa: E402
from rootsopt.plot_speeds import LABELS, legend_entries, plot_speeds  # noqa: E402
from rootsopt.programs import Program  # noqa: E402
from rootsopt.speeds import Part, sweep  # noqa: E402

SCENES = {"shipped": (), "light": ("scene.timing_gear.damping_ratio=0.1",)}
TITLES = {"shipped": "shipped scene", "light": "gear damping ratio 0.1"}
OPTIMISED = {
    "at 3000 rpm": (),
    "over the range, mean": ("objective.over_speeds=weighted",),
    "over the range, worst": ("objective.over_speeds=worst",),
}
QUICK = ("optimizer.screening=0", "optimizer.starts=1", "optimizer.iterations=1")
PHASES = 240
"""Phases of a mesh period at which the pair is linearised."""
ORDERS = 6
"""Harmonics of the mesh frequency looked at."""
PROMINENCE = 0.02
"""A maximum rises so far above its surroundings, relative to its height."""
NEAR = 0.03
"""A maximum lies at a crossing if their speeds differ by no more than this share."""


def settings(scene: str, family: str, *more: str) -> Config:
    return load(f"configs/{family}.yaml", [*SCENES[scene], *more])


@Program
def equilibria(pair: RotorPair, phases):
    """At phases (n,) of the mesh period, rotor 1 held: stiffness of the pair and of the flanks
    alone (N·m/rad), torque of the flanks (N·m) and contact force (N) in static equilibrium."""
    gear = pair.gear
    assert gear is not None
    still = jnp.asarray(0.0)

    def flank(phase, relative):
        # Without the damping that sliding at speed gives.
        side = jnp.where(relative < 0, 1.0, -1.0)
        pose = -side * (2 * np.pi / pair.lobes * phase + relative / 2), side * relative
        gap, _, lever = pair.contact(*pose)
        force = pair.law(-gap - pair.clearance, still)
        return side * lever * force, force

    def torque(phase, relative):
        return flank(phase, relative)[0] - gear(relative, still)

    def equilibrium(phase):
        def halve(_, ends):
            low, high = ends
            middle = (low + high) / 2
            carries = torque(phase, middle) > pair.load.torque
            return jnp.where(carries, middle, low), jnp.where(carries, high, middle)

        low = -2 * (gear.half_backlash + pair.load.torque / gear.stiffness) - pair.angle_scale
        relative, _ = jax.lax.fori_loop(0, 60, halve, (low, jnp.zeros(())))
        stiffness = -jax.grad(torque, argnums=1)(phase, relative)
        on_flank = -jax.grad(lambda x: flank(phase, x)[0])(relative)
        return stiffness, on_flank, *flank(phase, relative)

    return jax.vmap(equilibrium)(phases)


def linearised(pair: RotorPair) -> dict[str, float]:
    """Natural frequencies (Hz) of the pair about its static equilibrium, rotor 1 held.

    `contact`: of rotor 2 on the flanks, with the mean of their stiffness over the phases in which
    they carry most of the load, a share `contact_share` of all; `gear`: on the gear; `average`:
    mean over all phases of the local frequency, with whatever carries. `both_share`: share of the
    phases in which flanks and gear both carry; `static_peak_N`, `static_mean_N`: contact force.
    """
    phases = (np.arange(PHASES) + 0.5) / PHASES
    stiffness, on_flank, torque, force = map(np.asarray, equilibria(pair, phases))
    assert pair.gear is not None
    inertia, gear, load = (float(x) for x in (pair.inertia, pair.gear.stiffness, pair.load.torque))

    def frequency(k):
        return np.sqrt(np.maximum(k, 0) / inertia) / (2 * np.pi)

    carries = torque > load / 2
    return {
        "contact": float(frequency(np.mean(on_flank[carries]))),
        "gear": float(frequency(gear)),
        "average": float(np.mean(frequency(stiffness))),
        "contact_share": float(np.mean(carries)),
        "both_share": float(np.mean((torque > 0.01 * load) & (torque < 0.99 * load))),
        "gear_damping": float(pair.gear.damping) / (2 * math.sqrt(gear * inertia)),
        "static_peak_N": float(np.max(force)),
        "static_mean_N": float(np.mean(force)),
    }


def crossings(found: dict[str, float], lobes: int, speeds) -> list[dict[str, Any]]:
    """Speeds (rpm) at which harmonic k of the mesh frequency meets a natural frequency."""
    rows = []
    for mode in ("contact", "gear", "average"):
        for order in range(1, ORDERS + 1):
            speed = 60 * found[mode] / (order * lobes)
            if speeds[0] <= speed <= speeds[-1]:
                row = {"mode": mode, "frequency_Hz": found[mode], "order": order}
                rows.append(row | {"speed_rpm": speed})
    return rows


def maxima(parts: tuple[Part, ...], rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Local maxima of mean and peak force over speed, each with the crossing next to it."""
    speeds = np.array([part.speed_rpm for part in parts])
    found = []
    for force in LABELS:
        values = np.array([part.evaluation.response.get(force, 0.0) for part in parts])
        for k in find_peaks(values, prominence=PROMINENCE * np.max(values))[0]:
            near = min(rows, key=lambda row: abs(math.log(row["speed_rpm"] / speeds[k])))
            found.append(
                {
                    "force": force,
                    "speed_rpm": speeds[k],
                    "value_N": values[k],
                    "status": parts[k].evaluation.status.label,
                    "nearest_mode": near["mode"],
                    "order": near["order"],
                    "crossing_rpm": near["speed_rpm"],
                    "apart": speeds[k] / near["speed_rpm"] - 1,
                }
            )
    return found


def covered(rows: list[dict[str, Any]], speeds) -> float:
    """Share of the speeds that lie at a crossing: what chance alone would give."""
    at = np.array([row["speed_rpm"] for row in rows])
    return float(np.mean(np.min(np.abs(np.asarray(speeds)[:, None] / at - 1), axis=1) <= NEAR))


def objective(config: Config, one: Evaluation, baseline: Evaluation) -> float:
    """The objective at a speed; from averages of a window where the motion is not periodic."""
    if not (one.response and baseline.response):
        return math.nan
    weights = objective_weights(config)
    return sum(w * one.response[k] / baseline.response[k] for k, w in weights.items())


def study(scene: str, speeds, listed, quick: bool) -> dict[str, Any]:
    """Sweeps, optimisations and linearised pairs of a scene."""
    small = QUICK if quick else ()
    designs: dict[str, tuple[Part, ...]] = {}
    linear: dict[str, dict[str, float]] = {}
    outcomes: list[dict[str, Any]] = []
    evaluators = {f: Evaluator(settings(scene, f, *small)) for f in ("cic", "ee")}
    for family, evaluator in evaluators.items():
        designs[family.upper()] = sweep(evaluator, speeds)
        linear[family.upper()] = linearised(evaluator.pair(design_vector(evaluator.config)))
    base = designs["CIC"]
    config = evaluators["cic"].config
    for name, keys in list(OPTIMISED.items())[slice(1, 2) if quick else slice(None)]:
        over = (f"objective.speeds_rpm={list(listed)}", *keys) if keys else ()
        began = time.perf_counter()
        result = Search(settings(scene, "cic", *small, *over)).run()
        outcome: dict[str, Any] = {"scene": scene, "optimised": name}
        if result.problem is not None and result.optimized is not None:
            design = np.array(list(result.optimized.design.values()))
            label = f"CIC, optimised {name}"
            designs[label] = sweep(evaluators["cic"], speeds, design)
            linear[label] = linearised(evaluators["cic"].pair(jnp.asarray(design)))
            pairs = zip(designs[label], base, strict=True)
            along = [objective(config, p.evaluation, b.evaluation) for p, b in pairs]
            outcome |= result.optimized.design | {
                "own_objective": result.problem.objective(result.optimized),
                "at_3000_rpm": along[int(np.argmin(np.abs(np.asarray(speeds) - 3000)))],
                "mean_over_sweep": float(np.nanmean(along)),
                "worst_over_sweep": float(np.nanmax(along)),
                "worst_rpm": speeds[int(np.nanargmax(along))],
                "share_of_speeds_better": float(np.mean(np.asarray(along) < 1)),
            }
            at = sweep(evaluators["cic"], listed, design)
            pairs = zip(at, sweep(evaluators["cic"], listed), strict=True)
            those = [objective(config, p.evaluation, b.evaluation) for p, b in pairs]
            outcome |= {
                "mean_over_listed": float(np.mean(those)),
                "worst_over_listed": float(np.max(those)),
            }
        outcomes.append(outcome | {"seconds": time.perf_counter() - began})
    return {"designs": designs, "linear": linear, "outcomes": outcomes, "config": config}


def draw_speeds(studies: dict[str, dict]):
    """Mean and peak force over speed, a column for each scene."""
    made, axes = plot.figure(13, 7.4, 2, len(studies), sharex=True, sharey="row")
    *shown, _ = OPTIMISED
    labels = ["CIC", "EE", *(f"CIC, optimised {name}" for name in shown)]
    entries = {}
    top = dict.fromkeys(LABELS, 0.0)
    for column, (scene, found) in enumerate(studies.items()):
        designs = {k: found["designs"][k] for k in labels if k in found["designs"]}
        entries |= {entry.get_label(): entry for entry in legend_entries(designs)}
        for ax, force in zip(axes[:, column], LABELS, strict=True):
            plot_speeds(ax, designs, force)
            forces = (p.evaluation.response.get(force, 0) for d in designs.values() for p in d)
            top[force] = max(top[force], *forces)
        axes[0, column].set_title(TITLES[scene])
        axes[1, column].set_xlabel("speed (rpm)")
    for ax, force in zip(axes[:, 0], LABELS, strict=True):
        ax.set_ylim(0, 1.05 * top[force])
    made.legend(handles=list(entries.values()), loc="outside lower center", ncols=4, frameon=False)
    made.suptitle("Contact force over speed, from rest")
    return made


def draw_objective(studies: dict[str, dict], listed):
    """Objective of the optimised designs relative to CIC at the same speed."""
    made, axes = plot.figure(13, 4.6, 1, len(studies), sharey=True)
    styles = dict(zip(OPTIMISED, ((plot.GREEN, "-", "o"), (plot.PURPLE, "--", "s"),
                                  (plot.ORANGE, ":", "^")), strict=True))  # fmt: skip
    for ax, (scene, found) in zip(axes[0], studies.items(), strict=True):
        base = found["designs"]["CIC"]
        speeds = np.array([part.speed_rpm for part in base])
        for name, (color, dashes, marker) in styles.items():
            parts = found["designs"].get(f"CIC, optimised {name}")
            if parts is None:
                continue
            pairs = zip(parts, base, strict=True)
            values = np.array(
                [objective(found["config"], p.evaluation, b.evaluation) for p, b in pairs]
            )
            at = [3000.0] if name == "at 3000 rpm" else listed
            ax.plot(speeds, values, color=color, linestyle=dashes, label=f"optimised {name}")
            heights = np.interp(at, speeds, values)
            ax.plot(at, heights, marker, color=color, markersize=5)
            unsettled = np.array(
                [not (p.evaluation.usable and b.evaluation.usable)
                 for p, b in zip(parts, base, strict=True)]
            )  # fmt: skip
            ax.plot(speeds[unsettled], values[unsettled], "x", color=color, markersize=7)
        ax.axhline(1, color="black", linewidth=0.8, linestyle=":")
        ax.set(title=TITLES[scene], xlabel="speed (rpm)")
        ax.grid(color="0.92", linewidth=0.6)
    axes[0, 0].set_ylabel("objective / CIC at the same speed")
    lines, names = axes[0, 0].get_legend_handles_labels()
    made.legend(lines, names, loc="outside lower center", ncols=3, frameon=False)
    made.suptitle("What an optimum is worth at other speeds (markers: speeds of its objective)")
    return made


def draw_resonances(studies: dict[str, dict], rows: list[dict], peaks: list[dict]):
    """Peak force with the crossings and the maxima found: shipped pairs, optimised CIC."""
    shown = {
        "CIC": plot.BLUE,
        "EE": plot.VERMILION,
        f"CIC, optimised {next(iter(OPTIMISED))}": plot.SKY,
    }
    made, axes = plot.figure(13, 10.5, len(shown), len(studies), sharex=True)
    modes = {"contact": (plot.GREEN, "--"), "gear": (plot.PURPLE, ":"), "average": ("0.45", "-.")}
    for column, (scene, found) in enumerate(studies.items()):
        for ax, (name, color) in zip(axes[:, column], shown.items(), strict=True):
            if name not in found["designs"]:
                continue
            here = {"scene": scene, "design": name}.items()
            parts = found["designs"][name]
            for line in plot_speeds(ax, {name: parts}, "peak_force_N").lines:
                line.set_color(color)
            ax.axhline(found["linear"][name]["static_peak_N"], color="black", linewidth=0.9)
            top = 1.25 * max(part.evaluation.response.get("peak_force_N", 0) for part in parts)
            for row in rows:
                if not here <= row.items() or row["order"] > 3:
                    continue
                shade, dashes = modes[row["mode"]]
                ax.axvline(row["speed_rpm"], color=shade, linestyle=dashes, linewidth=1.1)
                height = 0.97 - 0.055 * list(modes).index(row["mode"])
                ax.text(row["speed_rpm"] + 30, height * top, str(row["order"]), color=shade,
                        va="center", fontsize=9)  # fmt: skip
            for peak in peaks:
                if here <= peak.items() and peak["force"] == "peak_force_N":
                    ax.plot(peak["speed_rpm"], 1.03 * peak["value_N"], "v", color="black", ms=5)
            ax.set(title=f"{name}, {TITLES[scene]}", ylim=(0, top))
    for ax in axes[-1]:
        ax.set_xlabel("speed (rpm)")

    def entry(label, **style):
        return Line2D([], [], label=label, **style)

    made.legend(
        handles=[
            *(entry(f"k × mesh frequency = {mode} frequency", color=c, linestyle=d)
              for mode, (c, d) in modes.items()),
            entry("peak at standstill", color="black", linewidth=0.9),
            entry("local maximum", color="black", linestyle="", marker="v", markersize=5),
            entry("chaotic, or not settled (+)", color="black", linestyle="", marker="x"),
        ],
        loc="outside lower center", ncols=3, frameon=False,
    )  # fmt: skip
    made.suptitle("Peak force over speed, and where harmonics k meet a natural frequency")
    return made


def main() -> int:
    arguments = argparse.ArgumentParser(description="Contact force over speed, and resonances.")
    arguments.add_argument("-o", "--output", type=Path, default=Path("results/speed"))
    arguments.add_argument("--quick", action="store_true", help="few speeds, tiny optimisations")
    options = arguments.parse_args()
    folder = files.ResultFolder(options.output)
    speeds = np.linspace(300, 6000, 5 if options.quick else 115).tolist()
    listed = (2000.0, 4000.0) if options.quick else tuple(np.arange(500.0, 6001.0, 500.0).tolist())
    studies: dict[str, dict] = {}
    rows: list[dict] = []
    resonances: list[dict] = []
    peaks: list[dict] = []
    chance: dict[str, float] = {}
    for scene in list(SCENES)[: 1 if options.quick else None]:
        found = studies[scene] = study(scene, speeds, listed, options.quick)
        for name, parts in found["designs"].items():
            here = {"scene": scene, "design": name}
            rows += [here | part.row() for part in parts]
            across = crossings(found["linear"][name], found["config"].profile.lobes, speeds)
            resonances += [here | row for row in across]
            peaks += [here | row for row in maxima(parts, across)]
            chance[f"{scene}, {name}"] = covered(across, speeds)
    summary = {
        "linearised": {scene: found["linear"] for scene, found in studies.items()},
        "optimisations": [row for found in studies.values() for row in found["outcomes"]],
        "maxima": len(peaks),
        "maxima_at_a_crossing": sum(abs(row["apart"]) <= NEAR for row in peaks),
        "maxima_at_a_crossing_by_chance": sum(
            chance[f"{row['scene']}, {row['design']}"] for row in peaks
        ),
        "statuses": {
            f"{scene}, {name}": {
                status: sum(p.evaluation.status.label == status for p in parts)
                for status in dict.fromkeys(p.evaluation.status.label for p in parts)
            }
            for scene, found in studies.items()
            for name, parts in found["designs"].items()
        },
        "versions": files.versions(),
    }
    folder.write_csv("speed.csv", files.row_columns(rows))
    folder.write_csv("speed_resonances.csv", files.row_columns(resonances))
    folder.write_csv("speed_maxima.csv", files.row_columns(peaks))
    folder.write_json("speed.json", summary)
    folder.write_figure("speed.png", draw_speeds(studies))
    folder.write_figure("speed_objective.png", draw_objective(studies, listed))
    folder.write_figure("speed_resonances.png", draw_resonances(studies, resonances, peaks))
    for key, value in summary.items():
        print(f"{key}: {value}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
