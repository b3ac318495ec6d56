"""Files of a sweep: rows, summary, and the dataset as netCDF."""

import io
from collections import Counter
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from rootsopt.response.result import RESPONSES
from rootsopt.response.sweeps.plan import Plan
from rootsopt.response.sweeps.points import Row
from rootsopt.response.sweeps.scenes import is_numeric, written
from rootsopt.status import Status
from rootsopt.view.files import ResultFolder

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

    These are taken from the first usable point, or from the first point if none is usable. If
    points are missing, the sweep was interrupted."""
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


def write_dataset(folder: ResultFolder, name: str, dataset: "xarray.Dataset") -> None:
    """Write a dataset as netCDF into `folder`; raise `InputError` if that fails."""
    data = io.BytesIO()
    dataset.to_netcdf(data, engine="h5netcdf")
    folder.write_bytes(name, data.getvalue())
