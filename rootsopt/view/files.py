"""Writes result files into a checked folder, by file operations that tests can make fail.

Commands write a folder under a temporary name and rename it when it is whole
(`rootsopt.view.runs`). Each operation is a small function on purpose: tests make each call fail in
turn, or end the process at this call. The lock on a folder can be held by one process at a time,
and the system releases it when that process ends."""

import contextlib
import csv
import enum
import errno
import io
import json
import math
import os
import shutil
import stat
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rootsopt.config import sources
from rootsopt.config.units import COLUMNS
from rootsopt.errors import InputError

if TYPE_CHECKING:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    from rootsopt.config.reading import Config
    from rootsopt.response.result import Series


# Resolution (dots per inch) of the figures.
_DPI = 150


class ResultFolder:
    """The folder `path` for result files, created with its parents if it does not exist.

    `place`: folder into which files are written. Raises `InputError` if the folder cannot be
    created."""

    def __init__(self, path: str | os.PathLike):
        if not str(path):
            raise InputError("the output folder must have a name, but is empty; give a path")
        self.path = self.place = Path(path)
        try:
            self.path.mkdir(parents=True, exist_ok=True)
        except (OSError, ValueError) as error:
            raise InputError(
                f"{str(path)!r}: cannot be used as output folder: {sources.reason(error)}; choose "
                "another folder or make this one writable"
            ) from None

    def write_bytes(self, name: str, data: bytes) -> Path:
        """Write `data` to the file `name`, which may include a subfolder (`figures/force.png`).

        Return the file's path. Raises `InputError` if the file cannot be written."""
        target = self.path / name
        with self._failing(name):
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(data)
        return target

    @contextlib.contextmanager
    def _failing(self, name: str = ""):
        try:
            yield
        except OSError as error:
            raise InputError(
                f"{str(self.path / name)!r}: cannot be written: {sources.reason(error)}; make room "
                "there or choose another output folder"
            ) from None

    def write_text(self, name: str, text: str) -> Path:
        """Write `text` as UTF-8 to the file `name`; return the file's path.

        Raises `InputError` if UTF-8 cannot represent the text, or if the file cannot be written."""
        try:
            data = text.encode("utf-8")
        except UnicodeEncodeError as error:
            wrong = text[max(0, error.start - 20) : error.end + 20]
            raise InputError(
                f"{name}: {wrong!a} cannot be written as UTF-8; rename the file it names"
            ) from None
        return self.write_bytes(name, data)

    def write_json(self, name: str, data: Any) -> Path:
        """Write `data` as strict JSON to the file `name`; return the file's path.

        Non-finite numbers become null. Raises `InputError` if the file cannot be written."""
        text = json.dumps(plain(data), indent=2, allow_nan=False, ensure_ascii=False)
        return self.write_text(name, text + "\n")

    def write_csv(self, name: str, columns: Mapping[str, ArrayLike]) -> Path:
        """Write `columns` {heading: values (n,)} to the CSV file `name`; return the file's path.

        Floats have 10 significant digits, truth values become `true` and `false`, and `None`
        becomes an empty cell. A column may mix these with text. Raises `ValueError` if the columns
        differ in length or are not one-dimensional. Raises `InputError` if the file cannot be
        written."""
        arrays = {name: np.asarray(values) for name, values in columns.items()}
        shapes = {name: array.shape for name, array in arrays.items()}
        if any(len(shape) != 1 for shape in shapes.values()) or len(set(shapes.values())) > 1:
            raise ValueError(
                f"Argument `columns` must hold 1-D arrays of one length, but has {shapes}"
            )
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(arrays)
        writer.writerows(zip(*(map(_cell, x.tolist()) for x in arrays.values()), strict=True))
        return self.write_text(name, text.getvalue())

    def write_figure(self, name: str, figure: "Figure") -> Path:
        """Write a matplotlib figure as PNG to the file `name`; return the file's path.

        `figure` has a canvas of the Agg backend, as those of `figures.style.figure` have; its
        resolution is changed. Raises `InputError` if the file cannot be written."""
        from PIL import Image  # Imported here: only figures need it.

        file, canvas = io.BytesIO(), cast("FigureCanvasAgg", figure.canvas)
        # `savefig` would lay out and draw everything twice.
        figure.set_dpi(_DPI)
        canvas.draw()
        picture = Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")
        # Without the opaque alpha, the lowest level gives files as small as matplotlib's default,
        # in half the time.
        picture.save(file, "png", compress_level=1, dpi=(_DPI, _DPI))
        return self.write_bytes(name, file.getvalue())


def plain(data: Any) -> Any:
    """Convert `data` to types that JSON supports; non-finite numbers become `None`."""
    if isinstance(data, Mapping):
        return {str(key): plain(value) for key, value in data.items()}
    if isinstance(data, (list, tuple)):
        return [plain(value) for value in data]
    if isinstance(data, enum.Enum):
        return data.name.lower()
    if isinstance(data, os.PathLike):
        return os.fspath(data)
    if hasattr(data, "tolist"):  # arrays and array scalars, NumPy or JAX
        return plain(data.tolist())
    if isinstance(data, float) and not math.isfinite(data):
        return None
    return data


