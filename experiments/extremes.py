"""Where solvers and precisions hold: scenes at and between the limits of every key.

    python experiments/extremes.py [-o DIR] [--quick] [--jobs 3]

1. Law: force and derivatives of every scene's contact law from no penetration to far beyond any,
   and the equation of motion with its derivatives in state and design, must be finite in either
   precision.
2. Motion: every scene is simulated from rest and must end in a finite result or in a named status.
3. Truth: a sample of those that ended periodic is closed again from the same state by dopri8 at
   1e-12 in double precision with contact by search, and by SciPy's DOP853 along that orbit. The
   relative deviation of mean and peak force must be below `ALLOWED` times the tolerance.
4. Public path: a sample goes through `Evaluator` from config to record, some with up to 1000
   revolutions.

Scenes are drawn by `experiments.extreme_scenes`. Writes extremes.csv (a row for each scene),
extremes.json (counts and worst deviations) and extremes.png; the exit status is 3 if a promise is
broken.
"""

import argparse
import dataclasses
import itertools
import math
import os
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

# As the commands do, before equinox is first imported.
os.environ.setdefault("EQX_ON_ERROR", "off")

from rootsopt.cli import use_cache, use_float64

use_float64()

import equinox as eqx  # noqa: E402
import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from scipy.integrate import solve_ivp  # noqa: E402

from experiments.extreme_scenes import Kind, cloud, grid, row_of, stacked  # noqa: E402
from experiments.extremes_plot import draw  # noqa: E402
from rootsopt import files  # noqa: E402
from rootsopt.batch import STATUSES, respond  # noqa: E402
from rootsopt.config import Config  # noqa: E402
from rootsopt.dynamics.flow import Integrator, flow, strobe  # noqa: E402
from rootsopt.dynamics.steady import close_orbit, force_rounding, no_tangents  # noqa: E402
from rootsopt.evaluate import Evaluator  # noqa: E402
from rootsopt.model import Model, design_vector  # noqa: E402
from rootsopt.programs import Program  # noqa: E402

HORIZON = 24
"""Mesh periods the transient may last in the mass of scenes."""
STEPS = 1024
"""Solver steps for a mesh period, there."""
ALLOWED = 100.0
"""Deviation of a force from the truth in units of the tolerance, relative to the greater of that
force and the static one; in single precision five roundings of the gap are added."""
CORNER = 1e-9
"""Tolerance below which deviations are not judged: a peak on a corner of the force is known to some
1e-8 only (docs/accuracy.md)."""
SINGLE = 2.4e-6
"""Tolerance that single precision holds."""
SHARP = "dopri8", 1e-12, 20_000
FEW = 50
"""Swings in a mesh period that SciPy, an explicit method in Python, is asked for at most."""
PATIENCE = 24
"""Mesh periods of plain motion where Newton's method does not close a reference."""
DEPTHS = np.concatenate([[-1e-3, 0.0], np.geomspace(1e-36, 1e-2, 39)])
RATES = np.concatenate([-np.geomspace(1e-9, 1e3, 7), [0.0], np.geomspace(1e-9, 1e3, 4)])
POSES = 4
"""Random states of each scene at which the equation of motion is looked at."""


@dataclasses.dataclass(frozen=True)
class Study:
    """How many scenes: `kinds` with the number of random ones, whether the grid is added, how
    many of each kind go to the reference, to SciPy and through the `Evaluator`, and how many
    with the long horizon (mesh periods)."""

    kinds: tuple[tuple[Kind, int], ...]
    gridded: bool
    references: int
    scipy: int
    evaluated: int
    long: int
    horizon: int = 3000


FULL = Study(
    kinds=(
        (Kind(), 2500),
        (Kind(precision="float32"), 2600),
        (Kind("kvaerno5"), 200),
        (Kind("dopri8"), 400),
        (Kind(lobes=2), 300),
        (Kind(lobes=6), 200),
        (Kind(family="ee"), 300),
        (Kind("kvaerno5", "float32"), 100),
        (Kind(fidelity="map", precision="float32"), 200),
        (Kind(lobes=4), 150),
        (Kind(lobes=5), 150),
        (Kind(geared=False), 150),
    ),
    gridded=True,
    references=30,
    scipy=4,
    evaluated=60,
    long=10,
)
QUICK = Study(
    kinds=((Kind(fidelity="linear"), 40),),
    gridded=False,
    references=0,
    scipy=3,
    evaluated=0,
    long=0,
)


