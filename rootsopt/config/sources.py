"""Files and modules that a config names, and the configs that come with the package."""

import contextlib
import functools
import importlib.machinery
import importlib.metadata
import importlib.util
import os
import re
import stat
import sys
import traceback
from collections.abc import Iterator
from pathlib import Path

from rootsopt.config.section import bare, put, taken
from rootsopt.config.units import near, placed, sentence
from rootsopt.errors import InputError

FILES = {
    "profile.outline_file": ("outline", "an outline"),
    "scene.timing_gear.transmission_error_file": ("transmission_error", "a table"),
}
"""Keys that hold the path of a file, each with two texts: the stem of its copy in a result folder,
and the name of its content in messages."""

# Size (bytes) above which a file that a config names is refused.
_MOST_BYTES = 50_000_000

# Name of the entry-point group in which installed packages offer families. The name of each entry
# point is that of its family.
_ENTRY_POINTS = "rootsopt.families"


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


def content(path: str | os.PathLike, key: str) -> bytes:
    """Return the content of the file that a `key` of the config names.

    Raises `InputError` if it cannot be read, or is larger than `_MOST_BYTES`."""
    file = regular_file(path, FILES[key][1])
    try:
        with file.open("rb") as stream:
            data = stream.read(_MOST_BYTES + 1)
    except (OSError, ValueError) as error:
        raise InputError(
            f"`{key}` must be a file that can be read, but is {placed(path)!r}: {reason(error)}; a "
            "path in a config is relative to the config's folder, a path given with --set to the "
            "current folder"
        ) from None
    if len(data) > _MOST_BYTES:
        raise InputError(
            f"{placed(file.name)}: must have at most {_MOST_BYTES / 1e6:g} MB, but is larger; "
            "export what is needed alone, with fewer points"
        )
    return data


# Folders of the configs: in an installed package, and in the source tree.
_PLACES = [folder / "configs" for folder in Path(__file__).parents[1:3]]
_SUFFIX = ".yaml"


@functools.cache
def shipped() -> dict[str, Path]:
    """Return the paths of the shipped configs by name, such as "cic"."""
    folders = (sorted(place.glob(f"*{_SUFFIX}")) for place in _PLACES)
    return {path.stem: path for path in next(filter(None, folders), [])}


def located(path: Path) -> Path:
    """Return the path of the config that a user calls `path`.

    A file has precedence. Otherwise "cic" and "cic.yaml" name the shipped config."""
    if len(path.parts) != 1 or path.suffix not in ("", _SUFFIX) or os.path.isfile(path):
        return path
    return shipped().get(path.stem, path)


def place_files(data: dict, folder: Path) -> None:
    """Make relative paths of files in `data` absolute, in place.

    `folder`: folder to which the paths are relative."""
    for key in FILES:
        if isinstance(path := taken(data, key), str):
            put(data, key, str((folder / path).absolute()))


def advice(path: Path) -> str:
    """Return advice on a `path` that does not exist."""
    names, meant = ", ".join(shipped()), near(path.stem, shipped())
    guess = f"; did you mean {meant!r}?" if meant else ""
    return f"give the path of a config, or the name of a shipped one ({names}){guess}"


def find_installed(name: str) -> None:
    """Load the installed packages that offer a family with this `name`, if there are any.

    Raises `InputError` if loading fails."""
    for point in importlib.metadata.entry_points(group=_ENTRY_POINTS):
        if bare(point.name) == bare(name):
            with _explained(f"profile family {point.name} of {point.value}"):
                point.load()


def import_named(name: str) -> None:
    """Import a module by name, or a Python file by path, unless it has been imported before.

    The module may register families. Raises `InputError` if the import fails."""
    with _explained(f"`--import` {placed(name)}"):
        if not (name.endswith(".py") or Path(name).is_file()):
            importlib.import_module(name)
            return
        path = Path(name).resolve(strict=True)
        known = "imported_" + re.sub(r"\W", "_", str(path))
        if known in sys.modules:
            return
        loader = importlib.machinery.SourceFileLoader(known, str(path))
        spec = importlib.util.spec_from_file_location(known, path, loader=loader)
        assert spec is not None
        module = sys.modules[known] = importlib.util.module_from_spec(spec)
        try:
            loader.exec_module(module)
        except BaseException:
            del sys.modules[known]
            raise


@contextlib.contextmanager
def _explained(what: str) -> Iterator[None]:
    """Turn any error in the `with` block into a one-line `InputError`.

    `what`: what the block loads, as the start of the message."""
    try:
        yield
    # Any exception here is caused by that module.
    except Exception as error:
        kind = type(error).__name__
        frames = traceback.extract_tb(error.__traceback__)
        line = f" (line {frames[-1].lineno} of {placed(frames[-1].filename)})" if frames else ""
        raise InputError(sentence(f"{what}: fails with {kind}: {error}{line}")) from error
