"""Divides work among the cores of the machine."""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np


def on_all_cores(work: Callable[..., Any], *arrays: Any) -> Any:
    """Return `work(*arrays)`, computed in parts along the leading axis (n,), one thread per core.

    All arrays, and all arrays of the result, must have this leading axis. The parts are equal in
    size, so that they share a compiled program."""
    count = arrays[0].shape[0]
    workers = max(1, min(os.cpu_count() or 1, count))
    size = -(-count // workers)
    # The last part is padded with copies of the last entry.
    index = np.minimum(np.arange(workers * size), count - 1).reshape(workers, size)
    with ThreadPoolExecutor(workers) as pool:
        parts = list(pool.map(lambda rows: work(*(x[rows] for x in arrays)), index))
    return jax.tree.map(lambda *x: jnp.concatenate(x)[:count], *parts)
