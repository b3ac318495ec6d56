"""Speed and memory beside two competitors, in one run on one machine.

    python experiments/benchmark.py [-o DIR] [--quick] [--gpu]

The shipped CIC scene, every tool at the cheapest setting that gives mean and peak force to 1e-3:
(a) SciPy with node-to-segment contact, (b) the pair compiled by Numba, both with
central differences, (c) rootsopt, one design and batches; (d) gap table and its Jacobian,
(e) cost over revolutions and batch size, memory of a long reverse-mode gradient, (f) the main
job from a cold process, without compiled programs and with them, (g) large batches on a GPU.

Each part runs in a process of its own (`--part NAME`, which prints JSON), so that its peak memory
is its own. Build, compile and run are timed apart, and the error reached stands beside the time.
Writes benchmark.csv, benchmark.json and benchmark.png, and ends with the table of targets.
"""

import argparse
import dataclasses
import functools
import json
import math
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

# As the commands do, before equinox is first imported.
os.environ.setdefault("EQX_ON_ERROR", "off")

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter
from rich.console import Console
from rich.table import Table

from experiments.baselines import FD_STEPS, Scene, Simulator
from experiments.baselines.scipy_nodes import NODES_1E3, ScipyNodes
from rootsopt import files
from rootsopt.config import load

CONFIG = "configs/cic.yaml"
BASELINE = (36.43, 9.0, 4.0)
FORCES = ("mean_force_N", "peak_force_N")
ACCURACY = 1e-3
"""Of mean and peak force."""
GRADIENT_ACCURACY = 0.1
"""Of the gradient where one is asked for: the competitors' differences are good to some 0.05 at
settings whose forces are good to `ACCURACY`, and no setting may be worse than that for speed."""
REFERENCE_RTOL = 1e-11
REFERENCE_STEPS = tuple(step / 5 for step in FD_STEPS)
"""Steps (deg, mm, deg) of the reference's central differences: truncation some 1e-5."""
CHECKED = 8
"""Designs of a batch whose reference is computed."""
SIZES = (16, 256, 1024)
GPU_SIZES = (256, 4096, 16384, 65536)
REVOLUTIONS = (1, 4, 15, 55, 200)
MESH_PERIODS = 3
"""In a revolution, for three lobes."""
BATCH_SECONDS = 150.0
"""A batch expected to take longer than this, all its runs together, is not run."""
CONTACTS = {
    "search": ("solver.fidelity=search",),
    "map 384x16": ("solver.fidelity=map", "solver.map_rolls=384", "solver.map_relatives=16"),
    "map 192x12": ("solver.fidelity=map", "solver.map_rolls=192", "solver.map_relatives=12"),
    "linear": ("solver.fidelity=linear",),
}
TOLERANCES = ((1e-4, 1e-4), (1e-5, 1e-5), (1e-6, 1e-6), (1e-5, 1e-6), (1e-7, 1e-7))
"""Of orbit and transient."""
ORBIT_ACCURACY = 1e-6
"""Of mean and peak force, where orbit and transient are compared."""
ORBIT_TOLERANCES = (1e-6, 1e-7, 1e-8, 1e-9)
ORBIT_SETTLES = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64, 96, 128, 192, 256)
ORBIT_SCENES = {
    "shipped": (),
    "forgets slowly": ("scene.timing_gear.damping_ratio=0.02", "scene.load.torque_N_m=2"),
}
MB = 1e-6

Row = dict[str, Any]


@dataclasses.dataclass(frozen=True)
class Job:
    """What a part is told: the part, whether it is quick, a batch size, and what earlier
    parts have found."""

    part: str
    quick: bool
    size: int
    known: dict[str, Any]

    @property
    def contacts(self) -> tuple[str, ...]:
        """Contacts to choose from, from coarse to fine."""
        return ("linear",) if self.quick else ("map 192x12", "map 384x16", "search")


# Measuring


def ready(result: Any) -> Any:
    """The result, once it is there."""
    import jax

    return jax.block_until_ready(result)


def median_time(
    call: Callable[[], Any], repeats: int, at_most: float = math.inf
) -> tuple[float, Any]:
    """Median seconds of a call and its result; stops repeating after `at_most` seconds."""
    times: list[float] = []
    result = None
    while not times or (len(times) < repeats and sum(times) < at_most):
        began = time.perf_counter()
        result = call()
        times.append(time.perf_counter() - began)
    return statistics.median(times), result


def first_and_warm(
    call: Callable[[], Any], repeats: int, at_most: float = math.inf
) -> tuple[float, float, Any]:
    """Seconds of compilation (first call less a warm one) and of a warm call, and the result."""
    first, _ = median_time(call, 1)
    warm, result = median_time(call, repeats, at_most)
    return max(first - warm, 0.0), warm, result


