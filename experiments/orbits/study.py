"""Compares orbits of random pairs, which are closed by collocation, with the same by shooting.

The study draws designs and scenes (speed, load, backlash, gear, contact) of several kinds: CIC with
two to four lobes, EE, arc and involute, four and five arcs, a free form, twisted and worn rotors, a
wrong centre distance, gas and friction, a motor, and lively scenes. Each motion begins at
rest. If it is periodic, shooting closes its orbit once more (`experiments._common.shooting`).
Forces, their derivatives along one direction of design, speed and load, and the greatest multiplier
are compared. If it repeats, but its orbit is not known, the pair is listed.
"""

import contextlib
import dataclasses
import functools
import itertools
import json
import os
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from experiments._common.batch import batches_of, compiled, rest_of, solver_of
from experiments._common.driver import NoResultError, Run
from experiments._common.scenes import CIC
from experiments._common.shooting import closed, differentiated, forces_near
from experiments._common.simulation import errors_of, numbers_of
from experiments._common.tables import Row, show
from experiments._common.timing import median_time, processor_time
from rootsopt import steady_response
from rootsopt.config import Config, load
from rootsopt.config.rotor import ProfileConfig
from rootsopt.dynamics.pair import RotorPair
from rootsopt.errors import InputError
from rootsopt.response.evaluation import Evaluator
from rootsopt.scene import Scene, check_geometry, design_vector
from rootsopt.scene.families import free_form_of
from rootsopt.status import Status

FORCES = "mean", "peak", "rms"

# Statuses of motions that repeat, but whose orbit or gradient is not known.
LEFT = "not_closed", "inaccurate"

# Number of scenes drawn for each pair wanted, above which a kind ends early.
PATIENCE = 12

# Number of coefficients of the free form.
COEFFICIENTS = 12

# Relative step of the differences. Orbits by shooting are accurate to about 1e-11.
STEP = 1e-5

# Relative difference of forces above which the two solvers disagree.
AGREE = 1e-4

# Number of pairs of a reduced run.
QUICK_COUNT = 2

# Relative difference between the parameters of a timed design and those of its neighbour, and orbit
# tolerance of its reference.
AWAY, EXACT = 2e-3, 1e-10

# Usual numbers of designs in a batch, and number of designs that are compared with single
# evaluations.
SIZES, CHECKED = (256, 1024, 4096, 16384, 65536), 8

# Maximum number of timed calls of a batch, and time (s) after which no further call is made.
REPEATS, SECONDS = 5, 10.0
GAS = [
    "scene.load={pressure_difference_Pa: 2.0e4}",
    "contact.friction={static: 0.2, kinetic: 0.1, stiction_speed_mm_s: 100, "
    "friction_speed_mm_s: 1000}",
]
TWIST = ["rotor.helix_deg=45", "solver.slices=4"]
MOTOR = ["scene.drive=torque", "scene.motor={slope_N_m_s_per_rad: 0.1, inertia_kg_m2: 1.0e-3}"]

# Family, lobes and further overrides of each kind. Most of the time goes into compiling, so that
# kinds combine what is independent: lobes, family, and parts of the scene.
KINDS: dict[str, tuple[str, int, list[str]]] = {
    "cic, 3 lobes": ("cic", 3, []),
    "cic, lively": ("cic", 3, []),
    "ee, 2 lobes": ("ee", 2, []),
    "ee, worn": ("ee", 3, ["contact.wear.depth_mm=0.02"]),
    "cic, 4 lobes, motor": ("cic", 4, MOTOR),
    "cic, 2 lobes, gas and friction": ("cic", 2, GAS),
    "cic, twisted, gas and friction": ("cic", 3, [*TWIST, *GAS]),
    "arc and involute": ("arc_involute", 3, []),
    "four arcs, centre distance": ("four_arcs", 3, ["scene.center_distance_error_mm=0.03"]),
    "five arcs": ("five_arcs", 3, []),
    "free form": ("free_form", 3, []),
}


