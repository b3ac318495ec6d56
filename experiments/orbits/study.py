"""Compares orbits closed by collocation with orbits closed by shooting, on random pairs.

The study draws designs and scenes (speed, load, backlash, gear, contact) of several kinds: CIC with
two to four lobes, EE, arc and involute, four and five arcs, a free form, twisted and worn rotors, a
wrong centre distance, with gas and friction, with a motor, and lively scenes. For each pair of
design and scene that settles, both solvers start from rest. Forces, their derivatives with respect
to design, speed and load, period, multipliers and status are compared. The times are those of a
second call in the same process.
"""

import csv
import dataclasses
import functools
import json
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from experiments._common.scenes import CIC
from rootsopt import steady_response
from rootsopt.config import Config, load
from rootsopt.config.scene import ProfileConfig
from rootsopt.errors import InputError
from rootsopt.scene import Scene, check_geometry, design_vector
from rootsopt.scene.families import free_form_of
from rootsopt.status import Status

Row = dict[str, Any]
METHODS = "collocation", "shooting"
FORCES = "mean", "peak", "rms"
PATIENCE = 12
"""Number of scenes drawn for each pair wanted, above which a kind ends early."""
COEFFICIENTS = 12
"""Number of coefficients of the free form."""
QUICK_COUNT = 2
"""Number of pairs of a reduced run."""
GAS = [
    "scene.load={pressure_difference_Pa: 2.0e4}",
    "contact.friction={static: 0.2, kinetic: 0.1, stiction_speed_mm_s: 100, "
    "friction_speed_mm_s: 1000}",
]
TWIST = ["rotor.helix_deg=45", "solver.slices=4"]
MOTOR = ["scene.drive=torque", "scene.motor={slope_N_m_s_per_rad: 0.1, inertia_kg_m2: 1.0e-3}"]
KINDS: dict[str, tuple[str, int, list[str]]] = {
    "cic, 3 lobes": ("cic", 3, []),
    "cic, lively": ("cic", 3, []),
    "ee, 3 lobes": ("ee", 3, []),
    "cic, 4 lobes": ("cic", 4, []),
    "arc and involute": ("arc_involute", 3, []),
    "cic, motor": ("cic", 3, MOTOR),
    "cic, gas and friction": ("cic", 3, GAS),
    "cic, 2 lobes": ("cic", 2, []),
    "ee, 2 lobes": ("ee", 2, []),
    "five arcs": ("five_arcs", 3, []),
    "free form": ("free_form", 3, []),
    "cic, twisted": ("cic", 3, TWIST),
    "cic, twisted, gas and friction": ("cic", 3, [*TWIST, *GAS]),
    "ee, worn": ("ee", 3, ["contact.wear.depth_mm=0.02"]),
    "four arcs": ("four_arcs", 3, []),
    "cic, centre distance": ("cic", 3, ["scene.center_distance_error_mm=0.03"]),
}
"""Family, lobes and further overrides of each kind."""