def peak_memory() -> float:
    """Greatest resident memory (MB) of this process so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 * MB


def forces_of(response: dict[str, float]) -> list[float]:
    return [response.get(key, math.nan) for key in FORCES]


def slopes_of(gradient: dict[str, dict[str, float]]) -> list[list[float]]:
    return [list(gradient[key].values()) if key in gradient else [math.nan] * 3 for key in FORCES]


def value_error(forces: Any, truth: Any) -> float:
    """Greatest relative error of mean and peak force."""
    return float(np.max(np.abs(np.asarray(forces) / np.asarray(truth) - 1)))


def gradient_error(slopes: Any, truth: Any) -> float:
    """Greatest error of a gradient relative to the greatest entry of its force."""
    slopes, truth = np.asarray(slopes), np.asarray(truth)
    off = np.abs(slopes - truth).max(axis=-1) / np.abs(truth).max(axis=-1)
    return float(np.max(off))


def row(tool: str, what: str, seconds: float, **more: Any) -> Row:
    """One line of the result: `seconds` a call for `designs` designs."""
    designs = more.pop("designs", 1)
    start: Row = {"tool": tool, "what": what, "designs": designs, "run_s": seconds}
    return start | {"per_design_ms": 1e3 * seconds / designs} | more


# rootsopt


def use_jax(gpu: bool = False) -> None:
    """Double precision, on the processor unless told otherwise."""
    from rootsopt.cli import use_float64

    use_float64()
    if gpu:
        import jax

        jax.config.update("jax_platforms", None)


def at(evaluator: Any, rtol: float, transient: float) -> Any:
    """The same evaluator at other tolerances; nothing is compiled anew."""
    import jax.numpy as jnp

    evaluator.orbit = dataclasses.replace(evaluator.orbit, rtol=jnp.asarray(rtol))
    evaluator.transient = dataclasses.replace(evaluator.transient, rtol=jnp.asarray(transient))
    return evaluator


def sample_designs(count: int) -> np.ndarray:
    """Designs (count, 3) around the baseline, which comes first; smaller samples are the
    beginnings of larger ones."""
    share = np.random.default_rng(0).random((count, 3))
    angle, tip = BASELINE[0] + 4 * share[:, 0] - 2, BASELINE[2] + 2 * share[:, 1] - 1
    longest = 33.0 * np.sin(np.radians(angle)) * np.radians(30.0 - tip)
    designs = np.stack([angle, (0.8 + 0.18 * share[:, 2]) * longest, tip], axis=1)
    designs[0] = BASELINE
    return designs


def part_reference(job: Job) -> dict[str, Any]:
    """Forces by the tightest settings, at the baseline and checked designs; gradients by central
    differences of them, which owe nothing to how rootsopt differentiates."""
    use_jax()
    from rootsopt.evaluate import Evaluator

    choice = ("solver.method=tsit5",) if job.quick else ("solver.method=dopri8",)
    tool = Evaluator(load(CONFIG, [*CONTACTS[job.contacts[-1]], *choice]))
    loose = at(tool, 1e-10, 1e-8)(series=False)
    at(tool, REFERENCE_RTOL, 1e-8)
    designs = sample_designs(2 if job.quick else CHECKED)
    found = [tool(design, series=False) for design in designs]
    if not all(one.usable for one in found):
        raise SystemExit(f"the reference ended as {[one.status.label for one in found]}")

    def differences(design: np.ndarray, start: Any) -> list[list[float]]:
        columns = []
        for i, step in enumerate(REFERENCE_STEPS):
            moved = np.eye(3)[i] * step
            ends = [tool(design + sign * moved, start, series=False) for sign in (1, -1)]
            forces = [np.array(forces_of(end.response)) for end in ends]
            columns.append((forces[0] - forces[1]) / (2 * step))
        return np.stack(columns, axis=1).tolist()

    forces = [forces_of(one.response) for one in found]
    slopes = [differences(x, one.state) for x, one in zip(designs, found, strict=True)]
    off = [
        gradient_error(slopes_of(one.gradient), slope)
        for one, slope in zip(found, slopes, strict=True)
    ]
    return {
        "forces": forces,
        "slopes": slopes,
        "designs": designs.tolist(),
        "error": value_error(forces_of(loose.response), forces[0]),
        "error_of_differentiation": off,
    }


def part_single(job: Job) -> dict[str, Any]:
    """One design through `Evaluator`: the cheapest setting that is good enough, and the
    default one; then the same through the traceable `respond`, value alone too."""
    use_jax()
    import equinox as eqx
    import jax.numpy as jnp

    from rootsopt.batch import respond
    from rootsopt.evaluate import Evaluator
    from rootsopt.model import integrators

    truth, slope = job.known["forces"][0], job.known["slopes"][0]
    repeats = 2 if job.quick else 9
    tried, tools, compiling = [], {}, {}
    for contact in job.contacts:
        tools[contact] = tool = Evaluator(load(CONFIG, CONTACTS[contact]))
        call = functools.partial(tool, series=False)
        compiling[contact], _, _ = first_and_warm(call, 1)
        for rtol, coarse in TOLERANCES[1:2] if job.quick else TOLERANCES:
            at(tool, rtol, coarse)
            tool(series=False)
            seconds, found = median_time(call, 3)
            off = value_error(forces_of(found.response), truth) if found.usable else math.nan
            by = gradient_error(slopes_of(found.gradient), slope)
            tried.append([contact, rtol, coarse, seconds, off, by, found.status.label])
    good = [one for one in tried if one[4] <= ACCURACY] or tried
    fine = [one for one in good if one[5] <= GRADIENT_ACCURACY] or good
    value_only, choice = (min(x, key=lambda one: one[3])[:3] for x in (good, fine))

    def evaluated(name: str, contact: str, rtol: float, coarse: float) -> Row:
        tool = at(tools[contact], rtol, coarse)
        seconds, found = median_time(lambda: tool(series=False), repeats)
        return row(
            f"rootsopt, {name}",
            "value+gradient",
            seconds,
            compile_s=compiling[contact],
            value_error=value_error(forces_of(found.response), truth),
            gradient_error=gradient_error(slopes_of(found.gradient), slope),
            settings=f"{contact}, rtol {rtol:g}, transient {coarse:g}",
            note="Evaluator: checks settlement, closes the orbit, reports stability",
        )

    solver = load(CONFIG).solver
    usual = "linear" if job.quick else "search"
    default = evaluated("default", usual, solver.rtol, solver.transient_rtol)
    rows = [default, evaluated("cheapest", *choice)]
    design, state = jnp.asarray(BASELINE), jnp.zeros(2)
    compiled = eqx.filter_jit(respond)
    for gradient in () if job.quick else (False, True):
        contact, rtol, coarse = choice if gradient else value_only
        tool = tools[contact]
        how = [
            dataclasses.replace(one, rtol=jnp.asarray(value))
            for one, value in zip(integrators(tool.config), (coarse, rtol), strict=True)
        ]
        call = functools.partial(compiled, tool.model, design, state, *how, gradient=gradient)
        extra, seconds, out = first_and_warm(lambda call=call: ready(call()), repeats)
        off = gradient_error(out.gradient[:2], slope) if gradient else None
        rows.append(
            row(
                "rootsopt, one program",
                "value+gradient" if gradient else "value",
                seconds,
                compile_s=extra,
                value_error=value_error(np.asarray(out.response)[[0, 1]], truth),
                gradient_error=off,
                settings=f"{contact}, rtol {rtol:g}, transient {coarse:g}",
                note="batch.respond: settlement checked, orbit closed, no second attempts",
            )
        )
    # A little deeper, for designs that dip deeper than the baseline.
    deepest = {name: 1.1 * float(tool.model.deepest) for name, tool in tools.items()}
    return {"rows": rows, "tried": tried, "choice": choice, "deepest": deepest}


def part_batch(job: Job) -> dict[str, Any]:
    """Designs around the baseline through `respond_many`, each from rest. The first batch looks
    for the setting that is good enough at the least cost; later ones keep to it."""
    use_jax(gpu=job.part == "gpu")
    import jax
    import jax.numpy as jnp

    from rootsopt.batch import respond_many
    from rootsopt.model import Model, integrators
    from rootsopt.timing import CompileClock

    if job.part == "gpu" and jax.default_backend() != "gpu":
        return {"rows": [], "note": "no GPU found"}
    designs, states = jnp.asarray(sample_designs(job.size)), jnp.zeros((job.size, 2))
    checked = min(len(job.known["forces"]), job.size)
    truth, slope = (np.asarray(job.known[key])[:checked] for key in ("forces", "slopes"))

    def run(contact: str, rtol: float, coarse: float, gradient: bool) -> Any:
        config = load(CONFIG, CONTACTS[contact])
        transient, orbit = integrators(config)
        how = (
            dataclasses.replace(transient, rtol=jnp.asarray(coarse)),
            dataclasses.replace(orbit, rtol=jnp.asarray(rtol)),
        )
        model = Model.of(config, job.known["deepest"][contact])
        return ready(respond_many(model, designs, states, *how, gradient=gradient))

    def looked_at(out: Any) -> tuple[int, float, list[float]]:
        """Usable designs, and errors of the checked ones among them: the greatest of the
        forces, each of the gradients."""
        usable = np.asarray(out.usable)[:checked]
        forces = np.asarray(out.response)[:checked, :2][usable]
        found = np.asarray(out.gradient)[:checked, :2][usable]
        off = value_error(forces, truth[usable]) if usable.any() else math.nan
        pairs = zip(found, slope[usable], strict=True) if found.size else ()
        return int(out.usable.sum()), off, [gradient_error(*pair) for pair in pairs]

    def choose() -> tuple[str, float, float]:
        """Cheapest contact and tolerance at which all designs settle and are good enough; the
        finest where there is none."""
        contacts = job.contacts[job.contacts.index(job.known["choice"][0]) :]
        for contact in contacts:
            run(contact, *TOLERANCES[1], True)
            for pair in TOLERANCES[1:2] if job.quick else TOLERANCES[1:]:
                call = functools.partial(run, contact, *pair, True)
                seconds, out = median_time(call, 2)
                tried.append([contact, *pair, seconds, *looked_at(out)])
            good = [
                one
                for one in tried
                if one[4] == job.size
                and one[5] <= ACCURACY
                and np.median(one[6]) <= GRADIENT_ACCURACY
            ]
            if good:
                return tuple(min(good, key=lambda one: one[3])[:3])
        return contacts[-1], *TOLERANCES[-1]

    tried: list[list[Any]] = []
    contact, rtol, coarse = job.known.get("batch_setting") or choose()
    repeats = 1 if job.quick else 5
    rows = []
    for gradient in (True,) if job.quick else (True, False):
        call = functools.partial(run, contact, rtol, coarse, gradient)
        with CompileClock() as clock:
            call()
        seconds, out = median_time(call, repeats, BATCH_SECONDS / 8)
        usable, off, by = looked_at(out)
        outside = int(np.sum(np.asarray(out.deepest) < job.known["deepest"][contact]))
        rows.append(
            row(
                f"rootsopt, batch of {job.size}" + (" (GPU)" if job.part == "gpu" else ""),
                "value+gradient" if gradient else "value",
                seconds,
                designs=job.size,
                # Compiled before, where this batch was the one to choose.
                compile_s=clock.seconds if not (tried and gradient) else None,
                value_error=off,
                # Where the peak falls on a corner of the force a gradient may fail: the typical
                # design counts, and the note tells the worst.
                gradient_error=float(np.median(by)) if by else None,
                settings=f"{contact}, rtol {rtol:g}, transient {coarse:g}",
                note=f"{usable} of {job.size} periodic"
                + (f", worst gradient error {max(by):.2g}" if by else "")
                + (f", {outside} beyond the map" if "map" in contact and outside else ""),
            )
        )
    return {
        "rows": rows,
        "batch_setting": (contact, rtol, coarse),
        "batch_tried": tried or job.known["batch_tried"],
    }


def part_table(job: Job) -> dict[str, Any]:
    """Gap table of one design and its Jacobian, compiled."""
    use_jax()
    import jax
    import jax.numpy as jnp

    from rootsopt.contact.map import MapContact
    from rootsopt.model import Model

    config = load(CONFIG)
    model = Model.of(config, job.known["deepest"].get("map 384x16"))
    rolls, relatives = (64, 12) if job.quick else model.map_size
    size = f"{rolls}x{relatives}"

    def table(design: Any) -> Any:
        return MapContact.of(model.profile(design), model.deepest, rolls, relatives).coefficients

    rows = []
    for what, function in (("gap table", table), ("table and Jacobian", None)):
        call = jax.jit(function or (lambda x: (table(x), jax.jacfwd(table)(x))))
        design = jnp.asarray(BASELINE)
        extra, seconds, _ = first_and_warm(
            lambda call=call, design=design: ready(call(design)), 3 if job.quick else 21
        )
        rows.append(row("rootsopt", what, seconds, compile_s=extra, settings=size))
    return {"rows": rows}


def part_orbit(job: Job) -> dict[str, Any]:
    """Value and gradient on the orbit, which starts from that of a neighbouring design, beside
    averaging after the transient, both right to `ORBIT_ACCURACY`, on one processor core."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    use_jax()
    import jax.numpy as jnp
    from baselines.transient import averaged

    from rootsopt.evaluate import Evaluator

    contact = CONTACTS["linear" if job.quick else "search"]
    wanted = 1e-4 if job.quick else ORBIT_ACCURACY
    design = jnp.asarray(BASELINE)
    repeats = 3 if job.quick else 15
    rows = []
    for scene, changes in list(ORBIT_SCENES.items())[: 1 if job.quick else None]:
        tool = Evaluator(load(CONFIG, [*contact, *changes]))
        truth = at(tool, 1e-11, 1e-9)(series=False)
        forces, slopes = forces_of(truth.response), slopes_of(truth.gradient)
        forgets = f"multiplier {truth.steady_state['floquet_multiplier']:.2g}"
        tried: list[Row] = []
        for rtol in ORBIT_TOLERANCES:
            at(tool, rtol, rtol)
            neighbour = tool(design * 1.002, series=False).state
            evaluate = functools.partial(tool, design, neighbour, series=False)
            seconds, found = median_time(evaluate, repeats)
            off = value_error(forces_of(found.response), forces)
            by = gradient_error(slopes_of(found.gradient), slopes)
            more = {"settings": f"rtol {rtol:g}", "value_error": off, "gradient_error": by}
            tried.append(row("orbit", f"value+gradient, {scene}", seconds, note=forgets, **more))
        best = [one for one in tried if one["value_error"] <= wanted]
        rows.append(min(best or tried[-1:], key=lambda one: one["run_s"]))
        tried = []
        for rtol in ORBIT_TOLERANCES:
            how = dataclasses.replace(tool.orbit, rtol=jnp.asarray(rtol))
            for settle in ORBIT_SETTLES[: 4 if job.quick else None]:
                call = functools.partial(averaged, tool.model, design, jnp.asarray(settle), how)
                found = ready(call())
                off = value_error(found[0], forces)
                if off <= wanted or settle == ORBIT_SETTLES[-1]:
                    by = gradient_error(found[1], slopes)
                    seconds, _ = median_time(lambda call=call: ready(call()), repeats)
                    settings = f"rtol {rtol:g}, {settle} + 1 mesh periods"
                    more = {"settings": settings, "value_error": off, "gradient_error": by}
                    what = f"value+gradient, {scene}"
                    tried.append(row("transient", what, seconds, note=forgets, **more))
                    break
        best = [one for one in tried if one["value_error"] <= wanted]
        if tried:
            rows.append(min(best or tried[-1:], key=lambda one: one["run_s"]))
    return {"rows": rows}


