"""What objective, trade-offs and limits can name, and evaluations without a motion for all of it
that does not depend on forces.

No equation of motion is compiled: geometry, flow, leakage, play and static loads follow from the
profile alone."""

import dataclasses
import re
import time
from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rootsopt.config import Config
from rootsopt.dynamics.measures import PEAK_NORM, line_name
from rootsopt.errors import InputError
from rootsopt.profiles import Geometry, geometry
from rootsopt.profiles.geometry import Soundness
from rootsopt.response.evaluation import Evaluation, Evaluator, Motions, objective_weights
from rootsopt.response.records import RESPONSES, geometry_record, message_of
from rootsopt.response.terms import needs_forces, terms_of, values_of
from rootsopt.runtime.programs import CachedFunction
from rootsopt.scene import Scene, fault_of
from rootsopt.status import Status

_LINE = re.compile(r"line_(\d+(?:\.\d+)?)_force_N")


def is_force(config: Config, name: str, key: str) -> bool:
    """Return whether `name` is a measure of the force; otherwise, it can only be a registered term.

    `key`: config key that holds the name, for the message. Raises `InputError` for a measure that
    cannot exist."""
    if name == PEAK_NORM and config.objective.peak_norm is None:
        raise InputError(
            f"`{key}` names {PEAK_NORM}, which needs `objective.peak_norm`; set it, or name "
            "peak_force_N"
        )
    found = _LINE.fullmatch(name)
    if found is None:
        return name in RESPONSES or name == PEAK_NORM
    order = float(found[1])
    if not 1e-2 <= order <= 1e3 or line_name(order) != name:
        raise InputError(
            f"`{key}` must name a line as line_ORDER_force_N with an order from 0.01 to "
            f"1000, as in line_2_force_N, but names {name}"
        )
    return True


def depends_on_forces(config: Config, scene: Scene, name: str, key: str) -> bool:
    """Return whether the quantity `name` is a force, or a term that reads forces.

    `key`: config key that holds the name. Raises `InputError` if no quantity has this name."""
    if is_force(config, name, key):
        return True
    (term,) = terms_of([name], key)
    return needs_forces(scene, term, jnp.asarray(np.asarray(config.design, np.float64)))


def reporting(config: Config, names: Sequence[str], key: str) -> Config:
    """Return a copy of a `config` whose evaluations report all quantities in `names`.

    `key`: config key that holds the names."""
    lines = [*config.response.lines]
    terms = dict(config.objective.terms)
    for name in names:
        forced = is_force(config, name, key)
        if found := _LINE.fullmatch(name):
            order = float(found[1])
            lines += [order] * (order not in lines)
        elif not forced:
            terms.setdefault(name, 0.0)
    response = config.response.model_copy(update={"lines": tuple(lines)})
    objective = config.objective.model_copy(update={"terms": terms})
    return config.model_copy(update={"response": response, "objective": objective})


@dataclasses.dataclass(frozen=True)
class Still(Motions):
    """No motion counts. The response of an evaluation has the further terms of the objective."""

    def evaluated(self, evaluator: Evaluator, design: Any, start: Any, series: bool) -> Evaluation:
        """Evaluate a `design` (d,) in config units; the other arguments have no effect."""
        began, scene, keys = time.perf_counter(), evaluator.scene, evaluator.keys
        names = tuple(evaluator.config.objective.terms)
        values, rows = map(np.asarray, values_of(scene, terms_of(names), *_arguments(design)))
        shape, margins = _shape(scene, design)
        # A search keeps margins of the profile above 0 by its constraints, to within rounding.
        sound = bool(np.all(np.isfinite(values)) and np.all(np.isfinite(rows)))
        status = Status.GEOMETRY_ONLY if sound else Status.UNSOUND
        slopes = zip(names, rows, strict=True)
        return Evaluation(
            design=dict(zip(keys, np.asarray(design).tolist(), strict=True)),
            geometry=geometry_record(scene, shape),
            response=dict(zip(names, values.tolist(), strict=True)) if sound else {},
            gradient={name: dict(zip(keys, row.tolist(), strict=True)) for name, row in slopes},
            steady_state={},
            status=status,
            message=message_of(evaluator.config, status)
            + ("" if sound else f" Here, {fault_of(margins)}."),
            statistics={"seconds": time.perf_counter() - began},
            series=None,
        )

    def prepare(self, evaluator: Evaluator, design: Any, series: bool, maxima: bool) -> None:
        """Compile the programs in the background."""
        names = tuple(evaluator.config.objective.terms)
        values_of.prepare(evaluator.scene, terms_of(names), *_arguments(design))
        _shape.prepare(evaluator.scene, design)


def _arguments(design: Any) -> tuple[Any, Any, Any]:
    return jnp.asarray(design), np.zeros(3), np.zeros((3, len(design)))


@CachedFunction
def _shape(scene: Scene, design: Float[Array, " d"]) -> tuple[Geometry, Soundness]:
    profile = scene.profile(design)
    return geometry(profile), scene.soundness(profile)


def needed_motion(config: Config) -> Evaluator:
    """Return the evaluator of a config's objective, without a motion if nothing depends on forces.

    These are the objective and the limits of `constraints.terms`. Raises `InputError` as
    `Evaluator.of` does."""
    found = Evaluator.of_objective(config)
    names = {*objective_weights(config), *config.objective.terms, *config.constraints.terms}
    if any(depends_on_forces(config, found.scene, name, "objective.terms") for name in names):
        return found
    return dataclasses.replace(found, motions=Still())
