"""The work of `rootsopt sweep`."""

import argparse
import time
from contextlib import closing
from functools import partial
from typing import Any

import numpy as np
from rich.console import Console

from rootsopt.commands import cli, door
from rootsopt.commands.work.searching import opened, progress_bar
from rootsopt.config.plausible import notes_on_swept
from rootsopt.config.reading import Config
from rootsopt.errors import InputError
from rootsopt.response.sweeps.cluster import running
from rootsopt.response.sweeps.plan import Plan, parse_over, plan_of, scattered
from rootsopt.response.sweeps.scenes import Points, checked, complete, dataset_of
from rootsopt.runtime.environment import say
from rootsopt.status import Status
from rootsopt.view import files, sweeps
from rootsopt.view.runs import RunFolder

_DATA = "sweep.nc"

# Number of points above which the terminal shows only the first.
_FEW = 40
_FIRST = "compiling and simulating"
_PROMISE = "keeping the points that are done and writing the files"


def body(config: Config, options: argparse.Namespace, folder: RunFolder) -> cli.Outcome:
    """Run `rootsopt sweep`: simulate all points, and write files into `folder`.

    Return the `Outcome`. Raises `InputError` if a key, a value or an option is not valid."""
    began = time.perf_counter()
    cli.load_figures(options, "sweep")
    config, plan = _points(config, options)
    plan = checked(config, plan)
    columns = {key: values for one in plan.dimensions for key, values in one.columns.items()}
    found = notes_on_swept(config, columns)
    for note in found:
        say(note)
    folder.add_notes(found)
    cache = not options.no_cache
    with (
        running(options.workers, options.scheduler, options.imports, cache) as runs,
        closing(opened(partial(Points, config, plan, options.imports), options, folder)) as journal,
        door.patience(_PROMISE) as stop,
        progress_bar(Console(stderr=True), _FIRST, "simulating", "points") as progress,
    ):
        known = len(journal.resumed)
        records = complete(config, plan, runs, journal, progress or _silent, stop)
    done = len(records) == plan.count
    seconds = time.perf_counter() - began
    dataset = dataset_of(config, plan, records)
    files.write_config(folder, config)
    rows = sweeps.rows_of(plan, records)
    folder.write_csv("sweep.csv", files.row_columns(rows))
    sweeps.write_dataset(folder, _DATA, dataset)
    statistics: dict[str, Any] = {"seconds": seconds, "resumed_points": known}
    statistics["points_per_second"] = (len(records) - known) / seconds
    record = sweeps.summary(plan, records) | {"data": _DATA, "statistics": statistics}
    folder.write_json("result.json", record | {"versions": files.versions()})
    if not options.no_figures:
        from rootsopt.view.figures.sweep import sweep_figure

        sweep_figure(folder, plan, dataset)
    if done:
        folder.remove_afterwards(folder.checkpoint)
    else:
        folder.overwrite = False  # An earlier result is more valuable than this one.
    rate = statistics["points_per_second"]
    line = f"{len(records) - known} points in {seconds:.1f} s, {rate:.3g} per second"
    usable = done and any(Status[row["status"].upper()].usable for row in rows)
    return cli.Outcome(cli.OK if usable else cli.NO_RESULT, [line], rows, _FEW)


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
    seed = 0 if options.seed is None else options.seed
    return plan_of(axes, options.zip or groups, options.sample, options.sobol, seed)


def _silent(done: int, expected: int) -> None:
    """Do nothing, in place of a progress bar."""