def part_revolutions(job: Job) -> dict[str, Any]:
    """Plain integration from rest over more and more revolutions."""
    use_jax()
    import equinox as eqx
    import jax.numpy as jnp

    from rootsopt.dynamics.flow import strobe
    from rootsopt.model import Model, integrators

    contact = "linear" if job.quick else "search"
    config = load(CONFIG, CONTACTS[contact])
    model = Model.of(config, job.known["deepest"].get(contact))
    pair = eqx.filter_jit(Model.pair)(model, jnp.asarray(BASELINE))
    how = integrators(config)[0]
    compiled = eqx.filter_jit(strobe)
    rows = []
    for count in REVOLUTIONS[:2] if job.quick else REVOLUTIONS:
        call = functools.partial(compiled, pair, jnp.zeros(2), MESH_PERIODS * count, how)
        extra, seconds, out = first_and_warm(lambda call=call: ready(call()), 5, 10.0)
        rows.append(
            row(
                "rootsopt",
                f"{count} revolutions",
                seconds,
                compile_s=extra,
                revolutions=count,
                settings=f"{contact}, rtol {float(how.rtol):g}",
                note=f"{int(out.steps)} steps, {'solved' if bool(out.solved) else 'failed'}",
            )
        )
    return {"rows": rows}


def part_reverse(job: Job) -> dict[str, Any]:
    """Reverse-mode gradient of the mean force over 200 revolutions, with checkpoints."""
    use_jax()
    import diffrax
    import equinox as eqx
    import jax
    import jax.numpy as jnp

    from rootsopt.dynamics.flow import Integrator, flow
    from rootsopt.model import Model

    contact = "linear" if job.quick else "search"
    config = load(CONFIG, CONTACTS[contact])
    model = Model.of(config, job.known["deepest"].get(contact))
    count = 3 if job.quick else 200
    periods = count * MESH_PERIODS
    how = Integrator(config.solver.method, jnp.asarray(1e-6), 200 * periods)
    before = peak_memory()

    def mean(design: Any) -> Any:
        adjoint = diffrax.RecursiveCheckpointAdjoint()
        start = jnp.zeros(2)
        out = flow(model.pair(design), start, jnp.asarray(float(periods)), how, 16, adjoint=adjoint)
        return out.mean, (out.steps, out.solved)

    compiled = eqx.filter_jit(jax.value_and_grad(mean, has_aux=True))
    call = functools.partial(compiled, jnp.asarray(BASELINE))
    extra, seconds, out = first_and_warm(lambda: ready(call()), 1)
    (value, (steps, solved)), slope = out
    memory = peak_memory()
    near = gradient_error(np.asarray(slope), job.known["slopes"][0][0])
    state = "solved" if bool(solved) else "failed"
    return {
        "rows": [
            row(
                "rootsopt",
                f"reverse over {count} revolutions",
                seconds,
                compile_s=extra,
                revolutions=count,
                value_error=abs(float(value) / job.known["forces"][0][0] - 1),
                gradient_error=near,
                settings=f"{contact}, rtol 1e-06",
                note=f"mean force from rest, {int(steps)} steps, {state}; "
                f"{memory - before:.0f} MB above the imports; errors against the closed orbit",
            )
        ]
    }


