"""One process at a time: a lock that dies with its process.

`filelock` was considered, but empties the file of a lock it does not get, and with it the number
of the process that holds it.
"""

import contextlib
import errno
import os
from pathlib import Path

from rootsopt.errors import InputError

try:
    import fcntl
except ImportError:  # no such locks on this system
    fcntl = None

_TAKEN = (errno.EWOULDBLOCK, errno.EAGAIN, errno.EACCES)


class TakenError(InputError):
    """Another process holds the lock; `process`: its number, if it is known."""

    def __init__(self, process: int | None):
        super().__init__("the lock is held by another process")
        self.process = process


class Lock:
    """An advisory lock on the file `path`, which exists only as long as the lock is held.

    The system takes it back when the process ends, however it ends. Where the file system has no
    locks, `held` is False and everything goes on without. Raises `TakenError`, and `OSError` where
    the file cannot be made.
    """

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
        # Its last holder may have removed the file between the two steps.
        if self.held and not self._same(file):
            os.close(file)
            self.held = False
            return
        self._file = file
        with contextlib.suppress(OSError):  # Without its number the lock is as good.
            os.ftruncate(file, 0)
            os.pwrite(file, f"{os.getpid()}\n".encode(), 0)

    def _open(self) -> int:
        flags = os.O_CREAT | getattr(os, "O_NOFOLLOW", 0)
        try:
            return os.open(self.path, os.O_RDWR | flags, 0o666)
        except PermissionError:  # another user's
            return os.open(self.path, os.O_RDONLY)

    def _same(self, file: int) -> bool:
        try:
            there, here = os.stat(self.path), os.fstat(file)
        except OSError:
            return False
        return (there.st_dev, there.st_ino) == (here.st_dev, here.st_ino)

    def release(self) -> None:
        """Remove the file and give the lock back; a second time does nothing."""
        if self._file < 0:
            return
        file, self._file, self.held = self._file, -1, False
        # While it is still held: nobody else can have taken it by then.
        with contextlib.suppress(OSError):
            os.unlink(self.path)
        os.close(file)


def _number(file: int) -> int | None:
    try:
        return int(os.pread(file, 32, 0))
    except (OSError, ValueError):
        return None
