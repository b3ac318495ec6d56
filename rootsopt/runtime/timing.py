"""Measures how much of a run is spent on tracing and compiling."""

import time
from types import TracebackType

import jax

_COMPILE_EVENTS = (
    "/jax/core/compile/jaxpr_trace_duration",
    "/jax/core/compile/jaxpr_to_mlir_module_duration",
    "/jax/core/compile/backend_compile_duration",
)


class CompileClock:
    """Context manager that measures the time spent on tracing, lowering and compiling.

    JAX reports the duration of each of these steps. Steps overlap, because programs compile in
    parallel and traces are nested. The clock therefore counts the time during which at least one
    step was running."""

    def __init__(self) -> None:
        self._spans: list[tuple[float, float]] = []
        self._running = False

    @property
    def seconds(self) -> float:
        """Time measured so far (s)."""
        total, reached = 0.0, float("-inf")
        for begin, end in sorted(self._spans):
            total += max(0.0, end - max(begin, reached))
            reached = max(reached, end)
        return total

    def __enter__(self) -> "CompileClock":
        self._running = True
        jax.monitoring.register_event_duration_secs_listener(self._listen)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._running = False

    def _listen(self, event: str, duration_secs: float, **_: object) -> None:
        if self._running and event in _COMPILE_EVENTS:
            now = time.perf_counter()
            self._spans.append((now - duration_secs, now))
