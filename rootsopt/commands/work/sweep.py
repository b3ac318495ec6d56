"""`rootsopt sweep`: simulate all points, and write rows, summary and a netCDF dataset."""

import argparse
import io
import time
from collections import Counter
from collections.abc import Mapping
from contextlib import closing
from functools import partial
from typing import Any

import numpy as np

from rootsopt.commands import cli, door
from rootsopt.commands.work.searching import opened, progress_bar
from rootsopt.config.plausible import notes_on_swept
from rootsopt.config.reading import Config
from rootsopt.errors import InputError
from rootsopt.response.result import RESPONSES
from rootsopt.response.sweeps.cluster import running
from rootsopt.response.sweeps.plan import Plan, parse_over, plan_of, scattered
from rootsopt.response.sweeps.points import Row
from rootsopt.response.sweeps.scenes import (
    Points,
    checked,
    complete,
    dataset_of,
    is_numeric,
    written,
)
from rootsopt.runtime.environment import say
from rootsopt.status import Status
from rootsopt.view import files
from rootsopt.view.runs import RunFolder


def rows_of(plan: Plan, records: Mapping[int, Row]) -> list[dict[str, Any]]:
    """Return one row per simulated point: its number, values, forces, kind of motion, status."""
    rows = []
    for number in sorted(records):
        record, values = records[number], plan.at(number)
        plain = {key: v if is_numeric([v]) else written(v) for key, v in values.items()}
        steady = record["steady_state"]
        response = record["response"]
        rows.append(
            {"point": number}
            | plain
            | {name: response.get(name) for name in (*RESPONSES, *response)}
            | {name: steady.get(name) for name in ("kind", "period", "floquet_multiplier")}
            | {"status": record["status"]}
        )
    return rows


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


_DATA = "sweep.nc"

# Number of points above which the terminal shows only the first.
_FEW = 40


def body(config: Config, options: argparse.Namespace, folder: RunFolder) -> cli.Outcome:
    """Run `rootsopt sweep`: simulate all points, and write files into `folder`.

    Return the `Outcome`. Raises `InputError` if a key, a value or an option is not valid."""
    began = time.perf_counter()
    config, plan = _points(config, options)
    plan = checked(config, plan)
    columns = {key: values for one in plan.dimensions for key, values in one.columns.items()}
    notes = notes_on_swept(config, columns)
    for note in notes:
        say(note)
    with (
        running(options.workers, options.scheduler, options.imports, not options.no_cache) as runs,
        closing(opened(partial(Points, config, plan, options.imports), options, folder)) as journal,
        door.patience("keeping the points that are done and writing the files") as stop,
        progress_bar("compiling and simulating", "simulating", "points") as progress,
    ):
        known = len(journal.resumed)
        told = progress or (lambda done, expected: None)
        records = complete(config, plan, runs, journal, told, stop)
    done = len(records) == plan.count
    seconds = time.perf_counter() - began
    rows = rows_of(plan, records)
    folder.write_csv("sweep.csv", files.row_columns(rows))
    dataset, data = dataset_of(config, plan, records), io.BytesIO()
    dataset.to_netcdf(data, engine="h5netcdf")
    folder.write_bytes(_DATA, data.getvalue())
    rate = (len(records) - known) / seconds
    statistics = {"seconds": seconds, "resumed_points": known, "points_per_second": rate}
    record = summary(plan, records) | {"data": _DATA, "statistics": statistics}
    if not options.no_figures:
        from rootsopt.view.figures.sweep import sweep_figure

        sweep_figure(folder, plan, dataset)
    if done:
        folder.remove_afterwards(folder.checkpoint)
    else:
        folder.overwrite = False  # An earlier result is more valuable than this one.
    line = f"{len(records) - known} points in {seconds:.1f} s, {rate:.3g} per second"
    usable = done and any(Status[row["status"].upper()].usable for row in rows)
    return cli.Outcome(usable, record, [line], rows, _FEW, config=config, notes=notes)


def _points(config: Config, options: argparse.Namespace) -> tuple[Config, Plan]:
    """Return the config without the sweep's own values, and the points of the sweep."""
    if options.tolerances is not None:
        for name in ("over", "zip", "zip_keys", "sample", "sobol", "seed"):
            if getattr(options, name) not in (None, False, []):
                raise InputError(
                    f"`--tolerances` draws all points, so that `--{name.replace('_', '-')}` has no "
                    "effect; remove one of them"
                )
        return scattered(config, options.tolerances)
    return config, _plan(config, options)


def _plan(config: Config, options: argparse.Namespace) -> Plan:
    axes: dict[str, Any] = {}
    for text in options.over:
        key, axis = parse_over(text)
        if key in axes:
            raise InputError(f"`--over {key}=...` is given twice; write all its values in one list")
        axes[key] = axis
    if not axes:
        speed = config.scene.speed_rpm
        speeds = sorted(config.objective.speeds_rpm) or np.linspace(0.1 * speed, 2 * speed, 39)
        axes = {"scene.speed_rpm": speeds}
    groups = [[key.strip() for key in text.split(",")] for text in options.zip_keys]
    if options.zip and groups:
        raise InputError("`--zip` zips all keys, so that `--zip-keys` has no effect; remove one")
    seeded = options.sample is not None or options.sobol is not None
    if options.seed is not None and not seeded:
        raise InputError("`--seed` is for samples; add `--sample N` or `--sobol N`, or remove it")
    return plan_of(axes, options.zip or groups, options.sample, options.sobol, options.seed or 0)
