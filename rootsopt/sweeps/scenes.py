"""Simulate a config over values of any of its keys, as a labelled dataset."""

import hashlib
import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import xarray

from rootsopt.config import Config
from rootsopt.config.sources import reason, regular_file
from rootsopt.errors import InputError
from rootsopt.runtime.precision import check_precision
from rootsopt.runtime.versions import versions
from rootsopt.sweeps.journal import Journal
from rootsopt.sweeps.local import in_process
from rootsopt.sweeps.plan import Plan, check_values, plan_of
from rootsopt.sweeps.points import Row, prepared
from rootsopt.sweeps.table import dataset_of

Run = Callable[[Config, Plan, Sequence[int], threading.Event], Any]
"""A function that simulates points of a plan and yields lists of (number, record) as they are
done: `in_process`, or the method of a cluster."""


def sweep_scenes(  # Keywords of the public interface, each independent of the others.
    config: Config,
    axes: Mapping[str, Sequence[Any] | str],
    progress: Callable[[int, int], None] = lambda done, expected: None,
    *,
    zip: bool | Sequence[Sequence[str]] = False,
    sample: int | None = None,
    sobol: int | None = None,
    seed: int = 0,
    workers: int | None = None,
    scheduler: str | None = None,
    checkpoint: str | Path | None = None,
    resume: bool = False,
) -> xarray.Dataset:
    """Simulate a `config` at every combination of the values of some of its keys.

    `axes`: dotted keys with their values, such as {"scene.speed_rpm": [1000, 2000]}, or with a text
    as for `rootsopt sweep --over`, such as "300:6000:39". Each key is a dimension of the result, in
    the order given. `progress` is called with (points done, number of points).

    - `zip`: `True` to advance all keys together along one dimension `point`; or groups of keys that
      do so.
    - `sample`, `sobol`: number of pseudo-random or Sobol samples, along one dimension `sample`,
      instead of a grid. They are drawn from intervals ("300:6000", "1:100:log") and from lists.
      `seed` of the samples.
    - `workers`: number of processes to start on this machine; `scheduler`: address of a Dask
      scheduler whose workers to use. Both need `pip install 'rootsopt[cluster]'`, and a script that
      starts processes must do so below `if __name__ == "__main__":`. By default, the points run in
      this process, on all cores.
    - `checkpoint`: file in which the points are kept as they are done; `resume`: whether to go on
      with that file after a run that was stopped.

    The result has these variables over the dimensions:

    - `mean_force_N`, `peak_force_N`, `rms_force_N` (N), and further responses that the config
      requests (NaN if not known);
    - `status`: labels, `status_code`: their codes, `message`: meaning and advice. A point whose
      values do not fit each other has the status `invalid`;
    - `period` (mesh periods; 0 if not periodic);
    - `floquet_multiplier`: greatest modulus (NaN if there is no closed orbit), and real and
      imaginary parts of all multipliers, with the further dimension `multiplier`;
    - geometry, such as `outer_radius_mm`;
    - `gradient_…` of each response per config unit, with the further dimension `design_key` (NaN
      without a gradient, and for parameters that the family of the point does not have).

    Raises `InputError` for a key or value that a config cannot have, before anything is simulated,
    and if there are no axes or an axis has no values. Raises RuntimeError if JAX is not set to the
    precision of the config.

    >>> import jax
    >>> import rootsopt
    >>> jax.config.update("jax_enable_x64", True)
    >>> config = rootsopt.load_config("cic")
    >>> data = rootsopt.sweep_scenes(config, {"scene.speed_rpm": [2900.0, 3000.0]})
    >>> data.mean_force_N.dims, data.mean_force_N.round(1).values.tolist()
    (('scene.speed_rpm',), [76.4, 76.2])
    """
    check_precision(config.solver.precision)
    plan = checked(config, plan_of(axes, zip, sample, sobol, seed))
    done: dict[int, Row] = {}
    with closing(_journal(config, plan, checkpoint, resume)) as journal:
        run = runner(workers, scheduler)
        done = complete(config, plan, run, journal, progress)
    return dataset_of(config, plan, done)


def checked(config: Config, plan: Plan) -> Plan:
    """Return the plan with absolute paths, after a check of its keys and values.

    Raises `InputError` as `check_values`."""
    plan = plan.mapped(prepared)
    check_values(config, plan)
    return plan


def complete(
    config: Config,
    plan: Plan,
    run: Run,
    journal: "Journal | Memory",
    progress: Callable[[int, int], None] = lambda done, expected: None,
    stop: threading.Event | None = None,
) -> dict[int, Row]:
    """Simulate all points that are not in the `journal`, and return the records by number.

    `run`: how to simulate them; `stop`: event after which no further point begins."""
    missing = [number for number in range(plan.count) if number not in journal.rows]
    progress(len(journal.rows), plan.count)
    if missing:
        for some in run(config, plan, missing, stop or threading.Event()):
            journal.add(some)
            progress(len(journal.rows), plan.count)
    return journal.rows


def runner(
    workers: int | None = None,
    scheduler: str | None = None,
    imports: Sequence[str] = (),
    cache: bool = True,
) -> Run:
    """Return the function that simulates points: in this process, or on a cluster.

    `workers`, `scheduler`: as in `sweep_scenes`; `imports`: names of files and modules that a
    worker imports first; `cache`: whether workers keep compiled programs between runs. Raises
    `InputError` if there is no cluster."""
    if workers is None and scheduler is None:
        return in_process
    from rootsopt.sweeps.cluster import Cluster  # Needs an optional package.

    return Cluster(workers, scheduler, tuple(imports), cache).run


def header(config: Config, plan: Plan, imports: Sequence[str] = ()) -> dict[str, Any]:
    """Return everything on which the records of a sweep depend, as plain values.

    `imports`: names of the files and modules that were imported first. Raises `InputError` if an
    outline file of the sweep cannot be read."""
    outlines = [config.profile.outline_file]
    for one in plan.dimensions:
        outlines += one.columns.get("profile.outline_file", ())
    found = {
        "config": config.model_dump(mode="json"),
        "sweep": plan.record(),
        "versions": versions(),
        "imports": [*imports],
    }
    return found | {"outlines": {path: _digest(path) for path in outlines if path is not None}}


def _digest(path: str) -> str:
    """Return a digest of an outline file."""
    try:
        return hashlib.sha256(regular_file(path, "an outline").read_bytes()).hexdigest()
    except OSError as error:
        raise InputError(f"{path!r}: cannot be read: {reason(error)}") from None


class Memory:
    """Keeps the records of a sweep in memory, with the methods of a `Journal`, if no file is
    wanted."""

    def __init__(self) -> None:
        self.rows: dict[int, Row] = {}

    def add(self, found: Sequence[tuple[int, Row]]) -> None:
        """Keep points (number, record)."""
        self.rows |= dict(found)

    def close(self) -> None:
        """Do nothing."""


def _journal(config: Config, plan: Plan, path: Any, resume: bool) -> "Journal | Memory":
    if path is None:
        return Memory()
    return Journal(Path(path), header(config, plan), resume)


__all__ = ["Memory", "checked", "complete", "header", "runner", "sweep_scenes"]