# Competitors


def tuned(
    make: Callable[..., Simulator], settings: Sequence[dict[str, Any]], truth: Any
) -> tuple[dict[str, Any], Simulator]:
    """The fastest of `settings` that is good enough at the baseline, or the best."""
    tried = []
    for one in settings:
        tool = make(**one)
        tool.simulate(BASELINE)
        seconds, found = median_time(lambda tool=tool: tool.simulate(BASELINE), 3)
        tried.append((value_error(found.response[:2], truth), seconds, one, tool))
    good = [one for one in tried if one[0] <= ACCURACY]
    best = min(good, key=lambda one: one[1]) if good else min(tried, key=lambda one: one[0])
    return best[2], best[3]


def competitor_rows(
    name: str, tool: Simulator, settings: dict[str, Any], job: Job, more: Row, repeats: int
) -> list[Row]:
    """Value, then value and gradient, of a competitor."""
    truth, slope = job.known["forces"][0], job.known["slopes"][0]
    text = ", ".join(f"{key} {value}" for key, value in settings.items())
    seconds, found = median_time(lambda: tool.simulate(BASELINE), repeats)
    off = value_error(found.response[:2], truth)
    told = f"told to settle {settings.get('settle', 4)} mesh periods; no check"
    rows = [row(name, "value", seconds, value_error=off, settings=text, note=told, **more)]
    best: tuple[float, float] | None = None
    for factor in (1.0, 3.0):
        steps = [factor * step for step in FD_STEPS]
        _, slopes = tool.gradient(BASELINE, steps)
        by = gradient_error(slopes[:2], slope)
        best = min(best or (math.inf, 0.0), (by, factor))
    assert best is not None
    steps = [best[1] * step for step in FD_STEPS]
    seconds, _ = median_time(lambda: tool.gradient(BASELINE, steps), repeats)
    told = f"{told}; central differences, steps x {best[1]:g}"
    shared: Row = {"value_error": off, "gradient_error": best[0], "settings": text, "note": told}
    rows.append(row(name, "value+gradient", seconds, **shared, **more))
    return rows


