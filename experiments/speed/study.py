"""Relates speed to contact force: sweeps, optimised designs, and natural frequencies.

The study sweeps mean and peak contact force over speed, each speed from rest. Designs: the shipped
CIC and EE pairs, and CIC optimised at 3000 rpm, over the range (weighted mean) and for its worst
speed. Scenes: the shipped scene, and a scene with less damping in the gear. The pair is linearised
for its natural frequencies. A *crossing* is a speed at which a harmonic of the mesh frequency
equals a natural frequency.
"""

import dataclasses
import itertools
import math
from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.artist import setp
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from scipy.signal import find_peaks

from experiments._common.driver import Run
from experiments._common.scenes import shipped
from experiments._common.simulation import evaluator_of
from experiments._common.style import BLUE, GREEN, ORANGE, PURPLE, SKY, VERMILION, sheet
from experiments._common.tables import Row, print_record
from rootsopt.config import Config
from rootsopt.dynamics.pair import RotorPair
from rootsopt.optimize.search import Search
from rootsopt.response.evaluation import Evaluator
from rootsopt.response.reducers import Point, evaluate_many, parts_at
from rootsopt.response.result import Evaluation, Part
from rootsopt.response.terms import objective_weights
from rootsopt.runtime.programs import CachedFunction
from rootsopt.view.figures.sweep import LABELS, legend_entries, plot_speeds

SCENES = {"shipped": (), "light": ("scene.timing_gear.damping_ratio=0.1",)}
TITLES = {"shipped": "shipped scene", "light": "gear damping ratio 0.1"}

# Overrides of each optimisation, by its name.
OPTIMISED = {
    "at 3000 rpm": (),
    "over the range, mean": ("objective.over_speeds=weighted",),
    "over the range, worst": ("objective.over_speeds=worst",),
}
QUICK = ("optimizer.screening=0", "optimizer.starts=1", "optimizer.iterations=1")

# Number of phases of a mesh period at which the pair is linearised.
PHASES = 240

# Number of harmonics of the mesh frequency considered.
ORDERS = 6

# Prominence of a point of a force curve (relative to the force) above which it counts as a
# maximum.
PROMINENCE = 0.02


@CachedFunction
def equilibria(pair: RotorPair, phases):
    """Find the static equilibria of a pair at `phases` (n,) of the mesh period, with rotor 1 fixed.

    Returns four arrays (n,): stiffness of the pair and of the flanks alone (N·m/rad), torque of the
    flanks (N·m), and contact force (N).
    """
    gear, still = pair.gear, jnp.asarray(0.0)
    assert gear is not None

    def flank(phase, relative):
        # At zero penetration rate, so that there is no damping force.
        side = jnp.where(relative < 0, 1.0, -1.0)
        pose = -side * (2 * np.pi / pair.lobes * phase + relative / 2), side * relative
        gap, _, lever = pair.contact(*pose)
        force = pair.law(-gap - pair.clearance, still)
        return side * lever * force, force

    def torque(phase, relative):
        return flank(phase, relative)[0] - gear(relative, still)

    def equilibrium(phase):
        def halve(_, ends):
            middle = sum(ends) / 2
            carries = torque(phase, middle) > pair.load.torque
            return jnp.where(carries, middle, ends[0]), jnp.where(carries, ends[1], middle)

        low = -2 * (gear.half_backlash + pair.load.torque / gear.stiffness) - pair.angle_scale
        relative, _ = jax.lax.fori_loop(0, 60, halve, (low, jnp.zeros(())))
        stiffness = -jax.grad(torque, argnums=1)(phase, relative)
        on_flank = -jax.grad(lambda x: flank(phase, x)[0])(relative)
        return stiffness, on_flank, *flank(phase, relative)

    return jax.vmap(equilibrium)(phases)