def pairs(seed: int, kind: str) -> Iterator[list[str]]:
    """Yield overrides of configs/cic_drawn.yaml of one kind, without end."""
    family, lobes, fixed = KINDS[kind]
    draw = np.random.default_rng([seed, list(KINDS).index(kind)])
    lively = "lively" in kind
    while True:
        angle, tip = draw.uniform(29, 42), draw.uniform(0.5, 4.0)
        longest = 33.0 * np.sin(np.radians(angle)) * (np.pi / 2 / lobes - np.radians(tip))
        length = draw.uniform(0.3, 0.95) * longest
        profile: Row = {"family": family, "lobes": lobes, "pitch_radius_mm": 33.0}
        flank = {"pressure_angle_deg": round(angle, 2), "involute_length_mm": round(length, 3)}
        land = {"tip_arc_angle_deg": round(tip, 2)}
        if family == "arc_involute":
            profile |= flank
        elif family == "cic":
            profile |= flank | land
        elif family == "free_form":  # It follows a CIC profile.
            near = ProfileConfig.model_validate(profile | flank | land | {"family": "cic"})
            profile = free_form_of(near, COEFFICIENTS)[0].model_dump(exclude_none=True)
        elif family == "four_arcs":
            profile |= {
                "arc_center_mm": round(draw.uniform(23, 31), 3),
                "tip_arc_radius_mm": round(draw.uniform(12, 21), 3),
                "tip_arc_turn_deg": round(draw.uniform(30, 60), 2),
            }
        elif family == "five_arcs":
            profile |= land | {
                "outer_radius_mm": round(draw.uniform(43.5, 45.5), 2),
                "tip_arc_radius_mm": round(draw.uniform(11.5, 13.5), 2),
                "tip_arc_turn_deg": round(draw.uniform(45, 65), 1),
            }
        speed = draw.uniform(1000, 3000) if lively else 10 ** draw.uniform(2.8, 3.7)
        torque = draw.uniform(0.8, 5.0) if lively else 10 ** draw.uniform(-0.2, 1.2)
        play = draw.uniform(0.15, 0.4) if lively else draw.uniform(0.02, 0.3)
        damping = draw.uniform(0.05, 0.35) if lively else 10 ** draw.uniform(-1.0, -0.2)
        values = {
            "scene.speed_rpm": f"{speed:.1f}",
            "scene.load.torque_N_m": f"{torque:.3f}",
            "scene.timing_gear.backlash_mm": f"{play:.3f}",
            "scene.timing_gear.damping_ratio": f"{damping:.3f}",
            "scene.timing_gear.stiffness_N_m_per_rad": f"{10 ** draw.uniform(3.6, 4.8):.0f}",
        }
        if "scene.load" in "".join(fixed):
            values.pop("scene.load.torque_N_m")
        yield [f"profile={json.dumps(profile)}", *(f"{k}={v}" for k, v in values.items()), *fixed]


@functools.lru_cache(maxsize=4)
def _solver(pair: tuple[Any, ...]):
    """Return the compiled response with derivatives; there is one program for each kind of
    `pair`."""
    del pair

    @eqx.filter_jit
    def solve(scene: Scene, design):
        def forces(change):
            found = steady_response(*_moved(scene, design, change))
            return jnp.stack([found.mean, found.peak, found.rms]), found

        return jax.jacfwd(forces, has_aux=True)(jnp.zeros(()))

    return solve


def _moved(scene: Scene, design, change):
    """Return scene and design after a relative `change` along the direction of the comparison."""
    way = 1 + change * (0.5 + jnp.arange(len(design)) / 7)
    speed, load = scene.speed * (1 - 0.6 * change), scene.load_torque * (1 + 0.8 * change)
    return dataclasses.replace(scene, speed=speed, load_torque=load), design * way


@eqx.filter_jit
def _pair(scene: Scene, design, change):
    scene, design = _moved(scene, design, change)
    return scene.pair(design)


