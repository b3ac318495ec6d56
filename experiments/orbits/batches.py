"""Times batches of designs: value and gradient, from a neighbour's orbit and from rest.

A CPU computes them on one thread, and on one thread per core. Some designs are compared with single
evaluations on the CPU, by a program without batches."""

import functools
from collections.abc import Callable, Iterator, Sequence

import jax
import numpy as np

from experiments._common.batch import batches_of, compiled, rest_of, solver_of
from experiments._common.scenes import CIC
from experiments._common.simulation import errors_of
from experiments._common.tables import Row
from experiments._common.timing import median_time
from experiments.orbits.speed import AWAY
from rootsopt import Scene
from rootsopt.config import load
from rootsopt.status import Status

# Usual numbers of designs in a batch.
SIZES = 256, 1024, 4096, 16384, 65536

# Number of designs that are compared with single evaluations.
_CHECKED = 8

# Maximum number of timed calls, and time (s) after which no further call is made.
_REPEATS, _SECONDS = 5, 10.0


def rows_of(sizes: Sequence[int], say: Callable[[str], None]) -> Iterator[Row]:
    """Yield a row for each of `sizes` and each start."""
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
            name: [single(design, start)[:2] for design in designs[:_CHECKED]]
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
                seconds, found = median_time(again, _REPEATS, _SECONDS)
                yield {
                    **row,
                    "start": name,
                    "designs": size,
                    "s": seconds,
                    "designs_per_s": size / seconds,
                    "periodic": float(np.mean(found[2] == Status.PERIODIC.code)),
                    "peak_bytes": (device.memory_stats() or {}).get("peak_bytes_in_use"),
                    **errors_of(
                        [x[:_CHECKED] for x in found[:2]],
                        [np.stack(x)[:size] for x in zip(*truth[name], strict=True)],
                    ),
                }
