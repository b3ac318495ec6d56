"""Files that a config names, and the configs that come with the package."""

import difflib
import functools
import os
import stat
from pathlib import Path

from rootsopt.errors import InputError

FILES = {
    "profile.outline_file": ("outline", "an outline"),
    "scene.timing_gear.transmission_error_file": ("transmission_error", "a table"),
}
"""Keys that hold the path of a file, each with the stem of its copy in a result folder and the name
of its content in a message."""


def reason(error: Exception) -> str:
    """Return an error's text with its first letter in lower case, for use within a sentence."""
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
    """Return `path`; raise `InputError` if it is a folder, pipe, device or socket.

    Reading one of these might never end. A missing file is accepted, because reading it reports the
    problem. `what`: name of the expected file in the message, as in "a config"."""
    try:
        mode = os.stat(path).st_mode
    except (OSError, ValueError):
        return Path(path)
    for is_kind, name in _KINDS:
        if is_kind(mode):
            raise InputError(f"{str(path)!r}: is {name}; give the path of {what} (a regular file)")
    return Path(path)


_PACKAGE = Path(__file__).parents[1]

# Folders of the configs: in an installed package, and in the source tree.
_PLACES = _PACKAGE / "configs", _PACKAGE.parent / "configs"
_SUFFIX = ".yaml"


@functools.cache
def shipped() -> dict[str, Path]:
    """Return the paths of the shipped configs by name, such as "cic"."""
    for place in _PLACES:
        if found := sorted(place.glob(f"*{_SUFFIX}")):
            return {path.stem: path for path in found}
    return {}


def located(path: Path) -> Path:
    """Return the path of the config that a user calls `path`.

    A file has precedence. Otherwise "cic" and "cic.yaml" name the shipped config."""
    if len(path.parts) != 1 or path.suffix not in ("", _SUFFIX) or os.path.isfile(path):
        return path
    return shipped().get(path.stem, path)


def advice(path: Path) -> str:
    """Return what to give instead of a `path` that does not exist."""
    near = difflib.get_close_matches(path.stem[:80], shipped(), n=1)
    meant = f"; did you mean {near[0]!r}?" if near else ""
    names = ", ".join(shipped())
    return f"give the path of a config, or the name of a shipped one ({names}){meant}"
