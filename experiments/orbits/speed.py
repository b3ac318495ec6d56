"""Times value and gradient from a neighbour's orbit against other methods for the same numbers.

All tools run in one process, in turns, on one core. Times are processor times, which other
processes on the machine hardly change. The neighbour is a design whose parameters differ by a small
fraction."""

import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments._common.engines import FD_STEPS
from experiments._common.engines import Scene as PlainScene
from experiments._common.engines.scipy_nodes import NODES_1E3, ScipyNodes
from experiments._common.scenes import CIC, SHAKY
from rootsopt import COMPILER_OPTIONS, Scene, steady_response
from rootsopt.config import load
from rootsopt.response.evaluation import Evaluator

Row = dict[str, Any]
AWAY = 2e-3
"""Relative difference between the parameters of a design and those of its neighbour."""
SCENES: dict[str, tuple[str, list[str]]] = {
    "cic": (CIC, []),
    "lively": (CIC, [*SHAKY]),
    "free form": ("configs/free.yaml", []),
    "pump": ("configs/pump.yaml", []),
}
"""Config and overrides of each scene."""
EXACT = 1e-10
"""Orbit tolerance of the reference."""


def processor_time(call: Callable[[], Any], repeats: int) -> tuple[float, Any]:
    """Return the median processor time (s) of a warm call, and its result."""
    found = call()
    times = []
    for _ in range(repeats):
        began = time.process_time()
        found = call()
        times.append(time.process_time() - began)
    return float(np.median(times)), found


def _numbers(evaluation) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and peak force (N), and their gradients (2, d)."""
    names = "mean_force_N", "peak_force_N"
    forces = np.array([evaluation.response[name] for name in names])
    return forces, np.array([list(evaluation.gradient[name].values()) for name in names])


def _row(scene: str, tool: str, seconds: float, found: Any, truth: Any) -> Row:
    forces, slopes = (np.asarray(x)[:2] for x in found)
    apart = np.max(np.abs(slopes - truth[1]), axis=1) / np.max(np.abs(truth[1]), axis=1)
    return {
        "scene": scene,
        "tool": tool,
        "ms": 1e3 * seconds,
        "force_error": float(np.max(np.abs(forces / truth[0] - 1))),
        "gradient_error": float(np.max(apart)),
    }


def rows_of(scene: str, repeats: int, say: Callable[[str], None] = lambda text: None) -> list[Row]:
    """Measure one of `SCENES`; return a row for each tool."""
    path, overrides = SCENES[scene]
    config = load(path, overrides)
    own = Evaluator.of(config)
    base = np.asarray(config.design, float)
    draw = np.random.default_rng(0)
    design = base * (1 + AWAY * draw.uniform(-1, 1, base.shape))
    say(f"{scene}: compiling")
    neighbour = own(base, series=False)
    exact = own.at_tolerance(EXACT)(design, series=False)
    if not (neighbour.usable and exact.usable):
        return [{"scene": scene, "tool": f"{neighbour.status.label}, {exact.status.label}"}]
    truth = _numbers(exact)

    near = own(design, start=neighbour.start, series=False)
    used = near.statistics.get("from_neighbour", 0)
    name = "evaluate, neighbour" if used else "evaluate, neighbour refused"
    calls = {
        name: lambda: own(design, start=neighbour.start, series=False),
        "evaluate, from rest": lambda: own(design, series=False),
    }
    rows = _public(scene, config, (base, design), truth, repeats)
    for tool, call in calls.items():
        say(f"{scene}: {tool}")
        seconds, found = processor_time(call, repeats)
        if not found.usable:
            rows.append({"scene": scene, "tool": f"{tool}: {found.status.label}"})
            continue
        rows.append(_row(scene, tool, seconds, _numbers(found), truth))
    if scene == "cic":
        rows += _competitors(config, design, truth, repeats, say)
    return rows


def solver_of(machine: Scene) -> Callable[..., Any]:
    """Return the function (design, start) -> mean and peak (N), their gradients, next start,
    status."""

    def solve(design, start):
        def forces(design):
            found = steady_response(machine, design, start)
            values = jnp.stack([found.mean, found.peak])
            return values, (values, found.start, found.status)

        slopes, (values, begin, status) = jax.jacfwd(forces, has_aux=True)(design)
        return values, slopes, begin, status

    return solve


def rest_of(machine: Scene, design: Any) -> Any:
    """Return a start at rest, in the form of `Response.start`."""
    start = jax.eval_shape(lambda: steady_response(machine, design).start)
    return jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), start)


def _public(scene: str, config: Any, designs: Any, truth: Any, repeats: int) -> list[Row]:
    """Measure `steady_response` under `jax.jit`, from a neighbour's orbit and from rest."""
    machine, (base, design) = Scene.from_config(config), designs
    solve = jax.jit(solver_of(machine), compiler_options=dict(COMPILER_OPTIONS))
    rest = rest_of(machine, base)
    known = solve(base, rest)[2]
    rows = []
    for tool, start in (("neighbour", known), ("from rest", rest)):
        seconds, found = processor_time(
            lambda start=start: jax.block_until_ready(solve(design, start)), repeats
        )
        rows.append(_row(scene, tool, seconds, found[:2], truth))
    return rows


def _competitors(config: Any, design, truth, repeats: int, say: Callable[[str], None]) -> list[Row]:
    """Measure SciPy and Numba with central differences."""
    from experiments._common.engines import numba_pair as numba

    scene = PlainScene.of(config)
    tools = {
        "SciPy, differences": ScipyNodes(scene, **NODES_1E3),
        "Numba, differences": numba.NumbaPair(scene, **numba.SEARCH_1E3),
        "Numba, gradient to 1e-3": numba.NumbaPair(scene, **numba.SEARCH_GRADIENT_1E3),
    }
    rows = []
    for name, tool in tools.items():
        say(f"cic: {name}")
        best: Row | None = None
        for factor in (1.0, 3.0):
            steps = [factor * step for step in FD_STEPS]
            count = max(1, repeats // 10) if "SciPy" in name else repeats
            seconds, (_, slopes) = processor_time(
                lambda tool=tool, steps=steps: tool.gradient(tuple(design), steps), count
            )
            forces = tool.simulate(tuple(design)).response
            row = _row("cic", name, seconds, (forces, slopes), truth)
            if best is None or row["gradient_error"] < best["gradient_error"]:
                best = row
        assert best is not None
        rows.append(best)
    return rows


def lines(rows: list[Row]) -> list[str]:
    """Return the table. The last column is the time relative to that from the neighbour."""
    head = f"{'scene':10s} {'tool':40s} {'ms':>9s} {'forces':>8s} {'gradient':>8s} {'ratio':>7s}"
    found = [head]
    for row in rows:
        if "ms" not in row:
            found.append(f"{row['scene']:10s} {row['tool']}")
            continue
        same = [one for one in rows if one["scene"] == row["scene"] and one["tool"] == "neighbour"]
        ratio = f"{float(row['ms']) / float(same[0]['ms']):7.1f}" if same else " " * 7
        errors = " ".join(f"{float(row[key]):8.0e}" for key in ("force_error", "gradient_error"))
        found.append(
            f"{row['scene']:10s} {row['tool']:40s} {float(row['ms']):9.2f} {errors} {ratio}"
        )
    return found