def part_scipy(job: Job) -> dict[str, Any]:
    """(a): LSODA and DOP853."""
    scene = Scene.of(load(CONFIG))
    rows = []
    choices = {
        "LSODA": [NODES_1E3],
        "DOP853": [
            {"method": "DOP853", "nodes": 800, "rtol": rtol, "settle": 1}
            for rtol in (1e-3, 3e-4, 1e-4, 1e-5)
        ],
    }
    for method, settings in list(choices.items())[: 1 if job.quick else 2]:
        used, tool = tuned(functools.partial(ScipyNodes, scene), settings, job.known["forces"][0])
        name = f"(a) SciPy {method}"
        rows += competitor_rows(name, tool, used, job, {}, 1 if job.quick else 5)
    return {"rows": rows}


def part_numba(job: Job) -> dict[str, Any]:
    """(b): search and map, with few and with four periods to settle; and the setting whose
    gradient is good to 1e-3."""
    from experiments.baselines import motion_of, rotor_of
    from experiments.baselines import numba_pair as numba

    scene, repeats = Scene.of(load(CONFIG)), 5 if job.quick else 51
    four = {"settle": 4}
    cases = {
        "(b) Numba search": numba.SEARCH_1E3,
        "(b) Numba map": numba.MAP_1E3,
        "(b) Numba search, settle 4": numba.SEARCH_1E3 | four,
        "(b) Numba map, settle 4": numba.MAP_1E3 | four,
        "(b) Numba search, gradient to 1e-3": numba.SEARCH_GRADIENT_1E3,
    }
    rows = []
    for name, settings in cases.items():
        tool, more = numba.NumbaPair(scene, **settings), {}
        extra, _, _ = first_and_warm(functools.partial(tool.simulate, BASELINE), 3)
        if tool.contact == "map":
            tool = tool.fitted(BASELINE)
            rotor = rotor_of(scene, BASELINE)
            deepest = tool.deepest or -motion_of(scene, 1e-6).angle_limit
            build = functools.partial(numba.tabulate, rotor, deepest, tool.rolls, tool.relatives)
            more["build_s"] = median_time(build, 5)[0]
        more["compile_s"] = extra if "settle" not in name and "gradient" not in name else None
        rows += competitor_rows(name, tool, settings, job, more, repeats)
    return {"rows": rows}


