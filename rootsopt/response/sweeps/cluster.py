"""Simulates points of a sweep, and designs of a search, in other processes, by Dask distributed.

Plan, search, steps and file stay in this process. A worker gets what it needs to simulate some
points of a sweep, or to evaluate a design: the evaluator, the design, and the orbit to begin from
(20 kB to 100 kB). If a worker dies, the scheduler gives its tasks to another one, with the same
result. Points of a sweep travel in small chunks. A chunk that ends several workers is divided into
its points. A point that ends several workers gets a status of its own. Processes are spawned, never
forked, because JAX has threads."""

import contextlib
import functools
import logging
import math
import os
import pickle
import signal
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from rootsopt.config.reading import Config
from rootsopt.config.sources import import_named
from rootsopt.config.units import shown
from rootsopt.errors import InputError
from rootsopt.response.reducers import HERE, Point, Runs
from rootsopt.response.result import Evaluation
from rootsopt.response.sweeps.points import Numbered, Row, at_once, lost
from rootsopt.runtime import environment, programs
from rootsopt.runtime.environment import versions
from rootsopt.status import Status

_MISSING = (
    "`--workers` and `--scheduler` need the package distributed, which is not installed; install "
    "it with `pip install 'rootsopt[cluster]'`"
)
# Number of chunks per worker into which a sweep is divided, so that all workers end together, and
# maximum number of points in a chunk: a worker that is killed loses at most this many.
_CHUNKS, _LARGEST = 8, 32
# Maximum time (s) until a scheduler answers, and until it has a worker.
_ANSWER, _WORKERS = 10.0, 60.0
# Time (s) after which a lost connection, the end of the search and a request to stop are noticed.
_POLL = 0.5
# Time (s) without workers after which a scheduler is abandoned. A new worker takes 10 to 60 s to
# start.
_DESERTED = 600.0
# Dask's settings for processes started here. By default, Dask gives up a process that was killed
# unless its successor is ready in 15 s. On a busy machine, it takes longer to import everything.
_SETTINGS = {
    "distributed.worker.multiprocessing-method": "spawn",
    "distributed.deploy.lost-worker-timeout": "1h",
}
_one = threading.Lock()


class Settings(NamedTuple):
    """Settings that a worker must share with the process that collects the results.

    `versions` (name, version); `imports`: names of files and modules to import first; `cache`:
    whether to keep compiled programs between runs."""

    versions: tuple[tuple[str, str], ...]
    imports: tuple[str, ...] = ()
    cache: bool = True


def work(settings: Settings, task: bytes) -> bytes:
    """Return what a function returns for its arguments, in a worker.

    `task`: the function, followed by its arguments. It travels as bytes, as does the result: its
    arrays need double precision, and its types may need an import. Raises `InputError` if this
    worker has other versions than the process that asks."""
    with _one:
        _prepare(settings)
    function, *arguments = pickle.loads(task)
    return pickle.dumps(function(*arguments))


def dask_setup(worker: Any) -> None:
    """Ignore Ctrl-C, which reaches all processes of a terminal: the sweep's own process reacts.

    Dask calls this function when it starts a process with this module as `preload`."""
    del worker
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, signal.SIG_IGN)


@functools.cache
def _prepare(settings: Settings) -> None:
    here = dict(versions())
    odd = [name for name, version in settings.versions if here.get(name) != version]
    if odd:
        there = dict(settings.versions)
        told = ", ".join(f"{name} {here.get(name)} instead of {there[name]}" for name in odd)
        raise InputError(
            f"a worker has other versions than this process: {told}; install the same ones on all "
            "machines"
        )
    environment.use_one_thread()
    environment.use_float64()
    refused = programs.keep_by_default() if settings.cache else programs.keep_in(None)
    if refused:
        environment.say(f"compiled programs are not kept between runs: {refused}")
    for name in settings.imports:
        import_named(name)


class ClosedError(Exception):
    """Raised in threads that still wait for a worker when the search or sweep has ended."""


