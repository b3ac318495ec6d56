"""File operations for everything that this package writes.

Each function is small on purpose: tests make each call fail in turn, or end the process at this
call. Only the standard library is used."""

import ctypes
import errno
import functools
import os
import shutil
import stat
from pathlib import Path

_AT_FDCWD = -100
_RENAME_EXCHANGE = 2
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


def exchange(first: Path, second: Path) -> bool:
    """Exchange the names of two folders in one step; return `False` if the system cannot do this.

    Raises `OSError` if the exchange fails for another reason."""
    call = _renameat2()
    if call is None:
        return False
    error = _exchanged(call, os.fsencode(first), os.fsencode(second))
    if error in _UNSUPPORTED:
        return False
    if error:
        raise OSError(error, os.strerror(error), str(first))
    return True


def can_exchange(folder: Path) -> bool:
    """Return whether the file system of `folder` can exchange the names of two folders.

    Raises `OSError` if the folders for this test cannot be created."""
    pair = [folder / name for name in (".first", ".second")]
    for one in pair:
        os.mkdir(one)
    try:
        return exchange(*pair)
    finally:
        for one in pair:
            discard(one)


def _exchanged(call, first: bytes, second: bytes) -> int:
    """Exchange two folders with the C function `call`; return its error number, or 0."""
    done = call(_AT_FDCWD, first, _AT_FDCWD, second, _RENAME_EXCHANGE)
    return ctypes.get_errno() if done else 0


@functools.cache
def _renameat2():
    """Return the C library's function `renameat2`, or `None` if it does not exist."""
    try:
        call = ctypes.CDLL(None, use_errno=True).renameat2
    except (OSError, AttributeError, TypeError):
        return None
    path = ctypes.c_char_p
    call.argtypes = ctypes.c_int, path, ctypes.c_int, path, ctypes.c_uint
    return call


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
