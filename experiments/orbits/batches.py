"""Times batches of designs: value and gradient, from a neighbour's orbit and from rest.

On a GPU, all designs of a batch are computed together, or as many as fit its memory. On a CPU, each
thread computes a part of the batch, one design after the other: on one thread, and on one thread
per core. Some designs are compared with single evaluations on the CPU, by a program without
batches."""

import functools
import os
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import numpy as np

from experiments._common.scenes import CIC
from experiments._common.timing import median_time
from experiments.orbits.speed import AWAY, Row, rest_of, solver_of
from rootsopt import Scene
from rootsopt.config import load
from rootsopt.status import Status

# Usual numbers of designs in a batch.
SIZES = 256, 1024, 4096, 16384, 65536

# Number of designs that are compared with single evaluations.
_CHECKED = 8

# Number of designs that a thread of a CPU computes in one call.
_PART = 32

# Memory (bytes) for each design that is computed on a GPU.
_NEEDED = 3.5e6

# Maximum number of timed calls, and time (s) after which no further call is made.
_REPEATS, _SECONDS = 5, 10.0


def rows_of(sizes: Sequence[int], say: Callable[[str], None] = lambda text: None) -> Iterator[Row]:
    """Yield a row for each of `sizes` and each start."""
    config = load(CIC, [])
    machine, base = Scene.from_config(config), np.asarray(config.design, float)
    draw = np.random.default_rng(0)
    designs = base * (1 + AWAY * draw.uniform(-1, 1, (max(sizes), *base.shape)))
    solve = solver_of(machine)
    say("compiling for single designs")
    with jax.default_device(jax.devices("cpu")[0]):
        single = jax.jit(solve)
        rest = rest_of(machine, base)
        starts = {"neighbour": single(base, rest)[2], "rest": rest}
        truth = {
            name: [single(design, start)[:2] for design in designs[:_CHECKED]]
            for name, start in starts.items()
        }
    device = jax.devices()[0]
    starts = jax.device_put(starts, device)
    for size in sizes:
        say(f"{size} designs: compiling")
        for call, row in _calls(solve, designs[:size], starts["rest"]):
            for name, start in starts.items():
                say(f"{size} designs from {name}, {row['device']}")
                call(start)
                again = functools.partial(call, start)
                seconds, found = median_time(again, _REPEATS, _SECONDS)
                yield {
                    **row,
                    "start": name,
                    "designs": size,
                    "s": seconds,
                    "designs_per_s": size / seconds,
                    "periodic": float(np.mean(found[2] == Status.PERIODIC.code)),
                    "peak_bytes": (device.memory_stats() or {}).get("peak_bytes_in_use"),
                    **_differences(found, truth[name]),
                }


def _calls(
    solve: Callable[..., Any], designs: np.ndarray, start: Any
) -> Iterator[tuple[Callable[[Any], list[np.ndarray]], Row]]:
    """Yield functions start -> (forces, gradients, statuses) of all `designs`, each with its row.

    There is one for a GPU, and two for a CPU: on one thread, and on one per core."""
    device, size = jax.devices()[0], len(designs)
    cpu = device.platform == "cpu"
    room = _PART if cpu else int((device.memory_stats() or {})["bytes_limit"] / _NEEDED)
    part = -(-size // -(-size // room))
    # Parts of equal size share a program. The last part is filled with the last design.
    rows = np.minimum(np.arange(-(-size // part) * part), size - 1).reshape(-1, part)
    parts = [jax.device_put(designs[some], device) for some in rows]

    def without_start(design, start):
        values, slopes, _, status = solve(design, start)
        return values, slopes, status

    lowered = jax.jit(jax.vmap(without_start, (0, None))).lower(parts[0], start)
    began = time.perf_counter()
    program = lowered.compile()
    row = {"together": part, "compile_s": time.perf_counter() - began}
    for threads in (1, os.cpu_count()) if cpu else (1,):

        def in_parts(start, threads=threads):
            with ThreadPoolExecutor(threads) as pool:
                done = pool.map(lambda x: jax.device_get(program(x, start)), parts)
                return [np.concatenate(x)[:size] for x in zip(*done, strict=True)]

        yield in_parts, row | {"device": f"{device.device_kind}" + f", {threads} threads" * cpu}


def _differences(found: list[np.ndarray], truth: list[Any]) -> Row:
    """Return the greatest relative differences of forces and gradients from single evaluations."""
    forces, slopes = (np.stack([np.asarray(one[k]) for one in truth]) for k in range(2))
    count = min(len(forces), len(found[0]))
    apart = np.max(np.abs(found[1][:count] - slopes[:count]), axis=-1)
    return {
        "force_difference": float(np.max(np.abs(found[0][:count] / forces[:count] - 1))),
        "gradient_difference": float(np.max(apart / np.max(np.abs(slopes[:count]), axis=-1))),
    }
