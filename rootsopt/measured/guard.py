"""Guards for calls to libraries that read a user's files.

Any exception raised by a library becomes an `InputError`. The library's log records and warnings
stay off the console. Guard only calls to the library, so that errors of this package stay visible.
"""

import contextlib
import logging
import warnings
from collections.abc import Iterator
from typing import Any

import numpy as np

from rootsopt.errors import InputError

_LOGGER = "ezdxf"
_REASON = 120
"""Number of characters above which a library's own message is shortened."""


def short(value: object, width: int = 60) -> str:
    """Return `value` as printable text for a message, shortened to about `width` characters."""
    text = value if isinstance(value, str) else str(value)
    size = len(text)
    text = text[:width] if size > width else text
    if not text.isprintable():
        text = text.encode("unicode_escape").decode("ascii")[: 2 * width]
    return f"{text}... ({size} characters)" if size > width else text


@contextlib.contextmanager
def silenced() -> Iterator[None]:
    """Suppress a library's log records and warnings in the `with` block, also those of NumPy."""
    logger = logging.getLogger(_LOGGER)
    level = logger.level
    if level > logging.CRITICAL:  # Nested: entering again is slow for thousands of entities.
        yield
        return
    logger.setLevel(logging.CRITICAL + 1)
    try:
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            yield
    finally:
        logger.setLevel(level)


@contextlib.contextmanager
def guarded(name: str, fault: str, remedy: str) -> Iterator[None]:
    """Turn any exception in the `with` block, which calls a library, into an `InputError`.

    The message reads "`name`: `fault`: (the exception's message); `remedy`". `MemoryError` and
    `RecursionError` are converted, too; an `InputError` passes unchanged."""
    try:
        with silenced():
            yield
    except InputError:
        raise
    except Exception as error:
        raise _error(error, name, fault, remedy) from error


def each(items: Iterator[Any], name: str, fault: str, remedy: str) -> Iterator[Any]:
    """Yield the items of a library's iterator.

    Exceptions raised by the iterator become `InputError`, with `name`, `fault` and `remedy` as in
    `guarded`. Exceptions raised by the code that uses the items pass unchanged."""
    while True:
        try:
            item = next(items)
        except StopIteration:
            return
        except Exception as error:
            raise _error(error, name, fault, remedy) from error
        yield item


def _error(error: Exception, name: str, fault: str, remedy: str) -> InputError:
    reason = short(" ".join(str(error).split()), _REASON)
    if not reason or isinstance(error, KeyError):
        reason = f"{type(error).__name__} {reason}".strip()
    return InputError(f"{name}: {fault}: {reason}; {remedy}")
