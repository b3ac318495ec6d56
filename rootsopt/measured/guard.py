"""The boundary around libraries that read other people's files.

Whatever a library raises inside becomes one `InputError`. What it logs or warns of stays off the
console. Only calls of the library stand inside, so that a mistake of this package stays visible.
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
"""Characters of a library's own message that are shown."""


def short(value: object, width: int = 60) -> str:
    """A value on one line of at most `width` characters or so."""
    text = value if isinstance(value, str) else str(value)
    size = len(text)
    text = text[:width] if size > width else text
    if not text.isprintable():
        text = text.encode("unicode_escape").decode("ascii")[: 2 * width]
    return f"{text}... ({size} characters)" if size > width else text


@contextlib.contextmanager
def silenced() -> Iterator[None]:
    """Keep log records, warnings and floating-point complaints of a library off the console."""
    logger = logging.getLogger(_LOGGER)
    level = logger.level
    if level > logging.CRITICAL:  # Inside another; entering is slow for thousands of entities.
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
    """Call a library inside. Raises `InputError` "`name`: `fault`: (its message); `remedy`" for
    any exception, out of memory and too deep a recursion among them."""
    try:
        with silenced():
            yield
    except InputError:
        raise
    except Exception as error:
        raise _error(error, name, fault, remedy) from error


def each(items: Iterator[Any], name: str, fault: str, remedy: str) -> Iterator[Any]:
    """The items of a library's iterator, behind the same guard; what is done with them is not."""
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
