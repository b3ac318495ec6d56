"""Samples of the scattered values of scene and design (`tolerances` of a config).

The search of a robust optimum uses a fixed sample from a scrambled Sobol sequence. Its points cover
the distributions more evenly than random ones. Fresh samples are pseudo-random and independent, so
that statistics over them have the usual standard errors.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from rootsopt.config.reading import Config
from rootsopt.config.tolerances import Scatter, TolerancesConfig
from rootsopt.scene.build import Scene
from rootsopt.scene.space import sobol

NOMINAL, RANDOM = "as given", "random"
"""Names of the config's own scene, and of random ones before their number, in `assumed`."""
# Index of the random stream from which fresh samples are drawn.
_FRESH = 1


class Shift(NamedTuple):
    """One sample: how far scene and design are from their nominal values.

    `values`: sampled value of each key that scatters, in the key's unit; `scene`: change of the
    scene's arrays in SI units, as a `Scene` (None: no array scatters); `design` (d,): change of the
    design in config units."""

    values: dict[str, float]
    scene: Scene | None
    design: NDArray[np.float64]


def quantiles(scatter: Scatter, levels: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Return the values (n,) of a distribution below which it has the probabilities `levels` (n,).

    Values are in the unit of the key. The normal distribution is cut off at `scatter.half`."""
    middle = np.asarray(levels, np.float64) - 0.5
    if scatter.kind == "uniform":
        away = 2 * scatter.width * middle
    elif scatter.kind == "triangular":
        away = scatter.width * np.sign(middle) * (1 - np.sqrt(1 - 2 * np.abs(middle)))
    else:
        from scipy.special import ndtr, ndtri  # Slow import (0.1 s).

        inside = 2 * ndtr(scatter.half / scatter.width) - 1
        away = scatter.width * ndtri(0.5 + inside * middle)
    return scatter.nominal + np.clip(away, -scatter.half, scatter.half)


def draw(config: Config, count: int, fresh: bool = False) -> Float[np.ndarray, "n q"]:
    """Return `count` samples of the q keys that scatter, in the order of `config.scatters`.

    With `tolerances.conditions`, the samples are these conditions. `fresh`: whether the sample is
    pseudo-random and independent of the search's, instead of the fixed Sobol sample of the search.
    Both follow from `optimizer.seed` alone."""
    scatters, tolerances = config.scatters, config.tolerances
    seed = config.optimizer.seed
    assert tolerances is not None
    if tolerances.conditions:
        rows = [
            [values.get(one.key, one.nominal) for one in scatters]
            for values in tolerances.conditions.values()
        ]
        return np.array(rows, float).reshape(len(rows), len(scatters))
    if fresh:
        levels = np.random.default_rng([seed, _FRESH]).random((count, len(scatters)))
    else:
        levels = sobol(count, seed, len(scatters))
    columns = [quantiles(one, levels[:, k]) for k, one in enumerate(scatters)]
    return np.stack(columns, axis=1)


def shifts(config: Config, samples: Float[np.ndarray, "n q"]) -> tuple[Shift, ...]:
    """Return the n samples (n, q) of `draw` as changes of scene and design."""
    keys = [one.key for one in config.scatters]
    here = Scene.from_config(config)
    changes = []
    for row in np.asarray(samples):
        values = dict(zip(keys, map(float, row), strict=True))
        of_scene = {key: x for key, x in values.items() if not key.startswith("profile.")}
        scene = _difference(here, here.renewed(config.moved(of_scene))) if of_scene else None
        changes.append(Shift(values, scene, config.moved(values).design - config.design))
    return tuple(changes)


def assumed(config: Config) -> dict[str, dict[str, float]]:
    """Return the scenes of a config's `assumptions`: their values by dotted key, by name.

    They are the scene of the config (`as given`), both ends of each range alone, and the random
    ones, a scrambled Sobol sample. Empty if nothing varies."""
    spans = config.spans
    if not spans:
        return {}
    ends = {scene_of(one.key, end): {one.key: end} for one in spans for end in one.ends}
    keys, low, high = zip(*spans, strict=True)
    levels = sobol(config.assumptions.scenes, config.optimizer.seed, len(spans))
    rows = np.array(low) + levels * (np.array(high) - np.array(low))
    drawn = {
        f"{RANDOM} {number}": dict(zip(keys, row.tolist(), strict=True))
        for number, row in enumerate(rows, start=1)
    }
    return {NOMINAL: {}, **ends, **drawn}


def scene_of(key: str, value: float) -> str:
    """Return the name of the scene in which only one value differs from the config's."""
    return f"{key}={value:.6g}"


def in_conditions(config: Config, scenes: Mapping[str, Mapping[str, float]], **rule: Any) -> Config:
    """Return a config with `scenes` (values by key, by name) as its `tolerances.conditions`.

    `rule`: further entries of `tolerances`. They are not checked."""
    given = {"conditions": scenes, "samples": len(scenes), "check_samples": 0, **rule}
    return config.model_copy(update={"tolerances": TolerancesConfig.model_construct(**given)})


def _difference(before: Scene, after: Scene) -> Scene:
    """Return the change of a scene's arrays, as a `Scene` with None in all other fields."""

    def change(x: Any, y: Any) -> Any:
        difference = np.asarray(x) - np.asarray(y)
        return difference if difference.any() else None

    return jax.tree.map(change, *(eqx.filter(x, eqx.is_inexact_array) for x in (after, before)))
