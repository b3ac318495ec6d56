"""Files that a config names, and the configs that come with the package."""

import difflib
import functools
import os
import stat
from pathlib import Path

from rootsopt.config.units import placed
from rootsopt.errors import InputError

FILES = {
    "profile.outline_file": ("outline", "an outline"),
    "scene.timing_gear.transmission_error_file": ("transmission_error", "a table"),
}
"""Keys that hold the path of a file, each with the stem of its copy in a result folder and the name
of its content in a message."""


MOST_BYTES = 50_000_000
"""Size (bytes) above which a file that a config names is refused."""


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


def content(path: str | os.PathLike, key: str, most: int = MOST_BYTES) -> bytes:
    """Return the content of the file that a `key` of the config names.

    `most`: size (bytes) above which it is refused. Raises `InputError` if it cannot be read."""
    file = regular_file(path, FILES[key][1])
    try:
        with file.open("rb") as stream:
            data = stream.read(most + 1)
    except (OSError, ValueError) as error:
        raise InputError(
            f"`{key}` must be a file that can be read, but is {placed(path)!r}: {reason(error)}; a "
            "path in a config is relative to the config's folder, a path given with --set to the "
            "current folder"
        ) from None
    if len(data) > most:
        raise InputError(
            f"{placed(file.name)}: must have at most {most / 1e6:g} MB, but is larger; export what "
            "is needed alone, with fewer points"
        )
    return data


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
