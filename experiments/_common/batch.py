"""Forces and gradients by `rootsopt.steady_response`: of one design, and of many at once.

On a GPU, all designs of a batch are computed together, or as many as fit its memory. On a CPU, each
thread computes a part of the batch, one design after the other."""

import os
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments._common.tables import Row
from rootsopt import COMPILER_OPTIONS, Scene, steady_response

# Maximum number of designs that a thread of a CPU computes in one call.
_PART = 32

# Memory (bytes) for each design that is computed on a GPU.
_NEEDED = 3.5e6

Solve = Callable[[Any, Any], tuple[Any, ...]]


def solver_of(scene: Scene, gradient: bool = True) -> Solve:
    """Return the function (design, start) -> (forces, gradients, status, next start).

    The forces are mean and peak (2,) in N, the gradients (2, d) in N per config unit, or None
    without `gradient`."""

    def solve(design, start):
        def forces(design):
            found = steady_response(scene, design, start)
            values = jnp.stack([found.mean, found.peak])
            return values, (values, found.status, found.start)

        if gradient:
            slopes, (values, *rest) = jax.jacfwd(forces, has_aux=True)(design)
        else:
            slopes, (values, *rest) = None, forces(design)[1]
        return values, slopes, *rest

    return solve


def compiled(solve: Solve) -> Solve:
    """Return `solve` as one program, whose results are ready."""
    program = jax.jit(solve, compiler_options=dict(COMPILER_OPTIONS))
    return lambda design, start: jax.block_until_ready(program(design, start))


def rest_of(scene: Scene, design: Any) -> Any:
    """Return a start at rest, in the form of `Response.start`."""
    start = jax.eval_shape(lambda: steady_response(scene, design).start)
    return jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), start)


def batches_of(
    solve: Solve, designs: np.ndarray, start: Any
) -> Iterator[tuple[Callable[[Any], list[np.ndarray]], Row]]:
    """Yield functions start -> (forces, gradients, statuses) of all `designs` (n, d).

    There is one for a GPU, and two for a CPU: on one thread, and on one per core. With each comes a
    row: designs in one call, time to compile (s), device."""
    device, size = jax.devices()[0], len(designs)
    cpu = device.platform == "cpu"
    shared = max(1, min(_PART, size // (os.cpu_count() or 1)))
    room = shared if cpu else int((device.memory_stats() or {})["bytes_limit"] / _NEEDED)
    part = -(-size // -(-size // room))
    # Parts of equal size share a program. The last part is filled with the last design.
    rows = np.minimum(np.arange(-(-size // part) * part), size - 1).reshape(-1, part)
    parts = [jax.device_put(designs[some], device) for some in rows]
    many = jax.vmap(lambda design, start: solve(design, start)[:3], (0, None))
    options = dict(COMPILER_OPTIONS) if cpu else {}
    lowered = jax.jit(many, compiler_options=options).lower(parts[0], start)
    began = time.perf_counter()
    program = lowered.compile()
    row = {"together": part, "compile_s": time.perf_counter() - began}
    for threads in (1, os.cpu_count()) if cpu else (1,):

        def in_parts(start, threads=threads):
            with ThreadPoolExecutor(threads) as pool:
                done = pool.map(lambda x: jax.device_get(program(x, start)), parts)
                return jax.tree.map(lambda *x: np.concatenate(x)[:size], *done)

        yield in_parts, row | {"device": f"{device.device_kind}" + f", {threads} threads" * cpu}
