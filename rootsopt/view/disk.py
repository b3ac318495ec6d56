"""File operations for everything that this package writes, and a lock on a folder.

Each function is small on purpose: tests make each call fail in turn, or end the process at this
call. Only the standard library is used.

The lock can be held by one process at a time, and the system releases it when that process ends."""

import contextlib
import errno
import os
import shutil
import stat
from pathlib import Path

from rootsopt.errors import InputError

_UNSUPPORTED = (errno.EINVAL, errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP)


def create(path: Path, data: bytes) -> None:
    """Write `data` to a new file with the user's usual permissions, and flush it to the disk.

    Raises `OSError` if this fails or if the file exists. In case of failure, no file is left
    behind."""
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0)
    file = os.open(path, flags, 0o666)
    try:
        try:
            view = memoryview(data)
            while view:
                view = view[os.write(file, view) :]
            os.fsync(file)
        finally:
            os.close(file)
    except BaseException:
        discard(path)
        raise


def make_folder(path: Path) -> None:
    """Create a folder, whose parent must exist. Raises `OSError` if this fails."""
    os.mkdir(path)


def make_folders(folder: Path, made: list[Path]) -> None:
    """Create a folder and its missing parents.

    `made`: list to which each folder is appended as soon as it is created. Raises `OSError` if a
    folder cannot be created."""
    missing = []
    while not folder.is_dir():
        missing.append(folder)
        if folder.parent == folder:
            break
        folder = folder.parent
    for new in reversed(missing):
        try:
            make_folder(new)
        except FileExistsError:
            if not new.is_dir():  # otherwise another process was faster
                raise
        else:
            made.append(new)


def sync_folder(path: Path) -> None:
    """Flush a folder's list of entries to the disk, if the file system supports this.

    Raises `OSError` if flushing fails for another reason."""
    try:
        folder = os.open(path, os.O_RDONLY)
    except PermissionError:  # where folders cannot be opened
        return
    try:
        os.fsync(folder)
    except OSError as error:
        if error.errno not in _UNSUPPORTED:
            raise
    finally:
        os.close(folder)


def move(source: Path, target: Path) -> None:
    """Rename the folder `source` to `target` in one step.

    If `target` is an empty folder, it is replaced. Raises `OSError` if renaming fails."""
    os.rename(source, target)


def replace(source: Path, target: Path) -> None:
    """Rename the file `source` to `target` in one step, replacing an existing file.

    Raises `OSError` if renaming fails."""
    os.replace(source, target)


def adopt_mode(path: Path, model: Path) -> None:
    """Give the folder `path` the permissions of the folder `model`, if the system allows it."""
    try:
        os.chmod(path, stat.S_IMODE(os.stat(model).st_mode))
    except OSError:
        return


def discard(path: Path) -> None:
    """Remove a file or an empty folder if it exists and can be removed."""
    try:
        if path.is_dir() and not path.is_symlink():
            os.rmdir(path)
        else:
            os.unlink(path)
    except OSError:
        return


def discard_tree(path: Path) -> None:
    """Remove a folder and its contents, as far as possible; ignore errors."""
    shutil.rmtree(path, ignore_errors=True)


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