PARTS: dict[str, Callable[[Job], dict[str, Any]]] = {
    "reference": part_reference,
    "scipy": part_scipy,
    "numba": part_numba,
    "single": part_single,
    "batch": part_batch,
    "orbit": part_orbit,
    "table": part_table,
    "revolutions": part_revolutions,
    "reverse": part_reverse,
    "gpu": part_batch,
}


# The run


def say(text: str) -> None:
    """Progress."""
    print(text, file=sys.stderr, flush=True)


def timed_child(
    command: list[str], environment: dict[str, str], log: Path
) -> tuple[float, float, int]:
    """Wall seconds, peak memory (MB) and exit code of a process."""
    began = time.perf_counter()
    with open(log, "wb") as sink:
        child = subprocess.Popen(command, env=environment, stdout=sink, stderr=sink)
        _, status, usage = os.wait4(child.pid, 0)
    # wait4 has reaped it behind Popen's back.
    child.returncode = os.waitstatus_to_exitcode(status)
    return time.perf_counter() - began, usage.ru_maxrss * 1024 * MB, child.returncode


class Run:
    """Runs the parts one after the other and gathers their rows and findings."""

    def __init__(self, quick: bool, scratch: Path):
        self.quick, self.scratch = quick, scratch
        self.rows: list[Row] = []
        self.known: dict[str, Any] = {"deepest": {}}
        self.failed: dict[str, str] = {}
        self.began = time.perf_counter()

    def part(self, name: str, size: int = 0) -> bool:
        """Run a part in its own process; whether it gave a result."""
        said = name + (f" {size}" if size else "")
        state, out, log = (self.scratch / one for one in ("known.json", "out.json", "log.txt"))
        state.write_text(json.dumps(self.known))
        out.unlink(missing_ok=True)
        command = [sys.executable, __file__, "--part", name, "--size", str(size)]
        command += ["--known", str(state), "--result", str(out)] + ["--quick"] * self.quick
        seconds, memory, code = timed_child(command, dict(os.environ), log)
        if code != 0 or not out.exists():
            tail = log.read_text(errors="replace").strip().splitlines()
            self.failed[said] = tail[-1] if tail else f"exit code {code}"
            say(f"{said} failed after {seconds:.0f} s: {self.failed[said]}")
            return False
        found = json.loads(out.read_text())
        for one in found.pop("rows", []):
            self.rows.append({"part": said, **one, "peak_memory_MB": memory})
        self.known |= found
        say(f"{said}: {seconds:.0f} s ({time.perf_counter() - self.began:.0f} s in all)")
        return True

    def batches(self, name: str, sizes: Sequence[int]) -> None:
        """Batches from small to large, as long as they can be expected to end in time."""
        for size in sizes:
            before = [r for r in self.rows if r["part"].startswith(f"{name} ")]
            # Each is run at least twice.
            expected = sum(2e-3 * r["per_design_ms"] * size for r in before[-2:])
            if expected > BATCH_SECONDS:
                self.failed[f"{name} {size}"] = f"not run: {expected:.0f} s expected"
                say(f"{name} {size} {self.failed[f'{name} {size}']}")
            elif not self.part(name, size):
                break

    def main_job(self) -> None:
        """The main job from a cold process: no cache, an empty one, a filled one."""
        job, options = "rootsopt.optimize", []
        cases = ["cold", "filling the cache", "cached"]
        if self.quick:
            job, cases, options = "rootsopt.profile", cases[2:], ["--no-figures"]
        environment = os.environ | {"ROOTSOPT_CACHE": str(self.scratch / "cache")}
        for case in cases:
            folder = self.scratch / case.split()[0]
            command = [sys.executable, "-m", job, CONFIG, "-o", str(folder), *options]
            command += ["--no-cache"] * (case == "cold")
            seconds, memory, code = timed_child(command, environment, self.scratch / "log.txt")
            one = row("rootsopt", f"{job.split('.')[1]}, {case}", seconds, note=f"exit {code}")
            self.rows.append({"part": "main job", **one, "peak_memory_MB": memory})
            if code != 0:
                self.failed[f"main job, {case}"] = f"exit code {code}"
            say(f"main job, {case}: {seconds:.1f} s")


def exponent(points: Sequence[tuple[float, float]]) -> float | None:
    """Slope of log time over log size; None for fewer than two points."""
    if len(points) < 2:
        return None
    x, y = np.log(np.array(points)).T
    return float(np.polyfit(x, y, 1)[0])


