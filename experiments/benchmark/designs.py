"""One design and batches of designs, computed by rootsopt."""

import dataclasses
import functools
import math
import os
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from experiments._common.batch import coarse, respond, respond_many
from experiments._common.driver import NoResultError
from experiments._common.engines import FD_STEPS
from experiments._common.scenes import CIC
from experiments._common.simulation import at, evaluator_of
from experiments._common.timing import first_and_warm, median_time, ready
from experiments.benchmark.job import (
    ACCURACY,
    BASELINE,
    BATCH_SECONDS,
    GRADIENT_ACCURACY,
    Job,
    Row,
    forces_of,
    gradient_error,
    row,
    sample_designs,
    slopes_of,
    value_error,
)
from rootsopt.commands.work.searching import CompileClock
from rootsopt.config import load
from rootsopt.dynamics.flow import one_period, strobe
from rootsopt.dynamics.integrator import Integrator
from rootsopt.scene import Scene, integrators

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
    choice = ("solver.method=tsit5",) if job.quick else ("solver.method=dopri8",)
    tool = evaluator_of(load(CIC, choice))
    tool = at(tool, REFERENCE_RTOL, 1e-8)
    designs = sample_designs(2 if job.quick else CHECKED)
    found = [tool(design, series=False) for design in designs]
    if not all(one.usable for one in found):
        raise NoResultError(f"the reference ended as {[one.status.label for one in found]}")

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
    return {"forces": forces, "slopes": slopes}


def part_single(job: Job) -> dict[str, Any]:
    """Time one design with `Evaluator`, at the cheapest sufficient setting and at the default.

    The pure function `respond` is timed too, with and without gradient.
    """
    truth, slope = job.known["forces"][0], job.known["slopes"][0]
    repeats = 2 if job.quick else 9
    tried = []
    usual = evaluator_of(load(CIC))
    compiling, _, _ = first_and_warm(functools.partial(usual, series=False), 1)
    for rtol, transient in TOLERANCES[1:2] if job.quick else TOLERANCES:
        tool = at(usual, rtol, transient)
        seconds, found = median_time(functools.partial(tool, series=False), 3)
        off = value_error(forces_of(found.response), truth) if found.usable else math.nan
        by = gradient_error(slopes_of(found.gradient), slope)
        tried.append([rtol, transient, seconds, off, by, found.status.label])
    good = [one for one in tried if one[3] <= ACCURACY] or tried
    fine = [one for one in good if one[4] <= GRADIENT_ACCURACY] or good
    value_only, choice = (min(x, key=lambda one: one[2])[:2] for x in (good, fine))

    def evaluated(name: str, rtol: float, transient: float) -> Row:
        tool = at(usual, rtol, transient)
        seconds, found = median_time(lambda: tool(series=False), repeats)
        return row(
            f"rootsopt, {name}",
            "value+gradient",
            seconds,
            compile_s=compiling,
            value_error=value_error(forces_of(found.response), truth),
            gradient_error=gradient_error(slopes_of(found.gradient), slope),
            settings=f"rtol {rtol:g}, transient {transient:g}",
            note="Evaluator: checks settlement, closes the orbit, reports stability",
        )

    solver = load(CIC).solver
    default = evaluated("default", solver.orbit_tolerance, solver.transient_tolerance)
    rows = [default, evaluated("cheapest", *choice)]
    design, state = jnp.asarray(BASELINE), jnp.zeros(2)
    compiled = eqx.filter_jit(respond)
    for gradient in () if job.quick else (False, True):
        rtol, transient = choice if gradient else value_only
        settling, closing = (
            dataclasses.replace(one, rtol=jnp.asarray(value))
            for one, value in zip(integrators(usual.config), (transient, rtol), strict=True)
        )
        solver = coarse(usual.scene, settling, closing)
        call = functools.partial(compiled, usual.scene, design, state, solver, gradient=gradient)
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
                settings=f"rtol {rtol:g}, transient {transient:g}",
                note="batch.respond: settlement checked, orbit closed, no second attempts",
            )
        )
    return {"rows": rows}