def row_of(kind: str, overrides: list[str]) -> Row:
    """Evaluate one pair of design and scene, and compare its orbit with that by shooting."""
    config = load(CIC, overrides)
    check_geometry(config)
    family, lobes, fixed = KINDS[kind]
    row = {"kind": kind, "scene": " ".join(overrides)}
    return row | compared(config, _solver((family, lobes, *fixed)))


def compared(config: Config, solve: Callable[..., Any] | None = None) -> Row:
    """Evaluate a config from rest. Compare a periodic orbit with that by shooting.

    `solve`: result of `_solver`, absent if no other config shares it."""
    solve = _solver.__wrapped__(()) if solve is None else solve
    scene, design = Scene.from_config(config), design_vector(config)
    slopes, found = solve(scene, design)
    row: Row = {"status": Status.of(int(found.status)).label, "period": int(found.period)}
    if row["status"] != "periodic":
        return row
    here = _pair(scene, design, jnp.zeros(()))
    truth = closed(here, here.scaled(found.state), row["period"])

    def pair(change: float) -> RotorPair:
        return _pair(scene, design, jnp.asarray(change))

    reference, noise = differentiated(forces_near(pair, truth, row["period"]), STEP)
    mine = np.array([found.mean, found.peak, found.rms])
    for k, name in enumerate(FORCES):
        row[f"{name}_difference"] = abs(mine[k] / truth.forces[k] - 1)
        row[f"{name}_gradient_difference"] = abs(float(slopes[k]) / reference[k] - 1)
        row[f"{name}_gradient_noise"] = noise[k] / abs(reference[k])
    modulus = float(np.max(np.abs(np.asarray(found.multipliers))))
    return row | {"multiplier_difference": abs(modulus - truth.multiplier), "miss": truth.miss}


def run(job: Run) -> bool:
    """Compare orbits, or time them (`--speed`, `--batches`); return whether the forces agree."""
    if job.options.speed or job.options.batches:
        return timed(job)
    rows = differences_of(job)
    periodic = [row for row in rows if row["status"] == "periodic"]
    names = [f"{name}_{what}" for what in ("difference", "gradient_difference") for name in FORCES]
    table = []
    for name in [*names, "multiplier_difference"]:
        # The noise of the differences that give a gradient is no error of the gradient.
        noise = name.replace("difference", "noise")
        off = [max(row[name] - row.get(noise, 0.0), 0.0) for row in periodic]
        # Unknown where an orbit of the differences does not close.
        known = np.array(off)[np.isfinite(off)]
        table.append(
            {"of": name, "pairs": known.size, "median": np.median(known), "greatest": max(known)}
        )
    show(f"{len(periodic)} orbits by collocation and by shooting", table)
    for row in rows:
        if row["status"] in LEFT:
            print(f"{row['status']}, period {row['period']}: {row['kind']}, {row['scene']}")
    return all(row[f"{name}_difference"] <= AGREE for row in periodic for name in FORCES)