def linearised(pair: RotorPair) -> dict[str, float]:
    """Find the natural frequencies (Hz) of a pair about its static equilibrium, with rotor 1 fixed.

    Keys of the result. `contact`: frequency of rotor 2 on the flanks, whose stiffness is averaged
    over the phases in which they carry most of the load; `gear`: frequency of rotor 2 on the gear;
    `average`: mean over all phases of the local frequency on flanks and gear; `gear_damping`: share
    of critical damping; `static_peak_N`: contact force.
    """
    phases = (np.arange(PHASES) + 0.5) / PHASES
    stiffness, on_flank, torque, force = map(np.asarray, equilibria(pair, phases))
    assert pair.gear is not None
    inertia, gear, load = (float(x) for x in (pair.inertia, pair.gear.stiffness, pair.load.torque))

    def frequency(k):
        return np.sqrt(np.maximum(k, 0) / inertia) / (2 * np.pi)

    return {
        "contact": float(frequency(np.mean(on_flank[torque > load / 2]))),
        "gear": float(frequency(gear)),
        "average": float(np.mean(frequency(stiffness))),
        "gear_damping": float(pair.gear.damping) / (2 * math.sqrt(gear * inertia)),
        "static_peak_N": float(np.max(force)),
    }


def crossings(found: dict[str, float], lobes: int, speeds) -> Iterator[Row]:
    """Yield a row for each crossing: a speed (rpm) at which a harmonic of the mesh frequency equals
    a natural frequency.

    `found`: result of `linearised`; `speeds`: speeds (rpm) of the sweep.
    """
    for mode, order in itertools.product(("contact", "gear", "average"), range(1, ORDERS + 1)):
        speed = 60 * found[mode] / (order * lobes)
        if speeds[0] <= speed <= speeds[-1]:
            yield {
                "mode": mode,
                "frequency_Hz": found[mode],
                "order": order,
                "speed_rpm": speed,
            }


def maxima(parts: tuple[Part, ...]) -> Iterator[Row]:
    """Yield a row for each local maximum of mean and peak force over speed."""
    for force in LABELS:
        values = np.array([part.evaluation.response.get(force, 0.0) for part in parts])
        for k in find_peaks(values, prominence=PROMINENCE * np.max(values))[0]:
            yield {
                "force": force,
                "speed_rpm": parts[k].speed_rpm,
                "value_N": values[k],
                "status": parts[k].evaluation.status.label,
            }


def objective(config: Config, one: Evaluation, baseline: Evaluation) -> float:
    """Return the objective at one speed, also for motions that are not periodic.

    The forces of such a motion are averages over a window. NaN without forces."""
    if not (one.response and baseline.response):
        return math.nan
    weights = objective_weights(config)
    return sum(w * one.response[k] / baseline.response[k] for k, w in weights.items())


@dataclasses.dataclass
class Study:
    """Results for one scene: sweeps and natural frequencies by design, optimisations, CIC's
    config."""

    config: Config
    designs: dict[str, tuple[Part, ...]]
    linear: dict[str, dict[str, float]]
    outcomes: list[Row]

    def over(self, parts: tuple[Part, ...], baseline: tuple[Part, ...] | None = None) -> np.ndarray:
        """Return the objective (n,) along a sweep, relative to a `baseline` sweep.

        `parts`: the sweep; `baseline`: by default the sweep of CIC."""
        pairs = zip(parts, baseline or self.designs["CIC"], strict=True)
        return np.array([objective(self.config, p.evaluation, b.evaluation) for p, b in pairs])


def swept(evaluator: Evaluator, speeds: Sequence[float], design=None) -> tuple[Part, ...]:
    """Evaluate a `design` (config units; default: the config's own) at each speed, from rest.

    `speeds` (rpm): each with an equal share."""
    points = [Point(evaluator.at_speed(speed), design) for speed in speeds]
    return parts_at([(speed, 1 / len(speeds)) for speed in speeds], evaluate_many(points))


