"""Time the pieces of one evaluation: gap table, orbit, integration, reverse mode."""

import dataclasses
import functools
import os
from typing import Any

import numpy as np

from experiments._common.driver import start_process
from experiments._common.scenes import CIC
from experiments._common.timing import first_and_warm, median_time, peak_memory, ready
from experiments.benchmark.job import (
    BASELINE,
    CONTACTS,
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


def part_table(job: Job) -> dict[str, Any]:
    """Time the gap table of one design and its Jacobian, compiled."""
    start_process()
    import jax
    import jax.numpy as jnp
    from rootsopt.contact.map import MapContact

    from rootsopt.scene import Scene

    config = load(CIC)
    model = Scene.from_config(config, job.known["deepest"].get("map 384x16"))
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

    contact = CONTACTS["linear" if job.quick else "search"]
    wanted = 1e-4 if job.quick else ORBIT_ACCURACY
    design = jnp.asarray(BASELINE)
    repeats = 3 if job.quick else 15
    rows = []
    for scene, changes in list(ORBIT_SCENES.items())[: 1 if job.quick else None]:
        tool = evaluator_of(load(CIC, [*contact, *changes]))
        truth = at(tool, 1e-11, 1e-9)(series=False)
        forces, slopes = forces_of(truth.response), slopes_of(truth.gradient)
        forgets = f"multiplier {truth.steady_state['floquet_multiplier']:.2g}"
        tried: list[Row] = []
        for rtol in ORBIT_TOLERANCES:
            here = at(tool, rtol, rtol)
            neighbour = here(design * 1.002, series=False).state
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

    contact = "linear" if job.quick else "search"
    config = load(CIC, CONTACTS[contact])
    model = Scene.from_config(config, job.known["deepest"].get(contact))
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
                settings=f"{contact}, rtol {float(how.rtol):g}",
                note=f"{int(out.steps)} steps, {'solved' if bool(out.solved) else 'failed'}",
            )
        )
    return {"rows": rows}


def part_reverse(job: Job) -> dict[str, Any]:
    """Time a reverse-mode gradient of the mean force over 200 revolutions, with checkpoints."""
    start_process()
    import diffrax
    import equinox as eqx
    import jax
    import jax.numpy as jnp

    from rootsopt.dynamics.flow import flow
    from rootsopt.dynamics.integrator import Integrator
    from rootsopt.scene import Scene

    contact = "linear" if job.quick else "search"
    config = load(CIC, CONTACTS[contact])
    model = Scene.from_config(config, job.known["deepest"].get(contact))
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