@dataclasses.dataclass
class Case:
    """A scene and what became of it; `row` is its line of the table."""

    kind: Kind
    config: Config
    row: dict[str, Any]
    state: Any = None


# Promise 1: the law and the equation


@eqx.filter_jit
def _law_values(laws, depths, rates):
    def one(law):
        def at(depth, rate):
            slopes = jax.grad(lambda *x: x[0](*x[1:]), argnums=(0, 1, 2))(law, depth, rate)
            return jnp.stack([law(depth, rate), *jax.tree.leaves(slopes)])

        table = jax.vmap(lambda d: jax.vmap(lambda r: at(d, r))(rates))(depths)
        return jnp.sum(~jnp.isfinite(table)), jnp.sum(table[..., 0] < 0)

    return jax.lax.map(one, laws)


@eqx.filter_jit
def _equation_values(models: Model, designs, poses):
    def one(at):
        model, design, poses = at

        def slope(design, pose):
            pair = model.pair(design)
            scale = pair.angle_scale
            state = jnp.stack([pose[1], pose[2]]).astype(scale.dtype)
            found, contact = pair.derivative(pose[0].astype(scale.dtype), state)
            return jnp.append(found, contact.total)

        def all_of(pose):
            jacobians = jax.jacfwd(slope, argnums=(0, 1))(design, pose)
            return jnp.concatenate([slope(design, pose), *(x.ravel() for x in jacobians)])

        return jnp.sum(~jnp.isfinite(jax.vmap(all_of)(poses)))

    return jax.lax.map(one, (models, designs, poses))


def check_law(cases: list[Case]) -> dict[str, Any]:
    """Values of the law that are not finite, or negative, among all scenes."""
    laws = [jax.tree.map(np.asarray, Model.of(case.config).law) for case in cases]
    laws = jax.tree.map(lambda *leaves: np.stack(leaves), *laws)
    found: dict[str, Any] = {}
    for dtype in (np.float32, np.float64):
        single = jax.tree.map(lambda x: jnp.asarray(x, dtype), laws)  # noqa: B023
        bad, negative = _law_values(single, jnp.asarray(DEPTHS, dtype), jnp.asarray(RATES, dtype))
        found[np.dtype(dtype).name] = {
            "values": len(cases) * DEPTHS.size * RATES.size,
            "not_finite": int(np.sum(bad)),
            "negative": int(np.sum(negative)),
        }
    return found


def check_equation(cases: list[Case], seed: int) -> dict[str, Any]:
    """Values of the equation of motion, and of its derivatives in state and design, that are not
    finite: at random times, some static depths and plays to either side, at any speed."""
    draw = np.random.default_rng(seed)
    found: dict[str, Any] = {}
    groups: dict[tuple, list[Case]] = {}
    for case in cases:
        kind = case.kind
        shape = kind.family, kind.lobes, kind.geared, kind.fidelity
        groups.setdefault(shape, []).append(case)
    for (family, lobes, geared, fidelity), members in groups.items():
        if fidelity == "map" or lobes in (4, 5):
            continue
        configs = [case.config for case in members]
        designs = np.stack([np.asarray(design_vector(config)) for config in configs])
        size = np.exp(draw.uniform(np.log(1e-9), np.log(30), (2, len(members), POSES)))
        signed = size * draw.choice([-1, 1], size.shape)
        poses = np.stack([draw.uniform(0, 1, size.shape[1:]), signed[0], 100 * signed[1]], axis=-1)
        models = stacked(configs, "float64")
        for precision in ("float32", "float64"):
            bad = _equation_values(dataclasses.replace(models, precision=precision), designs, poses)
            name = f"{family} {lobes}{'' if geared else ' no gear'}, {precision}"
            found[name] = {"scenes": len(members), "not_finite": int(np.sum(bad))}
    return found


# Promise 2: the motion


@Program
def _simulate(model: Model, design, tolerances, method: str):
    pair = model.pair(design)
    transient, orbit = (Integrator(method, tolerances[k], STEPS) for k in range(2))
    out = respond(model, design, jnp.zeros(2), transient, orbit, HORIZON)
    assert pair.pace is not None
    swings = pair.mesh_period / (2 * jnp.pi * pair.pace.swing)
    # Share of the static penetration that is lost in rounding.
    rounding = jnp.finfo(pair.angle_scale.dtype).eps * model.pitch_radius
    return out, swings, rounding / pair.law.depth_at(pair.force_scale), pair.force_scale


