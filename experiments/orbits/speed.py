"""Times value and gradient from a neighbour's orbit against other methods for the same numbers.

All tools run in one process, in turns, on one core. Times are processor times, which other
processes on the machine hardly change. The neighbour is a design whose parameters differ by a small
fraction."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments._common.driver import NoResultError
from experiments._common.engines import FD_STEPS
from experiments._common.engines import Scene as PlainScene
from experiments._common.engines.scipy_nodes import NODES_1E3, ScipyNodes
from experiments._common.scenes import CIC
from experiments._common.timing import processor_time
from rootsopt import COMPILER_OPTIONS, Scene, steady_response
from rootsopt.config import load
from rootsopt.response.evaluation import Evaluator

Row = dict[str, Any]

# Relative difference between the parameters of a design and those of its neighbour.
AWAY = 2e-3

# Orbit tolerance of the reference.
EXACT = 1e-10


def _numbers(evaluation) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and peak force (N), and their gradients (2, d)."""
    names = "mean_force_N", "peak_force_N"
    forces = np.array([evaluation.response[name] for name in names])
    return forces, np.array([list(evaluation.gradient[name].values()) for name in names])


def _row(tool: str, seconds: float, found: Any, truth: Any) -> Row:
    forces, slopes = (np.asarray(x)[:2] for x in found)
    apart = np.max(np.abs(slopes - truth[1]), axis=1) / np.max(np.abs(truth[1]), axis=1)
    return {
        "tool": tool,
        "ms": 1e3 * seconds,
        "force_error": float(np.max(np.abs(forces / truth[0] - 1))),
        "gradient_error": float(np.max(apart)),
    }


def rows_of(repeats: int, say: Callable[[str], None] = lambda text: None) -> list[Row]:
    """Measure all tools in the shipped scene; return a row for each.

    Raises `NoResultError` if a design has no orbit."""
    config = load(CIC)
    own = Evaluator.of(config)
    base = np.asarray(config.design, float)
    draw = np.random.default_rng(0)
    design = base * (1 + AWAY * draw.uniform(-1, 1, base.shape))
    say("compiling")
    neighbour = own(base, series=False)
    exact = own.at_tolerance(EXACT)(design, series=False)
    if not (neighbour.usable and exact.usable):
        raise NoResultError(f"no orbit: {neighbour.status.label}, {exact.status.label}")
    truth = _numbers(exact)
    rows = _public(config, (base, design), truth, repeats)
    for tool, start in (("neighbour", neighbour.start), ("from rest", None)):
        say(f"evaluate, {tool}")
        call = functools.partial(own, design, start=start, series=False)
        seconds, found = processor_time(call, repeats)
        rows.append(_row(f"evaluate, {tool}", seconds, _numbers(found), truth))
    return rows + _competitors(config, design, truth, repeats, say)


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


def _public(config: Any, designs: Any, truth: Any, repeats: int) -> list[Row]:
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
        rows.append(_row(tool, seconds, found[:2], truth))
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
        say(name)
        best: Row | None = None
        for factor in (1.0, 3.0):
            steps = [factor * step for step in FD_STEPS]
            count = max(1, repeats // 10) if "SciPy" in name else repeats
            seconds, (_, slopes) = processor_time(
                lambda tool=tool, steps=steps: tool.gradient(tuple(design), steps), count
            )
            forces = tool.simulate(tuple(design)).response
            row = _row(name, seconds, (forces, slopes), truth)
            if best is None or row["gradient_error"] < best["gradient_error"]:
                best = row
        assert best is not None
        rows.append(best)
    return rows
