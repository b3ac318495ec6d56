"""Result files, in a folder that is checked beforehand.

Commands write a folder under a temporary name and rename it when it is whole
(`rootsopt.view.runs`)."""

import csv
import enum
import io
import json
import math
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rootsopt.config import sources
from rootsopt.errors import InputError
from rootsopt.runtime.environment import versions as versions

if TYPE_CHECKING:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    from rootsopt.config import Config
    from rootsopt.response.records import Series

DPI = 150
"""Resolution (dots per inch) of the figures."""


class ResultFolder:
    """The folder `path` for result files, created with its parents if it does not exist.

    Raises `InputError` if the folder cannot be created."""

    def __init__(self, path: str | os.PathLike):
        if not str(path):
            raise InputError("the output folder must have a name, but is empty; give a path")
        self.path = Path(path)
        try:
            self.path.mkdir(parents=True, exist_ok=True)
        except (OSError, ValueError) as error:
            raise InputError(
                f"{str(path)!r}: cannot be used as output folder: {sources.reason(error)}; choose "
                "another folder or make this one writable"
            ) from None

    @property
    def place(self) -> Path:
        """Folder into which files are written."""
        return self.path

    def write_bytes(self, name: str, data: bytes) -> Path:
        """Write `data` to the file `name`, which may include a subfolder (`figures/force.png`).

        Return the file's path. Raises `InputError` if the file cannot be written."""
        target = self.path / name
        try:
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(data)
        except OSError as error:
            raise InputError(
                f"{str(target)!r}: cannot be written: {sources.reason(error)}; make room there or "
                "choose another output folder"
            ) from None
        return target

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
        return self.write_text(name, _csv(columns))

    def write_figure(self, name: str, figure: "Figure") -> Path:
        """Write a matplotlib figure as PNG to the file `name`; return the file's path.

        `figure` has a canvas of the Agg backend, as those of `figures.style.figure` have; its
        resolution is changed. Raises `InputError` if the file cannot be written."""
        from PIL import Image  # As matplotlib, only for figures.

        file, canvas = io.BytesIO(), cast("FigureCanvasAgg", figure.canvas)
        # `savefig` would lay out and draw everything twice.
        figure.set_dpi(DPI)
        canvas.draw()
        picture = Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")
        # Without the opaque alpha, the lowest level gives files as small as matplotlib's default,
        # in half the time.
        picture.save(file, "png", compress_level=1, dpi=(DPI, DPI))
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


def _csv(columns: Mapping[str, ArrayLike]) -> str:
    arrays = {name: np.asarray(values) for name, values in columns.items()}
    shapes = {name: array.shape for name, array in arrays.items()}
    if any(len(shape) != 1 for shape in shapes.values()) or len(set(shapes.values())) > 1:
        raise ValueError(f"Argument `columns` must hold 1-D arrays of one length, but has {shapes}")
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(arrays)
    writer.writerows(zip(*(_cells(array) for array in arrays.values()), strict=True))
    return text.getvalue()


def _cells(array: NDArray) -> list[str]:
    if array.dtype.kind == "f":
        return [f"{value:.10g}" for value in (array + 0.0).tolist()]  # no "-0"
    return [_cell(value) for value in array.tolist()]


def _cell(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, bool | np.bool_):
        return "true" if value else "false"
    if isinstance(value, float | np.floating):
        return f"{value + 0.0:.10g}"
    return str(value)


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


def profile_columns(outline_mm: ArrayLike) -> dict[str, NDArray[np.float64]]:
    """Return the columns `x_mm` and `y_mm` of `profile_*.csv`, each (n,).

    `outline_mm` (n, 2): points of the closed outline (mm)."""
    outline = np.asarray(outline_mm)
    return {"x_mm": outline[:, 0], "y_mm": outline[:, 1]}


def response_columns(series: "Series") -> dict[str, NDArray[np.float64]]:
    """Return the columns of `response_*.csv`: motion and forces over time, each (n,).

    `series`: time series of a motion, in SI units. Units of the columns are in their names. Loads
    on the bearings come last, if there are any."""
    loads = series.bearing_loads
    more = {} if loads is None else dict(zip(_BEARINGS, loads.T, strict=True))
    return {
        "time_s": series.time,
        "rotation_deg": np.degrees(series.rotation),
        "relative_rotation_rad": series.relative,
        "relative_speed_rad_s": series.rate,
        "drive_flank_force_N": series.drive_force,
        "coast_flank_force_N": series.coast_force,
        "contact_force_N": series.force,
    } | more


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
