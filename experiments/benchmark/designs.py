"""One design and batches of designs, computed by rootsopt."""

import dataclasses
import functools
import math
from typing import Any

import numpy as np

from experiments._common.driver import start_process
from experiments._common.engines import FD_STEPS
from experiments._common.scenes import CIC
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
from rootsopt.config import load

REFERENCE_RTOL = 1e-11
REFERENCE_STEPS = tuple(step / 5 for step in FD_STEPS)
"""Steps (deg, mm, deg) of the reference's central differences; their truncation error is 1e-5."""
CHECKED = 8
"""Number of designs of a batch that are compared with a reference."""
TOLERANCES = ((1e-4, 1e-4), (1e-5, 1e-5), (1e-6, 1e-6), (1e-5, 1e-6), (1e-7, 1e-7))
"""Tolerances (orbit, transient) to choose from, in the order in which they are tried."""


def part_reference(job: Job) -> dict[str, Any]:
    """Compute the reference at the tightest settings, at the baseline and the checked designs.

    Gradients are central differences of its forces, so they do not use rootsopt's differentiation.
    """
    start_process()
    from experiments._common.simulation import at, evaluator_of

    choice = ("solver.method=tsit5",) if job.quick else ("solver.method=dopri8",)
    tool = evaluator_of(load(CIC, choice))
    loose = at(tool, 1e-10, 1e-8)(series=False)
    tool = at(tool, REFERENCE_RTOL, 1e-8)
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
    """Time one design with `Evaluator`, at the cheapest sufficient setting and at the default.

    The pure function `respond` is timed too, with and without gradient.
    """
    start_process()
    import equinox as eqx
    import jax.numpy as jnp

    from experiments._common.batch import coarse, respond
    from experiments._common.simulation import at, evaluator_of
    from rootsopt.scene import integrators

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
    return {"rows": rows, "tried": tried, "choice": choice}


class _Batch:
    """Designs around the baseline, each simulated from rest, and references for some of them."""

    def __init__(self, job: Job):
        import jax.numpy as jnp

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
        import jax.numpy as jnp

        from experiments._common.batch import coarse, respond_many
        from rootsopt.scene import Scene, integrators

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
        from rootsopt.runtime.timing import CompileClock

        job, (rtol, coarse) = self.job, setting
        call = functools.partial(self.run, *setting, gradient)
        with CompileClock() as clock:
            call()
        seconds, out = median_time(call, 1 if job.quick else 5, BATCH_SECONDS / 8)
        usable, off, by = self.errors(out)
        return row(
            f"rootsopt, batch of {job.size}" + (" (GPU)" if job.part == "gpu" else ""),
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


def part_batch(job: Job) -> dict[str, Any]:
    """Time a batch of designs around the baseline with `respond_many`, each from rest.

    The first batch searches for the cheapest sufficient setting; later batches reuse this setting.
    """
    start_process(gpu=job.part == "gpu")
    import jax

    if job.part == "gpu" and jax.default_backend() != "gpu":
        return {"rows": [], "note": "no GPU found"}
    batch = _Batch(job)
    setting = job.known.get("batch_setting") or batch.choose()
    gradients = (True,) if job.quick else (True, False)
    rows = [batch.timed(setting, gradient) for gradient in gradients]
    return {
        "rows": rows,
        "batch_setting": setting,
        "batch_tried": batch.tried or job.known["batch_tried"],
    }
