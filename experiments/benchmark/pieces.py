"""Time the pieces of one evaluation: orbit, integration."""

import dataclasses
import functools
import os
from typing import Any

from experiments._common.driver import start_process
from experiments._common.scenes import CIC
from experiments._common.timing import first_and_warm, median_time, ready
from experiments.benchmark.job import (
    BASELINE,
    Job,
    Row,
    forces_of,
    gradient_error,
    row,
    slopes_of,
    value_error,
)
from rootsopt.config import load

REVOLUTIONS = (1, 4, 15, 55, 200)
MESH_PERIODS = 3
"""Mesh periods per revolution, for three lobes."""
ORBIT_ACCURACY = 1e-6
"""Relative error of mean and peak force at which orbit and transient are compared."""
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
    start_process()
    import jax.numpy as jnp

    from experiments._common.engines.transient import averaged
    from experiments._common.simulation import at, evaluator_of

    wanted = 1e-4 if job.quick else ORBIT_ACCURACY
    design = jnp.asarray(BASELINE)
    repeats = 3 if job.quick else 15
    rows = []
    for scene, changes in list(ORBIT_SCENES.items())[: 1 if job.quick else None]:
        tool = evaluator_of(load(CIC, list(changes)))
        truth = at(tool, 1e-11, 1e-9)(series=False)
        forces, slopes = forces_of(truth.response), slopes_of(truth.gradient)
        forgets = f"multiplier {truth.steady_state['floquet_multiplier']:.2g}"
        tried: list[Row] = []
        for rtol in ORBIT_TOLERANCES:
            here = at(tool, rtol, rtol)
            neighbour = here(design * 1.002, series=False).start
            evaluate = functools.partial(here, design, neighbour, series=False)
            seconds, found = median_time(evaluate, repeats)
            off = value_error(forces_of(found.response), forces)
            by = gradient_error(slopes_of(found.gradient), slopes)
            more = {"settings": f"rtol {rtol:g}", "value_error": off, "gradient_error": by}
            tried.append(row("orbit", f"value+gradient, {scene}", seconds, note=forgets, **more))
        best = [one for one in tried if one["value_error"] <= wanted]
        rows.append(min(best or tried[-1:], key=lambda one: one["run_s"]))
        tried = []
        for rtol in ORBIT_TOLERANCES:
            how = dataclasses.replace(tool.scene.solver.orbit, rtol=jnp.asarray(rtol))
            for settle in ORBIT_SETTLES[: 4 if job.quick else None]:
                call = functools.partial(averaged, tool.scene, design, jnp.asarray(settle), how)
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
    """Time plain integration from rest over an increasing number of revolutions."""
    start_process()
    import equinox as eqx
    import jax.numpy as jnp

    from rootsopt.dynamics.flow import strobe
    from rootsopt.scene import Scene, integrators

    config = load(CIC)
    model = Scene.from_config(config)
    pair = eqx.filter_jit(Scene.pair)(model, jnp.asarray(BASELINE))
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
                settings=f"rtol {float(how.rtol):g}",
                note=f"{int(out.steps)} steps, {'solved' if bool(out.solved) else 'failed'}",
            )
        )
    return {"rows": rows}
