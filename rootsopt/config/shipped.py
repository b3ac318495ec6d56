"""The configs that come with the package, and how they are found by name."""

import difflib
import functools
import os
from pathlib import Path

_PACKAGE = Path(__file__).parents[1]
_PLACES = _PACKAGE / "configs", _PACKAGE.parent / "configs"
"""Folders of the configs: in an installed package, and in the source tree."""
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