class _Batch:
    """Designs around the baseline, each simulated from rest, and references for some of them."""

    def __init__(self, job: Job):

        self.job = job
        self.designs = jnp.asarray(sample_designs(job.size))
        self.states = jnp.zeros((job.size, 2))
        self.checked = min(len(job.known["forces"]), job.size)
        self.truth, self.slope = (
            np.asarray(job.known[key])[: self.checked] for key in ("forces", "slopes")
        )
        self.tried: list[list[Any]] = []

    def run(self, rtol: float, transient_rtol: float, gradient: bool) -> Any:
        """Simulate all designs with these tolerances."""

        config = load(CIC)
        transient, orbit = integrators(config)
        how = (
            dataclasses.replace(transient, rtol=jnp.asarray(transient_rtol)),
            dataclasses.replace(orbit, rtol=jnp.asarray(rtol)),
        )
        scene = Scene.from_config(config)
        solver = coarse(scene, *how)
        return ready(respond_many(scene, self.designs, self.states, solver, gradient))

    def errors(self, out: Any) -> tuple[int, float, list[float]]:
        """Count usable designs, and compare the designs that have a reference with it.

        Returns the count, the largest error of the forces, and the error of each gradient.
        """
        usable = np.asarray(out.usable)[: self.checked]
        forces = np.asarray(out.response)[: self.checked, :2][usable]
        found = np.asarray(out.gradient)[: self.checked, :2][usable]
        off = value_error(forces, self.truth[usable]) if usable.any() else math.nan
        pairs = zip(found, self.slope[usable], strict=True) if found.size else ()
        return int(out.usable.sum()), off, [gradient_error(*pair) for pair in pairs]

    def choose(self) -> tuple[float, float]:
        """Choose the cheapest tolerances at which all designs are accurate enough.

        If none are, choose the finest. Returns (orbit tolerance, transient tolerance).
        """
        job = self.job
        self.run(*TOLERANCES[1], True)
        for pair in TOLERANCES[1:2] if job.quick else TOLERANCES[1:]:
            seconds, out = median_time(functools.partial(self.run, *pair, True), 2)
            self.tried.append([*pair, seconds, *self.errors(out)])
        good = [
            one
            for one in self.tried
            if one[3] == job.size and one[4] <= ACCURACY and np.median(one[5]) <= GRADIENT_ACCURACY
        ]
        return tuple(min(good, key=lambda one: one[2])[:2]) if good else TOLERANCES[-1]

    def timed(self, setting: tuple[float, float], gradient: bool) -> Row:
        """Time the batch with a setting; the first call includes compilation."""

        job, (rtol, coarse) = self.job, setting
        call = functools.partial(self.run, *setting, gradient)
        with CompileClock() as clock:
            call()
        seconds, out = median_time(call, 1 if job.quick else 5, BATCH_SECONDS / 8)
        usable, off, by = self.errors(out)
        return row(
            f"rootsopt, batch of {job.size}",
            "value+gradient" if gradient else "value",
            seconds,
            designs=job.size,
            # None if it was compiled before, when this batch chose the setting.
            compile_s=clock.seconds if not (self.tried and gradient) else None,
            value_error=off,
            # Where the peak falls on a corner of the force, a gradient may fail. The median design
            # counts, and the note gives the worst.
            gradient_error=float(np.median(by)) if by else None,
            settings=f"rtol {rtol:g}, transient {coarse:g}",
            note=f"{usable} of {job.size} periodic"
            + (f", worst gradient error {max(by):.2g}" if by else ""),
        )


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


def part_batch(job: Job) -> dict[str, Any]:
    """Time a batch of designs around the baseline with `respond_many`, each from rest.

    The first batch searches for the cheapest sufficient setting; later batches reuse this setting.
    """
    batch = _Batch(job)
    setting = job.known.get("batch_setting") or batch.choose()
    gradients = (True,) if job.quick else (True, False)
    rows = [batch.timed(setting, gradient) for gradient in gradients]
    return {"rows": rows, "batch_setting": setting}


@eqx.filter_jit
def averaged(model: Scene, design: Any, settle: Any, how: Integrator) -> tuple[Any, Any]:
    """Average the contact force over one mesh period, after a transient of `settle` mesh periods.

    The motion starts from rest. Returns (mean, peak) in N, and their derivatives (2, d) in N per
    config unit, which are carried along throughout. `how`: integrator.
    """

    def forces(design: Any) -> tuple[Any, Any]:
        pair = model.pair(design)

        def pass_by(_: Any, state: Any) -> Any:
            return strobe(pair, state, 1, how).states[-1]

        state = lax.fori_loop(0, settle, pass_by, jnp.zeros(2))
        found = one_period(pair, state, how).response[::2]
        return found, found

    slopes, found = jax.jacfwd(forces, has_aux=True)(design)
    return found, slopes
