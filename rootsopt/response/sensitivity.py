"""First-order sensitivities of a steady motion to the quantities of its scene.

A quantity is a number of the config, such as the load torque. The rotor pair depends on each
quantity, and the forces depend on the pair. The derivatives of the forces come from the orbit, by
the same compiled program as the derivatives with respect to the design.
"""

import dataclasses
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
from numpy.typing import NDArray

from rootsopt.config import Config
from rootsopt.dynamics.maxima import local_maxima
from rootsopt.dynamics.pair import RotorPair
from rootsopt.dynamics.steady import Steady, varied
from rootsopt.response.evaluation import Evaluation, Evaluator
from rootsopt.response.starts import Seed, Seeds, begun
from rootsopt.runtime.programs import CachedFunction
from rootsopt.scene import Scene, along
from rootsopt.status import Status

# Relative step of the difference quotients that approximate the derivatives of the scene with
# respect to a quantity. Their error is small, since the scene depends almost linearly on its
# quantities.
_STEP = 1e-6
MICROMETRE = 1e-3
"""One micrometre (mm): change of clearance, backlash and centre distance error for which the table
states the effect."""
_PERCENT = 0.01


class Quantity(NamedTuple):
    """A quantity of a scene on which the contact forces depend.

    `key`: dotted config key; `name`: description in words; `unit` of `value` and `step`; `value`:
    number in the config; `step`: change for which the table states the effect.
    """

    key: str
    name: str
    unit: str
    value: float
    step: float


_LENGTHS = (
    ("contact.clearance_mm", "clearance of the flanks"),
    ("scene.timing_gear.backlash_mm", "backlash of the timing gear"),
    ("scene.center_distance_error_mm", "centre distance error"),
)
_OTHERS = (
    ("scene.speed_rpm", "speed", "rpm"),
    ("scene.load.torque_N_m", "load", "N m"),
    ("scene.load.pressure_difference_Pa", "pressure difference", "Pa"),
    ("scene.timing_gear.stiffness_N_m_per_rad", "stiffness of the timing gear", "N m/rad"),
    ("scene.timing_gear.damping_ratio", "damping ratio of the timing gear", ""),
    ("contact.stiffness_N_per_mm_e", "contact stiffness", "N/mm^e"),
    ("contact.max_damping_N_s_per_mm", "contact damping", "N s/mm"),
    ("rotor.density_kg_m3", "density", "kg/m^3"),
    ("rotor.length_mm", "rotor length", "mm"),
)


NAMES = {key: name for key, name, *_ in (*_LENGTHS, *_OTHERS)}
"""Names in words of these quantities, by config key."""


def quantities(config: Config) -> list[Quantity]:
    """Return the quantities that the sensitivity table lists for the scene of `config`.

    The table states the effect of a change by 1 µm for clearance, backlash and centre distance
    error. For all other quantities, the change is 1 %. Quantities of parts that the scene does not
    have are left out. So are quantities that are 0, except the first three."""
    found = []
    for key, name in _LENGTHS:
        value = config.value(key)
        if value is not None:
            found.append(Quantity(key, name, "mm", value, MICROMETRE))
    for key, name, unit in _OTHERS:
        value = config.value(key)
        if value:
            found.append(Quantity(key, name, unit, value, _PERCENT * value))
    return found


def direction(
    config: Config, scene: Scene, key: str, value: float
) -> tuple[Scene, NDArray[np.float64]]:
    """Return the derivatives of the scene's arrays and of the design (d,) with respect to a key.

    `key`: dotted config key of a number; `value`: this number in the `config`. The first result is
    a `Scene`, the second in config units."""
    size = _STEP * (abs(value) or 1.0)
    other = config.moved({key: value + size})
    if key.startswith("profile."):
        still = jax.tree.map(np.zeros_like, eqx.filter(scene, eqx.is_inexact_array))
        return still, (other.design - config.design) / size

    def change(before, after):
        return (np.asarray(after, np.float64) - np.asarray(before, np.float64)) / size

    # Outline and solver stay the same, so that their derivatives are 0.
    arrays = (eqx.filter(scene.renewed(one), eqx.is_inexact_array) for one in (config, other))
    return jax.tree.map(change, *arrays), np.zeros(len(config.design))


@CachedFunction
def along_values(scene: Scene, design, directions: Scene, turns):
    """Return the rotor pair of a design, and its derivatives along several directions.

    `directions`, `turns` (n, d): results of `direction`, stacked along a leading axis."""
    arrays, rest = eqx.partition(scene, eqx.is_inexact_array)

    def build(values):
        return eqx.combine(values[0], rest).pair_and_shape(values[1])

    return along(build, (arrays, design), (directions, turns))[:2]


def motions_along(
    evaluator: Evaluator,
    design: NDArray[np.float64],
    directions: Sequence[tuple[Scene, NDArray[np.float64]]],
    start: Seeds = None,
) -> Iterator[tuple[int, RotorPair, RotorPair, Steady]]:
    """Yield the steady motion of a `design` (d,) in config units, with its derivatives along some
    of the `directions` at a time, as (number of these, pair, its derivatives, motion).

    `directions`: results of `direction`; `start`: where the first search begins. There are as many
    directions at a time as design parameters, to reuse the compiled programs; the last ones may be
    padded."""
    size, longest = max(1, len(design)), evaluator.scene.solver.max_orbit
    for begin in range(0, len(directions), size):
        some = directions[begin : begin + size]
        blank = [jax.tree.map(np.zeros_like, some[0])] * (size - len(some))
        stacked = jax.tree.map(lambda *x: np.stack(x), *some, *blank)
        pair, tangents = along_values(evaluator.scene, design, *stacked)
        found = evaluator.motion(pair, tangents, begun(pair, start, longest))
        yield len(some), pair, tangents, found
        if begin + size < len(directions):
            start = Seed.of(found, pair)


def by_scene(evaluator: Evaluator, evaluation: Evaluation) -> Evaluation | None:
    """Return `evaluation` with gradients with respect to the quantities of the scene.

    They replace the gradients with respect to the design: in `gradient` (N per config unit, keyed
    by config key), and in `maxima`. The result is None if the steady motion from the evaluation's
    start is not periodic, or does not have the same number of maxima."""
    config, measures = evaluator.config, evaluator.scene.solver.measures
    design = np.array(list(evaluation.design.values()))
    wanted = quantities(config)
    directions = [direction(config, evaluator.scene, one.key, one.value) for one in wanted]
    gradient: dict[str, dict[str, float]] = {}
    slopes, maxima, done = [], evaluation.maxima, 0
    for count, pair, tangents, found in motions_along(
        evaluator, design, directions, evaluation.start
    ):
        if Status.of(found.status) is not Status.PERIODIC:
            return None
        rows = np.column_stack([found.orbit.response, found.orbit.sensitivity])
        named = measures.named(rows, int(found.period))
        for name in evaluation.response.keys() & named.keys():
            slope = map(float, named[name][1][:count])
            row = gradient.setdefault(name, {})
            row |= {one.key: x for one, x in zip(wanted[done:], slope, strict=False)}
        done += count
        if maxima is not None:
            again = local_maxima(pair, tangents, varied(found))
            if again.times.shape != maxima.times.shape:
                return None
            slopes.append(again.slopes[:, :count])
    if maxima is not None:
        maxima = maxima._replace(slopes=np.concatenate(slopes, axis=1))
    return dataclasses.replace(evaluation, gradient=gradient, maxima=maxima)