def pairs(seed: int, kind: str) -> Iterator[list[str]]:
    """Yield overrides of configs/cic.yaml of one kind, without end."""
    family, lobes, fixed = KINDS[kind]
    draw = np.random.default_rng([seed, list(KINDS).index(kind)])
    lively = "lively" in kind
    while True:
        angle, tip = draw.uniform(29, 42), draw.uniform(0.5, 4.0)
        longest = 33.0 * np.sin(np.radians(angle)) * (np.pi / 2 / lobes - np.radians(tip))
        length = draw.uniform(0.3, 0.95) * longest
        profile: Row = {"family": family, "lobes": lobes, "pitch_radius_mm": 33.0}
        if family not in ("ee", "four_arcs"):
            profile |= {
                "pressure_angle_deg": round(angle, 2),
                "involute_length_mm": round(length, 3),
            }
        if family in ("cic", "free_form"):
            profile["tip_arc_angle_deg"] = round(tip, 2)
        if family == "free_form":  # It follows a CIC profile.
            near = ProfileConfig.model_validate(profile | {"family": "cic"})
            profile = free_form_of(near, COEFFICIENTS)[0].model_dump(exclude_none=True)
        if family == "four_arcs":
            profile |= {
                "arc_center_mm": round(draw.uniform(23, 31), 3),
                "tip_arc_radius_mm": round(draw.uniform(12, 21), 3),
                "tip_arc_turn_deg": round(draw.uniform(30, 60), 2),
            }
        if family == "five_arcs":
            profile = {key: profile[key] for key in ("family", "lobes", "pitch_radius_mm")} | {
                "tip_arc_angle_deg": round(tip, 2),
                "outer_radius_mm": round(draw.uniform(43.5, 45.5), 2),
                "tip_arc_radius_mm": round(draw.uniform(11.5, 13.5), 2),
                "tip_arc_turn_deg": round(draw.uniform(45, 65), 1),
            }
        speed = draw.uniform(1000, 3000) if lively else 10 ** draw.uniform(2.8, 3.7)
        torque = draw.uniform(0.8, 5.0) if lively else 10 ** draw.uniform(-0.2, 1.2)
        play = draw.uniform(0.15, 0.4) if lively else draw.uniform(0.02, 0.3)
        damping = draw.uniform(0.05, 0.35) if lively else 10 ** draw.uniform(-1.0, -0.2)
        stiffness = 10 ** draw.uniform(3.6, 4.8)
        values = {
            "scene.speed_rpm": f"{speed:.1f}",
            "scene.load.torque_N_m": f"{torque:.3f}",
            "scene.timing_gear.backlash_mm": f"{play:.3f}",
            "scene.timing_gear.damping_ratio": f"{damping:.3f}",
            "scene.timing_gear.stiffness_N_m_per_rad": f"{stiffness:.0f}",
        }
        if "scene.load" in "".join(fixed):
            values.pop("scene.load.torque_N_m")
        yield [f"profile={json.dumps(profile)}", *(f"{k}={v}" for k, v in values.items()), *fixed]


@functools.lru_cache(maxsize=4)
def _solver(method: str, pair: tuple[Any, ...]):
    """Return the compiled response with derivatives.

    There is one program for each method and kind of `pair`."""
    del method, pair

    @eqx.filter_jit
    def solve(scene: Scene, design):
        start = design, scene.speed, scene.load_torque

        def forces(start):
            design, speed, load = start
            moved = dataclasses.replace(scene, speed=speed, load_torque=load)
            found = steady_response(moved, design)
            return jnp.stack([found.mean, found.peak, found.rms]), found

        slopes, found = jax.jacfwd(forces, has_aux=True)(start)
        slopes = [x.reshape(3, -1) * jnp.ravel(at) for x, at in zip(slopes, start, strict=True)]
        return jnp.concatenate(slopes, axis=1), found

    return solve


def solved(config: Config, kind: str, method: str) -> tuple[np.ndarray, Any, float]:
    """Return logarithmic derivatives (3, d + 2) of the forces, the response and the time (s)."""
    scene = Scene.from_config(config)
    scene = dataclasses.replace(scene, solver=dataclasses.replace(scene.solver, closing=method))
    design = design_vector(config)
    family, lobes, fixed = KINDS[kind]
    solve = _solver(method, (family, lobes, *fixed))
    jax.block_until_ready(solve(scene, design))
    began = time.perf_counter()
    slopes, found = jax.block_until_ready(solve(scene, design))
    return np.asarray(slopes), jax.tree.map(np.asarray, found), time.perf_counter() - began


def row_of(kind: str, overrides: list[str]) -> Row:
    """Compare both solvers on one pair of design and scene."""
    config = load(CIC, overrides)
    check_geometry(config)
    row: Row = {"kind": kind, "scene": " ".join(overrides)}
    found = {}
    for method in METHODS:
        found[method] = solved(config, kind, method)
        _, response, seconds = found[method]
        row[f"{method}_status"] = Status.of(int(response.status)).label
        row[f"{method}_period"] = int(response.period)
        row[f"{method}_s"] = seconds
        for name in FORCES:
            row[f"{method}_{name}"] = float(getattr(response, name))
    (by_one, one, _), (by_other, other, _) = found["collocation"], found["shooting"]
    for k, name in enumerate(FORCES):
        reference = float(getattr(other, name))
        row[f"{name}_difference"] = abs(float(getattr(one, name)) - reference) / (
            abs(reference) or 1.0  # flanks that never touch
        )
        size = np.max(np.abs(by_other[k])) or 1.0
        row[f"{name}_gradient_difference"] = float(np.max(np.abs(by_one[k] - by_other[k])) / size)
    row["multiplier_difference"] = float(
        np.max(np.abs(np.abs(one.multipliers) - np.abs(other.multipliers)))
    )
    return row


