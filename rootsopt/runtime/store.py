"""Files of compiled programs: owned by the user, signed, and limited in total size.

Programs read from these files are executed, so other users must not be able to change them. Nor may
they change the folder or replace a folder above it. Each entry is signed together with its name and
purpose, with a key in the user's own state folder. An entry that is damaged, unsigned or stored
under another name is ignored."""

import contextlib
import hashlib
import hmac
import os
import secrets
import stat
import time
from collections.abc import Iterator
from pathlib import Path

import platformdirs

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

MOST_BYTES = 200 * 2**20
"""Total size (bytes) of all entries above which the least recently used entries are removed."""
SUFFIX = ".program"
"""Suffix of the file names of entries. It distinguishes them from other files in the folder."""

_KEY_NAME = "programs.key"
_KEY_BYTES = 32
_HEADER = b"rootsopt program 1\n"
_MAC_BYTES = hashlib.sha256().digest_size
_OTHERS_WRITE = stat.S_IWGRP | stat.S_IWOTH
_OTHERS_AT_ALL = stat.S_IRWXG | stat.S_IRWXO
_NEW_SECONDS = 2.0
"""Age (s) of an unfinished file below which it is kept: its process may not have locked it yet."""
# With these flags, a symbolic link is not followed and a named pipe does not block.
_SAFELY = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
_HAS_OWNERS = hasattr(os, "geteuid")
_IN_FOLDER = {os.open, os.unlink, os.stat, os.rename} <= os.supports_dir_fd


class UnsafeFolderError(Exception):
    """Raised if other users can change or replace a folder.

    The message names the folder and the remedy."""