class DaskRunner:
    """Runs evaluations, and points of a sweep, on the workers of a Dask `client`, for many threads.

    `dask`: the package distributed; `settings`: settings that the workers must share."""

    def __init__(self, dask: Any, client: Any, settings: Settings):
        self._dask, self._client, self._settings = dask, client, settings
        self._closed, self._lock = threading.Event(), threading.Lock()
        self._count, self._asked, self._seen = 1, -math.inf, time.monotonic()

    @property
    def slots(self) -> int:
        """Twice the number of tasks that the workers can run at a time."""
        return 2 * self._workers()

    def _workers(self) -> int:
        """Return the number of tasks that the workers can run at a time, at least 1."""
        with self._lock:
            now = time.monotonic()
            if now - self._asked > _POLL:
                threads = sum(self._client.nthreads().values())
                self._asked, self._count = now, max(1, threads)
                self._seen = now if threads else self._seen
            return self._count

    def _check(self) -> None:
        """Raise `InputError` if the connection is lost, or if there has been no worker for long."""
        if self._client.status != "running":
            raise _gone()
        self._workers()
        if time.monotonic() - self._seen > _DESERTED:
            raise InputError(
                f"there has been no worker for {_DESERTED:g} s; what was done is kept: start "
                "workers, and run the same command again with `--resume` if it has that option"
            )

    def evaluated(self, point: Point) -> Evaluation:
        """Return the evaluation of a point, computed by a worker.

        Raises `InputError` if the workers cannot be used; `ClosedError` after `close`."""
        task = point._replace(design=np.asarray(point.design, float))
        evaluation = self._run(self._closed, HERE.evaluated, task)
        if evaluation is None:
            raise InputError(
                "a design ended its process several times; it may need more memory: use fewer "
                "workers, and run the same command with `--resume` if it has that option"
            )
        return evaluation

    def share(self, count: int) -> int:
        """Return the number of points in a chunk, for a sweep of `count` points."""
        return min(-(-count // (_CHUNKS * self._workers())), _LARGEST)

    def simulated(
        self, config: Config, points: Sequence[Numbered], stop: threading.Event
    ) -> list[tuple[int, Row]]:
        """Return (number, record) of `points`, as `points.at_once`.

        Raises `InputError` if the workers cannot be used; `ClosedError` once `stop` is set."""
        rows = self._run(stop, at_once, config, points)
        if rows is not None:
            return rows
        if len(points) > 1:
            return [row for one in points for row in self.simulated(config, [one], stop)]
        why = "the process that simulated it ended, several times; it may need more memory"
        return [(points[0][0], lost(Status.FAILED, why))]

    def _run(self, stop: threading.Event, function: Callable[..., Any], *arguments: Any) -> Any:
        """Return `function(*arguments)`, computed by a worker; `None` if it kills the workers."""
        import cloudpickle  # Installed with distributed; serialises a script's classes.

        if stop.is_set() or self._closed.is_set():
            raise ClosedError
        task = cloudpickle.dumps((function, *arguments))
        future = self._client.submit(work, self._settings, task, pure=False)
        done = threading.Event()
        future.add_done_callback(lambda _: done.set())
        while not done.wait(_POLL):
            if stop.is_set() or self._closed.is_set():
                future.cancel()
                raise ClosedError
            self._check()
        if future.status in ("cancelled", "lost"):
            raise ClosedError if self._closed.is_set() else _gone()
        error = future.exception()
        if error is None:
            return pickle.loads(future.result())
        if isinstance(error, self._dask.KilledWorker):
            return None
        if isinstance(error, InputError):
            raise error
        raise InputError(
            f"a worker cannot simulate: {type(error).__name__}: {error}; install the same version "
            "of rootsopt on all machines"
        ) from error

    def close(self) -> None:
        """End all waiting threads; nothing can be evaluated any more."""
        self._closed.set()


def _gone() -> InputError:
    return InputError(
        "the connection to the scheduler was lost; what was done is kept: run the same command "
        "again with `--resume` if it has that option"
    )


@contextlib.contextmanager
def running(
    workers: int | None = None,
    scheduler: str | None = None,
    imports: Sequence[str] = (),
    cache: bool = True,
) -> Iterator[Runs]:
    """Yield what runs the evaluations of a search or a sweep: this process, or a cluster.

    `workers`: number of processes to start on this machine; `scheduler`: address of a scheduler
    whose workers to use. Give at most one of the two. `imports`, `cache`: see `Settings`.

    Raises `InputError` if both are given, if the package distributed is not installed, or if the
    scheduler cannot be used."""
    if workers is None and scheduler is None:
        yield HERE
        return
    if workers is not None and scheduler is not None:
        raise InputError(
            "`--workers` and `--scheduler` exclude each other: a scheduler has its own "
            "workers; remove one"
        )
    if workers is not None and not 1 <= workers <= 1024:
        raise InputError(f"`--workers` must be from 1 to 1024, but is {workers}")
    try:
        import distributed
    except ImportError:
        raise InputError(_MISSING) from None
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    option, advice = f"`--workers` {workers}", "choose fewer workers"
    if scheduler is not None:
        option = f"`--scheduler` {shown(scheduler)}"
        advice = (
            "give the address of a running `dask scheduler` that has workers, for example "
            "tcp://10.0.0.1:8786"
        )
    settings = Settings(tuple(versions().items()), tuple(imports), cache)
    with contextlib.ExitStack() as stack:
        address = scheduler
        if workers is not None:
            address = stack.enter_context(_started(distributed, workers))
        try:
            client = stack.enter_context(distributed.Client(address, timeout=_ANSWER))
            client.wait_for_workers(1, timeout=_WORKERS)
        except (OSError, ValueError, TypeError, TimeoutError) as error:
            why = error or "it does not answer"
            raise InputError(f"{option} cannot be used: {why}; {advice}") from None
        runner = DaskRunner(distributed, client, settings)
        stack.callback(runner.close)
        yield runner


@contextlib.contextmanager
def _started(dask: Any, workers: int) -> Iterator[Any]:
    """Start workers on this machine, reachable from this machine only; yield their cluster."""
    from dask import config as settings

    with (
        tempfile.TemporaryDirectory(prefix="rootsopt-") as scratch,
        settings.set(_SETTINGS),
        dask.LocalCluster(
            n_workers=workers,
            threads_per_worker=max(1, (os.cpu_count() or 1) // workers),
            processes=True,
            host="127.0.0.1",
            dashboard_address="127.0.0.1:0",
            worker_dashboard_address="127.0.0.1:0",
            memory_limit=0,
            preload=["rootsopt.response.sweeps.cluster"],
            local_directory=scratch,
            silence_logs=logging.CRITICAL,
        ) as cluster,
    ):
        yield cluster