def run(
    quick: bool,
    count: int = 72,
    seed: int = 0,
    say: Callable[[str], None] = lambda text: None,
    keep: Callable[[list[Row]], None] = lambda rows: None,
) -> list[Row]:
    """Compare `count` pairs, evenly distributed over the kinds; return a row for each.

    Only pairs with a periodic orbit by shooting count. `keep` is called with all rows so far after
    each pair. A reduced run compares a few pairs of one kind."""
    kinds = list(KINDS)[: 1 if quick else None]
    each = QUICK_COUNT if quick else -(-count // len(kinds))
    rows: list[Row] = []
    for kind in kinds:
        done = 0
        for number, overrides in enumerate(pairs(seed, kind)):
            if done >= each or number >= PATIENCE * each:
                break
            try:
                row = row_of(kind, overrides)
            except InputError:  # The drawn profile is not sound.
                continue
            if row["shooting_status"] == "periodic" or row["collocation_status"] == "periodic":
                done += row["shooting_status"] == "periodic"
                rows.append(row)
                keep(rows)
            say(f"{kind}: {done} of {each}")
    return rows


def read(folder: Path) -> list[Row]:
    """Return the rows that a run has written."""
    with (folder / "orbits.csv").open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


@dataclasses.dataclass(frozen=True)
class Judgement:
    """Summary of all rows.

    `pairs`: number of pairs with a periodic orbit by shooting; `closed`: number of these that
    collocation has closed; `only`: number of orbits that only collocation has closed;
    `other_period`: number of pairs with different periods; `differences`: greatest and median value
    of each difference; `faster`: median and least ratio of the times; `left`: a line for each pair
    that collocation leaves to shooting."""

    pairs: int
    closed: int
    only: int
    other_period: int
    differences: dict[str, tuple[float, float]]
    faster: tuple[float, float]
    left: tuple[str, ...]

    def lines(self) -> list[str]:
        """Return the table."""
        head = [
            f"pairs with a periodic orbit by shooting: {self.pairs}; closed by collocation: "
            f"{self.closed}; only by collocation: {self.only}; other period: {self.other_period}",
            f"shooting takes {self.faster[0]:.1f} times as long (median; least "
            f"{self.faster[1]:.2f})",
            f"{'difference':32s} {'median':>9s} {'greatest':>9s}",
        ]
        spread = (f"{k:32s} {v[1]:9.1e} {v[0]:9.1e}" for k, v in self.differences.items())
        return [*head, *spread, *self.left]


def judge(rows: list[Row]) -> Judgement:
    """Summarise the rows."""
    shot = [row for row in rows if row["shooting_status"] == "periodic"]
    closed = [row for row in shot if row["collocation_status"] == "periodic"]
    only = [row for row in rows if row not in shot and row["collocation_status"] == "periodic"]
    same = [row for row in closed if int(row["collocation_period"]) == int(row["shooting_period"])]
    names = [f"{name}_difference" for name in FORCES]
    names += [f"{name}_gradient_difference" for name in FORCES] + ["multiplier_difference"]
    spread = {name: np.array([float(row[name]) for row in same]) for name in names}
    ratio = np.array([float(row["shooting_s"]) / float(row["collocation_s"]) for row in closed])
    return Judgement(
        pairs=len(shot),
        closed=len(closed),
        only=len(only),
        other_period=len(closed) - len(same),
        differences={
            name: (float(np.max(values, initial=0.0)), float(np.median(values)))
            for name, values in spread.items()
            if values.size
        },
        faster=(float(np.median(ratio)), float(np.min(ratio))) if ratio.size else (0.0, 0.0),
        left=tuple(
            f"left to shooting ({row['collocation_status']}, period {row['shooting_period']}): "
            f"{row['kind']}, {row['scene']}"
            for row in shot
            if row not in closed
        ),
    )