def _arguments(case: Case) -> tuple[Any, ...]:
    model = jax.tree.map(np.asarray, Model.of(case.config))
    solver = case.config.solver
    tolerances = np.array([solver.transient_rtol, solver.rtol])
    return model, np.asarray(design_vector(case.config)), tolerances, case.kind.method


def simulate(case: Case) -> None:
    """Simulate a scene from rest and complete its row."""
    arguments = _arguments(case)
    began = time.perf_counter()
    found = _simulate(*arguments)
    out, swings, rounding, force = jax.device_get(found)
    status = STATUSES[int(out.status)]
    numbers = np.concatenate([np.ravel(out.response), np.ravel(out.gradient)])
    mean, peak, rms = map(float, out.response)
    case.state = np.asarray(out.state, np.float64)
    case.row |= {
        "seconds": time.perf_counter() - began,
        "steps": int(out.steps),
        "swings": float(swings),
        "gap_rounding": float(rounding),
        "static_force_N": float(force),
        "status": status.label,
        "period": int(out.period),
        "multiplier": float(out.multiplier),
        "mean_force_N": mean,
        "peak_force_N": peak,
        "rms_force_N": rms,
        # What is called a result is finite, and nothing else looks like one.
        "named": bool(np.all(np.isfinite(numbers)) if status.usable else np.all(np.isnan(numbers))),
    }


# Promise 3: the truth


@Program
def _sharp(model: Model, design, state, period):
    method, rtol, steps = SHARP
    pair = model.pair(design)
    how = Integrator(method, jnp.asarray(rtol), steps)
    orbit = close_orbit(pair, no_tangents(pair), state, period, how)
    return orbit._replace(flow=orbit.flow._replace(grid=jnp.zeros(0)))


@Program
def _patient(model: Model, design, state, period):
    """The last round of plain motion, without Newton's method, and the state it begins with."""
    method, rtol, steps = SHARP
    pair = model.pair(design)
    how = Integrator(method, jnp.asarray(100 * rtol), steps)
    states = strobe(pair, state, PATIENCE, how).states
    last = states[PATIENCE - 1 - period]
    out = flow(pair, last, period.astype(float), how, 2520, no_tangents(pair))
    return out._replace(grid=jnp.zeros(0)), last


@eqx.filter_jit
def _equation(model: Model, design):
    return model.pair(design)


@eqx.filter_jit
def _rates(pair, tau, state):
    slope, contact = pair.derivative(tau, state)
    return jnp.append(slope, contact.total / pair.force_scale)


def refine(case: Case) -> None:
    """Deviation of a periodic result from the orbit that the sharp settings find beside it."""
    model = dataclasses.replace(Model.of(case.config), precision="float64", fidelity="search")
    design = np.asarray(design_vector(case.config))
    period = np.asarray(case.row["period"])
    orbit = jax.device_get(_sharp(model, design, case.state, period))
    closed = bool(orbit.flow.solved) and float(orbit.residual) < 1e-9
    state, numbers = orbit.state, orbit.response[:3]
    if not closed:
        out, state = jax.device_get(_patient(model, design, case.state, period))
        closed = bool(out.solved) and float(np.max(np.abs(out.end - state))) < 1e-4
        numbers = np.array([out.mean, out.mean_square, out.peak])
    mean, square, peak = numbers
    truth = np.array([mean, peak, np.sqrt(square)])
    names = ("mean_force_N", "peak_force_N", "rms_force_N")
    found = np.array([case.row[name] for name in names])
    off = np.abs(found - truth) / np.maximum(truth, case.row["static_force_N"])
    allowed = ALLOWED * max(case.config.solver.rtol, CORNER)
    if case.kind.precision == "float32":
        # Of the reference's gap in double; single rounds 2^29 times as coarsely.
        rounding = 2**29 * float(force_rounding(orbit, model.law.exponent, model.pitch_radius))
        allowed = ALLOWED * max(case.config.solver.rtol, SINGLE) + 5 * rounding
    case.row |= {
        "reference": "closed" if closed else "not closed",
        "reference_mean_N": float(mean),
        "reference_peak_N": float(peak),
        "mean_off": float(off[0]),
        "peak_off": float(off[1]),
        "moved": float(np.max(np.abs(state - case.state))),
        "reference_multiplier": float(orbit.multiplier),
        "share_of_allowed": float(max(off[:2]) / allowed),
    }
    case.state = np.asarray(state)