class Folder:
    """A folder that belongs to the user, created if it does not exist, and kept open.

    Files are opened through the folder's descriptor, because its path may lead to another folder
    later. Raises `UnsafeFolderError` if other users own the folder, or could write to it or replace
    it. Raises `OSError` if the folder cannot be created or opened."""

    def __init__(self, path: Path):
        try:
            self.path = path.expanduser().resolve()
        except RuntimeError as error:  # no home, or links in a circle
            raise OSError(str(error)) from None
        _make(self.path)
        self._open: int | None = None
        if _IN_FOLDER:
            self._open = os.open(self.path, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
        try:
            _check(self.path, os.stat(self.path) if self._open is None else os.fstat(self._open))
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Close the folder."""
        if self._open is not None:
            os.close(self._open)
            self._open = None

    def __del__(self) -> None:
        with contextlib.suppress(Exception):
            self.close()

    def _at(self, name: str) -> str:
        return name if self._open is not None else os.fspath(self.path / name)

    def open(self, name: str, flags: int) -> int:
        """Open a file in the folder with the `flags` of `os.open`, and return its descriptor.

        A new file is accessible only to the user. Raises `OSError` if the file cannot be opened."""
        return os.open(self._at(name), flags | _SAFELY, 0o600, dir_fd=self._open)

    def stat(self, name: str) -> os.stat_result:
        """Return the `os.stat` result of the file `name`, or of the link itself if it is a link.

        Raises `OSError` if there is no such file."""
        return os.stat(self._at(name), dir_fd=self._open, follow_symlinks=False)

    def exists(self, name: str) -> bool:
        """Return whether the folder contains a regular file called `name`."""
        try:
            return stat.S_ISREG(self.stat(name).st_mode)
        except OSError:
            return False

    def unlink(self, name: str) -> None:
        """Remove the file `name`; do nothing if it cannot be removed."""
        with contextlib.suppress(OSError):
            os.unlink(self._at(name), dir_fd=self._open)

    def link(self, name: str, other: str) -> None:
        """Give the file `name` a second name, `other`.

        Raises `FileExistsError` if a file called `other` exists."""
        os.link(self._at(name), self._at(other), src_dir_fd=self._open, dst_dir_fd=self._open)

    def replace(self, name: str, other: str) -> None:
        """Rename the file `name` to `other` in one step, replacing an existing file."""
        os.replace(self._at(name), self._at(other), src_dir_fd=self._open, dst_dir_fd=self._open)

    def names(self) -> list[str]:
        """Return the names of all entries of the folder."""
        return os.listdir(self.path if self._open is None else self._open)

    def read(self, name: str, most: int, forbidden: int = _OTHERS_WRITE) -> bytes | None:
        """Return the content of the regular file `name`, or `None` if it cannot be trusted.

        `None` is returned if the file does not exist, belongs to another user, or is larger than
        `most` bytes. It is also returned if the file has one of the `forbidden` permission bits."""
        try:
            file = self.open(name, os.O_RDONLY)
        except OSError:
            return None
        try:
            found = os.fstat(file)
            if not stat.S_ISREG(found.st_mode) or found.st_size > most:
                return None
            if _HAS_OWNERS and (found.st_uid != os.geteuid() or found.st_mode & forbidden):
                return None
            with open(file, "rb", closefd=False) as stream:
                data = stream.read(most + 1)
            with contextlib.suppress(OSError):
                os.utime(file if os.utime in os.supports_fd else self._at(name))
            return data if len(data) <= most else None
        except OSError:
            return None
        finally:
            os.close(file)

    @contextlib.contextmanager
    def unfinished(self, name: str, data: bytes) -> Iterator[str]:
        """Create a file with `data`, and yield its temporary name, which contains `name`.

        The file is locked during the `with` block, so that `sweep` can distinguish it from a file
        left by an ended process. On exit, it is removed unless it has been renamed."""
        own = f".{name}.{secrets.token_hex(8)}"
        file = self.open(own, os.O_WRONLY | os.O_CREAT | os.O_EXCL)
        try:
            if fcntl is not None:
                with contextlib.suppress(OSError):
                    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            with open(file, "wb", closefd=fcntl is None) as stream:
                stream.write(data)
            yield own
        finally:
            self.unlink(own)
            if fcntl is not None:
                os.close(file)

    def sweep(self, middle: str) -> None:
        """Remove unfinished files that ended processes have left.

        `middle`: only files whose names contain this text are removed."""
        for name in self.names():
            if not (name.startswith(".") and middle in name):
                continue
            with contextlib.suppress(OSError):
                if abs(time.time() - self.stat(name).st_mtime) < _NEW_SECONDS:
                    continue
                file = self.open(name, os.O_RDWR)
                try:
                    if fcntl is not None:
                        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                        self.unlink(name)
                finally:
                    os.close(file)
                self.unlink(name)  # On Windows this fails while a process has it open.


class Store:
    """A folder `path` of signed entries.

    Raises `UnsafeFolderError` if other users could change the entries or read the key. Raises
    `OSError` if the folder cannot be used."""

    def __init__(self, path: Path):
        self._folder = Folder(path)
        self._key = _key()
        self._folder.sweep(f"{SUFFIX}.")

    def __contains__(self, name: str) -> bool:
        return self._folder.exists(name + SUFFIX)

    def read(self, name: str, purpose: str) -> bytes | None:
        """Return the data of the entry `name`, or `None` if no valid entry has this `purpose`."""
        found = self._folder.read(name + SUFFIX, MOST_BYTES)
        if found is None:
            return None
        start = len(_HEADER) + _MAC_BYTES
        data = found[start:]
        if not hmac.compare_digest(found[:start], _HEADER + self._mac(name, purpose, data)):
            return None
        return data

    def write(self, name: str, purpose: str, data: bytes) -> None:
        """Write `data` as the entry `name`, completely or not at all.

        The entry is signed together with its `purpose`. Raises `OSError` if writing fails."""
        signed = _HEADER + self._mac(name, purpose, data) + data
        target = name + SUFFIX
        with self._folder.unfinished(target, signed) as made:
            self._folder.replace(made, target)
        self._prune()

    def _mac(self, name: str, purpose: str, data: bytes) -> bytes:
        mac = hmac.new(self._key, digestmod=hashlib.sha256)
        for part in (_HEADER, name.encode(), purpose.encode(), data):
            mac.update(len(part).to_bytes(8, "big"))
            mac.update(part)
        return mac.digest()

    def _prune(self) -> None:
        """Remove the least recently used entries until the rest has at most `MOST_BYTES`."""
        kept = []
        for name in self._folder.names():
            # Only our own files: the folder may hold others.
            if name.endswith(SUFFIX) and not name.startswith("."):
                with contextlib.suppress(OSError):  # removed by another process
                    found = self._folder.stat(name)
                    if stat.S_ISREG(found.st_mode):
                        kept.append((found.st_mtime_ns, found.st_size, name))
        total = 0
        for _, size, name in sorted(kept, reverse=True):
            total += size
            if total > MOST_BYTES:
                self._folder.unlink(name)
        self._folder.sweep(f"{SUFFIX}.")


def key_folder() -> Path:
    """Return the path of the folder of the signing key, in the user's state folder."""
    return Path(platformdirs.user_state_dir("rootsopt", appauthor=False))


def _key() -> bytes:
    """Return the user's signing key; create one if there is no valid key.

    Raises `UnsafeFolderError` if the key cannot be stored in a place that only the user can access.
    """
    path = key_folder()
    try:
        if not path.is_absolute():
            raise OSError("it is not an absolute path")
        folder = Folder(path)
        folder.sweep(f"{_KEY_NAME}.")
        for _ in range(_ATTEMPTS):
            there = _there(folder)  # Check this first: a key that appears later is valid.
            key = folder.read(_KEY_NAME, _KEY_BYTES, _OTHERS_AT_ALL)
            if key is not None and len(key) == _KEY_BYTES:
                return key
            # Replace a key that is damaged or that others may have read. Programs signed with it
            # are compiled again.
            with folder.unfinished(_KEY_NAME, secrets.token_bytes(_KEY_BYTES)) as made:
                if there:
                    folder.replace(made, _KEY_NAME)
                    continue
                try:
                    folder.link(made, _KEY_NAME)
                except FileExistsError:
                    pass  # Another process was faster; use its key.
                except (OSError, NotImplementedError):  # a file system without links
                    folder.replace(made, _KEY_NAME)
        raise OSError("it cannot be read back")
    except (OSError, UnsafeFolderError) as error:
        said = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        raise UnsafeFolderError(
            f"the key that compiled programs are signed with cannot be kept in "
            f"{os.fspath(path)!r}: {said}; correct that, or set XDG_STATE_HOME to another folder"
        ) from None


_ATTEMPTS = 3


def _there(folder: Folder) -> bool:
    try:
        folder.stat(_KEY_NAME)
    except FileNotFoundError:
        return False
    return True


def _make(path: Path) -> None:
    """Create a folder and the missing folders above it, accessible only to the user."""
    missing = []
    while not os.path.lexists(path):
        missing.append(path)
        path = path.parent
    for folder in reversed(missing):
        with contextlib.suppress(FileExistsError):
            os.mkdir(folder, 0o700)


def _check(path: Path, found: os.stat_result) -> None:
    """Raise `UnsafeFolderError` if other users own a folder, or could change or replace it.

    `path`: the folder; `found`: its `os.stat` result."""
    if not _HAS_OWNERS:
        return  # On such systems, folders below the user's home are the user's by default.
    me = os.geteuid()
    if found.st_uid != me:
        raise UnsafeFolderError(
            f"{os.fspath(path)!r} belongs to another user (number {found.st_uid}); choose a "
            "folder of your own"
        )
    if found.st_mode & _OTHERS_WRITE:
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