@dataclasses.dataclass(frozen=True)
class Lookup:
    """Figures of the finished run by tool and task."""

    rows: list[Row]

    def best(self, tool: str, what: str) -> Row | None:
        """Fastest row of a tool whose name begins so, of those that are good enough."""
        rows = [r for r in self.rows if r["tool"].startswith(tool) and r["what"] == what]
        fine = [
            r
            for r in rows
            if (r.get("value_error") or 0.0) <= ACCURACY
            and (r.get("gradient_error") or 0.0) <= GRADIENT_ACCURACY
        ]
        return min(fine, key=lambda r: r["per_design_ms"], default=None)

    def ratio(self, slow: tuple[str, str], fast: tuple[str, str]) -> float | None:
        """Time of one over time of the other, a design."""
        one, other = self.best(*slow), self.best(*fast)
        return one["per_design_ms"] / other["per_design_ms"] if one and other else None

    def seconds(self, what: str) -> float | None:
        found = [r["run_s"] for r in self.rows if r["what"].endswith(what)]
        return found[0] if found else None

    def revolutions(self) -> list[tuple[float, float]]:
        rows = [r for r in self.rows if r["part"] == "revolutions"]
        return [(r["revolutions"], r["run_s"]) for r in rows]

    def batches(self, what: str, part: str = "batch") -> list[tuple[float, float]]:
        rows = [r for r in self.rows if r["part"].startswith(f"{part} ") and r["what"] == what]
        return [(r["designs"], r["run_s"]) for r in rows]


def targets(rows: list[Row]) -> list[Row]:
    """What was aimed at, with the figure reached; `reached` is None where not measured."""
    look = Lookup(rows)
    both, value, one, many = "value+gradient", "value", "rootsopt, ", "rootsopt, batch of 256"
    single = Lookup([r for r in rows if r["part"] == "single" or r["tool"].startswith("(")])
    reverse = [r for r in rows if r["part"] == "reverse"]
    orbit = next((r for r in rows if r["tool"] == "orbit"), None)
    limits = (
        ("value + gradient, times faster than (a)", ">=", 200.0,
         single.ratio(("(a)", both), (one, both)), "one design"),
        ("the same in a batch of 256", ">=", 200.0,
         look.ratio(("(a)", both), (many, both)), "per design"),
        ("value + gradient, times faster than (b)", ">=", 1.0,
         single.ratio(("(b)", both), (one, both)), "one design"),
        ("the same in a batch of 256", ">=", 1.0,
         look.ratio(("(b)", both), (many, both)), "per design"),
        ("one value, time in units of (b)'s", "<=", 3.0,
         single.ratio((one, value), ("(b)", value)), "one design"),
        ("a value in a batch of 256, in units of (b)'s", "<=", 1.0,
         look.ratio((many, value), ("(b)", value)), "per design"),
        ("value + gradient on the orbit (ms)", "<=", 50.0,
         milli(orbit["run_s"]) if orbit else None, "to 1e-6, one core"),
        ("gap table (ms)", "<", 10.0, milli(look.seconds("gap table")), "one design"),
        ("gap table and Jacobian (ms)", "<", 40.0, milli(look.seconds("Jacobian")), "one design"),
        ("exponent of cost over revolutions", "<=", 1.1,
         exponent(look.revolutions()), "1 is linear"),
        ("exponent of cost over batch size", "<=", 1.1,
         exponent(look.batches(both)), "value + gradient"),
        ("memory of reverse mode, 200 revolutions (MB)", "<", 1000.0,
         reverse[0]["peak_memory_MB"] if reverse else None, "whole process"),
        ("main job, cold process (s)", "<=", 20.0, look.seconds(", cold"), "no cache"),
        ("main job, programs cached (s)", "<=", 8.0, look.seconds(", cached"), "second run"),
    )  # fmt: skip
    compare = {">=": lambda x, y: x >= y, "<=": lambda x, y: x <= y, "<": lambda x, y: x < y}
    return [
        {
            "target": name,
            "limit": f"{sign} {limit:g}",
            "figure": figure,
            "reached": None if figure is None else bool(compare[sign](figure, limit)),
            "note": note,
        }
        for name, sign, limit, figure, note in limits
    ]


def milli(seconds: float | None) -> float | None:
    return None if seconds is None else 1e3 * seconds


# Report

BLUE, ORANGE, GREEN = "#0072B2", "#E69F00", "#009E73"
COLUMNS = (
    "part",
    "tool",
    "what",
    "designs",
    "per_design_ms",
    "run_s",
    "build_s",
    "compile_s",
    "value_error",
    "gradient_error",
    "peak_memory_MB",
    "settings",
    "note",
)


