"""Files of a sweep: rows, summary, and the dataset as netCDF or Zarr."""

import importlib
import io
import warnings
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from rootsopt.config.words import shown
from rootsopt.errors import InputError
from rootsopt.output.files import ResultFolder
from rootsopt.response.records import RESPONSES
from rootsopt.status import Status
from rootsopt.sweeps.plan import Plan
from rootsopt.sweeps.points import Row
from rootsopt.sweeps.scenes import is_numeric, written

if TYPE_CHECKING:
    import xarray


def rows_of(plan: Plan, records: Mapping[int, Row]) -> list[dict[str, Any]]:
    """Return one row per simulated point: its number, values, forces, kind of motion, status."""
    found = []
    for number in sorted(records):
        record, values = records[number], plan.at(number)
        plain = {key: v if is_numeric([v]) else written(v) for key, v in values.items()}
        steady = record["steady_state"]
        response = record["response"]
        found.append(
            {"point": number}
            | plain
            | {name: response.get(name) for name in (*RESPONSES, *response)}
            | {name: steady.get(name) for name in ("kind", "period", "floquet_multiplier")}
            | {"status": record["status"]}
        )
    return found


def outcome(plan: Plan, records: Mapping[int, Row]) -> tuple[Status, str]:
    """Return status and message of a whole sweep.

    They are those of the first usable point, or of the first point if none is usable. If points are
    missing, the sweep was interrupted."""
    first = sorted(records)
    known = [number for number in first if Status[records[number]["status"].upper()].usable]
    counts = f"{len(known)} of {plan.count} points have a usable result."
    if len(records) < plan.count:
        return Status.INTERRUPTED, (
            f"The sweep was stopped: {len(records)} of {plan.count} points are done. Run it again "
            "with --resume for the others."
        )
    record = records[(known or first)[0]]
    status = Status[record["status"].upper()]
    return status, counts if known else f"{counts} The first one: {record['message']}"


def summary(plan: Plan, records: Mapping[int, Row]) -> dict[str, Any]:
    """Return the record of a sweep for the result file."""
    status, message = outcome(plan, records)
    counts = Counter(records[number]["status"] for number in sorted(records))
    missing = plan.count - len(records)
    return {
        "sweep": plan.record() | {"points": plan.count},
        "statuses": dict(counts) | ({"not_simulated": missing} if missing else {}),
        "status": status.label,
        "message": message,
    }


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


def write_dataset(folder: ResultFolder, name: str, dataset: "xarray.Dataset") -> None:
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


def _zarr(dataset: "xarray.Dataset") -> dict[str, Any]:
    """Return the files of a dataset by name, in Zarr's format 2, which supports texts."""
    found: dict[str, Any] = {}
    memory: Any = importlib.import_module("zarr.storage").MemoryStore(found)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        dataset.to_zarr(memory, mode="w", zarr_format=2)
    return found
