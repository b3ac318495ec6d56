"""How much of a run went into tracing and compiling."""

from types import TracebackType

import jax

_COMPILE_EVENTS = (
    "/jax/core/compile/jaxpr_trace_duration",
    "/jax/core/compile/jaxpr_to_mlir_module_duration",
    "/jax/core/compile/backend_compile_duration",
)


class CompileClock:
    """Adds up JAX's own tracing, lowering and compile times while it is entered.

    Nested traces are counted once each by JAX, so the trace share is an upper bound.
    """

    def __init__(self) -> None:
        self.seconds = 0.0
        self._running = False

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
        if self._running and event in _COMPILE_EVENTS[1:]:
            self.seconds += duration_secs
