"""Writes datasets into a result folder, as netCDF or Zarr."""

import importlib
import io
import warnings
from pathlib import Path
from typing import Any, NamedTuple

import xarray

from rootsopt.config.words import shown
from rootsopt.errors import InputError
from rootsopt.output.files import ResultFolder


class _Format(NamedTuple):
    """A file format: its name, the packages that write it, and the extra that installs them."""

    name: str
    packages: tuple[str, ...]
    extra: str


_FORMATS = {
    ".nc": _Format("netCDF", ("h5netcdf", "h5py"), ""),
    ".zarr": _Format("Zarr", ("zarr",), "[zarr]"),
}
"""Formats by the suffix of the file's name."""
SUFFIXES = tuple(_FORMATS)
"""Suffixes of the names that a dataset can have."""


def check_name(name: str) -> None:
    """Raise `InputError` unless a dataset can be written under this `name`.

    The suffix must be that of a known format, whose packages are installed."""
    suffix = Path(name).suffix
    if Path(name).name != name or suffix not in _FORMATS or Path(name).stem.startswith("."):
        known = " or ".join(f"sweep{one} ({_FORMATS[one].name})" for one in SUFFIXES)
        raise InputError(
            f"`--data` must be the name of a file in the result folder, {known}, but is "
            f"{shown(name)}"
        )
    wanted = _FORMATS[suffix]
    for package in wanted.packages:
        try:
            importlib.import_module(package)
        except ImportError:
            raise InputError(
                f"{name!r} cannot be written, because the package {package} is not installed; "
                f"install it with `pip install 'rootsopt{wanted.extra}'`, or choose another "
                f"format with `--data`"
            ) from None


def write_dataset(folder: ResultFolder, name: str, dataset: xarray.Dataset) -> None:
    """Write a dataset into `folder`; the suffix of `name` chooses the format, as in `SUFFIXES`.

    Raises `InputError` as `check_name`, or if a file cannot be written."""
    check_name(name)
    if Path(name).suffix == ".nc":
        data = io.BytesIO()
        dataset.to_netcdf(data, engine="h5netcdf")
        folder.write_bytes(name, data.getvalue())
        return
    for key, value in _zarr(dataset).items():
        folder.write_bytes(f"{name}/{key}", value.to_bytes())


def _zarr(dataset: xarray.Dataset) -> dict[str, Any]:
    """Return the files of a dataset by name, in Zarr's format 2, which supports texts."""
    found: dict[str, Any] = {}
    memory: Any = importlib.import_module("zarr.storage").MemoryStore(found)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        dataset.to_zarr(memory, mode="w", zarr_format=2)
    return found


__all__ = ["SUFFIXES", "check_name", "write_dataset"]
