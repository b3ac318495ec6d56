"""Keeps the points of a sweep in a file as they are done, so that a killed sweep can be resumed.

The file has one JSON object per line. JSON preserves every float exactly. The first line, the
header, states config, points and versions; each further line holds the record of one point. An
incomplete last line is cut off."""

import json
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from rootsopt.config.words import shown
from rootsopt.errors import InputError
from rootsopt.sweeps.points import Row

_SHOWN = 5
"""Maximum number of differences that an error message lists."""
_ABSENT = "absent"


class Journal:
    """A file with the records of one sweep. Only one process may use it at a time.

    `path`: path of the file; `header`: everything on which the records depend, as nested mappings
    of plain values; `resume`: whether to continue an existing file. `rows`: record of each point by
    its number.

    With `resume`, raises `InputError` if the file does not exist or has another header. Raises
    `OSError` if the file cannot be written."""

    def __init__(self, path: Path, header: Mapping[str, Any], resume: bool = False):
        self.path = path
        self.rows: dict[int, Row] = {}
        plain = json.loads(json.dumps(header))
        kept = 0
        if resume:
            found, self.rows, kept = read(path)
            if found is not None:
                _compare(found, plain)
        self._file = open(path, "r+b" if kept else "wb")  # noqa: SIM115
        self._file.truncate(kept)
        self._file.seek(kept)
        if not kept:
            self._write([plain])

    def add(self, found: Iterable[tuple[int, Row]]) -> None:
        """Append points (number, record) and flush them to the disk; known numbers are ignored.

        Raises `OSError` if the file cannot be written, for example because the disk is full."""
        new = {number: row for number, row in found if number not in self.rows}
        self._write({"number": number, "row": row} for number, row in new.items())
        self.rows |= new

    def _write(self, lines: Iterable[Mapping[str, Any]]) -> None:
        data = b"".join(json.dumps(line).encode() + b"\n" for line in lines)
        self._file.write(data)
        self._file.flush()
        os.fsync(self._file.fileno())

    def close(self) -> None:
        """Close the file, and remove it if it holds no points; a second call does nothing."""
        if not self._file.closed and not self.rows:
            self.path.unlink(missing_ok=True)
        self._file.close()


def read(path: Path) -> tuple[dict[str, Any] | None, dict[int, Row], int]:
    """Return header, records by number, and size (bytes) of the complete lines of a journal.

    The header is `None` if the file ends before it. Raises `InputError` if the file cannot be
    read."""
    try:
        data = path.read_bytes()
    except OSError:
        raise InputError(
            f"`--resume` needs the checkpoint of an interrupted sweep, but there is no "
            f"{str(path)!r}; leave out `--resume`, or name that run's folder with --output"
        ) from None
    header: dict[str, Any] | None = None
    rows: dict[int, Row] = {}
    kept = 0
    for line in data.splitlines(keepends=True):
        try:
            found = json.loads(line) if line.endswith(b"\n") else None
            if not isinstance(found, dict):
                break
            if header is None:
                header = found
            else:
                rows.setdefault(int(found["number"]), found["row"])
        except (ValueError, LookupError, TypeError):
            break
        kept += len(line)
    return header, rows, kept


def _compare(found: Mapping[str, Any], header: Mapping[str, Any]) -> None:
    """Raise `InputError` if the header `found` in the file differs from `header`."""
    old, new = _flat(found), _flat(header)
    keys = [key for key in dict.fromkeys((*new, *old)) if old.get(key) != new.get(key)]
    if not keys:
        return
    changes = [
        f"{key} (then {shown(old.get(key, _ABSENT))}, now {shown(new.get(key, _ABSENT))})"
        for key in keys[:_SHOWN]
    ]
    more = f" and {len(keys) - _SHOWN} more" if len(keys) > _SHOWN else ""
    raise InputError(
        f"`--resume` needs the config, the points and the versions of the interrupted sweep, but "
        f"these differ: {', '.join(changes)}{more}; restore them, or leave out `--resume`"
    )


def _flat(tree: Any, name: str = "") -> dict[str, Any]:
    """Return the values in nested mappings as one mapping with names joined by `: `."""
    if not isinstance(tree, dict):
        return {name: tree}
    found: dict[str, Any] = {}
    for key, value in tree.items():
        found |= _flat(value, f"{name}: {key}" if name else key)
    return found


__all__ = ["Journal", "read"]
