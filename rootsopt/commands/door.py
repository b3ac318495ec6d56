"""The edge of the process: signals, standard streams, exit code.

A command line owns these, and a library must leave them alone. Everything here is active only while
a command runs as its own process (`main()` without arguments). Called from Python with arguments, a
command touches neither signals nor file descriptors. This module imports little, so that an
interrupt works even while the rest is being imported.
"""

import contextlib
import errno
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from typing import Any

OK, BAD_INPUT, NO_RESULT = 0, 2, 3
_NAMES = {signal.SIGINT: "Ctrl-C", signal.SIGTERM: "SIGTERM"}
_GONE = (errno.EPIPE, errno.EBADF, errno.ESHUTDOWN)
"""Error numbers of a stream without a reader; the exit code ignores them."""
_WAITING = "rootsopt signals"
_SHOW_CURSOR = "\x1b[?25h"


class Signals:
    """Response of a run to SIGINT and SIGTERM.

    A thread waits for the signals, because the main thread may stay in compiled code for a long
    time. The first signal stops the run at once: `abandon` removes unfinished files, one line says
    so, and the exit code is 3. With `patient`, the first signal only sets `stop` and tells the user
    the `promise`. The second signal stops the run.
    """

    def __init__(self, command: str):
        self.command = command
        self.stop = threading.Event()
        self.patient = False
        self.promise = ""
        self.abandon: Callable[[], str] = str
        self._before: dict[int, Any] = {}
        self._pipe: tuple[int, int] | None = None
        self._wakeup = -1

    def install(self) -> None:
        """Take over the signals that have their default handler; leave others alone."""
        if threading.current_thread() is not threading.main_thread():
            return
        for number in _NAMES:
            before = signal.getsignal(number)
            if before in (signal.SIG_DFL, signal.default_int_handler):
                self._before[number] = before
        if not self._before:
            return
        reading, writing = self._pipe = os.pipe()
        os.set_blocking(writing, False)
        self._wakeup = signal.set_wakeup_fd(writing, warn_on_full_buffer=False)
        waiting = threading.Thread(target=self._wait, args=(reading,), name=_WAITING, daemon=True)
        waiting.start()
        for number in self._before:
            signal.signal(number, _nothing)

    def remove(self) -> None:
        """Restore the signal handlers that `install` replaced."""
        if self._pipe is None:
            return
        for number, before in self._before.items():
            signal.signal(number, before)
        signal.set_wakeup_fd(self._wakeup)
        _, writing = self._pipe
        self._pipe = None
        os.close(writing)  # ends the thread, which closes the other end

    def _wait(self, reading: int) -> None:
        while numbers := os.read(reading, 1):
            self._answer(_NAMES.get(signal.Signals(numbers[0]), "a signal"))
        os.close(reading)

    def _answer(self, what: str) -> None:
        if self.patient and not self.stop.is_set():
            self.say(f"{what}: {self.promise} (once more to stop at once)")
            self.stop.set()
            return
        state = self.abandon()
        self.say(f"stopped by {what}" + (f"; {state}" if state else ""))
        os._exit(NO_RESULT)

    def say(self, text: str) -> None:
        """Write one line to stderr; a stream that cannot be written is not an error."""
        shown = f"rootsopt {self.command}".rstrip()
        try:
            start = f"\r{_SHOW_CURSOR}" if os.isatty(2) else ""
            os.write(2, f"{start}{shown}: {text}\n".encode(errors="replace"))
        except OSError:
            return


def _nothing(number: int, frame: object) -> None:
    """Let the main thread continue after a signal."""


_running: Signals | None = None


@contextlib.contextmanager
def patience(promise: str) -> Iterator[threading.Event]:
    """Yield an event that the first signal sets instead of stopping the run.

    `promise`: text that tells the user what happens after the signal. In a command that is not its
    own process, nothing sets the event.
    """
    signals = _running
    if signals is None:
        yield threading.Event()
        return
    signals.promise, signals.patient = promise, True
    yield signals.stop  # Stay patient to the end: results that took long must be written.


@contextlib.contextmanager
def leaving(abandon: Callable[[], str]) -> Iterator[None]:
    """Call `abandon` if a signal stops the process during the `with` block.

    `abandon` cleans up and returns a text for the user."""
    signals = _running
    if signals is None:
        yield
        return
    signals.abandon = abandon
    try:
        yield
    finally:
        signals.abandon = str


