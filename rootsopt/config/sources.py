"""Checks that files named by the user can be read, and gives the reason where they cannot."""

import os
import stat
from pathlib import Path

from rootsopt.errors import InputError


def reason(error: Exception) -> str:
    """Return the system's text for an error, in lower case for the middle of a sentence."""
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
    """Return `path`, rejecting everything whose reading may never end.

    A missing file passes: the reader reports it. Raises `InputError` for a folder, pipe, device or
    socket."""
    try:
        mode = os.stat(path).st_mode
    except (OSError, ValueError):
        return Path(path)
    for is_kind, name in _KINDS:
        if is_kind(mode):
            raise InputError(f"{str(path)!r}: is {name}; give the path of {what} (a regular file)")
    return Path(path)
