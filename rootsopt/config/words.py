"""Turns values, names and whole messages into one line of limited length."""

import difflib
import reprlib
from collections.abc import Sequence
from typing import Any

LONGEST = 500
"""Length (characters) above which a message about a config is shortened."""

# Lengths (characters) of a string value, a key and a path above which a message shortens them.
_VALUE, _NAME, _PATH = 80, 60, 160


class _Bounded(reprlib.Repr):
    """A `repr` that shortens long values and does not process the omitted part."""

    def __init__(self):
        super().__init__()
        self.maxstring = self.maxother = _VALUE
        self.maxlevel, self.maxdict, self.maxlist, self.maxtuple = 3, 4, 8, 8

    def repr_int(self, x, level):
        digits = int(abs(x).bit_length() * 0.30103)
        if digits < 30:
            return repr(x)
        return f"a whole number of {digits} digits"


_repr = _Bounded().repr


def shown(value: Any) -> str:
    """Return a value as text for a message: its `repr`, shortened if it is long."""
    return clipped(_repr(value), 2 * _VALUE)


def named(part: Any, longest: int = _NAME) -> str:
    """Return a config key or another text as printable text for a message.

    It is shortened if it has more than `longest` characters."""
    text = clipped(part if isinstance(part, str) else shown(part), longest)
    return text if text.isprintable() else ascii(text)[1:-1]


def placed(path: Any) -> str:
    """Return a path as printable text for a message. Only the end of a long path is shown."""
    text = str(path)
    text = text if len(text) <= _PATH else "..." + text[3 - _PATH :]
    return text if text.isprintable() else ascii(text)[1:-1]


def clipped(text: str, longest: int = LONGEST) -> str:
    """Shorten a text to at most `longest` characters by omitting its middle."""
    if len(text) <= longest:
        return text
    tail = longest // 3
    return f"{text[: longest - tail - 5]} ... {text[-tail:]}"


def sentence(text: str) -> str:
    """Return a message as one line of at most `LONGEST` characters."""
    return clipped(" ".join(text[: 100 * LONGEST].split()))


def near(word: str, known: Sequence[str]) -> str:
    """Return the one of the `known` words that is most similar to `word`, or "" without one."""
    return next(iter(difflib.get_close_matches(word[:_NAME], known, n=1)), "")
