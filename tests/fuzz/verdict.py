"""What counts as a failure of the package on odd input."""

import signal
from collections.abc import Callable
from contextlib import contextmanager

from rootsopt.errors import InputError

LONGEST = 500
"""Length (characters) of a message above which it counts as a failure."""


class LateError(BaseException):
    """Raised if something takes too long; code that catches `Exception` does not stop it."""


@contextmanager
def guarded(seconds: float):
    """Raise `LateError` in code that takes more CPU time than this (s)."""

    def late(*_):
        raise LateError

    before = signal.signal(signal.SIGPROF, late)
    # Raise it repeatedly, because an exception inside a destructor is lost.
    signal.setitimer(signal.ITIMER_PROF, seconds, 0.1)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)


def fault_of(action: Callable[[], object], seconds: float = 20.0) -> str | None:
    """Return what is wrong with an action that may end with an `InputError` and no other, or
    None."""
    try:
        with guarded(seconds):
            action()
    except InputError as error:
        return wrong_message(str(error))
    except LateError:
        return f"takes longer than {seconds} s"
    except Exception as error:
        return f"{type(error).__name__}: {str(error)[:200]!r}"
    return None


def wrong_message(message: str) -> str | None:
    """Return what is wrong with the message of an `InputError`, or None."""
    faults = {
        "empty": not message.strip(),
        "long": len(message) > LONGEST,
        "of several lines": len(message.splitlines()) > 1,
        "not printable": not message.isprintable(),
        "a traceback": "Traceback" in message,
    }
    found = [fault for fault, is_so in faults.items() if is_so]
    return f"message is {', '.join(found)}: {message[:200]!r}" if found else None