def by_scipy(case: Case) -> None:
    """Along the orbit (that of the reference, if there is one): how far SciPy's end is from its
    start, and its mean force."""
    fidelity = "search" if "reference" in case.row else case.kind.fidelity
    model = dataclasses.replace(Model.of(case.config), precision="float64", fidelity=fidelity)
    pair = _equation(model, design_vector(case.config))
    period = case.row["period"]
    done = solve_ivp(
        lambda tau, y: np.asarray(_rates(pair, tau, y[:2])),
        (0.0, float(period)),
        np.append(case.state, 0.0),
        method="DOP853",
        rtol=1e-11,
        atol=1e-11,
        max_step=1 / 32,
    )
    mean = done.y[2, -1] / period * float(pair.force_scale)
    truth = case.row.get("reference_mean_N", case.row["mean_force_N"])
    case.row |= {
        "scipy_end": float(np.max(np.abs(done.y[:2, -1] - case.state))),
        "scipy_mean_off": abs(mean - truth) / (truth if truth > 0 else 1.0),
    }


# Promise 4: the public path


def evaluate(case: Case, evaluator: Evaluator) -> None:
    """Simulate a scene as the commands do."""
    began = time.perf_counter()
    evaluation = evaluator(series=False)
    record = evaluation.record()
    numbers = [*record["response"].values()]
    numbers += [x for row in record["gradient"].values() for x in row.values()]
    case.row |= {
        "evaluator_status": record["status"],
        "evaluator_seconds": time.perf_counter() - began,
        "evaluator_periods": int(record["statistics"]["transient_mesh_periods"]),
        "evaluator_mean_N": record["response"].get("mean_force_N", math.nan),
        "named": bool(case.row["named"] and np.all(np.isfinite(numbers))),
    }


def evaluator_of(config: Config, horizon: int) -> Evaluator:
    """An evaluator of a config with a transient of at most `horizon` mesh periods."""
    changes = {"max_mesh_periods": horizon, "max_steps_per_period": STEPS}
    solver = config.solver.model_copy(update=changes)
    return Evaluator(config.model_copy(update={"solver": solver}))


# The study


def run(
    study: Study, jobs: int, say: Callable[[str], None], keep: Callable[[list[Case]], None]
) -> tuple[list[Case], dict[str, Any]]:
    """All scenes with their rows, kept after every stage, and the finite values of law and
    equation."""
    cases: list[Case] = []
    for kind, count in study.kinds:
        configs: Iterable[Config] = cloud(kind, count, seed=0)
        if study.gridded and kind == Kind():
            configs = itertools.chain(configs, grid(kind))
        cases += [
            Case(kind, c, {"kind": kind.label, **dataclasses.asdict(kind), **row_of(c)})
            for c in configs
        ]
    say(f"{len(cases)} scenes")
    checks = {"law": check_law(cases), "equation": check_equation(cases, seed=1)}
    say(f"law and equation: {checks}")

    def each(what: str, task: Callable[[Case], None], chosen: list[Case]) -> None:
        began = time.perf_counter()
        with ThreadPoolExecutor(jobs) as pool:
            for done, _ in enumerate(pool.map(task, chosen), 1):
                if done % 200 == 0:
                    say(f"{what}: {done} of {len(chosen)}")
        say(f"{what}: {len(chosen)} in {time.perf_counter() - began:.0f} s")

    # The next kind's program is made while scenes of this one are simulated.
    first = [next(case for case in cases if case.kind == kind) for kind, _ in study.kinds]
    for number, (kind, _) in enumerate(study.kinds):
        for case in first[number : number + 2]:
            _simulate.prepare(*_arguments(case))
        each(kind.label, simulate, [case for case in cases if case.kind == kind])
        keep(cases)
    picked: list[Case] = []
    compared: list[Case] = []
    for kind, _ in study.kinds:
        if kind.lobes in (4, 5, 6) or not kind.geared:
            continue  # The reference needs programs of its own for each.
        mine = [case for case in cases if case.kind == kind]
        good = [case for case in mine if case.row["status"] == "periodic"]
        picked += good[: study.references]
        compared += [case for case in good if case.row["swings"] < FEW][: study.scipy]
    each("reference", refine, picked)
    keep(cases)
    each("scipy", by_scipy, compared)
    for kind, _ in study.kinds[: 2 if study.evaluated else 0]:
        mine = [case for case in cases if case.kind == kind][: study.evaluated]
        for place, case in enumerate(mine):
            horizon = study.horizon if place < study.long else 8 * HORIZON
            evaluate(case, evaluator_of(case.config, horizon))
    return cases, checks