def _cell(value: Any) -> str:
    if isinstance(value, float | np.floating):
        return f"{value + 0.0:.10g}"  # no "-0"
    if isinstance(value, bool | np.bool_):
        return str(value).lower()
    return "" if value is None else str(value)


def write_config(folder: ResultFolder, config: "Config") -> None:
    """Write config.yaml into `folder`, with copies of the files that the config names.

    The written config names the copies, so that the folder can be moved. Raises `InputError` if
    a file cannot be read or written."""
    for key, (stem, _) in sources.FILES.items():
        if config.value(key) is None:
            continue
        copy = f"{stem}{Path(config.value(key)).suffix.lower()}"
        folder.write_bytes(copy, sources.content(config.value(key), key))
        config = config.moved({key: copy})
    folder.write_text("config.yaml", config.to_yaml())


def profile_columns(outline_mm: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
    """Return the columns `x_mm` and `y_mm` of `profile_*.csv`, each (n,).

    `outline_mm` (n, 2): points of the closed outline (mm)."""
    return {"x_mm": outline_mm[:, 0], "y_mm": outline_mm[:, 1]}


def response_columns(series: "Series") -> dict[str, NDArray[np.float64]]:
    """Return the columns of `response_*.csv`: motion and forces over time, each (n,).

    `series`: time series of a motion, in SI units. Units of the columns are in their names. Loads
    on the bearings come last, if there are any."""
    loads = series.bearing_loads
    return {
        "time_s": series.time,
        **{
            name: factor * getattr(series, field)
            for field, (name, *_, factor) in COLUMNS.items()
            if field != "depth"
        },
        **({} if loads is None else dict(zip(_BEARINGS, loads.T, strict=True))),
    }


# Columns of the loads on the bearings.
_BEARINGS = tuple(f"bearing_{rotor}_{end}_end_N" for rotor in (1, 2) for end in ("gear", "far"))


def design_file(point: int) -> str:
    """Return the name of the file with the config of the point of a front with this number."""
    return f"designs/point_{point:02d}.yaml"


def row_columns(
    rows: Sequence[Mapping[str, Any]], keys: Iterable[str] | None = None
) -> dict[str, NDArray]:
    """Return {key: column (n,)} for n `rows`, for example for the rows of a history.

    `keys`: keys of the columns in order. By default, these are all keys of `rows` in the order of
    their first appearance. An absent entry becomes `None`."""
    if keys is None:
        keys = dict.fromkeys(key for row in rows for key in row)
    columns = {}
    for key in keys:
        columns[key] = np.empty(len(rows), dtype=object)
        columns[key][:] = [row.get(key) for row in rows]
    return columns


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


def make_folders(folder: Path, made: list[Path]) -> None:
    """Create a folder and its missing parents.

    `made`: list to which each folder is appended as soon as it is created. Raises `OSError` if a
    folder cannot be created."""
    for new in reversed([x for x in (folder, *folder.parents) if not x.is_dir()]):
        try:
            os.mkdir(new)
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


def adopt_mode(path: Path, model: Path) -> None:
    """Give the folder `path` the permissions of the folder `model`.

    Do nothing if there is no such folder, or if the system does not allow it."""
    with contextlib.suppress(OSError):
        os.chmod(path, stat.S_IMODE(os.stat(model).st_mode))


def discard(path: Path) -> None:
    """Remove a file or an empty folder if it exists and can be removed."""
    with contextlib.suppress(OSError):
        if path.is_dir() and not path.is_symlink():
            os.rmdir(path)
        else:
            os.unlink(path)


def discard_tree(path: Path) -> None:
    """Remove a folder and its contents, as far as possible; ignore errors."""
    shutil.rmtree(path, ignore_errors=True)


try:
    import fcntl
except ImportError:  # this system has no such locks
    fcntl = None


class TakenError(InputError):
    """Raised if another process holds the lock; its message names that process."""


class Lock:
    """An advisory lock on the file `path`, which exists only while the lock is held.

    The system releases the lock when the process ends, for whatever reason. If the system has no
    such locks, `held` is `False` and no error is raised. Raises `TakenError` if another process
    holds the lock. Raises `OSError` if the file cannot be created."""

    def __init__(self, path: Path):
        self.path = path
        self.held = False
        self._file = -1
        while fcntl is not None and self._file < 0:
            self._try()

    def _try(self) -> None:
        file = self._open()
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)  # pyright: ignore
            self.held = True
        except (BlockingIOError, PermissionError):
            holder = _holder(file)
            os.close(file)
            raise TakenError(holder) from None
        except OSError:
            pass  # This file system has no such locks.
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
            return os.path.samestat(os.stat(self.path), os.fstat(file))
        except OSError:
            return False

    def release(self) -> None:
        """Remove the file and release the lock; a second call does nothing."""
        if self._file < 0:
            return
        file, self._file, self.held = self._file, -1, False
        # Remove it while the lock is held: nobody else can have taken it by then.
        with contextlib.suppress(OSError):
            os.unlink(self.path)
        os.close(file)


def _holder(file: int) -> str:
    try:
        return f"process {int(os.pread(file, 32, 0))}"
    except (OSError, ValueError):
        return "another process"