def figure_of(rows: list[Row]) -> Figure:
    """Time per design by tool; time over revolutions; time over batch size."""
    figure = Figure(figsize=(15, 5.6), layout="constrained")
    FigureCanvasAgg(figure)
    bars, turns, batches = figure.subplots(1, 3, width_ratios=(1.5, 1, 1))
    look = Lookup(rows)
    timed = [r for r in rows if r["what"] in ("value", "value+gradient")]
    names = list(dict.fromkeys(r["tool"] for r in timed))
    for shift, (what, color) in enumerate((("value", ORANGE), ("value+gradient", BLUE))):
        chosen = [r for r in timed if r["what"] == what]
        place = [names.index(r["tool"]) + 0.38 * (shift - 0.5) for r in chosen]
        label = what.replace("+", " + ")
        bars.barh(place, [r["per_design_ms"] for r in chosen], 0.36, color=color, label=label)
        for y, r in zip(place, chosen, strict=True):
            bars.annotate(
                short(r["per_design_ms"]), (r["per_design_ms"], y), (3, 0),
                textcoords="offset points", va="center", fontsize=7,
            )  # fmt: skip
    bars.set_yticks(range(len(names)), names, fontsize=8)
    bars.invert_yaxis()
    bars.margins(x=0.15)
    bars.set(xscale="log", xlabel="time per design, warm (ms)")
    bars.legend(fontsize=8, loc="lower right")
    draw_power(turns, look.revolutions(), "from rest, no statistics", BLUE, "o")
    turns.set(xlabel="revolutions", ylabel="time (s)")
    for what, color, mark in (("value", ORANGE, "s"), ("value+gradient", BLUE, "o")):
        draw_power(batches, look.batches(what), what.replace("+", " + "), color, mark)
        draw_power(batches, look.batches(what, "gpu"), f"{what}, GPU", GREEN, mark)
    batches.set(xlabel="designs in a batch", ylabel="time of the batch (s)")
    for ax in (turns, batches):
        ax.set(xscale="log", yscale="log")
        for axis in (ax.xaxis, ax.yaxis):
            axis.set_major_formatter("{x:g}")
            axis.set_minor_formatter(NullFormatter())
        if ax.lines:
            ax.legend(fontsize=8)
    for ax in (bars, turns, batches):
        ax.grid(True, axis="x" if ax is bars else "both", color="0.9", lw=0.6)
        ax.set_axisbelow(True)
    figure.suptitle(f"Shipped CIC scene; mean and peak force to {ACCURACY:g}", fontsize=11)
    return figure


def short(value: float) -> str:
    """Two digits, without a power of ten."""
    return f"{value:.0f}" if value >= 100 else f"{value:.2g}"


def draw_power(
    ax: Any, points: list[tuple[float, float]], label: str, color: str, mark: str
) -> None:
    """Points of a cost with the exponent of their fit."""
    if not points:
        return
    slope = exponent(points)
    name = label if slope is None else f"{label}: exponent {slope:.2f}"
    ax.plot(*zip(*points, strict=True), marker=mark, color=color, lw=1.4, label=name)


def show(title: str, rows: list[Row], columns: Sequence[str]) -> None:
    """Table on standard output."""
    table = Table(title=title)
    for key in columns:
        words = key in ("part", "tool", "what", "settings", "note", "target")
        table.add_column(key.replace("_", " "), justify="left" if words else "right")
    for one in rows:
        table.add_row(*(cell(one.get(key)) for key in columns))
    Console(width=250).print(table)


def cell(value: Any) -> str:
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return "-"
    if isinstance(value, bool):
        return "reached" if value else "missed"
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def whole(options: argparse.Namespace) -> int:
    """Run all parts, write and print."""
    folder = files.ResultFolder(options.output)
    with tempfile.TemporaryDirectory() as scratch:
        run = Run(options.quick, Path(scratch))
        if not run.part("reference"):
            return 3
        for name in ("scipy", "numba", "single"):
            run.part(name)
        if "choice" in run.known:
            run.batches("batch", (4,) if options.quick else SIZES)
        for name in ("table", "revolutions"):
            run.part(name)
        for name in ("orbit", "reverse"):
            if options.quick:
                run.failed[name] = "left out of a quick run"
            else:
                run.part(name)
        run.main_job()
        if options.gpu and "choice" in run.known:
            run.batches("gpu", GPU_SIZES)
    goals = targets(run.rows)
    # Columns in their usual order; what only some rows have comes last.
    keys = dict.fromkeys([*COLUMNS, *(key for one in run.rows for key in one)])
    folder.write_csv("benchmark.csv", files.row_columns(run.rows, keys))
    folder.write_json(
        "benchmark.json",
        {
            "rows": run.rows,
            "targets": goals,
            "not_measured": run.failed,
            "reference": run.known,
            "quick": options.quick,
            "processors": os.cpu_count(),
            "versions": files.versions(),
        },
    )
    folder.write_figure("benchmark.png", figure_of(run.rows))
    show("Benchmark", run.rows, COLUMNS)
    for name, reason in run.failed.items():
        print(f"not measured: {name}: {reason}")
    show("Targets", goals, ("target", "limit", "figure", "reached", "note"))
    print(f"{time.perf_counter() - run.began:.0f} s; written to {options.output}")
    return 0


def main() -> int:
    arguments = argparse.ArgumentParser(description="Speed and memory beside two competitors.")
    arguments.add_argument("-o", "--output", type=Path, default=Path("results/benchmark"))
    arguments.add_argument(
        "--quick", action="store_true", help="coarse contact, small sizes, as in the tests"
    )
    arguments.add_argument("--gpu", action="store_true", help="large batches on a GPU as well")
    inner = arguments.add_argument_group("used by the script itself, for one part's process")
    inner.add_argument("--part", choices=PARTS)
    inner.add_argument("--size", type=int, default=0)
    inner.add_argument("--known", type=Path)
    inner.add_argument("--result", type=Path)
    options = arguments.parse_args()
    if options.part is None:
        return whole(options)
    known = json.loads(options.known.read_text())
    result = PARTS[options.part](Job(options.part, options.quick, options.size, known))
    files.ResultFolder(options.result.parent).write_json(options.result.name, result)
    return 0


if __name__ == "__main__":
    sys.exit(main())
