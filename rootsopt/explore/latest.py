"""A thread that runs the newest of the jobs it is given, and drops those that came before."""

import threading
import time
from collections.abc import Callable


class Latest:
    """Runs jobs one at a time in a thread of its own; the newest waiting job replaces all others.

    A slider can ask for work faster than it can be done. A job that has not begun when a newer one
    arrives never begins. `failed` is called with the exception of a job that raises one."""

    def __init__(self, failed: Callable[[Exception], None]):
        self._failed = failed
        self._job: Callable[[], object] | None = None
        self._due = 0.0
        self._changed = threading.Condition()
        self._closed = False
        self._began: float | None = None
        threading.Thread(target=self._work, daemon=True).start()

    def submit(self, job: Callable[[], object], delay: float = 0.0) -> None:
        """Run `job` as soon as the present one has ended, but not before `delay` (s).

        A newer job within this time replaces it."""
        with self._changed:
            self._job, self._due = job, time.monotonic() + delay
            self._changed.notify()

    def clear(self) -> None:
        """Drop the waiting job."""
        with self._changed:
            self._job = None

    def close(self) -> None:
        """Drop the waiting job, and end the thread after the present one."""
        with self._changed:
            self._job, self._closed = None, True
            self._changed.notify()

    @property
    def seconds(self) -> float:
        """Time (s) that the present job has taken so far; 0 if none is running."""
        began = self._began
        return 0.0 if began is None else time.monotonic() - began

    def _work(self) -> None:
        while (job := self._next()) is not None:
            self._began = time.monotonic()
            try:
                job()
            except Exception as error:
                self._failed(error)
            finally:
                self._began = None

    def _next(self) -> Callable[[], object] | None:
        """Wait for a job that is due and return it; `None` once the thread is to end."""
        with self._changed:
            while not self._closed:
                if self._job is None:
                    self._changed.wait()
                elif (left := self._due - time.monotonic()) > 0:
                    self._changed.wait(left)
                else:
                    job, self._job = self._job, None
                    return job
            return None


__all__ = ["Latest"]
