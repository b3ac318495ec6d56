"""Guards for calls to libraries that read a user's files.

Any exception raised by a library becomes an `InputError`, with the exception as its cause. The
library's log records and warnings stay off the console. Guard little else than calls to the
library, because an error of this package would also read as a fault of the file.
"""

import contextlib
import logging
import warnings
from collections.abc import Iterator

import numpy as np

from rootsopt.config.words import named
from rootsopt.errors import InputError

_LOGGER = "ezdxf"

# Number of characters above which a library's own message is shortened.
_REASON = 120


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
        reason = named(" ".join(str(error).split()), _REASON)
        if not reason or isinstance(error, KeyError):
            reason = f"{type(error).__name__} {reason}".strip()
        raise InputError(f"{name}: {fault}: {reason}; {remedy}") from error