def study(scene: str, speeds, listed, quick: bool) -> Study:
    """Sweep, optimise and linearise all pairs in one scene.

    `speeds`: speeds (rpm) of the sweep; `listed`: speeds (rpm) of the objective; `quick`: whether
    the run is reduced."""
    here = (*SCENES[scene], *(QUICK if quick else ()))
    evaluators = {f: evaluator_of(shipped(f, *here)) for f in ("cic", "ee")}
    found = Study(evaluators["cic"].config, {}, {}, [])
    for family, evaluator in evaluators.items():
        found.designs[family.upper()] = swept(evaluator, speeds)
        found.linear[family.upper()] = linearised(evaluator.pair(evaluator.config.design))
    for name, keys in list(OPTIMISED.items())[slice(1, 2) if quick else slice(None)]:
        over = (f"objective.speeds_rpm={list(listed)}", *keys) if keys else ()
        result = Search(shipped("cic", *here, *over)).run()
        outcome: Row = {"scene": scene, "optimised": name}
        if result.problem is not None and result.optimized is not None:
            design = np.array(list(result.optimized.design.values()))
            label, cic = f"CIC, optimised {name}", evaluators["cic"]
            found.linear[label] = linearised(cic.pair(design))
            found.designs[label] = swept(cic, speeds, design)
            along = found.over(found.designs[label])
            those = found.over(swept(cic, listed, design), swept(cic, listed))
            outcome |= result.optimized.design | {
                "own_objective": result.problem.objective(result.optimized),
                "at_3000_rpm": along[int(np.argmin(np.abs(np.asarray(speeds) - 3000)))],
                "worst_over_sweep": float(np.nanmax(along)),
                "share_of_speeds_better": float(np.mean(along < 1)),
                "mean_over_listed": float(np.mean(those)),
                "worst_over_listed": float(np.max(those)),
            }
        found.outcomes.append(outcome)
    return found


def over_speed(studies: dict[str, Study]) -> Figure:
    """Draw mean and peak force over speed, one column per scene."""
    made, axes = sheet(13, 7.4, 2, len(studies), sharex=True, sharey="row")
    *shown, _ = OPTIMISED
    labels = ["CIC", "EE", *(f"CIC, optimised {name}" for name in shown)]
    entries = {}
    for column, (scene, found) in enumerate(studies.items()):
        designs = {k: found.designs[k] for k in labels if k in found.designs}
        entries |= {entry.get_label(): entry for entry in legend_entries(designs)}
        for ax, force in zip(axes[:, column], LABELS, strict=True):
            plot_speeds(ax, designs, force)
        axes[0, column].set_title(TITLES[scene])
    for ax in axes.flat:
        ax.set_ylim(0, None)
    setp(axes[1], xlabel="speed (rpm)")
    made.legend(handles=list(entries.values()), loc="outside lower center", ncols=4, frameon=False)
    made.suptitle("Contact force over speed, from rest")
    return made


def objectives(studies: dict[str, Study], listed: Sequence[float]) -> Figure:
    """Draw the objective of the optimised designs over speed, relative to CIC at the same speed."""
    made, axes = sheet(13, 4.6, 1, len(studies), sharey=True)
    styles = dict(zip(OPTIMISED, ((GREEN, "-", "o"), (PURPLE, "--", "s"),
                                  (ORANGE, ":", "^")), strict=True))  # fmt: skip
    for ax, (scene, found) in zip(axes[0], studies.items(), strict=True):
        base = found.designs["CIC"]
        speeds = np.array([part.speed_rpm for part in base])
        for name, (color, dashes, marker) in styles.items():
            parts = found.designs.get(f"CIC, optimised {name}")
            if parts is None:
                continue
            values = found.over(parts)
            at = [3000.0] if name == "at 3000 rpm" else listed
            ax.plot(speeds, values, color=color, linestyle=dashes, label=f"optimised {name}")
            ax.plot(at, np.interp(at, speeds, values), marker, color=color, markersize=5)
            unsettled = np.array(
                [not (p.evaluation.usable and b.evaluation.usable)
                 for p, b in zip(parts, base, strict=True)]
            )  # fmt: skip
            ax.plot(speeds[unsettled], values[unsettled], "x", color=color, markersize=7)
        ax.axhline(1, color="black", linewidth=0.8, linestyle=":")
        ax.set(title=TITLES[scene], xlabel="speed (rpm)")
    axes[0, 0].set_ylabel("objective / CIC at the same speed")
    entries = axes[0, 0].get_legend_handles_labels()
    made.legend(*entries, loc="outside lower center", ncols=3, frameon=False)
    made.suptitle("Objective of each optimum at other speeds (markers: speeds of its objective)")
    return made


