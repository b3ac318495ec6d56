"""Files of compiled programs: owned by the user, and limited in total size.

Programs read from these files are executed, so other users must not be able to change them. Nor may
they change the folder or replace a folder above it. Each entry holds a checksum of its name,
purpose and data. An entry that is damaged or stored under another name is ignored."""

import contextlib
import hashlib
import os
import stat
import tempfile
import time
from pathlib import Path

MOST_BYTES = 200 * 2**20
"""Total size (bytes) of all entries above which the least recently used entries are removed."""

# Suffix of the file names of entries. It distinguishes them from other files in the folder.
_SUFFIX = ".program"
_HEADER = b"rootsopt program 2\n"
_OTHERS_WRITE = stat.S_IWGRP | stat.S_IWOTH

# Age (s) of an unfinished file above which it is removed: its process has ended.
_LEFT_SECONDS = 600.0
# With these flags, a symbolic link is not followed and a named pipe does not block.
_SAFELY = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
_HAS_OWNERS = hasattr(os, "geteuid")


class UnsafeFolderError(Exception):
    """Raised if other users can change or replace a folder.

    The message names the folder and the remedy."""


class Store:
    """A folder `path` of entries.

    Raises `UnsafeFolderError` if other users could change the entries. Raises `OSError` if the
    folder cannot be used."""

    def __init__(self, path: Path):
        self._folder = _own_folder(path)
        # Remove unfinished files that ended processes have left.
        for file in self._folder.glob(f".*{_SUFFIX}.*"):
            with contextlib.suppress(OSError):
                if abs(time.time() - file.lstat().st_mtime) > _LEFT_SECONDS:
                    file.unlink()

    def _file(self, name: str) -> Path:
        return self._folder / (name + _SUFFIX)

    def __contains__(self, name: str) -> bool:
        file = self._file(name)
        return file.is_file() and not file.is_symlink()

    def read(self, name: str, purpose: str) -> bytes | None:
        """Return the data of the entry `name`, or `None` if no valid entry has this `purpose`."""
        content = _read(self._file(name)) or b""
        data = content[len(_checksum(name, purpose, b"")) :]
        return data if content and content == _checksum(name, purpose, data) + data else None

    def write(self, name: str, purpose: str, data: bytes) -> None:
        """Write `data` as the entry `name` for this `purpose`, completely or not at all.

        Only the user can access its file. Raises `OSError` if writing fails."""
        file = self._file(name)
        handle, unfinished = tempfile.mkstemp(prefix=f".{file.name}.", dir=file.parent)
        try:
            with open(handle, "wb") as stream:
                stream.write(_checksum(name, purpose, data) + data)
            os.replace(unfinished, file)
        finally:
            with contextlib.suppress(OSError):
                os.unlink(unfinished)
        self._prune()

    def _prune(self) -> None:
        """Remove the least recently used entries until the rest has at most `MOST_BYTES`."""
        kept = []
        # Only our own finished files: the folder may hold others.
        for file in self._folder.glob(f"[!.]*{_SUFFIX}"):
            with contextlib.suppress(OSError):  # removed by another process
                status = file.lstat()
                if stat.S_ISREG(status.st_mode):
                    kept.append((status.st_mtime_ns, status.st_size, file))
        total = 0
        for _, size, file in sorted(kept, reverse=True):
            total += size
            if total > MOST_BYTES:
                with contextlib.suppress(OSError):
                    file.unlink()


def _checksum(name: str, purpose: str, data: bytes) -> bytes:
    parts = (name.encode(), purpose.encode(), data)
    return _HEADER + hashlib.sha256(b"".join(hashlib.sha256(x).digest() for x in parts)).digest()


def _read(file: Path) -> bytes | None:
    """Return the content of a regular file, or `None` if it cannot be trusted.

    `None` is returned if the file does not exist, belongs to another user, or is larger than
    `MOST_BYTES`. It is also returned if others may write to the file."""
    with contextlib.suppress(OSError), open(os.open(file, os.O_RDONLY | _SAFELY), "rb") as stream:
        status = os.fstat(stream.fileno())
        foreign = _HAS_OWNERS and (status.st_uid != os.geteuid() or status.st_mode & _OTHERS_WRITE)
        if stat.S_ISREG(status.st_mode) and status.st_size <= MOST_BYTES and not foreign:
            os.utime(file)
            return stream.read(MOST_BYTES + 1)  # The checksum refuses a file that still grows.
    return None


def _own_folder(path: Path) -> Path:
    """Return the real path of a folder that belongs to the user, created if it does not exist.

    New folders are accessible only to the user. Raises `UnsafeFolderError` if other users own the
    folder, or could write to it or replace it. Raises `OSError` if it cannot be used."""
    try:
        path = path.expanduser().resolve()
    except RuntimeError as error:  # no home, or links in a circle
        raise OSError(str(error)) from None
    for folder in reversed([path, *path.parents]):
        if not os.path.lexists(folder):
            with contextlib.suppress(FileExistsError):
                os.mkdir(folder, 0o700)
    os.listdir(path)  # An `OSError` unless it is a folder that can be read.
    if not _HAS_OWNERS:
        return path  # On such systems, folders below the user's home are the user's by default.
    me, status = os.geteuid(), os.stat(path)
    if status.st_uid != me:
        raise UnsafeFolderError(
            f"{os.fspath(path)!r} belongs to another user (number {status.st_uid}); choose a "
            "folder of your own"
        )
    if status.st_mode & _OTHERS_WRITE:
        raise UnsafeFolderError(
            f"others may write to {os.fspath(path)!r}; remove that permission with chmod go-w, or "
            "choose another folder"
        )
    for parent in path.parents:
        above = os.stat(parent)
        if above.st_uid not in (0, me):
            raise UnsafeFolderError(
                f"{os.fspath(parent)!r} above it belongs to another user (number {above.st_uid}), "
                "who can replace the folder; choose one inside a folder of your own"
            )
        # In a folder with the sticky bit, such as /tmp, only owners can rename their files.
        if above.st_mode & _OTHERS_WRITE and not above.st_mode & stat.S_ISVTX:
            raise UnsafeFolderError(
                f"others may write to {os.fspath(parent)!r}, and so replace the folder in it; "
                "remove that permission with chmod go-w, or choose another folder"
            )
    return path
