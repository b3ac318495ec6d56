"""Simulate a config over values of any of its keys, as a labelled dataset."""

import threading
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing, suppress
from itertools import takewhile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml

import rootsopt
from rootsopt.config.explain import tree
from rootsopt.config.reading import Config
from rootsopt.config.sources import FILES
from rootsopt.config.units import unit_of
from rootsopt.response.journal import Journal, header_of
from rootsopt.response.reducers import HERE, as_done
from rootsopt.response.result import RESPONSES
from rootsopt.response.sweeps.cluster import ClosedError, running
from rootsopt.response.sweeps.plan import Plan, check_values, plan_of
from rootsopt.response.sweeps.points import InProcess, Row, check_row, lost, prepared
from rootsopt.runtime.environment import check_precision
from rootsopt.status import Status

if TYPE_CHECKING:
    import xarray

_LONG = {
    "mean_force_N": "mean contact force",
    "peak_force_N": "peak contact force",
    "rms_force_N": "RMS contact force",
    "outer_radius_mm": "outer radius of the rotor",
    "root_radius_mm": "root radius of the rotor",
    "area_mm2": "area of the rotor's section",
    "area_efficiency": "share of the outer circle that the section leaves free",
    "polar_inertia_kg_m2": "polar moment of inertia of a rotor",
    "undercut_margin_mm": "margin to undercut",
    "seal_width_mm": "arc length of the tip land",
}
# Unit and long name of each number that is taken from `steady_state`.
_SCALARS = {
    "period": ("mesh periods", "period of the motion (0: not periodic)"),
    "floquet_multiplier": ("1", "greatest modulus of the Floquet multipliers"),
    "lyapunov_exponent_per_mesh_period": ("1", "Lyapunov exponent per mesh period"),
}
_PLAIN = str.maketrans({"·": " ", "°": "deg", "²": "2", "³": "3", "µ": "u"})


def dataset_of(
    config: Config,
    plan: Plan,
    rows: Mapping[int, Row],
    attributes: Mapping[str, Any] | None = None,
) -> "xarray.Dataset":
    """Return the dataset of a sweep.

    `config`: config of the sweep; `plan`: the points; `rows`: record of each point by its number,
    where a point without one has the status `not_simulated`; `attributes`: further attributes of
    the dataset."""
    missing = lost(Status.NOT_SIMULATED)
    records = [rows.get(number, missing) for number in range(plan.count)]
    grid = _Grid(plan)
    columns: dict[str, Any] = {}
    names: list[str] = [*RESPONSES, *(name for row in records for name in row["response"])]
    keys = _design_keys(config, records)
    for name in dict.fromkeys(names):
        long = _LONG.get(name, name.replace("_", " "))
        values = [row["response"].get(name) for row in records]
        columns[name] = grid.numbers(values, unit(name), long)
        if keys:
            slopes = [[row["gradient"].get(name, {}).get(key) for key in keys] for row in records]
            columns[f"gradient_{name}"] = grid.numbers(
                slopes,
                f"{unit(name)} per unit of the key",
                f"derivative of the {long} per unit of a design parameter",
                "design_key",
            )
    columns |= _statuses(grid, records) | _motions(grid, records) | _geometries(grid, records)
    coordinates = _coordinates(plan)
    if keys:
        coordinates["design_key"] = ("design_key", keys, {"long_name": "design parameter"})
        units = [unit(key) for key in keys]
        text = {"long_name": "unit of the design parameter"}
        coordinates["design_unit"] = ("design_key", units, text)
    made = {
        "Conventions": "CF-1.11",
        "title": f"rootsopt sweep over {', '.join(plan.keys)}",
        "source": f"rootsopt {rootsopt.__version__}",
        "config": config.to_yaml(),
        "method": plan.method,
    }
    made |= {} if plan.seed is None else {"seed": plan.seed}
    import xarray  # Slow import.

    return xarray.Dataset(columns, coordinates, made | dict(attributes or {}))


class _Grid:
    """Arranges values, one per point, in the shape of a sweep."""

    def __init__(self, plan: Plan):
        self.dims, self.shape = tuple(one.name for one in plan.dimensions), plan.shape

    def numbers(self, values: Sequence[Any], units: str, long: str, *last: str) -> tuple:
        """Return a variable of numbers, one of `values` per point, with `None` as NaN.

        `units`, `long`: its unit and long name; `last`: names of further dimensions."""
        array = np.array(values, dtype=float)
        shape = (*self.shape, *array.shape[1:])
        return (*self.dims, *last), array.reshape(shape), {"units": units, "long_name": long}

    def words(self, values: Sequence[str], long: str) -> tuple:
        """Return a variable of texts, of type object: many points share one long message."""
        return self.dims, np.array(values, dtype=object).reshape(self.shape), {"long_name": long}


def _statuses(grid: _Grid, rows: Sequence[Row]) -> dict[str, Any]:
    labels = [row["status"] for row in rows]
    codes = np.array([Status[label.upper()].code for label in labels], np.int8)
    flags = {
        "long_name": "code of the status",
        "flag_values": np.arange(len(Status), dtype=np.int8),
        "flag_meanings": " ".join(status.label for status in Status),
    }
    return {
        "status": grid.words(labels, "status"),
        "status_code": (grid.dims, codes.reshape(grid.shape), flags),
        "message": grid.words([row["message"] for row in rows], "meaning of the status, advice"),
    }


