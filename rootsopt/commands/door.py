"""Signals, standard streams and exit code of a command's process.

A program may change these settings of its process, but a library must leave them alone. A command
runs as its own process if `main()` is called without arguments. Only then does it change signal
handlers and file descriptors, not if Python code calls it with arguments. This module imports
little, so that an interrupt is handled even while other modules are being imported."""

import contextlib
import errno
import gc
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from typing import Any

OK, BAD_INPUT, NO_RESULT = 0, 2, 3
_NAMES = {signal.SIGINT: "Ctrl-C", signal.SIGTERM: "SIGTERM"}

# Error numbers (errno) that mean that nobody reads a stream. They do not change the exit code.
_GONE = (errno.EPIPE, errno.EBADF, errno.ESHUTDOWN)
_WAITING = "rootsopt signals"
_SHOW_CURSOR = "\x1b[?25h"


class Signals:
    """Handles SIGINT and SIGTERM while a command runs.

    `command`: name of the command in messages. A thread waits for the signals, because the main
    thread may stay in compiled code for a long time. The first signal stops the run at once with
    exit code 3. Before that, `abandon` is called to remove unfinished files, and one line on stderr
    says what happened.

    If `patient` is true, the first signal only sets the event `stop` and prints `promise`. The
    second signal then stops the run."""

    def __init__(self, command: str):
        self.command = command
        self.stop = threading.Event()
        self.patient = False
        self.promise = ""
        self.abandon: Callable[[], str] = str
        self._before: dict[int, Any] = {}
        self._writing = -1
        self._wakeup = -1

    def install(self) -> None:
        """Handle each signal that has Python's default handler; leave other handlers in place.

        Outside the main thread, do nothing."""
        if threading.current_thread() is not threading.main_thread():
            return
        found = {number: signal.getsignal(number) for number in _NAMES}
        defaults = signal.SIG_DFL, signal.default_int_handler
        self._before = {number: one for number, one in found.items() if one in defaults}
        if not self._before:
            return
        reading, self._writing = os.pipe()
        os.set_blocking(self._writing, False)
        self._wakeup = signal.set_wakeup_fd(self._writing, warn_on_full_buffer=False)
        threading.Thread(target=self._wait, args=(reading,), name=_WAITING, daemon=True).start()
        for number in self._before:
            # Another thread responds to the signal.
            signal.signal(number, lambda *_: None)

    def remove(self) -> None:
        """Restore the signal handlers that `install` replaced."""
        if self._writing < 0:
            return
        for number, before in self._before.items():
            signal.signal(number, before)
        signal.set_wakeup_fd(self._wakeup)
        os.close(self._writing)  # ends the thread, which closes the other end
        self._writing = -1

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
        """Write `text` as one line to stderr; ignore an `OSError`."""
        shown = f"rootsopt {self.command}".rstrip()
        with contextlib.suppress(OSError):
            start = f"\r{_SHOW_CURSOR}" if os.isatty(2) else ""
            os.write(2, f"{start}{shown}: {text}\n".encode(errors="replace"))


_running: Signals | None = None


@contextlib.contextmanager
def patience(promise: str) -> Iterator[threading.Event]:
    """Yield an event that the first signal sets, instead of stopping the run.

    `promise`: message that tells the user what the run does after the signal. No signal sets the
    event unless the command runs as its own process."""
    signals = _running or Signals("")  # The latter receives no signal.
    signals.promise, signals.patient = promise, True
    yield signals.stop  # Stay patient to the end: results that took long must be written.


@contextlib.contextmanager
def leaving(abandon: Callable[[], str]) -> Iterator[None]:
    """Call `abandon` if a signal stops the process during the `with` block.

    `abandon`: function that cleans up and returns a message for the user. It is not called unless
    the command runs as its own process."""
    signals = _running or Signals("")  # The latter receives no signal.
    signals.abandon = abandon
    try:
        yield
    finally:
        signals.abandon = str


class _Stream:
    """A standard stream whose errors do not end the run.

    After an `OSError`, further output is discarded. The error is stored in `error`, unless it only
    means that nobody reads the stream."""

    def __init__(self, stream: Any, number: int | None):
        self.stream, self.number = stream, number
        self.error: OSError | None = None
        self.closed_early = False

    def write(self, text: str) -> int:
        """Write `text` and return its length, without raising an `OSError`."""
        if not self.closed_early:
            self._guarded(lambda: self.stream.write(text))
        return len(text)

    def writelines(self, lines) -> None:
        for line in lines:
            self.write(line)

    def flush(self) -> None:
        """Flush the stream, without raising an `OSError`."""
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
    """Redirect the file descriptor `number` to the null device, which discards all output."""
    with contextlib.suppress(OSError):
        null = os.open(os.devnull, os.O_RDWR)
        if null != number:
            os.dup2(null, number)
            os.close(null)


@contextlib.contextmanager
def _streams(own: bool) -> Iterator[_Stream]:
    """Replace stdout and stderr with `_Stream` objects during the `with` block; yield stdout.

    `own`: whether the command runs as its own process. If so, standard streams that are closed are
    first redirected to the null device."""
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
    """Run a command's `work` and return its exit code; handle signals and stream errors.

    `command`: name of the command in messages; `work`: function that returns the exit code; `own`:
    whether the command runs as its own process. If nobody reads stdout (as in `| true`), the exit
    code does not change. If writing to stdout fails for another reason, the exit code is 2."""
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
    """End the process with the exit code `code`, even if a signal arrives in the meantime.

    The process does not wait for threads that are still running. If Python shut down while they
    run, the process could abort with a different exit code."""
    for number in _NAMES:
        with contextlib.suppress(ValueError, OSError):
            signal.signal(number, lambda *_: os._exit(code))
    names = {one.name for one in threading.enumerate()}
    if names - {threading.main_thread().name, _WAITING}:
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(AttributeError, OSError, ValueError):
                stream.flush()
        os._exit(code)
    # Python collects garbage when it ends: in all objects of JAX, which takes half a second.
    gc.freeze()
    sys.exit(code)
