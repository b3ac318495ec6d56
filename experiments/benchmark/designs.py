"""One design and batches of designs, computed by rootsopt."""

import dataclasses
import functools
import os
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from experiments._common.batch import batches_of, compiled, rest_of, solver_of
from experiments._common.driver import NoResultError
from experiments._common.engines import FD_STEPS, central_differences
from experiments._common.scenes import CIC
from experiments._common.simulation import at, errors_of, evaluator_of, numbers_of
from experiments._common.tables import Row
from experiments._common.timing import first_and_warm, median_time, ready
from experiments.benchmark.job import (
    ACCURACY,
    BASELINE,
    BATCH_SECONDS,
    GRADIENT_ACCURACY,
    Job,
    row,
    sample_designs,
)
from rootsopt.config import load
from rootsopt.dynamics.flow import one_period, strobe
from rootsopt.dynamics.integrator import Integrator
from rootsopt.scene import Scene
from rootsopt.status import Status

REFERENCE_RTOL = 1e-11

# Steps (deg, mm, deg) of the reference's central differences; their truncation error is 1e-5.
REFERENCE_STEPS = tuple(step / 5 for step in FD_STEPS)

# Number of designs of a batch that are compared with a reference.
CHECKED = 8

# Tolerances (orbit, transient) to choose from, in the order in which they are tried.
TOLERANCES = ((1e-4, 1e-4), (1e-5, 1e-5), (1e-6, 1e-6), (1e-5, 1e-6), (1e-7, 1e-7))


def part_reference(job: Job) -> dict[str, Any]:
    """Compute the reference at the tightest settings, at the baseline and the checked designs.

    Gradients are central differences of its forces, so they do not use rootsopt's differentiation.
    """
    method = "tsit5" if job.quick else "dopri8"
    tool = at(evaluator_of(load(CIC, [f"solver.method={method}"])), REFERENCE_RTOL, 1e-8)
    designs = sample_designs(2 if job.quick else CHECKED)
    found = [tool(design, series=False) for design in designs]
    if not all(one.usable for one in found):
        raise NoResultError(f"the reference ended as {[one.status.label for one in found]}")
    truth = [
        central_differences(
            lambda x, near=one.state: numbers_of(tool(x, near, series=False))[0],
            design.tolist(),
            REFERENCE_STEPS,
        )
        for design, one in zip(designs, found, strict=True)
    ]
    forces, slopes = map(np.array, zip(*truth, strict=True))
    return {"forces": forces, "slopes": slopes}


def cheapest(tried: list[Row]) -> Row:
    """Return the fastest row with exact forces and gradients, else the fastest with exact forces,
    else the fastest."""
    good = [one for one in tried if one["value_error"] <= ACCURACY] or tried
    good = [one for one in good if one["gradient_error"] <= GRADIENT_ACCURACY] or good
    return min(good, key=lambda one: one["run_s"])


def setting_of(rtol: float, transient: float) -> str:
    """Name the tolerances of orbit and transient."""
    return f"rtol {rtol:g}, transient {transient:g}"


def part_single(job: Job) -> dict[str, Any]:
    """Time one design with `Evaluator`, at the cheapest sufficient setting and at the default.

    `steady_response` as one program is timed too, with and without gradient.
    """
    truth, repeats = tuple(x[0] for x in job.truth(1)), 2 if job.quick else 9
    usual = evaluator_of(load(CIC))
    compiling, _, _ = first_and_warm(functools.partial(usual, series=False), 1)
    solver = usual.config.solver

    def evaluated(rtol: float, transient: float) -> Row:
        call = functools.partial(at(usual, rtol, transient), series=False)
        seconds, found = median_time(call, repeats)
        return row(
            "rootsopt, default",
            "value+gradient",
            seconds,
            compile_s=compiling,
            **errors_of(numbers_of(found), truth),
            settings=setting_of(rtol, transient),
            note="Evaluator: checks settlement, closes the orbit, reports stability",
        )

    choices = {setting_of(*pair): pair for pair in TOLERANCES[: 1 if job.quick else None]}
    best = cheapest([evaluated(*pair) for pair in choices.values()])
    rows = [evaluated(solver.orbit_tolerance, solver.transient_tolerance)]
    rows.append(best | {"tool": "rootsopt, cheapest"})
    scene = at(usual, *choices[best["settings"]]).scene
    rest = rest_of(scene, BASELINE)
    for what in () if job.quick else ("value", "value+gradient"):
        solve = compiled(solver_of(scene, what != "value"))
        call = functools.partial(solve, jnp.asarray(BASELINE), rest)
        extra, seconds, found = first_and_warm(call, repeats)
        more = errors_of(found[:2], truth) | {"compile_s": extra, "settings": best["settings"]}
        note = "steady_response: settlement checked, orbit closed"
        rows.append(row("rootsopt, one program", what, seconds, note=note, **more))
    return {"rows": rows}


