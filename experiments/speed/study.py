"""Relates speed to contact force: sweeps, optimised designs, and natural frequencies.

The study sweeps mean and peak contact force over speed, each speed from rest. Designs: the shipped
CIC and EE pairs, and CIC optimised at 3000 rpm, over the range (weighted mean) and for its worst
speed. Scenes: the shipped scene, and a scene with less damping in the gear. The pair is linearised
for its natural frequencies. A *crossing* is a speed at which a harmonic of the mesh frequency
equals a natural frequency.
"""

import dataclasses
import math
import time
from collections import Counter

import jax
import jax.numpy as jnp
import numpy as np
from scipy.signal import find_peaks

from experiments._common.driver import Run
from experiments._common.scenes import shipped
from experiments._common.simulation import evaluator_of
from experiments._common.tables import Row, print_record
from rootsopt.config import Config
from rootsopt.dynamics.pair import RotorPair
from rootsopt.optimize.search import Search
from rootsopt.response.result import Evaluation, Part
from rootsopt.response.terms import objective_weights
from rootsopt.runtime.programs import CachedFunction
from rootsopt.scene import design_vector
from rootsopt.view.figures.sweep import LABELS

SCENES = {"shipped": (), "light": ("scene.timing_gear.damping_ratio=0.1",)}

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


def settings(scene: str, family: str, *more: str) -> Config:
    """Load the shipped config of a `family` in one of the scenes, with further overrides `more`."""
    return shipped(family, *SCENES[scene], *more)


@CachedFunction
def equilibria(pair: RotorPair, phases):
    """Find the static equilibria of a pair at `phases` (n,) of the mesh period, with rotor 1 fixed.

    Returns four arrays (n,): stiffness of the pair and of the flanks alone (N·m/rad), torque of the
    flanks (N·m), and contact force (N).
    """
    gear = pair.gear
    assert gear is not None
    still = jnp.asarray(0.0)

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
    """Find the natural frequencies (Hz) of a pair about its static equilibrium, with rotor 1 fixed.

    Keys of the result. `contact`: frequency of rotor 2 on the flanks, whose stiffness is averaged
    over the phases in which they carry most of the load; `contact_share`: share of these phases;
    `gear`: frequency of rotor 2 on the gear; `average`: mean over all phases of the local frequency
    on flanks and gear; `both_share`: share of the phases in which flanks and gear both carry;
    `static_peak_N`, `static_mean_N`: contact force.
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


def crossings(found: dict[str, float], lobes: int, speeds) -> list[Row]:
    """Find the crossings: speeds (rpm) at which a harmonic of the mesh frequency equals a natural
    frequency.

    `found`: result of `linearised`; `speeds`: speeds (rpm) of the sweep. Returns a row per
    crossing.
    """
    rows = []
    for mode in ("contact", "gear", "average"):
        for order in range(1, ORDERS + 1):
            speed = 60 * found[mode] / (order * lobes)
            if speeds[0] <= speed <= speeds[-1]:
                crossing = {"mode": mode, "frequency_Hz": found[mode], "order": order}
                rows.append(crossing | {"speed_rpm": speed})
    return rows


def maxima(parts: tuple[Part, ...], rows: list[Row]) -> list[Row]:
    """Find the local maxima of mean and peak force over speed.

    `rows`: crossings. Returns a row per maximum, with the nearest crossing."""
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
        base = self.designs["CIC"] if baseline is None else baseline
        pairs = zip(parts, base, strict=True)
        return np.array([objective(self.config, p.evaluation, b.evaluation) for p, b in pairs])


def study(scene: str, speeds, listed, quick: bool) -> Study:
    """Sweep, optimise and linearise all pairs in one scene.

    `speeds`: speeds (rpm) of the sweep; `listed`: speeds (rpm) of the objective; `quick`: whether
    the run is reduced."""
    small = QUICK if quick else ()
    evaluators = {f: evaluator_of(settings(scene, f, *small)) for f in ("cic", "ee")}
    found = Study(evaluators["cic"].config, {}, {}, [])
    for family, evaluator in evaluators.items():
        found.designs[family.upper()] = evaluator.swept(speeds)
        pair = evaluator.pair(design_vector(evaluator.config))
        found.linear[family.upper()] = linearised(pair)
    for name, keys in list(OPTIMISED.items())[slice(1, 2) if quick else slice(None)]:
        over = (f"objective.speeds_rpm={list(listed)}", *keys) if keys else ()
        began = time.perf_counter()
        result = Search(settings(scene, "cic", *small, *over)).run()
        outcome: Row = {"scene": scene, "optimised": name}
        if result.problem is not None and result.optimized is not None:
            design = np.array(list(result.optimized.design.values()))
            own = result.problem.objective(result.optimized)
            outcome |= result.optimized.design | {"own_objective": own}
            label = f"CIC, optimised {name}"
            found.linear[label] = linearised(evaluators["cic"].pair(jnp.asarray(design)))
            found.designs[label] = evaluators["cic"].swept(speeds, design)
            outcome |= worth(found.over(found.designs[label]), speeds)
            at = evaluators["cic"].swept(listed, design)
            those = found.over(at, evaluators["cic"].swept(listed))
            outcome |= {
                "mean_over_listed": float(np.mean(those)),
                "worst_over_listed": float(np.max(those)),
            }
        found.outcomes.append(outcome | {"seconds": time.perf_counter() - began})
    return found


def worth(along: np.ndarray, speeds) -> Row:
    """Return a summary of an objective (n,) over the speeds (rpm) of the sweep."""
    return {
        "at_3000_rpm": along[int(np.argmin(np.abs(np.asarray(speeds) - 3000)))],
        "mean_over_sweep": float(np.nanmean(along)),
        "worst_over_sweep": float(np.nanmax(along)),
        "worst_rpm": speeds[int(np.nanargmax(along))],
        "share_of_speeds_better": float(np.mean(along < 1)),
    }


def run(job: Run) -> None:
    """Study all scenes; a reduced run takes one scene, few speeds and one short optimisation."""
    from experiments.speed import figures

    speeds = np.linspace(300, 6000, 5 if job.quick else 115).tolist()
    listed = (2000.0, 4000.0) if job.quick else tuple(np.arange(500.0, 6001.0, 500.0).tolist())
    studies: dict[str, Study] = {}
    rows: list[Row] = []
    crossed: list[Row] = []
    peaks: list[Row] = []
    statuses = {}
    for scene in list(SCENES)[: 1 if job.quick else None]:
        found = studies[scene] = study(scene, speeds, listed, job.quick)
        for name, parts in found.designs.items():
            here = {"scene": scene, "design": name}
            rows += [here | part.row(whole=True) for part in parts]
            across = crossings(found.linear[name], found.config.profile.lobes, speeds)
            crossed += [here | row for row in across]
            peaks += [here | row for row in maxima(parts, across)]
            labels = (part.evaluation.status.label for part in parts)
            statuses[f"{scene}, {name}"] = dict(Counter(labels))
        job.say(f"{scene}: {len(found.designs)} designs at {len(speeds)} speeds")
    record = {
        "linearised": {scene: found.linear for scene, found in studies.items()},
        "optimisations": [row for found in studies.values() for row in found.outcomes],
        "statuses": statuses,
    }
    job.csv("speed.csv", rows)
    job.csv("speed_resonances.csv", crossed)
    job.csv("speed_maxima.csv", peaks)
    job.json("speed.json", record)
    job.figure("speed.png", figures.over_speed(studies))
    job.figure("speed_objective.png", figures.objectives(studies, listed))
    job.figure("speed_resonances.png", figures.resonances(studies, crossed, peaks))
    print_record(record)
