"""Simulates points of a sweep in other processes and on other machines, by Dask distributed.

The same workers evaluate designs of a search (`rootsopt.sweeps.evaluations`).

Points travel in small chunks. Only the process that collects them writes them down, and it knows
each point by its number. If a worker dies, the scheduler gives its chunks to another one. A chunk
that ends several workers is divided into its points. A point that ends several workers gets a
status of its own. Processes are spawned, never forked, because JAX has threads."""

import contextlib
import logging
import os
import queue
import tempfile
import threading
from collections.abc import Iterator, Sequence
from typing import Any

from rootsopt.config import Config
from rootsopt.config.words import shown
from rootsopt.errors import InputError
from rootsopt.runtime.environment import versions
from rootsopt.status import Status
from rootsopt.sweeps.evaluations import DaskRunner, Watch, gone, refusal
from rootsopt.sweeps.local import divided
from rootsopt.sweeps.plan import Plan
from rootsopt.sweeps.points import Row, lost
from rootsopt.sweeps.worker import Settings, work

_MISSING = (
    "`--workers` and `--scheduler` need the package distributed, which is not installed; install "
    "it with `pip install 'rootsopt[cluster]'`"
)
# Number of chunks per worker into which a sweep is divided, so that all workers end together.
_CHUNKS = 8
# Maximum number of points in a chunk. A worker that is killed loses at most this many.
_LARGEST = 32
# Number of chunks per worker that are sent to the scheduler in advance.
_AHEAD = 3
# Time (s) within which a scheduler must answer.
_ANSWER = 10.0
# Time (s) within which a scheduler must have a worker.
_WORKERS = 60.0
# Time (s) after which a request to stop is noticed.
_POLL = 0.5
# Dask's settings for processes started here. By default, Dask gives up a process that was killed
# unless its successor is ready in 15 s. On a busy machine, it takes longer to import everything.
_SETTINGS = {
    "distributed.worker.multiprocessing-method": "spawn",
    "distributed.deploy.lost-worker-timeout": "1h",
}


class Cluster:
    """Workers on this machine, or those of a running scheduler.

    `workers`: number of processes to start; `scheduler`: address of a scheduler. Give one of the
    two. `imports`, `cache`: see `Settings`.

    Raises `InputError` if both are given, or if the package distributed is not installed."""

    def __init__(
        self,
        workers: int | None = None,
        scheduler: str | None = None,
        imports: tuple[str, ...] = (),
        cache: bool = True,
    ):
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
        self._dask = distributed
        self.workers, self.scheduler = workers, scheduler
        threads = 1 if workers is None else max(1, (os.cpu_count() or 1) // workers)
        self._settings = Settings(tuple(versions().items()), imports, cache, threads)

    def run(
        self, config: Config, plan: Plan, numbers: Sequence[int], stop: threading.Event
    ) -> Iterator[list[tuple[int, Row]]]:
        """Yield lists of (number, record) of the points with these `numbers`, as they are done.

        `stop`: event after which no further points are awaited. Raises `InputError` if the
        scheduler cannot be used, or if a worker has other versions."""
        with self._client(1) as client:
            yield from _Collection(self._dask, client, self._settings, (config, plan)).of(
                numbers, stop
            )

    @contextlib.contextmanager
    def evaluations(self) -> Iterator[DaskRunner]:
        """Yield what runs the evaluations of a search on the workers.

        Raises `InputError` if the scheduler cannot be used."""
        with self._client(self._settings.threads) as client:
            found = DaskRunner(self._dask, client, self._settings)
            try:
                yield found
            finally:
                found.close()

    @contextlib.contextmanager
    def _client(self, threads: int) -> Iterator[Any]:
        """Yield a client of the scheduler, with at least one worker.

        `threads`: number of tasks at a time of each worker started here."""
        logging.getLogger("distributed").setLevel(logging.CRITICAL)
        option, advice = f"`--workers` {self.workers}", "choose fewer workers"
        if self.scheduler is not None:
            option = f"`--scheduler` {shown(self.scheduler)}"
            advice = (
                "give the address of a running `dask scheduler` that has workers, for example "
                "tcp://10.0.0.1:8786"
            )
        with contextlib.ExitStack() as stack:
            address = self.scheduler
            if address is None:
                address = stack.enter_context(self._started(threads))
            try:
                client = stack.enter_context(self._dask.Client(address, timeout=_ANSWER))
                client.wait_for_workers(1, timeout=_WORKERS)
            except (OSError, ValueError, TypeError, TimeoutError) as error:
                why = error or "it does not answer"
                raise InputError(f"{option} cannot be used: {why}; {advice}") from None
            yield client

    @contextlib.contextmanager
    def _started(self, threads: int) -> Iterator[Any]:
        """Start workers on this machine, reachable from this machine only; yield their cluster."""
        from dask import config as settings

        with (
            tempfile.TemporaryDirectory(prefix="rootsopt-") as scratch,
            settings.set(_SETTINGS),
            self._dask.LocalCluster(
                n_workers=self.workers,
                threads_per_worker=threads,
                processes=True,
                host="127.0.0.1",
                dashboard_address="127.0.0.1:0",
                worker_dashboard_address="127.0.0.1:0",
                memory_limit=0,
                preload=["rootsopt.sweeps.worker"],
                local_directory=scratch,
                silence_logs=logging.CRITICAL,
            ) as cluster,
        ):
            yield cluster


class _Collection:
    """The points that a scheduler still has to deliver."""

    def __init__(self, dask: Any, client: Any, settings: Settings, sweep: tuple[Config, Plan]):
        self._dask, self._client, self._settings = dask, client, settings
        config, self._plan = sweep
        self._config = config.plain()
        self._done: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._running: dict[Any, list[int]] = {}
        self._watch = Watch(client)

    def of(self, numbers: Sequence[int], stop: threading.Event) -> Iterator[list[tuple[int, Row]]]:
        """Yield the points with these `numbers`, as they are done."""
        waiting = [*divided(numbers, self._size(numbers))][::-1]
        while (waiting or self._running) and not stop.is_set():
            while waiting and len(self._running) < _AHEAD * self._watch.count():
                self._submit(waiting.pop())
            try:
                future = self._done.get(timeout=_POLL)
            except queue.Empty:
                self._watch.check()
                continue
            chunk = self._running.pop(future)
            found = self._result(future, chunk)
            if found is None:
                waiting += [[number] for number in chunk]
            else:
                yield found
        self._client.cancel([*self._running])

    def _size(self, numbers: Sequence[int]) -> int:
        share = -(-len(numbers) // (_CHUNKS * self._watch.count()))
        return min(max(share, min(self._settings.threads, len(numbers))), _LARGEST)

    def _submit(self, chunk: list[int]) -> None:
        points = [(number, self._plan.at(number)) for number in chunk]
        future = self._client.submit(work, self._settings, self._config, points, pure=False)
        self._running[future] = chunk
        future.add_done_callback(self._done.put)

    def _result(self, future: Any, chunk: list[int]) -> list[tuple[int, Row]] | None:
        """Return the points of a chunk, or `None` if they must be tried one by one."""
        if future.status == "cancelled" or future.status == "lost":
            raise gone()
        error = future.exception()
        if error is None:
            return future.result()
        if isinstance(error, self._dask.KilledWorker):
            why = "the process that simulated it ended, several times; it may need more memory"
            return None if len(chunk) > 1 else [(chunk[0], lost(Status.FAILED, why))]
        raise refusal(error)


__all__ = ["Cluster"]