def differences_of(job: Run) -> list[Row]:
    """Evaluate pairs until enough of them, evenly distributed over the kinds, are periodic.

    Writes and returns a row for each pair whose motion settles, updated after each pair. A reduced
    run compares a few pairs of one kind."""
    kinds = list(KINDS)[: 1 if job.quick else None]
    each = QUICK_COUNT if job.quick else -(-job.options.count // len(kinds))
    rows: list[Row] = []
    for kind in kinds:
        done = 0
        for overrides in itertools.islice(pairs(job.options.seed, kind), PATIENCE * each):
            with contextlib.suppress(InputError):  # The drawn profile is not sound.
                row = row_of(kind, overrides)
                if row["status"] in ("periodic", *LEFT):
                    done += row["status"] == "periodic"
                    rows.append(row)
                    job.csv("orbits.csv", rows)
                job.say(f"{kind}: {done} of {each}")
            if done >= each:
                break
    return rows


def timed(job: Run) -> bool:
    """Time batches of designs, or with `--speed` an orbit from a neighbour's on one core.

    Writes and prints a row for each size and start, or for each way. Returns whether the forces of
    the batches agree with those of single designs."""
    one_core = job.options.speed
    if one_core and hasattr(os, "sched_setaffinity"):  # before JAX starts its threads
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    sizes = SIZES[: 1 if job.quick else None]
    repeats = 3 if job.quick else 20
    rows: list[Row] = []
    for row in speeds_of(repeats, job.say) if one_core else batch_rows(sizes, job.say):
        rows.append(row)
        job.csv("speed.csv" if one_core else "batches.csv", rows)
    show("Value and gradient", rows)
    return one_core or all(row["value_error"] <= AGREE for row in rows)


def _row(way: str, seconds: float, found: Any, truth: Any) -> Row:
    return {"way": way, "ms": 1e3 * seconds} | errors_of(found, truth)


def speeds_of(repeats: int, say: Callable[[str], None]) -> Iterator[Row]:
    """Time value and gradient from a neighbour and from rest, in turns; yield a row for each way.

    Times are processor times, which other processes on the machine hardly change. Raises
    `NoResultError` if a design has no orbit."""
    config = load(CIC)
    own = Evaluator.of(config)
    base = np.asarray(config.design, float)
    design = base * (1 + AWAY * np.random.default_rng(0).uniform(-1, 1, base.shape))
    say("compiling")
    neighbour = own(base, series=False)
    exact = own.at_tolerance(EXACT)(design, series=False)
    if not (neighbour.usable and exact.usable):
        raise NoResultError(f"no orbit: {neighbour.status.label}, {exact.status.label}")
    truth = numbers_of(exact)
    machine = Scene.from_config(config)
    solve, rest = compiled(solver_of(machine)), rest_of(machine, base)
    for way, start in (("neighbour", solve(base, rest)[3]), ("from rest", rest)):
        call = functools.partial(solve, design, start)
        seconds, found = processor_time(call, repeats)
        yield _row(way, seconds, found[:2], truth)
    for way, start in (("neighbour", neighbour.start), ("from rest", None)):
        say(f"evaluate, {way}")
        call = functools.partial(own, design, start=start, series=False)
        seconds, found = processor_time(call, repeats)
        yield _row(f"evaluate, {way}", seconds, numbers_of(found), truth)


def batch_rows(sizes: Sequence[int], say: Callable[[str], None]) -> Iterator[Row]:
    """Yield a row for each of `sizes` and each start, from a neighbour's orbit and from rest.

    A CPU computes a batch on one thread, and on one thread per core. Some designs are compared with
    single evaluations on the CPU, by a program without batches."""
    config = load(CIC, [])
    machine, base = Scene.from_config(config), np.asarray(config.design, float)
    changes = np.random.default_rng(0).uniform(-1, 1, (max(sizes), *base.shape))
    designs = base * (1 + AWAY * changes)
    solve = solver_of(machine)
    say("compiling for single designs")
    with jax.default_device(jax.devices("cpu")[0]):
        single, rest = compiled(solve), rest_of(machine, base)
        starts = {"neighbour": single(base, rest)[3], "rest": rest}
        truth = {
            name: [single(design, start)[:2] for design in designs[:CHECKED]]
            for name, start in starts.items()
        }
    device = jax.devices()[0]
    starts = jax.device_put(starts, device)
    for size in sizes:
        say(f"{size} designs: compiling")
        for call, row in batches_of(solve, designs[:size], starts["rest"]):
            for name, start in starts.items():
                say(f"{size} designs from {name}, {row['device']}")
                call(start)
                again = functools.partial(call, start)
                seconds, found = median_time(again, REPEATS, SECONDS)
                yield {
                    **row,
                    "start": name,
                    "designs": size,
                    "s": seconds,
                    "designs_per_s": size / seconds,
                    "periodic": float(np.mean(found[2] == Status.PERIODIC.code)),
                    "peak_bytes": (device.memory_stats() or {}).get("peak_bytes_in_use"),
                    **errors_of(
                        [x[:CHECKED] for x in found[:2]],
                        [np.stack(x)[:size] for x in zip(*truth[name], strict=True)],
                    ),
                }