def summary_of(cases: list[Case], checks: dict[str, Any]) -> dict[str, Any]:
    """Counts of each status, worst deviations, and what broke a promise."""
    rows = [case.row for case in cases]
    kinds = dict.fromkeys(row["kind"] for row in rows)
    judged = [row for row in rows if row.get("reference") == "closed"]
    table = {}
    for kind in kinds:
        mine = [row for row in rows if row["kind"] == kind]
        closed = [row for row in judged if row["kind"] == kind]
        table[kind] = {
            "scenes": len(mine),
            "status": dict(Counter(row["status"] for row in mine)),
            "longest_s": max(row["seconds"] for row in mine),
            "compared": len(closed),
            "reference_not_closed": sum(
                row["kind"] == kind and row.get("reference") == "not closed" for row in rows
            ),
            "beyond_allowed": sum(row["share_of_allowed"] > 1 for row in closed),
            "worst_share_of_allowed": max((r["share_of_allowed"] for r in closed), default=None),
            "worst_mean_off": max((row["mean_off"] for row in closed), default=None),
            "worst_peak_off": max((row["peak_off"] for row in closed), default=None),
        }
    counts = [*checks["law"].values(), *checks["equation"].values()]
    scipy = [row for row in rows if "scipy_end" in row]
    public = [row for row in rows if "evaluator_status" in row]
    return {
        "scenes": len(rows),
        "kinds": table,
        "checks": checks,
        "unnamed": sum(not row["named"] for row in rows),
        "not_finite": sum(count["not_finite"] for count in counts),
        "compared": len(judged),
        "beyond_allowed": sum(row["share_of_allowed"] > 1 for row in judged),
        "scipy": {
            "compared": len(scipy),
            "worst_end": max((row["scipy_end"] for row in scipy), default=None),
            "worst_mean_off": max((row["scipy_mean_off"] for row in scipy), default=None),
        },
        "evaluator": {
            "scenes": len(public),
            "status": dict(Counter(row["evaluator_status"] for row in public)),
            "longest_s": max((row["evaluator_seconds"] for row in public), default=None),
            "most_mesh_periods": max((row["evaluator_periods"] for row in public), default=None),
        },
    }


def main() -> int:
    arguments = argparse.ArgumentParser(description="Where solvers and precisions hold.")
    arguments.add_argument("-o", "--output", type=Path, default=Path("results/extremes"))
    arguments.add_argument("--quick", action="store_true", help="a few scenes of one kind")
    arguments.add_argument("--jobs", type=int, default=2, help="scenes simulated side by side")
    options = arguments.parse_args()
    use_cache()
    folder = files.ResultFolder(options.output)
    began = time.perf_counter()

    def say(text: str) -> None:
        print(f"{time.perf_counter() - began:7.0f} s  {text}", flush=True)

    def keep(cases: list[Case]) -> None:
        keys = list(dict.fromkeys(key for case in cases for key in case.row))
        columns = {key: [case.row.get(key, "") for case in cases] for key in keys}
        folder.write_csv("extremes.csv", columns)

    cases, checks = run(QUICK if options.quick else FULL, options.jobs, say, keep)
    keep(cases)
    summary = summary_of(cases, checks)
    folder.write_json("extremes.json", summary)
    draw([case.row for case in cases], ALLOWED, SINGLE, options.output / "extremes.png")
    for kind, found in summary["kinds"].items():
        print(kind, found)
    broken = {key: summary[key] for key in ("unnamed", "not_finite", "beyond_allowed")}
    print(broken)
    return 3 if any(broken.values()) else 0


if __name__ == "__main__":
    sys.exit(main())
