"""Evaluate a config over ranges of its keys, as labelled arrays."""

import itertools
import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import xarray

from rootsopt.config import Config
from rootsopt.response.choice import resolve
from rootsopt.response.evaluation import RESPONSES, Evaluation
from rootsopt.response.evaluators import evaluator_for
from rootsopt.scene import check_geometry

_LONG = {
    "mean_force_N": "mean contact force",
    "peak_force_N": "peak contact force",
    "rms_force_N": "RMS contact force",
}


def sweep_scenes(
    config: Config,
    axes: Mapping[str, Sequence[Any]],
    progress: Callable[[int, int], None] = lambda done, expected: None,
) -> xarray.Dataset:
    """Evaluate a `config` at every combination of the values of some of its keys.

    `axes`: dotted keys with their values, such as {"scene.speed_rpm": [1000, 2000]}. Each key is a
    dimension of the result, in the order given. `progress` is called with (points done, number of
    points).

    The result has these variables over the dimensions:

    - `mean_force_N`, `peak_force_N`, `rms_force_N` (N), and further responses that the config
      requests (NaN if not known);
    - `status`: labels;
    - `period` (mesh periods; 0 if not periodic);
    - `floquet_multiplier`: greatest modulus (NaN if there is no closed orbit);
    - `gradient_…` of each response per config unit, with the further dimension `design_key` (NaN
      without a gradient).

    Raises `InputError` for a key or value that a config cannot have, before anything is simulated.
    Raises ValueError if there are no axes, if an axis has no values, or if the design parameters
    differ between points.

    >>> rootsopt.sweep_scenes(config, {"scene.speed_rpm": [1000.0, 2000.0, 3000.0]}).mean_force_N
    """
    if not axes or not all(len(values) for values in axes.values()):
        raise ValueError(
            "Argument `axes` must name at least one key with at least one value each, but is "
            f"{dict(axes)!r}"
        )
    points = list(itertools.product(*axes.values()))
    configs = [config.replaced(dict(zip(axes, point, strict=True))) for point in points]
    for one in configs:
        check_geometry(one)
    keys = dict.fromkeys(one.design_keys for one in configs)
    if len(keys) > 1:
        raise ValueError(
            "Argument `axes` must leave the design parameters the same at every point, but gives "
            f"{' and '.join(map(str, keys))}; sweep one family at a time"
        )

    def at(one: Config) -> Evaluation:
        return evaluator_for(resolve(one)[0])(series=False)

    found: list[Evaluation] = []
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        for evaluation in pool.map(at, configs):
            found.append(evaluation)
            progress(len(found), len(configs))
    return _dataset(config, axes, found, next(iter(keys)))


def _dataset(config: Config, axes, found: Sequence[Evaluation], keys) -> xarray.Dataset:
    shape, dims = tuple(map(len, axes.values())), tuple(axes)

    def grid(values: list[Any], *last: int) -> np.ndarray:
        return np.array(values).reshape(*shape, *last)

    names = dict.fromkeys([*RESPONSES, *(name for one in found for name in one.response)])
    columns: dict[str, Any] = {}
    for name in names:
        attributes = {"units": _unit(name), "long_name": _LONG.get(name, name)}
        values = [one.response.get(name, np.nan) for one in found]
        columns[name] = dims, grid(values), attributes
        slopes = [[one.gradient.get(name, {}).get(key, np.nan) for key in keys] for one in found]
        if keys:
            long = f"derivative of the {_LONG.get(name, name)} per unit of a design parameter"
            columns[f"gradient_{name}"] = (
                (*dims, "design_key"),
                grid(slopes, len(keys)),
                {"units": f"{_unit(name)} per unit of the key", "long_name": long},
            )
    steady = [one.steady_state for one in found]
    columns["status"] = dims, grid([one.status.label for one in found]), {"long_name": "status"}
    periods = [one.steady_state.get("period", 0) if one.usable else 0 for one in found]
    columns["period"] = (
        dims,
        grid(periods),
        {"units": "mesh periods", "long_name": "period of the motion"},
    )
    columns["floquet_multiplier"] = (
        dims,
        grid([one.get("floquet_multiplier", np.nan) for one in steady]),
        {"units": "1", "long_name": "greatest modulus of the Floquet multipliers"},
    )
    coords: dict[str, Any] = {
        key: (key, list(values), {"units": _unit(key), "long_name": key})
        for key, values in axes.items()
    }
    if keys:
        coords["design_key"] = list(keys)
    return xarray.Dataset(columns, coords=coords, attrs={"config": config.to_yaml()})


def _unit(name: str) -> str:
    """Return the unit with which a key ends, or "1" if the key has no unit."""
    endings = {"_rpm": "rpm", "_mm": "mm", "_deg": "deg", "_N": "N", "_N_m": "N m", "_mrad": "mrad"}
    fits = [ending for ending in endings if name.endswith(ending)]
    return endings[max(fits, key=len)] if fits else "1"
