"""Evaluations of a search on the workers of a cluster.

The search stays in this process, with its steps and its checkpoint. A worker gets an evaluator, a
design, and the orbit to begin from, all of which are small (20 kB to 100 kB). It returns the
evaluation, with the orbit that it found. If a worker dies, the scheduler gives its evaluation to
another one, with the same result."""

import contextlib
import math
import pickle
import threading
import time
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from rootsopt.errors import InputError
from rootsopt.response.evaluation import Evaluation
from rootsopt.response.many import HERE, Point, Runs
from rootsopt.sweeps.worker import Settings, evaluate

# Time (s) after which a lost connection and the end of the search are noticed.
_POLL = 0.5


# Time (s) after which a scheduler without workers is given up: a new one takes 10 to 60 s.
_DESERTED = 600.0


class ClosedError(Exception):
    """Raised in threads that still wait for an evaluation when the search has ended."""


class DaskRunner:
    """Runs evaluations on the workers of a Dask `client`.

    `dask`: the package distributed; `settings`: what the workers must agree on."""

    def __init__(self, dask: Any, client: Any, settings: Settings):
        self._dask, self._client, self._settings = dask, client, settings
        self._closed, self._watch = threading.Event(), Watch(client)

    @property
    def slots(self) -> int:
        """Twice the number of evaluations that the workers can run at a time."""
        return 2 * self._watch.count()

    def evaluated(self, point: Point) -> Evaluation:
        """Return the evaluation of a point, computed by a worker.

        Raises `InputError` if the workers cannot be used; `ClosedError` after `close`."""
        import cloudpickle  # Comes with distributed; takes classes of a script or notebook along.

        task = point._replace(design=np.asarray(point.design, float))
        future = self._submit(cloudpickle.dumps(task))
        done = threading.Event()
        future.add_done_callback(lambda _: done.set())
        while not done.wait(_POLL):
            if self._closed.is_set():
                future.cancel()
                raise ClosedError
            self._watch.check()
        return pickle.loads(self._result(future))

    def _submit(self, task: bytes) -> Any:
        if self._closed.is_set():
            raise ClosedError
        return self._client.submit(evaluate, self._settings, task, pure=False)

    def _result(self, future: Any) -> bytes:
        if future.status in ("cancelled", "lost"):
            raise ClosedError if self._closed.is_set() else gone()
        error = future.exception()
        if error is None:
            return future.result()
        if isinstance(error, self._dask.KilledWorker):
            raise InputError(
                "a design ended its process several times; it may need more memory: use fewer "
                "workers, and run the same command with `--resume` if it has that option"
            )
        raise refusal(error)

    def close(self) -> None:
        """End all waiting threads; nothing can be evaluated any more."""
        self._closed.set()


class Watch:
    """Keeps an eye on the workers of a Dask `client`. Threads can share an instance."""

    def __init__(self, client: Any):
        self._client, self._lock = client, threading.Lock()
        self._count, self._asked = 1, -math.inf
        self._seen = time.monotonic()

    def count(self) -> int:
        """Return the number of tasks that the workers can run at a time, at least 1."""
        with self._lock:
            now = time.monotonic()
            if now - self._asked > _POLL:
                self._asked = now
                found = sum(self._client.nthreads().values())
                self._seen = now if found else self._seen
                self._count = max(1, found)
            return self._count

    def check(self) -> None:
        """Raise `InputError` if the connection is lost, or if there has been no worker for long."""
        if self._client.status != "running":
            raise gone()
        self.count()
        if time.monotonic() - self._seen > _DESERTED:
            raise InputError(
                f"there has been no worker for {_DESERTED:g} s; what was done is kept: start "
                "workers, and run the same command again with `--resume` if it has that option"
            )


def gone() -> InputError:
    """Return the error of a lost connection."""
    return InputError(
        "the connection to the scheduler was lost; what was done is kept: run the same command "
        "again with `--resume` if it has that option"
    )


def refusal(error: BaseException) -> InputError:
    """Return what to raise for an `error` that a worker has raised."""
    if isinstance(error, InputError):
        return error
    found = InputError(
        f"a worker cannot simulate: {type(error).__name__}: {error}; install the same version of "
        "rootsopt on all machines"
    )
    found.__cause__ = error
    return found


@contextlib.contextmanager
def evaluating(
    workers: int | None = None,
    scheduler: str | None = None,
    imports: Sequence[str] = (),
    cache: bool = True,
) -> Iterator[Runs]:
    """Yield what runs the evaluations of a search: this process, or a cluster.

    Arguments: see `rootsopt.sweeps.scenes.runner`. Raises `InputError` if there is no cluster."""
    if workers is None and scheduler is None:
        yield HERE
        return
    from rootsopt.sweeps.cluster import Cluster  # Needs an optional package.

    with Cluster(workers, scheduler, tuple(imports), cache).evaluations() as found:
        yield found


__all__ = ["ClosedError", "DaskRunner", "Watch", "evaluating", "gone", "refusal"]