class _Stream:
    """A standard stream whose errors do not end the run, but are stored in `error`."""

    def __init__(self, stream: Any, number: int | None):
        self.stream, self.number = stream, number
        self.error: OSError | None = None
        self.closed_early = False

    def write(self, text: str) -> int:
        """Write `text` and return its length; an `OSError` is not raised."""
        if not self.closed_early:
            self._guarded(lambda: self.stream.write(text))
        return len(text)

    def writelines(self, lines) -> None:
        for line in lines:
            self.write(line)

    def flush(self) -> None:
        """Flush the stream; an `OSError` is not raised."""
        if not self.closed_early:
            self._guarded(self.stream.flush)

    def _guarded(self, work: Callable[[], object]) -> None:
        try:
            work()
        except OSError as error:
            self.closed_early = True
            gone = _GONE + ((errno.EIO,) if self._terminal() else ())
            if error.errno not in gone:
                self.error = error
            if self.number is not None:
                # Discard what is left in the buffer, also at the end of the process.
                _nowhere(self.number)

    def _terminal(self) -> bool:
        try:
            return self.stream.isatty()
        except (OSError, ValueError):
            return True

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)


def _nowhere(number: int) -> None:
    """Redirect a file descriptor to the null device."""
    with contextlib.suppress(OSError):
        null = os.open(os.devnull, os.O_RDWR)
        if null != number:
            os.dup2(null, number)
            os.close(null)


@contextlib.contextmanager
def _streams(own: bool) -> Iterator[_Stream]:
    """Yield a guarded stdout; stdout and stderr are `_Stream` objects during the `with` block.

    `own`: the streams are the process's own, so that closed streams are opened first."""
    if own:
        for number in (0, 1, 2):
            try:
                os.fstat(number)
            except OSError:
                _nowhere(number)
    before: tuple[Any, Any] = sys.stdout, sys.stderr
    guards = []
    for number, stream in enumerate(before, start=1):
        if stream is None:
            stream = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115
        elif own:
            with contextlib.suppress(AttributeError, ValueError, OSError):
                # Show a question mark for a character that the terminal lacks.
                stream.reconfigure(errors="replace")
        guards.append(_Stream(stream, number if own else None))
    sys.stdout, sys.stderr = guards
    try:
        yield guards[0]
    finally:
        for guard in guards:
            guard.flush()
        sys.stdout, sys.stderr = before


def through(command: str, work: Callable[[], int], own: bool) -> int:
    """Run a command's `work` and return its exit code; guard the edges of the process.

    `own`: the process is the command's own. A missing reader (as in `| true`) does not change the
    exit code. If stdout cannot take the output, the exit code is 2.
    """
    global _running
    if not own or _running is not None:
        with _streams(own=False) as out:
            code = work()
            out.flush()
        return _code(command, code, out)
    signals = Signals(command)
    signals.install()
    _running = signals
    try:
        with _streams(own=True) as out:
            try:
                code = work()
            except SystemExit as end:  # raised by the parser: help, or wrong arguments
                code = end.code if isinstance(end.code, int) else NO_RESULT
            out.flush()
            code = _code(command, code, out)
            sys.stderr.flush()
            if signals.stop.is_set():
                # Abandoned evaluations may still be running in other threads.
                os._exit(code)
    finally:
        _running = None
        signals.remove()
    return code


def _code(command: str, code: int, out: _Stream) -> int:
    if out.error is None:
        return code
    why = (out.error.strerror or str(out.error)).lower()
    message = f"rootsopt {command}: standard output cannot be written: {why}; redirect it elsewhere"
    print(message, file=sys.stderr)
    return BAD_INPUT


def leave(code: int) -> None:
    """End the process with exit `code`, which a signal during the exit does not change.

    If other threads are still running, end at once without waiting for them. Shutting Python down
    around them can abort the process with another exit code.
    """
    for number in _NAMES:
        with contextlib.suppress(ValueError, OSError):
            signal.signal(number, lambda *_: os._exit(code))
    names = {one.name for one in threading.enumerate()}
    if names - {threading.main_thread().name, _WAITING}:
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(AttributeError, OSError, ValueError):
                stream.flush()
        os._exit(code)
    sys.exit(code)