def part_batch(job: Job) -> dict[str, Any]:
    """Time a batch of designs around the baseline, each from rest.

    The first batch searches for the cheapest sufficient setting; later batches reuse this setting.
    """
    usual, designs = evaluator_of(load(CIC)), sample_designs(job.size)
    setting = job.known.get("batch_setting")

    def timed(pair: tuple[float, float], gradient: bool, repeats: int) -> Row:
        scene = at(usual, *pair).scene
        rest = rest_of(scene, BASELINE)
        # The last way uses all cores of a CPU.
        *_, (call, known) = batches_of(solver_of(scene, gradient), designs, rest)
        call(rest)
        call = functools.partial(call, rest)
        seconds, found = median_time(call, repeats, BATCH_SECONDS / 8)
        periodic = found[2] == Status.PERIODIC.code
        forces, slopes = job.truth(job.size)
        each = [
            errors_of((found[0][k], found[1][k] if gradient else None), (forces[k], slopes[k]))
            for k in np.flatnonzero(periodic[: len(forces)])
        ]
        # Where the peak falls on a corner of the force, a gradient may fail. The median counts.
        kinds = {"value_error": np.max, "gradient_error": np.median}
        errors = {key: float(kinds[key]([one[key] for one in each])) for key in each[0]}
        return row(
            f"rootsopt, batch of {job.size}",
            "value+gradient" if gradient else "value",
            seconds,
            designs=job.size,
            compile_s=known["compile_s"],
            **errors,
            settings=setting_of(*pair),
            periodic=int(periodic.sum()),
        )

    if setting is None:
        choices = {setting_of(*pair): pair for pair in TOLERANCES[1 : 2 if job.quick else None]}
        tried = [timed(pair, True, 2) for pair in choices.values()]
        complete = [one for one in tried if one["periodic"] == job.size] or tried
        setting = choices[cheapest(complete)["settings"]]
    gradients = (True,) if job.quick else (True, False)
    rows = [timed(setting, gradient, 1 if job.quick else 5) for gradient in gradients]
    return {"rows": rows, "batch_setting": setting}


REVOLUTIONS = (1, 4, 15, 55, 200)

# Mesh periods per revolution, for three lobes.
MESH_PERIODS = 3

# Relative error of mean and peak force at which orbit and transient are compared.
ORBIT_ACCURACY = 1e-6
ORBIT_TOLERANCES = (1e-6, 1e-7, 1e-8, 1e-9)
ORBIT_SETTLES = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64, 96, 128, 192, 256)
ORBIT_SCENES = {
    "shipped": (),
    "forgets slowly": ("scene.timing_gear.damping_ratio=0.02", "scene.load.torque_N_m=2"),
}


def part_orbit(job: Job) -> dict[str, Any]:
    """Time forces with gradient by a closed orbit, and by averaging after a transient.

    The orbit is closed from the state of a neighbouring design's orbit. Both methods are accurate
    to `ORBIT_ACCURACY` and run on one processor core.
    """
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    design, rows = jnp.asarray(BASELINE), []
    for scene, changes in ORBIT_SCENES.items():
        tool = evaluator_of(load(CIC, list(changes)))
        exact = at(tool, 1e-11, 1e-9)(series=False)
        forgets = f"multiplier {exact.steady_state['floquet_multiplier']:.2g}"
        truth, what = numbers_of(exact), f"value+gradient, {scene}"
        tried: list[Row] = []
        for rtol in ORBIT_TOLERANCES:
            here = at(tool, rtol, rtol)
            neighbour = here(design * 1.002, series=False).start
            call = functools.partial(here, design, neighbour, series=False)
            seconds, found = median_time(call, 15)
            more = {"note": forgets, "settings": f"rtol {rtol:g}"}
            tried.append(row("orbit", what, seconds, **more, **errors_of(numbers_of(found), truth)))
            how = dataclasses.replace(tool.scene.solver.orbit, rtol=jnp.asarray(rtol))
            for settle in ORBIT_SETTLES:
                call = functools.partial(averaged, tool.scene, design, jnp.asarray(settle), how)
                error = errors_of((ready(call())[0], None), truth)["value_error"]
                if error <= ORBIT_ACCURACY or settle == ORBIT_SETTLES[-1]:
                    seconds, found = median_time(lambda call=call: ready(call()), 15)
                    more["settings"] += f", {settle} + 1 mesh periods"
                    tried.append(row("transient", what, seconds, **more, **errors_of(found, truth)))
                    break
        for method in ("orbit", "transient"):
            every = [one for one in tried if one["tool"] == method]
            best = [one for one in every if one["value_error"] <= ORBIT_ACCURACY]
            rows.append(min(best or every[-1:], key=lambda one: one["run_s"]))
    return {"rows": rows}


def part_revolutions(job: Job) -> dict[str, Any]:
    """Time plain integration from rest over an increasing number of revolutions."""
    config = load(CIC)
    pair, how = evaluator_of(config).pair(BASELINE), Scene.from_config(config).solver.transient
    program = eqx.filter_jit(strobe)
    rows = []
    for count in REVOLUTIONS[:2] if job.quick else REVOLUTIONS:
        call = functools.partial(program, pair, jnp.zeros(2), MESH_PERIODS * count, how)
        extra, seconds, out = first_and_warm(lambda call=call: ready(call()), 5, 10.0)
        more = {"compile_s": extra, "revolutions": count, "settings": f"rtol {float(how.rtol):g}"}
        note = f"{int(out.steps)} steps, {'solved' if bool(out.solved) else 'failed'}"
        rows.append(row("rootsopt", f"{count} revolutions", seconds, note=note, **more))
    return {"rows": rows}


@eqx.filter_jit
def averaged(model: Scene, design: Any, settle: Any, how: Integrator) -> tuple[Any, Any]:
    """Average the contact force over one mesh period, after a transient of `settle` mesh periods.

    The motion starts from rest. Returns (mean, peak) in N, and their derivatives (2, d) in N per
    config unit, which are carried along throughout. `how`: integrator.
    """

    def forces(design: Any) -> tuple[Any, Any]:
        pair = model.pair(design)
        state = lax.fori_loop(
            0, settle, lambda _, state: strobe(pair, state, 1, how).states[-1], jnp.zeros(2)
        )
        found = one_period(pair, state, how).response[::2]
        return found, found

    slopes, found = jax.jacfwd(forces, has_aux=True)(design)
    return found, slopes