def _motions(grid: _Grid, rows: Sequence[Row]) -> dict[str, Any]:
    steady = [row["steady_state"] for row in rows]
    columns: dict[str, Any] = {
        name: grid.numbers([one.get(name) for one in steady], units, long)
        for name, (units, long) in _SCALARS.items()
    }
    usable = [Status[row["status"].upper()].usable for row in rows]
    periods = [one.get("period", 0) if ok else 0 for one, ok in zip(steady, usable, strict=True)]
    dims, _, attributes = columns["period"]
    columns["period"] = dims, np.array(periods, int).reshape(grid.shape), attributes
    pairs = [one.get("floquet_multipliers") or [] for one in steady]
    most = max(map(len, pairs))
    padded = [[*some, *[[np.nan, np.nan]] * (most - len(some))] for some in pairs]
    for part, long in enumerate(("real", "imaginary")) if most else ():
        values = [[pair[part] for pair in some] for some in padded]
        columns[f"floquet_multiplier_{long}"] = grid.numbers(
            values, "1", f"{long} part of each Floquet multiplier", "multiplier"
        )
    return columns


def _geometries(grid: _Grid, rows: Sequence[Row]) -> dict[str, Any]:
    names: dict[str, None] = dict.fromkeys(name for row in rows for name in row["geometry"])
    return {
        name: grid.numbers(
            [row["geometry"].get(name) for row in rows], unit(name), _LONG.get(name, name)
        )
        for name in names
        if not any(name in row["response"] for row in rows)
    }


def _design_keys(config: Config, rows: Sequence[Row]) -> list[str]:
    """Return the design parameters for which there are derivatives at some point.

    If no point has a gradient, these are the parameters of the config."""
    slopes = (slope for row in rows for slope in row["gradient"].values())
    return [*dict.fromkeys(key for slope in slopes for key in slope)] or [*config.design_keys]


def _coordinates(plan: Plan) -> dict[str, Any]:
    """Return the values of all keys along their dimensions.

    Values that are not all numbers become texts, as YAML writes them."""
    coordinates: dict[str, Any] = {}
    for one in plan.dimensions:
        if one.name not in one.columns:
            numbers = {"long_name": f"number of the {one.name.partition('_')[0]}"}
            coordinates[one.name] = one.name, np.arange(one.size), numbers
        for key, values in one.columns.items():
            field = tree(Config).get(key)
            long = field.description if field is not None and field.description else key
            attributes = {"units": unit(key), "long_name": long}
            if not is_numeric(values):
                values, attributes = [*map(written, values)], {"long_name": long}
            coordinates[key] = one.name, np.array([*values]), attributes
    return coordinates


def is_numeric(values: Sequence[Any]) -> bool:
    """Return whether all values are numbers, not truth values."""
    return all(isinstance(x, int | float) and not isinstance(x, bool) for x in values)


def written(value: Any) -> str:
    """Return a value as text, as YAML writes it on one line."""
    if isinstance(value, str):
        return value
    text = yaml.safe_dump(value, default_flow_style=True, sort_keys=False, width=10**6)
    return text.removesuffix("\n").removesuffix("\n...")


def unit(name: str) -> str:
    """Return the unit with which a name ends, as UDUNITS reads it; "1" for a name without one."""
    return unit_of(name).translate(_PLAIN) or "1"


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
    - `gradient_…` of each response per config unit, with the further dimension `design_key`. It is
      NaN without a gradient, and for parameters that the family of the point lacks.

    Raises `InputError` for a key or value that a config cannot have, before anything is simulated.
    Also raises it if there are no axes, or if an axis has no values, too many, or a repeated one.
    Also raises it if `resume` finds no file, or that of another sweep. Raises RuntimeError if JAX
    is not set to the precision of the config.

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
    path = None if checkpoint is None else Path(checkpoint)
    with (
        closing(Points(config, plan, (), path, resume)) as journal,
        running(workers, scheduler) as runs,
    ):
        if journal.damage:
            warnings.warn(journal.damage, stacklevel=2)
        done = complete(config, plan, runs, journal, progress)
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
    runs: Any,
    journal: "Points",
    progress: Callable[[int, int], None] = lambda done, expected: None,
    stop: threading.Event | None = None,
) -> dict[int, Row]:
    """Simulate all points that are not in the `journal`, and return the records by number.

    `runs`: where to simulate them (`cluster.running`); `stop`: event after which no further point
    begins."""
    runs, stop = InProcess() if runs is HERE else runs, stop or threading.Event()
    missing = [number for number in range(plan.count) if number not in journal.rows]
    size = runs.share(len(missing)) or 1
    begins = takewhile(lambda _: not stop.is_set(), range(0, len(missing), size))
    chunks = ([(n, plan.at(n)) for n in missing[begin : begin + size]] for begin in begins)
    progress(len(journal.rows), plan.count)
    with suppress(ClosedError):  # Stopped: workers may take long to end their chunks.
        for _, some in as_done(lambda one: runs.simulated(config, one, stop), chunks, runs.slots):
            journal.add(some)
            progress(len(journal.rows), plan.count)
    return journal.rows


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
