"""Evaluates designs without simulating a motion, for quantities that do not depend on forces.

No equation of motion is compiled: geometry, flow, leakage, play and static loads follow from the
profile alone."""

import dataclasses
import time
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rootsopt.config.reading import Config
from rootsopt.profiles import Geometry, geometry
from rootsopt.profiles.soundness import Soundness
from rootsopt.response.evaluation import Evaluator, Motions
from rootsopt.response.records import geometry_record, message_of
from rootsopt.response.result import Evaluation
from rootsopt.response.terms import depends_on_forces, objective_weights, terms_of, values_of
from rootsopt.runtime.programs import CachedFunction
from rootsopt.scene.build import Scene
from rootsopt.scene.families import fault_of
from rootsopt.status import Status


@dataclasses.dataclass(frozen=True)
class Still(Motions):
    """Evaluates the objective's further terms from the geometry alone, without a motion."""

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
    evaluator = Evaluator.of_objective(config)
    names = {*objective_weights(config), *config.objective.terms, *config.constraints.terms}
    if any(depends_on_forces(config, evaluator.scene, name, "objective.terms") for name in names):
        return evaluator
    return dataclasses.replace(evaluator, motions=Still())
