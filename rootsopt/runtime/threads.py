"""Divides work among the cores of the machine, with results that do not depend on their number.

Also saves time and memory while programs are compiled."""

import contextlib
import ctypes
import gc
import os
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from threadpoolctl import threadpool_limits

T = TypeVar("T")
POLL = 0.05
"""Interval (s) at which a waiting thread checks whether it should stop."""


class _OneThread(contextlib.ContextDecorator):
    """Context in which dense algebra (BLAS, LAPACK) uses one thread.

    The number of threads belongs to the process, so that overlapping contexts share it. It is
    restored when the last one ends, provided that this is in the thread that began the first one:
    threadpoolctl lets no other thread change it."""

    def __init__(self) -> None:
        self._lock, self._users = threading.Lock(), 0
        self._limits: Any = None

    def __enter__(self) -> None:
        with self._lock:
            if not self._users:
                self._limits = threadpool_limits(1)
            self._users += 1

    def __exit__(self, *error: object) -> None:
        with self._lock:
            self._users -= 1
            if not self._users:
                self._limits.restore_original_limits()


one_thread = _OneThread()
"""Decorator and context for dense algebra on one thread. With more threads, rounding depends on
their number. Commands choose one thread for the whole process instead (`use_one_thread`)."""


def on_all_cores(work: Callable[..., Any], *arrays: Any) -> Any:
    """Return `work(*arrays)`, computed row by row along the leading axis (n,), one thread per core.

    All arrays, and all arrays of the result, must have this leading axis. Rows are not grouped: the
    size of a group would depend on the number of cores, and rounding on the size."""
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        rows = range(arrays[0].shape[0])
        parts = list(pool.map(lambda k: work(*(x[k : k + 1] for x in arrays)), rows))
    return jax.tree.map(lambda *x: jnp.concatenate(x), *parts)


def until_stopped(work: Callable[[], T], stop: threading.Event, patience: float) -> T | None:
    """Run `work()` in its own thread, and return its result, or `None` if it ends too late.

    `stop`: event that asks `work` to end. Once it is set, this function waits at most `patience`
    (s). The first `KeyboardInterrupt` sets `stop`; a second one is raised. Because `work` has its
    own thread, an interrupt takes effect even while compiled code is running."""
    future: Future[T] = Future()

    def do() -> None:
        try:
            future.set_result(work())
        except BaseException as error:
            future.set_exception(error)

    threading.Thread(target=do, daemon=True).start()
    late = float("inf")
    while True:
        try:
            wait([future], POLL)
            if stop.is_set():
                late = min(late, time.monotonic() + patience)
        except KeyboardInterrupt:
            if stop.is_set():
                raise
            stop.set()
        if future.done():
            return future.result()
        if time.monotonic() > late:
            return None


@contextlib.contextmanager
def without_collection() -> Iterator[None]:
    """Pause the collection of cyclic garbage. Tracing makes many objects and drops few of them, and
    spends a quarter of its time in the collector."""
    paused = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if paused:
            gc.enable()


def trim() -> None:
    """Give memory that the compiler has freed back to the system.

    The C library of Linux keeps it otherwise: some 150 MB for each large program."""
    with contextlib.suppress(OSError, AttributeError, TypeError):
        ctypes.CDLL(None).malloc_trim(0)
