"""What each part of a scene costs.

    python experiments/parts.py [-o DIR] [--quick]

Adds every part by itself to the smallest scene, contact driven at constant speed, and all of them
together, and reports states, equations of the traced right-hand side, time of one right-hand side
inside a compiled loop, and time of a simulation with gradient (compiled, and the first with its
compilation). Ratios are to the smallest scene in the same run. Writes parts.csv.
"""

import argparse
import statistics
import sys
import time
from pathlib import Path
from typing import Any

from rootsopt.cli import use_float64

use_float64()

import equinox as eqx  # noqa: E402
import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
from rich.console import Console  # noqa: E402
from rich.table import Table  # noqa: E402

from rootsopt import files  # noqa: E402
from rootsopt.config import Config, load  # noqa: E402
from rootsopt.evaluate import Evaluator  # noqa: E402
from rootsopt.model import Model, design_vector  # noqa: E402

# A light load at high speed, which flanks alone can hold; slower, lobes pass through each other.
BARE = (
    "scene.timing_gear=null",
    "scene.speed_rpm=6000",
    "scene.load.torque_N_m=0.1",
    "profile.involute_length_mm=6",
)
GEAR = "scene.timing_gear={stiffness_N_m_per_rad: 2.0e4, damping_ratio: 0.5, backlash_mm: 0.1}"
PARTS = {
    "smallest": (),
    "timing gear": (GEAR,),
    "gear with phase error": (GEAR, "scene.phase_error_mrad=0.4"),
    "motor": ("scene.drive=torque", "scene.motor={slope_N_m_s_per_rad: 0.1}"),
    "gas load": ("scene.load={pressure_difference_Pa: 1000}",),
    "friction": ("contact.friction={}",),
    "centre distance error": ("scene.center_distance_error_mm=0.02",),
    "supports": ("scene.supports={stiffness_N_per_mm: 2.0e5, damping_N_s_per_mm: 5}",),
}


def equations(jaxpr) -> int:
    """Equations of a traced program, with those of its inner ones."""
    total = len(jaxpr.eqns)
    for equation in jaxpr.eqns:
        for value in jax.tree.leaves(equation.params, is_leaf=lambda v: hasattr(v, "jaxpr")):
            inner = getattr(value, "jaxpr", value)
            total += equations(inner) if hasattr(inner, "eqns") else 0
    return total


def right_hand_side(config: Config, calls: int) -> dict[str, float]:
    """States, equations, and time (µs) of one right-hand side along a slowly moving state."""
    pair = eqx.filter_jit(Model.pair)(Model.of(config), design_vector(config))
    numbers, static = eqx.partition(pair, eqx.is_array)
    state = jnp.full(pair.states, 0.05)

    def derivative(tau, y, numbers):
        return eqx.combine(numbers, static).derivative(tau, y)[0]

    size = equations(jax.make_jaxpr(derivative)(jnp.zeros(()), state, numbers).jaxpr)

    @jax.jit
    def many(numbers):
        def call(k, y):
            return y + 1e-9 * derivative(k / calls, y, numbers)

        return jax.lax.fori_loop(0, calls, call, state)

    jax.block_until_ready(many(numbers))
    times = []
    for _ in range(5):
        began = time.perf_counter()
        jax.block_until_ready(many(numbers))
        times.append(time.perf_counter() - began)
    return {"states": pair.states, "equations": size, "rhs_us": 1e6 * min(times) / calls}


def evaluation(config: Config, repeats: int) -> dict[str, float | str]:
    """Time (s) of the first evaluation and (ms) of later ones, value and gradient."""
    evaluator = Evaluator(config)
    began = time.perf_counter()
    found = evaluator(series=False)
    first = time.perf_counter() - began
    times = []
    for _ in range(repeats):
        began = time.perf_counter()
        evaluator(series=False)
        times.append(time.perf_counter() - began)
    steps = found.statistics["solver_steps"]
    return {
        "first_s": first,
        "evaluation_ms": 1e3 * statistics.median(times),
        "solver_steps": steps,
        "status": found.status.label,
    }


def main() -> int:
    assert __doc__ is not None
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=Path, default=Path("results/parts"))
    parser.add_argument("--quick", action="store_true", help="right-hand sides only, few calls")
    options = parser.parse_args()
    scenes = {name: load("configs/cic.yaml", [*BARE, *more]) for name, more in PARTS.items()}
    scenes["all of them"] = load("configs/pump.yaml")
    if options.quick:
        scenes = {name: scenes[name] for name in ("smallest", "timing gear", "all of them")}
    rows: list[dict[str, Any]] = []
    for name, config in scenes.items():
        row: dict[str, Any] = {"part": name} | right_hand_side(
            config, 500 if options.quick else 20000
        )
        row["rhs_ratio"] = row["rhs_us"] / (rows[0] if rows else row)["rhs_us"]
        if not options.quick:
            row |= evaluation(config, 5)
        rows.append(row)
    folder = files.ResultFolder(options.output)
    folder.write_csv("parts.csv", {key: [row[key] for row in rows] for key in rows[0]})
    table = Table(*rows[0])
    for row in rows:
        table.add_row(*(f"{x:.3g}" if isinstance(x, float) else str(x) for x in row.values()))
    Console().print(table)
    return 0


if __name__ == "__main__":
    sys.exit(main())
