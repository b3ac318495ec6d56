"""Files that a user names: whether they can be read, and why not."""

import os
import stat
from pathlib import Path

from rootsopt.errors import InputError


def reason(error: Exception) -> str:
    """What the system says of a failure, for the middle of a sentence."""
    text = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
    return text[:1].lower() + text[1:]


_KINDS = (
    (stat.S_ISDIR, "a folder"),
    (stat.S_ISFIFO, "a pipe"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
    (stat.S_ISSOCK, "a socket"),
)


def regular_file(path: str | os.PathLike, what: str) -> Path:
    """`path`, if reading it comes to an end: not a pipe, a device, a folder or a socket. A missing
    file passes, for the reader to say so. Raises `InputError`."""
    try:
        mode = os.stat(path).st_mode
    except (OSError, ValueError):
        return Path(path)
    for is_kind, name in _KINDS:
        if is_kind(mode):
            raise InputError(f"{str(path)!r}: is {name}; give the path of {what} (a regular file)")
    return Path(path)
