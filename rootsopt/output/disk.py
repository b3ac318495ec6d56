"""File operations used for everything that is written.

Each function does little on purpose: tests make every one of these calls fail in turn, or end the
process there. Only the standard library is used.
"""

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
    """Write a new file with the user's usual permissions and flush it to the disk.

    If that fails, no file is left behind."""
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
    """Make one new folder."""
    os.mkdir(path)


def make_folders(folder: Path, made: list[Path]) -> None:
    """Create a folder and its missing parents; append each new folder to `made` at once."""
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
    """Flush a folder's list of names to the disk, if the file system supports that."""
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
    """Rename the folder `source` to `target` in one step, replacing an empty folder there."""
    os.rename(source, target)


def replace(source: Path, target: Path) -> None:
    """Rename the file `source` to `target` in one step, replacing a file there."""
    os.replace(source, target)


def exchange(first: Path, second: Path) -> bool:
    """Exchange two folders in one step. Return `False` if the system cannot exchange folders."""
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
    """Return whether the file system of `folder` can exchange two folders."""
    pair = [folder / name for name in (".first", ".second")]
    for one in pair:
        os.mkdir(one)
    try:
        return exchange(*pair)
    finally:
        for one in pair:
            discard(one)


def _exchanged(call, first: bytes, second: bytes) -> int:
    """Return the error number of an exchange, 0 for success."""
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
    """Give the folder `path` the permissions of the folder `model`, as far as allowed."""
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
    """Remove a folder and its content, as far as possible."""
    shutil.rmtree(path, ignore_errors=True)
