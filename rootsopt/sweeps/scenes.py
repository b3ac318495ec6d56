"""Simulate a config over values of any of its keys, as a labelled dataset."""

import threading
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rootsopt.config import Config
from rootsopt.config.sources import FILES
from rootsopt.runtime.environment import check_precision
from rootsopt.runtime.journal import Journal, header_of
from rootsopt.sweeps.local import in_process
from rootsopt.sweeps.plan import Plan, check_values, plan_of
from rootsopt.sweeps.points import Row, check_row, prepared
from rootsopt.sweeps.table import dataset_of

if TYPE_CHECKING:
    import xarray

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
) -> "xarray.Dataset":
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
      with that file after a run that was stopped. Damaged lines of the file are dropped with a
      warning, and their points are simulated again.

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
    if there are no axes, if an axis has no values, too many or one of them twice, and if `resume`
    finds no file or that of another sweep. Raises RuntimeError if JAX is not set to the
    precision of the config.

    >>> import jax
    >>> import rootsopt
    >>> jax.config.update("jax_enable_x64", True)
    >>> config = rootsopt.load_config("cic")
    >>> data = rootsopt.sweep_scenes(config, {"scene.speed_rpm": [2900.0, 3000.0]})
    >>> data.mean_force_N.dims, data.mean_force_N.round(1).values.tolist()
    (('scene.speed_rpm',), [26.7, 26.8])
    """
    check_precision()
    plan = checked(config, plan_of(axes, zip, sample, sobol, seed))
    done: dict[int, Row] = {}
    path = None if checkpoint is None else Path(checkpoint)
    with closing(Points(config, plan, (), path, resume)) as journal:
        if journal.damage:
            warnings.warn(journal.damage, stacklevel=2)
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
    journal: "Points",
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


class Points(Journal):
    """The journal of a sweep: the record of each point by its number.

    `config`, `plan`: those of the sweep; `imports`: names of the files and modules that were
    imported first; `path`, `resume`: see `Journal`."""

    def __init__(
        self,
        config: Config,
        plan: Plan,
        imports: Sequence[str] = (),
        path: Path | None = None,
        resume: bool = False,
    ):
        self._count = plan.count
        columns = [one.columns.get(key, ()) for one in plan.dimensions for key in FILES]
        files = [path for column in columns for path in column]
        header = header_of("sweep", config, imports, files, sweep=plan.record())
        super().__init__(header, path, resume)

    def read(self, key: Any, value: Any) -> Row:
        if type(key) is not int or not 0 <= key < self._count:
            raise ValueError(f"{key} is not the number of a point")
        return check_row(value)