def resonances(studies: dict[str, Study], rows: list[Row], peaks: list[Row]) -> Figure:
    """Draw peak force over speed, with resonance crossings and maxima: shipped pairs, optimised
    CIC."""
    shown = {
        "CIC": BLUE,
        "EE": VERMILION,
        f"CIC, optimised {next(iter(OPTIMISED))}": SKY,
    }
    made, axes = sheet(13, 10.5, len(shown), len(studies), sharex=True)
    modes: dict[str, tuple[str, Any]] = {
        "contact": (GREEN, "--"), "gear": (PURPLE, ":"), "average": ("0.45", "-."),
    }  # fmt: skip
    for column, (scene, found) in enumerate(studies.items()):
        for ax, (name, color) in zip(axes[:, column], shown.items(), strict=True):
            if name not in found.designs:
                continue
            here = {"scene": scene, "design": name}.items()
            parts = found.designs[name]
            for line in plot_speeds(ax, {name: parts}, "peak_force_N").lines:
                line.set_color(color)
            ax.axhline(found.linear[name]["static_peak_N"], color="black", linewidth=0.9)
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
    setp(axes[-1], xlabel="speed (rpm)")
    black: dict[str, Any] = {"color": "black", "linestyle": ""}
    made.legend(
        handles=[
            *(Line2D([], [], label=f"k × mesh frequency = {mode} frequency", color=c, linestyle=d)
              for mode, (c, d) in modes.items()),
            Line2D([], [], label="peak at standstill", color="black", linewidth=0.9),
            Line2D([], [], label="local maximum", marker="v", markersize=5, **black),
            Line2D([], [], label="chaotic, or not settled (+)", marker="x", **black),
        ],
        loc="outside lower center", ncols=3, frameon=False,
    )  # fmt: skip
    made.suptitle("Peak force over speed; lines: harmonic k meets a natural frequency")
    return made


def run(job: Run) -> None:
    """Study all scenes; a reduced run takes one scene, few speeds and one short optimisation."""
    speeds = np.linspace(300, 6000, 5 if job.quick else 115).tolist()
    listed = (2000.0, 4000.0) if job.quick else tuple(np.arange(500.0, 6001.0, 500.0).tolist())
    studies: dict[str, Study] = {}
    tables: dict[str, list[Row]] = {"speed": [], "speed_resonances": [], "speed_maxima": []}
    rows, crossed, peaks = tables.values()
    for scene in list(SCENES)[: 1 if job.quick else None]:
        found = studies[scene] = study(scene, speeds, listed, job.quick)
        for name, parts in found.designs.items():
            here = {"scene": scene, "design": name}
            rows += [here | part.row(whole=True) for part in parts]
            across = crossings(found.linear[name], found.config.profile.lobes, speeds)
            crossed += [here | row for row in across]
            peaks += [here | row for row in maxima(parts)]
        job.say(f"{scene}: {len(found.designs)} designs at {len(speeds)} speeds")
    record = {
        "linearised": {scene: found.linear for scene, found in studies.items()},
        "optimisations": [row for found in studies.values() for row in found.outcomes],
        "statuses": Counter("{scene}, {design}, {status}".format(**row) for row in rows),
    }
    for name, table in tables.items():
        job.csv(f"{name}.csv", table)
    job.json("speed.json", record)
    job.figure("speed.png", over_speed(studies))
    job.figure("speed_objective.png", objectives(studies, listed))
    job.figure("speed_resonances.png", resonances(studies, crossed, peaks))
    print_record(record)
