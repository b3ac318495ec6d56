"""A lock that only one process at a time can hold, released by the system when that process ends.

The package `filelock` is not used, because it empties the lock file even if it does not get the
lock. The file would then lose the ID of the process that holds the lock."""

import contextlib
import errno
import os
from pathlib import Path

from rootsopt.errors import InputError

try:
    import fcntl
except ImportError:  # this system has no such locks
    fcntl = None

_TAKEN = (errno.EWOULDBLOCK, errno.EAGAIN, errno.EACCES)


class TakenError(InputError):
    """Raised if another process holds the lock.

    `process`: ID of this process, `None` if unknown."""

    def __init__(self, process: int | None):
        super().__init__("the lock is held by another process")
        self.process = process


class Lock:
    """An advisory lock on the file `path`, which exists only while the lock is held.

    The system releases the lock when the process ends, for whatever reason. If the system has no
    such locks, `held` is `False` and no error is raised. Raises `TakenError` if another process
    holds the lock. Raises `OSError` if the file cannot be created."""

    def __init__(self, path: Path):
        self.path = path
        self.held = False
        self._file = -1
        if fcntl is None:
            return
        while self._file < 0:
            self._try()

    def _try(self) -> None:
        file = self._open()
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)  # pyright: ignore
            self.held = True
        except OSError as error:
            if error.errno in _TAKEN:
                process = _number(file)
                os.close(file)
                raise TakenError(process) from None
        # The last holder may have removed the file between the two steps.
        if self.held and not self._same(file):
            os.close(file)
            self.held = False
            return
        self._file = file
        with contextlib.suppress(
            OSError
        ):  # The lock works even if the process's number cannot be written.
            os.ftruncate(file, 0)
            os.pwrite(file, f"{os.getpid()}\n".encode(), 0)

    def _open(self) -> int:
        flags = os.O_CREAT | getattr(os, "O_NOFOLLOW", 0)
        try:
            return os.open(self.path, os.O_RDWR | flags, 0o666)
        except PermissionError:  # the file belongs to another user
            return os.open(self.path, os.O_RDONLY)

    def _same(self, file: int) -> bool:
        try:
            there, here = os.stat(self.path), os.fstat(file)
        except OSError:
            return False
        return (there.st_dev, there.st_ino) == (here.st_dev, here.st_ino)

    def release(self) -> None:
        """Remove the file and release the lock; a second call does nothing."""
        if self._file < 0:
            return
        file, self._file, self.held = self._file, -1, False
        # Remove it while the lock is held: nobody else can have taken it by then.
        with contextlib.suppress(OSError):
            os.unlink(self.path)
        os.close(file)


def _number(file: int) -> int | None:
    try:
        return int(os.pread(file, 32, 0))
    except (OSError, ValueError):
        return None
